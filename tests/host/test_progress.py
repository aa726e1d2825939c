"""Steps of long computations, and how a terminal shows them."""

import io
import re
import shutil
from contextlib import contextmanager
from pathlib import Path

import pytest
from rich.console import Console

from truearm.cli import progress_line
from truearm.cli.main import main
from truearm.cli.progress_line import Shown
from truearm.progress import listening, step, steps_of

SESSION = Path(__file__).parents[1] / "data" / "sessions" / "ball-bar.mcap"


class Heard(list):
    """A listener that records its calls."""

    @contextmanager
    def __call__(self, what):
        self.append(what)
        try:
            yield self.append
        finally:
            self.append("end")


def test_listeners_hear_of_steps_shares_and_failures():
    with step("fitting") as advance:
        advance(0.5)
    assert list(steps_of("ab", "reading")) == ["a", "b"]
    heard = Heard()
    with listening(heard), step("outer"):
        assert list(steps_of([1, 2, 3, 4], "inner")) == [1, 2, 3, 4]
    assert heard == ["outer", "inner", 0.0, 0.25, 0.5, 0.75, "end", "end"]
    assert list(steps_of([1], "nobody hears this")) == [1]
    assert len(heard) == 8
    heard = Heard()
    with pytest.raises(ZeroDivisionError), listening(heard), step("dividing"):
        _ = 1 // 0
    assert heard == ["dividing", "end"]


def drawn(stream, quiet_s, monkeypatch):
    """Return what is drawn of a step within another one, half of which is done."""
    monkeypatch.setattr(progress_line, "QUIET_S", quiet_s)
    listener = Shown(Console(file=stream, force_terminal=True, width=100))
    with listening(listener.running), step("planning\x1b[2J [bold]a"), step("choosing poses") as advance:
        advance(0.5)
        listener.refresh()
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", stream.getvalue())


def test_long_steps_are_shown_with_their_shares_and_cleared(monkeypatch):
    stream = io.StringIO()
    rows = [row for row in re.split(r"[\r\n]+", drawn(stream, -1.0, monkeypatch)) if row]
    assert re.match(r"planning\\x1b\[2J \[bold\]a +0:00:0\d", rows[0])
    assert re.match(r"choosing poses +50% 0:00:0\d", rows[-1])
    assert "\x1b[?25h" in stream.getvalue()[-8:]  # the cursor is shown again


def test_short_steps_are_not_shown(monkeypatch):
    assert drawn(io.StringIO(), 60.0, monkeypatch).strip() == ""


def test_a_terminal_that_goes_away_stops_nothing():
    class Gone(io.StringIO):
        def write(self, text):
            raise OSError

    with listening(Shown(Console(file=Gone(), force_terminal=True)).running), step("working"):
        pass


class Depth:
    """A listener that records how many steps were open when each began."""

    def __init__(self):
        self.open, self.begun = 0, []

    @contextmanager
    def __call__(self, what):
        self.begun.append((self.open, what))
        self.open += 1
        try:
            yield lambda share: None
        finally:
            self.open -= 1


@pytest.fixture(scope="module")
def session_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("session")
    shutil.copy(SESSION, folder / "s.mcap")
    assert main(["identify", str(folder / "s.mcap"), "--model", "puma560", "--out", str(folder / "r.json")]) in (0, 3)
    return folder


@pytest.mark.parametrize(
    ("command", "first"),
    [
        ("identify s.mcap --model puma560 --report r.html", "identifying"),
        ("report r.json s.mcap --out c.html", "repeating the identification"),
        ("validate r.json s.mcap", "validating"),
        ("inspect s.mcap", "inspecting the session"),
        ("session relabel s.mcap --trust plan", "examining the session"),
        ("session relabel s.mcap --trust evidence --model puma560", "examining the session"),
        ("session export s.mcap --out tables", "exporting the session"),
        ("export r.json --format dh-hayati --allow-unusable --out dh.toml", "exporting the robot"),
        ("map r.json --allow-unusable --out map.csv", "mapping the errors"),
    ],
)
def test_no_long_work_lies_outside_a_step(session_folder, monkeypatch, command, first, tmp_path):
    """Short steps one after the other lie within one that lasts: a terminal is never silent for long."""
    shutil.copytree(session_folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    heard = Depth()
    with listening(heard):
        assert main(command.split()) in (0, 3)
    assert heard.open == 0
    assert next(what for depth, what in heard.begun if depth == 0) == first
