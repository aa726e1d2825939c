"""Sessions of earlier versions remain readable: the files of tests/data/sessions give the same observations as before."""

import csv
from pathlib import Path

import numpy as np
import pytest

from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import read_table
from truearm.session.session_file import open_session
from truearm.workflows.recorded_session import observations_of_session, open_finished
from truearm.workflows.requests import ExportSession
from truearm.workflows.session_files import export_session_files

SESSIONS = Path(__file__).parents[1] / "data" / "sessions"
# dwells and passes that gave observations, and readings of the robot, all of which count
KNOWN = {"ball-bar": (3, 0, 476), "line": (0, 2, 489), "rtde": (1, 0, 518)}
# Sums may be in another order with other versions of NumPy and on other processors: some 1e4 roundings of 1e-16 of the
# largest value of a column. A velocity near zero is a difference of such values.
RTOL = 1e-12


def columns_of(path):
    """Columns by their titles; numbers as floats, words as they are."""
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    return {
        title: np.array(column, float) if title.rpartition("_")[2] in ("m", "rad", "s") else np.array(column)
        for title, column in zip(header, zip(*rows, strict=True), strict=True)
    }


@pytest.mark.parametrize("name", KNOWN)
class TestOldSessions:
    def test_observations_are_the_same(self, name, tmp_path):
        export_session_files(ExportSession(SESSIONS / f"{name}.mcap", tmp_path / "tables"))
        found = columns_of(tmp_path / "tables" / "observations.csv")
        for title, expected in columns_of(SESSIONS / f"{name}.csv").items():  # later versions say more, and the same
            if expected.dtype == float:
                np.testing.assert_allclose(
                    found[title], expected, rtol=0, atol=RTOL * np.abs(expected).max(), err_msg=title
                )
            else:
                assert found[title].tolist() == expected.tolist(), title

    def test_everything_was_read(self, name):
        result = observations_of_session(open_finished(SESSIONS / f"{name}.mcap"))
        dwells, passes, readings = KNOWN[name]
        assert sum(not dwell.reason for dwell in result.dwells) == dwells
        assert sum(not one.reason for one in result.passes) == passes
        joints = result.survey.joints
        assert (joints.readings, joints.lost, joints.malformed, joints.restarts) == (readings, 0, 0, 0)
        assert (result.survey.losses.frames_lost, result.survey.losses.samples_lost) == (0, 0)


@pytest.mark.parametrize("name", KNOWN)
def test_they_are_known_as_simulated(name, tmp_path):
    """By the uid of the simulated box: also in a selection, beside rows without a mark, and as an exported table."""
    export_session_files(ExportSession(SESSIONS / f"{name}.mcap", tmp_path / "tables"))
    exported = read_table(tmp_path / "tables" / "observations.csv")
    for table in (observations_of_session(open_finished(SESSIONS / f"{name}.mcap")).table, exported):
        assert table.simulated
        first = table.select(slice(0, 1))
        unmarked = first.replace(simulated=None)
        assert not unmarked.simulated
        assert ObservationTable.joined([unmarked, first]).simulated


def test_events_of_the_operator():
    events = [message.data for message in open_session(SESSIONS / "rtde.mcap").messages("/events")]
    assert b'{"kind":"note","text":"the table was knocked"}' in events
    assert sum(b'"kind":"mounted"' in event for event in events) == 2
