"""Odd input to every command: one line that names the problem, exit code 1 or 2, no traceback, nothing overwritten."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.refusals import ended

from truearm.cli.main import main

Run = Callable[..., tuple[int, str]]
JOINTS = ",".join(f"q{i}_rad" for i in range(1, 7))
TABLE = f"kind,{JOINTS},place,socket\n" + "".join(f"seat,0,0,0,0,0,{i},a,0\n" for i in range(4))
IDENTIFY = ("identify", "t.csv", "--model", "puma560")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run main() in a folder of odd files; return the exit code and the line on stderr."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.csv").write_text(TABLE)
    (tmp_path / "empty").touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "circle").symlink_to("circle")
    (tmp_path / "latin.csv").write_bytes("kind,é".encode("latin-1"))
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "text.mcap").write_text("hello")
    # a record that claims 2^62 bytes
    (tmp_path / "claims.mcap").write_bytes(b"\x89MCAP0\r\n\x06" + (2**62).to_bytes(8, "little"))
    os.mkfifo(tmp_path / "pipe.csv")
    os.mkfifo(tmp_path / "pipe.mcap")

    def call(*arguments: str) -> tuple[int, str]:
        code = main(list(arguments))
        captured = capsys.readouterr()
        assert captured.err.count("\n") == 1, captured.err
        assert captured.err.startswith("truearm: ")
        assert captured.out == ""
        return code, captured.err

    return call


LONG = "a" * 300  # a name that no file system takes

CASES = {
    "a link in a circle as input": (("identify", "circle", "t.csv", "--model", "puma560"), "cannot be read: Too many"),
    "a link in a circle as output": ((*IDENTIFY, "--out", "circle"), "symbolic link loop"),
    "a link in a circle as page": ((*IDENTIFY, "--report", "circle"), "symbolic link loop"),
    "too long a name as input": (("identify", LONG, "--model", "puma560"), "cannot be read: File name too long"),
    "too long a name as output": ((*IDENTIFY, "--out", LONG), f"{LONG}: cannot be written: File name too long"),
    "too long a name of a table": ((*IDENTIFY, "--table-out", LONG), "cannot be written: File name too long"),
    "too long a name of a session": (("inspect", f"{LONG}.mcap"), "cannot be read: File name too long"),
    "standard input": (("identify", "-", "--model", "puma560"), "truearm: - is not a file; give its path"),
    "standard output": ((*IDENTIFY, "--out", "-"), "truearm: --out - is not a file; give its path"),
    "standard output without JSON": (("simulate", "--out", "-", "--fast"), "--out - is not a file; give its path"),
    "an empty name": (("identify", "", "--model", "puma560"), "unreadable-file"),
    "an empty name as output": ((*IDENTIFY, "--report", ""), "unreadable-file"),
    "a result named as a table": ((*IDENTIFY, "--out", "r.csv"), "wrong-suffix"),
    "a report named as PDF": ((*IDENTIFY, "--report", "r.pdf"), "wrong-suffix"),
    "a table named as a workbook": ((*IDENTIFY, "--table-out", "t.xls"), "wrong-suffix"),
    "a session named as a bag": (("record", "--box", "x", "--out", "s.bag"), "wrong-suffix"),
    "a plan named as text": (
        ("plan", "ballbar", "--model", "puma560", "--rig", "r.toml", "--poses", "9", "--out", "plan.txt"),
        "wrong-suffix",
    ),
    "a URDF named as TOML": (("export", "r.json", "--format", "urdf", "--out", "e.toml"), "wrong-suffix"),
    "a pipe as table": (("identify", "pipe.csv", "--model", "puma560"), "unreadable-file"),
    "a pipe as session": (("inspect", "pipe.mcap"), "unreadable-file"),
    "an empty table": (("identify", "empty", "--model", "puma560"), "no-rows"),
    "a table in Latin-1": (("identify", "latin.csv", "--model", "puma560"), "not-text"),
    "an empty session": (("identify", "empty.mcap", "--model", "puma560"), "not-a-session"),
    "a folder as session": (("identify", "folder.mcap", "--model", "puma560"), "unreadable-file"),
    "text as session": (("inspect", "text.mcap"), "not-a-session"),
    "absurd lengths": (("inspect", "claims.mcap"), "session-incomplete"),
    "a name with a surrogate": (("identify", "\udcff", "--model", "puma560"), "missing-file"),
    "a robot with a NUL": (("identify", "t.csv", "--model", "a\0b"), "wrong-value"),
    "a table as robot": (("identify", "t.csv", "--model", "t.csv"), "t.csv:"),
    "an empty rig name": ((*IDENTIFY, "--rig", "=x"), "missing-file"),
    "a file of no name": ((*IDENTIFY, "--rig", "a="), "unreadable-file"),
    "nothing between commas": ((*IDENTIFY, "--also-free", ","), "matches no parameter"),
    "an open bracket": ((*IDENTIFY, "--free", "["), "matches no parameter"),
    "a fraction of nothing": ((*IDENTIFY, "--hold-out", "1e-300"), "less than one row"),
    "a demo into the folder of no name": (("demo", "--out", ""), "file-exists"),
    "a demo into a file": (("demo", "--out", "t.csv"), "cannot be used as"),
    "a demo into a stranger's folder": (("demo", "--out", "."), "file-exists"),
    "a rate that is not a number": (("demo", "--rate", "nan", "--out", "new"), "--rate must be"),
    "a device of no address": (("record", "--box", "socket://", "--out", "s.mcap"), "wrong-value"),
    "an endless time": (("record", "--box", "x", "--out", "s.mcap", "--duration-s", "inf"), "finite number"),
    "a port beyond": (("simulate", "--port", "99999"), "65535"),
    "a rate in real time": (("simulate", "--rate", "300", "--out", "new"), "needs-option"),
    "a level that is none": (("simulate", "--fast", "--level", "abc", "--out", "new"), "not one of"),
    "a seed that draws nothing": ((*IDENTIFY, "--seed", "3"), "needs-option"),
    "a seed with a group": ((*IDENTIFY, "--seed", "3", "--hold-out", "bar=b"), "needs-option"),
    "points of no line": ((*IDENTIFY, "--line-points", "9"), "no-effect"),
    "a stage in virtual time": (("simulate", "--fast", "--stage", "--out", "new"), "in real time: leave out --fast"),
    "no command": (("",), "No such command"),
}


@pytest.mark.parametrize(("arguments", "message"), CASES.values(), ids=CASES.keys())
def test_odd_input_is_one_line(run: Run, tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    before = sorted(p.name for p in tmp_path.iterdir())
    code, said = run(*arguments)
    assert code == 2
    ended(said, message)
    assert sorted(p.name for p in tmp_path.iterdir()) == before
    assert (tmp_path / "t.csv").read_text() == TABLE
