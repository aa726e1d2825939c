"""A robot whose readings wait to be stored when the recording ends."""

import json

import pytest
from record_box import HOST_0, SECOND, Box, Robot, Wire
from record_files import run, topics

from truearm.record.links import Backlog


class Backlogged(Wire):
    """A link whose reader holds what has arrived: few pieces are taken at a time."""

    @property
    def backlog(self):
        return Backlog(len(self.arrived))

    def read(self, timeout_s):
        arrived = super().read(timeout_s)
        self.arrived = arrived[10:]
        return arrived[:10]


@pytest.mark.parametrize("mute", [False, True])
@pytest.mark.parametrize("ending", ["duration", "interrupted"])
def test_what_was_received_before_the_end_is_stored(lab, path, ending, mute):
    """Readings that came at once, as after a laptop woke, were dropped; also if the box does not answer any more."""
    robot, box = Robot(lab, 100.0, link=Backlogged), Box(lab)
    end_ns = HOST_0 + 2 * SECOND
    burst = [json.dumps({"t": 200 + k, "seq": 1000 + k, "q": [0.0] * 6}).encode() for k in range(5000)]

    def wake():
        for line in burst:
            robot.say(line)
        if mute:
            box.link.on_write = lambda data: None

    lab.at(end_ns, wake)
    how = {"seconds": 2.0} if ending == "duration" else {"seconds": None, "interrupted": lambda: lab.now >= end_ns}
    summary = run(lab, box, path, robot=robot.link, **how)
    assert summary.reason == ending
    assert bool(summary.box_gone) == mute
    assert summary.counters.robot_unstored == 0
    stored = [m.data for m in topics(path)["/robot/joints"]]
    assert stored == robot.sent[: len(stored)]
    assert stored[-1] not in burst
    assert set(burst) <= set(stored)
