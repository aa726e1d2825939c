"""A session that was interrupted and recorded in parts is one session."""

import numpy as np
import pytest
from tests.end_to_end.conftest import lab_with, record_session, recorded_with_plan

from truearm.model.robot_file import builtin_robot
from truearm.record.session_writer import SessionWriter
from truearm.session.session_file import open_session
from truearm.workflows.inputs import Sources, read_sources
from truearm.workflows.recorded_session import SETUP, observations_of_session, open_finished, session_parts, with_parts
from truearm_sim.world import World, standard_plan

CHAIN = builtin_robot("puma560").chain


@pytest.fixture(scope="module")
def in_parts(tmp_path_factory):
    """One robot's program, recorded as a whole and, by a recorder that was stopped in between, in two parts."""
    folder = tmp_path_factory.mktemp("parts")
    whole = record_session(folder / "whole.mcap", 18, osr=16384)
    first = folder / "s.mcap"
    with lab_with(World(1, standard_plan(18, 1))) as lab:
        for path, setup, seconds in ((first, {}, 60.0), (folder / "s.2.mcap", {"of": "s.mcap", "part": "2"}, None)):
            summary = recorded_with_plan(lab, path, osr=16384, duration_s=seconds, head=[(SETUP, setup)])
            assert summary.reason == ("duration" if seconds else "robot closed")
            for _ in range(40):
                lab.box_link.read(0.1)  # the break: four seconds
    return whole.path, first


def test_parts_are_one_session(in_parts):
    """All dwells of both parts, of which the break cost one or two; their lengths are those of the whole recording to its noise."""
    whole, first = in_parts
    assert [path.name for path in session_parts(first)] == ["s.mcap", "s.2.mcap"]
    reference = observations_of_session(open_finished(whole)).table
    _, table, *_ = read_sources(Sources(tuple(with_parts([first]))), CHAIN)
    assert len(reference) - 3 <= len(table) < len(reference)
    assert {str(source).split(" ")[0].split(":")[0] for source in table.source} >= {"s.mcap", "s.2.mcap"}
    apart = np.max(np.abs(table.q[:, None, :] - reference.q[None, :, :]), axis=2)
    same = np.argmin(apart, axis=1)
    assert np.all(apart[np.arange(len(table)), same] < 1e-3)
    assert np.array_equal(table.bar, reference.bar[same])
    # the same dwells of the same world: they differ by the samples that are used, each mean good to a micron or so
    assert np.max(np.abs(table.value - reference.value[same])) < 2e-5


def test_an_empty_part_is_no_fault(in_parts, tmp_path):
    """Stopped before the first dwell: the other parts count."""
    _, first = in_parts
    for path in session_parts(first):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    short = tmp_path / "s.3.mcap"
    session = open_session(first)
    with SessionWriter(short, _Clock(session)) as writer:
        writer.metadata(SETUP, {"of": "s.mcap", "part": "3"})
        writer.attach("rig.toml", session.attachments["rig.toml"])
    _, two, *_ = read_sources(Sources(tuple(with_parts([first]))), CHAIN)
    _, three, *_ = read_sources(Sources(tuple(with_parts([tmp_path / "s.mcap"]))), CHAIN)
    assert len(with_parts([tmp_path / "s.mcap"])) == 3
    assert np.array_equal(two.value, three.value)


class _Clock:
    kind = "virtual"

    def __init__(self, session):
        self._now = int(session.metadata["session-end"]["monotonic_ns"])

    def now_ns(self):
        return self._now

    def utc_anchor(self):
        return self._now, self._now
