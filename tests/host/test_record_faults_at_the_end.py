"""Eight faults × four endings: whatever ends a recording, the same is asked, in the same words, and the exit code is 4.

The command runs in virtual time, with the box in memory and with the process's own signals.
"""

import os
import resource
import signal

import pytest
from record_box import HOST_0, SECOND, Box, Lab, Robot
from test_record_command import RIG

from truearm.cli.main import main
from truearm.session.session_file import open_session

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")

END_NS = HOST_0 + 6 * SECOND
ENDINGS = [None, signal.SIGINT, signal.SIGTERM, signal.SIGHUP]  # None: --duration-s


@pytest.fixture
def lab(monkeypatch):
    lab = Lab()
    monkeypatch.setattr("truearm.workflows.record.HostClock", lambda: lab)
    return lab


def record(monkeypatch, lab, out, ending, fault=lambda box, robot: None, more=()):
    """Run truearm record until its ending; ``fault`` prepares what happens to the box and the robot before."""
    box, robot = Box(lab), Robot(lab, 100.0)
    fault(box, robot)
    monkeypatch.setattr("truearm.workflows.record.BoxPort", lambda *_: lambda: box.link)
    monkeypatch.setattr("truearm.workflows.record.open_source", lambda *_: robot.link)
    options = ["--duration-s", "6"]
    if ending is not None:
        options = []
        lab.at(END_NS, lambda: signal.raise_signal(ending))
    return main(["record", "--box", "memory", "--address", "tcp://memory:1", "--out", str(out), *options, *more])


def overwrite(path):
    with path.open("r+b") as file:
        file.seek(200)
        file.write(b"\xff\x00\xff")


def regrow(path):
    """As ``cp`` of another file does: the file is emptied and is at once longer than before."""
    path.write_bytes(b"x" * (path.stat().st_size + 1000))


def fill_disk(path):
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 100, hard))


def to_the_file(happens):
    return lambda lab, box, robot, path: lab.at(END_NS - SECOND // 10, lambda: happens(path))


def mute_box(lab, box, robot, path):
    def stop():
        box.link.on_write = lambda data: None
        box.streaming = False
        box.boot_id = 0  # no further heartbeat

    lab.at(END_NS - 2 * SECOND, stop)


def mute_robot(lab, box, robot, path):
    lab.at(END_NS - 4 * SECOND, lambda: setattr(robot.link, "deliver", lambda data: None))


FAULTS = {
    "overwritten": (to_the_file(overwrite), "overwritten"),
    "truncated": (to_the_file(lambda path: os.truncate(path, 100)), "was truncated"),
    "truncated and regrown": (to_the_file(regrow), "were overwritten"),
    "deleted": (to_the_file(lambda path: path.unlink()), "was deleted"),
    "renamed": (to_the_file(lambda path: path.rename(path.with_name("other.mcap"))), "was renamed"),
    "full disk": (to_the_file(fill_disk), "cannot be written any more"),
    "box mute": (mute_box, "the box was gone"),
    "robot mute": (mute_robot, "the robot sent nothing"),
}


@pytest.fixture
def restored_limit():
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


# Every fault at the end by duration and every ending with one fault; all combinations in make soak.
@pytest.mark.parametrize(
    ("fault", "ending"),
    [
        pytest.param(
            fault,
            ending,
            marks=[pytest.mark.soak] * (fault != "renamed" and ending is not None),
            id=f"{fault}-{ending.name if ending else 'duration'}",
        )
        for fault in FAULTS
        for ending in ENDINGS
    ],
)
def test_what_is_missing_is_asked_at_every_ending(monkeypatch, tmp_path, lab, capfd, restored_limit, fault, ending):
    out = tmp_path / "s.mcap"
    happens, says = FAULTS[fault]
    code = record(monkeypatch, lab, out, ending, lambda box, robot: happens(lab, box, robot, out))
    said = capfd.readouterr()
    assert code == 4, said
    last = said.err.splitlines()[-1]
    assert says in last
    assert str(tmp_path) in last


@pytest.mark.parametrize(("ending", "code"), [*zip(ENDINGS, [0, 130, 130, 130], strict=True)])
def test_only_a_complete_recording_is_interrupted(monkeypatch, tmp_path, lab, capfd, ending, code):
    assert record(monkeypatch, lab, tmp_path / "s.mcap", ending) == code
    assert ("interrupted" in capfd.readouterr().out) == (code == 130)


@pytest.mark.parametrize("fault", [None, "renamed"])
def test_a_second_signal_while_the_dwells_are_counted(monkeypatch, tmp_path, lab, fault):
    """It comes after the file was completed and before anything was said; it once ended the command with 130."""
    out, rig = tmp_path / "s.mcap", tmp_path / "rig.toml"
    rig.write_text(RIG)
    monkeypatch.setattr("truearm.workflows.record.recorded_dwells", lambda _: signal.raise_signal(signal.SIGINT))
    happens = FAULTS[fault][0] if fault else lambda *_: None
    more = ["--unchecked", "--rig", str(rig), "--mounted", "bar=bar46,chuck=c1,sphere=s1"]
    code = record(monkeypatch, lab, out, signal.SIGINT, lambda box, robot: happens(lab, box, robot, out), more)
    assert code == (4 if fault else 130)


def test_bytes_appended_to_the_file(monkeypatch, tmp_path, lab, capfd):
    """Its name and what was written are intact, but the end of the file is not where readers look for it."""
    out = tmp_path / "s.mcap"

    def append():
        with out.open("ab") as file:
            file.write(b"x" * 1_000_000)

    assert record(monkeypatch, lab, out, None, lambda box, robot: lab.at(END_NS - SECOND, append)) == 4
    assert "were overwritten" in capfd.readouterr().err


def test_a_second_recorder_with_the_same_name_is_refused_before_its_box_is_started(monkeypatch, tmp_path, lab, capfd):
    out, codes, other = tmp_path / "s.mcap", [], Box(lab)

    def second(box, robot):
        def run():
            with monkeypatch.context() as patch:
                patch.setattr("truearm.workflows.record.BoxPort", lambda *_: lambda: other.link)
                codes.append(main(["record", "--box", "memory", "--duration-s", "1", "--out", str(out)]))

        box.link.on_write, write = lambda data: (run() if not codes else None, write(data)), box.link.on_write

    assert record(monkeypatch, lab, out, None, second) == 0
    assert codes == [2]
    assert "choose another name" in capfd.readouterr().err
    assert other.commands == []
    assert open_session(out).metadata["session-end"]["reason"] == "duration"
