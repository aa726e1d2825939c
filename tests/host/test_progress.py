"""Steps of long computations, and how a terminal shows them."""

import io
import re
import shutil
from pathlib import Path

import pytest

from truearm.cli import progress_line as shown
from truearm.cli.main import main
from truearm.progress import listening, part_of, step, steps_of

SESSION = Path(__file__).parents[1] / "data" / "sessions" / "ball-bar.mcap"


class Heard(list):
    """A listener that records its calls."""

    def begin(self, what):
        self.append(what)
        return self

    def advance(self, share):
        self.append(share)

    def end(self):
        self.append("end")


def test_nobody_listens():
    with step("fitting") as advance:
        advance(0.5)
    assert list(steps_of("ab", "reading")) == ["a", "b"]


def test_a_listener_hears_of_steps_and_shares():
    heard = Heard()
    with listening(heard), step("outer"):
        assert list(steps_of([1, 2, 3, 4], "inner")) == [1, 2, 3, 4]
    assert heard == ["outer", "inner", 0.0, 0.25, 0.5, 0.75, "end", "end"]
    assert list(steps_of([1], "nobody hears this")) == [1]
    assert len(heard) == 8


def test_steps_inside_move_the_step_around_them_forwards_only():
    heard = Heard()
    with listening(heard), step("outer") as advance, part_of(advance, 0.5, 1.0):
        for _ in range(2):
            assert list(steps_of([1, 2], "inner")) == [1, 2]
    inner = ["inner", 0.0, 0.5, 0.5, 0.75, "end"]
    assert heard == ["outer", 0.5, *inner, "inner", 0.0, 0.75, 0.5, 0.75, "end", 1.0, "end"]
    with step("nobody") as advance, part_of(advance, 0.0, 1.0):
        assert list(steps_of([1], "hears")) == [1]


def test_the_time_left_of_all_stands_before_that_of_the_step():
    whole, inner = shown.RunningStep("planning", 0.0, print, 0.25), shown.RunningStep("looking", 27.0, print, 0.5)
    assert shown.shown_text([whole, inner], 30.0) == (
        "planning: 25 %, 30 s, about 1 min 30 s left; looking: 50 %, 3 s, about 3 s left"
    )
    assert shown.shown_text([whole], 30.0) == "planning: 25 %, 30 s, about 1 min 30 s left"
    assert shown.shown_text([shown.RunningStep("all", 0.0, print), inner], 30.0) == "looking: 50 %, 3 s, about 3 s left"
    assert shown.shown_text([], 30.0) == ""


def test_a_step_that_fails_ends():
    heard = Heard()
    with pytest.raises(ZeroDivisionError), listening(heard), step("dividing"):
        _ = 1 // 0
    assert heard == ["dividing", "end"]


@pytest.mark.parametrize(
    ("share", "after_s", "text"),
    [
        (0.0, 12.2, "reading a.mcap: 12 s"),
        (0.25, 30.0, "reading a.mcap: 25 %, 30 s, about 1 min 30 s left"),
        (1.0, 200.0, "reading a.mcap: 100 %, 3 min 20 s, about 0 s left"),
    ],
)
def test_what_is_said(share, after_s, text):
    assert shown.said(shown.RunningStep("reading a.mcap", 5.0, lambda _: None, share), 5.0 + after_s) == text


def test_the_innermost_step_that_is_long_is_shown_and_cleared(monkeypatch):
    now_s = [0.0]
    monkeypatch.setattr(shown.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(shown, "EVERY_S", 3600.0)  # the thread sleeps; the test looks
    stream = io.StringIO()
    listener = shown.Shown(stream)
    with listening(listener), step("planning\x1b[2J"):
        now_s[0] = 1.9
        listener.show()
        assert stream.getvalue() == ""
        with step("choosing poses") as advance:
            now_s[0] = 3.0
            listener.show()  # the inner step is young
            now_s[0] = 5.9
            advance(0.5)
            listener.show()
        assert stream.getvalue().endswith(shown.CLEAR)
    listener.close()
    lines = [line for line in re.split(r"\r|\x1b\[2K", stream.getvalue()) if line]
    assert lines == ["planning\\x1b[2J: 3 s", "choosing poses: 50 %, 4 s, about 4 s left"]


def test_a_terminal_that_goes_away_stops_nothing():
    class Gone(io.StringIO):
        def write(self, text):
            raise OSError

    listener = shown.Shown(Gone())
    with listening(listener), step("working"):
        listener._steps[0].begun_s -= 10.0
        listener.show()
    listener.close()


class Depth:
    """A listener that records how many steps were open when each began."""

    def __init__(self):
        self.open, self.begun = 0, []

    def begin(self, what):
        self.begun.append((self.open, what))
        self.open += 1
        return self

    def advance(self, share):
        pass

    def end(self):
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
