"""A session while bar and sensor warm up, from the simulated box to lengths: corrected with thermometers, warned of without."""

from dataclasses import replace

import numpy as np
import pytest
from tests.end_to_end.levels import LEVELS, wait_until_ready
from tests.end_to_end.test_identify_levels import one_shell

from truearm.files.rig_file import format_rig
from truearm.record.recorder import RecordOptions, record
from truearm.record.session_writer import SessionWriter
from truearm.session.session_tables import tabulate
from truearm.workflows.record import plan_rows
from truearm.workflows.session_observations import SessionOptions, observations_of_session
from truearm_sim.lab import Lab
from truearm_sim.simbox import SimulatedBox
from truearm_sim.thermal import STEEL, Thermal
from truearm_sim.world import Setup, World, standard_plan

OSR = 16384
GAIN_DRIFT = 1e-4
SIGMA = 1e-6  # m, repeatability of this bar: a usual one's would hide what 2 K do
POSES = 14


def session(path, thermal, level="vm"):
    """The lab, and its session, of a robot that visits POSES poses; the rig knows the bar's coefficients."""
    rig = one_shell()
    bars = {
        name: replace(
            bar, sigma=SIGMA, expansion=STEEL, expansion_sigma=1e-6, gain_drift=GAIN_DRIFT, gain_drift_sigma=2e-5
        )
        for name, bar in rig.bars.items()
    }
    rig = replace(rig, bars=bars)
    plan = standard_plan(POSES, 3, rig)
    world = World(3, plan, rig, setup=Setup(thermal=thermal))
    box = SimulatedBox(world, seed=3, power_on=LEVELS[level]())
    lab = Lab(world, box, 3)
    try:
        wait_until_ready(lab)
        options = RecordOptions(plan=plan_rows(plan), rig_toml=format_rig(rig).encode(), osr=OSR)
        record(
            lab.box_link,
            SessionWriter(path, lab.clock, overwrite=True),
            lab.clock,
            robot=lab.robot_link,
            options=options,
        )
    finally:
        box.close()
    return world, rig


def left(world, rig, result):
    """(2, n) [m] how far the lengths are from the true ones of that dwell: as measured, and with the temperatures of the table."""
    (bar,) = rig.bars.values()
    table = result.table
    used = [i for i, dwell in enumerate(result.dwells) if not dwell.reason]
    truth = world.truth.length[[result.dwells[i].pose for i in used]]
    extension = (table.value - bar.zero) / bar.gain
    warm, hot = table.more["bar_temperature"] - 20.0, table.more["sensor_temperature"] - 20.0
    corrected = bar.zero * (1.0 + STEEL * warm) + bar.gain * (1.0 + GAIN_DRIFT * hot) * extension
    return np.stack([table.value, corrected]) - truth


@pytest.fixture(scope="module")
def warm(tmp_path_factory):
    path = tmp_path_factory.mktemp("warm") / "session.mcap"
    world, rig = session(path, Thermal(drift=2.0, ahead=3.0, gain_drift=GAIN_DRIFT))
    said = []
    return world, rig, observations_of_session(path, options=SessionOptions(say=said.append)), said


def test_two_kelvins_of_a_steel_bar_are_corrected_to_the_noise(warm):
    world, rig, result, said = warm
    assert len(result.table) >= POSES - 1
    measured, corrected = left(world, rig, result)
    assert np.ptp(measured) > 10e-6, "0.46 m · 11.5 ppm/K · 2 K, and the sensor's part"
    # a step of 62.5 mK is half up or down 0.28 µm, a reading is of a moment 1 s off in a session of 47 s: 0.4 µm; noise of a mean: 0.1 µm
    assert np.abs(corrected).max() < 0.8e-6
    assert np.all(np.abs(corrected) < result.table.sigma)
    assert said == [], "nothing to warn of"


def test_tables_hold_every_reading_with_its_name_and_time(warm):
    _, _, result, _ = warm
    rows = [columns for name, columns in tabulate(result.survey) if name == "box_temperature"]
    names = np.concatenate([columns["name"] for columns in rows])
    degc = np.concatenate([columns["temperature_mdegc"] for columns in rows]) * 1e-3
    assert set(names) == {"bar", "sensor"}
    assert np.all(np.diff(degc[names == "bar"]) >= 0.0)
    assert 1.5 < np.ptp(degc[names == "bar"]) <= 2.0
    np.testing.assert_allclose(degc[names == "sensor"] - degc[names == "bar"], 3.0, atol=1e-9)


def test_without_a_thermometer_a_session_far_from_the_calibration_is_warned_of_with_the_size(tmp_path):
    session(tmp_path / "session.mcap", Thermal(begin=24.0, drift=0.0, ahead=1.0, thermometers=()))
    said = []
    result = observations_of_session(tmp_path / "session.mcap", options=SessionOptions(say=said.append))
    assert "bar_temperature" not in result.table.more
    (text,) = said
    assert "5.0 °C warmer than when lvdt was calibrated" in text
    # 5 K · (11.5 ppm/K · 460 mm + 100 ppm/K · 37.5 mm)
    assert "may be off by 0.045 mm" in text
