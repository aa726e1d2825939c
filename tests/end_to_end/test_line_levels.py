"""A line driven past the line device, at every level: sample by sample the world's, each when it says it was.

Box and chip begin to sample at other moments, and a magnet in motion is elsewhere then: of each level the world of the other
has to tell every sample.
"""

import functools

import numpy as np
import pytest
from tests.end_to_end.levels import LEVELS, lab_of, record_lab, samples

from truearm.session.box_ident import find_channel
from truearm_sim import sensors
from truearm_sim.line_plan import drawn_line_plan, line_rig
from truearm_sim.world import Setup, World

ADC_PERIOD_NS = 983_040
SECONDS = (
    3.4  # from 4 s on: the magnet rests, moves along half a metre from 4.5 to 6.35 s, rests, and is on its way back
)
SPEED = 0.4  # m/s
ALONG, ACROSS = "magnetostrictive", ("transverse_a", "transverse_b")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return sessions by level, each recorded once."""

    @functools.cache
    def recorded(level):
        world = World(6, drawn_line_plan(1, 1, speed=SPEED), line_rig(), setup=Setup(lost_stops=0.01))
        with lab_of(level, seed=6, world=world) as lab:
            return record_lab(lab, tmp_path_factory.mktemp("line") / f"{level}.mcap", SECONDS)

    return recorded


@pytest.fixture(params=LEVELS)
def session(request, recorded):
    return recorded(request.param)


@pytest.fixture
def others(request, session, recorded):
    """Return the worlds of the other levels."""
    return [other.world for level in LEVELS if (other := recorded(level)) is not session]


def rests(session, stream, n):
    """Whether the robot stood at each of the first n samples of a stream and three milliseconds about, more than the group delay."""
    robot = session.world.controller
    _, stamps, _ = samples(session.blocks(stream), (4, 1)[stream])
    t = session.box.true_s(stamps[:n])
    same = robot.stop_index(t - 3e-3) == robot.stop_index(t + 3e-3)
    return same & robot.is_settled(t - 3e-3) & robot.is_settled(t + 3e-3)


def lateness(shown, stamps, session, where, said_ns):
    """How much longer than the delay that was said before its stamp [s] the magnet was where each channel (n, c) shows it.

    By least squares over all samples of a drive: from one drive to the next the magnet's error in its guide is another at once.
    """
    t, robot = session.box.true_s(stamps) - 1e-9 * said_ns, session.world.controller
    at, rate = where(t), (where(t + 1e-4) - where(t - 1e-4)) / 2e-4
    one_drive = robot.stop_index(t - 3e-3) == robot.stop_index(t + 3e-3)
    good = one_drive & np.isfinite(rate).all(axis=1) & np.isfinite(shown).all(axis=1)
    return -float(((shown - at) * rate)[good].sum() / np.square(rate[good]).sum())


def test_a_position_belongs_to_its_interrogation_and_a_voltage_to_its_group_delay_before(session):
    """To 5 µs, which are 2 µm along and 10 nm across: what the ident says of delays is what the samples have."""
    ident, world = session.ident(), session.world
    stream, column = find_channel(ident, ALONG)
    ticks, stamps, _ = samples(session.blocks(1), 1)
    seconds = np.where(ticks > 0, ticks, np.nan) * stream.channels[column].scale
    poly = stream.channels[column].poly
    along = poly[0] + poly[1] * seconds
    assert stream.group_delay_ns == 0
    assert abs(lateness(along, stamps, session, lambda t: world.magnet_position(t)[:, None], 0)) < 5e-6

    counts, stamps, _ = samples(session.blocks(0), 4)
    places = [find_channel(ident, name) for name in ACROSS]
    channels = [stream.channels[column] for stream, column in places]
    volts = [counts[:, column] * stream.channels[column].scale for stream, column in places]
    aside = np.stack([c.poly[0] + c.poly[1] * v for c, v in zip(channels, volts, strict=True)], axis=1)
    delay_ns = places[0][0].group_delay_ns
    assert delay_ns == sensors.group_delay_ns(ADC_PERIOD_NS // sensors.MODULATOR_NS) > 700_000
    assert abs(lateness(aside, stamps, session, world.transverse, delay_ns)) < 5e-6
