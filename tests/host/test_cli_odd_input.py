"""Odd input to every command: one line that names the problem, exit code 1 or 2, no traceback, nothing overwritten."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

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
    "a link in a circle as output": ((*IDENTIFY, "--out", "circle"), "a symbolic link loop"),
    "a link in a circle as page": ((*IDENTIFY, "--report", "circle"), "a symbolic link loop"),
    "too long a name as input": (("identify", LONG, "--model", "puma560"), "cannot be read: File name too long"),
    "too long a name as output": ((*IDENTIFY, "--out", LONG), f"{LONG}: cannot be written: File name too long"),
    "too long a name of a table": ((*IDENTIFY, "--table-out", LONG), "cannot be written: File name too long"),
    "too long a name of a session": (("inspect", f"{LONG}.mcap"), "cannot be read: File name too long"),
    "standard input": (("identify", "-", "--model", "puma560"), "standard input is not read"),
    "standard output": ((*IDENTIFY, "--out", "-"), "--json prints the result"),
    "an empty name": (("identify", "", "--model", "puma560"), "not a regular file"),
    "an empty name as output": ((*IDENTIFY, "--report", ""), "is a directory"),
    "a result named as a table": ((*IDENTIFY, "--out", "r.csv"), "r.csv: would be written as .json; give a name that"),
    "a report named as PDF": ((*IDENTIFY, "--report", "r.pdf"), "would be written as .html"),
    "a table named as a workbook": ((*IDENTIFY, "--table-out", "t.xls"), "would be written as .csv"),
    "a session named as a bag": (("record", "--box", "x", "--out", "s.bag"), "would be written as .mcap"),
    "a plan named as text": (
        ("plan", "ballbar", "--model", "puma560", "--rig", "r.toml", "--poses", "9", "--out", "plan.txt"),
        "plan.txt: would be written as .csv; give a name that ends in .csv",
    ),
    "a URDF named as TOML": (("export", "r.json", "--format", "urdf", "--out", "e.toml"), "would be written as .urdf"),
    "a pipe as table": (("identify", "pipe.csv", "--model", "puma560"), "not a regular file"),
    "a pipe as session": (("inspect", "pipe.mcap"), "not a regular file"),
    "an empty table": (("identify", "empty", "--model", "puma560"), "is empty"),
    "a table in Latin-1": (("identify", "latin.csv", "--model", "puma560"), "is not UTF-8"),
    "an empty session": (("identify", "empty.mcap", "--model", "puma560"), "is not an MCAP file"),
    "a folder as session": (("identify", "folder.mcap", "--model", "puma560"), "not a regular file"),
    "text as session": (("inspect", "text.mcap"), "is not an MCAP file"),
    "absurd lengths": (("inspect", "claims.mcap"), "is incomplete"),
    "a name with a surrogate": (("identify", "\udcff", "--model", "puma560"), "no such file"),
    "a robot with a NUL": (("identify", "t.csv", "--model", "a\0b"), "is neither a built-in robot"),
    "a table as robot": (("identify", "t.csv", "--model", "t.csv"), "t.csv: is a table of observations, where a robot"),
    "an empty rig name": ((*IDENTIFY, "--rig", "=x"), "no such file"),
    "a file of no name": ((*IDENTIFY, "--rig", "a="), "not a regular file"),
    "nothing between commas": ((*IDENTIFY, "--also-free", ","), "matches no parameter"),
    "an open bracket": ((*IDENTIFY, "--free", "["), "matches no parameter"),
    "a fraction of nothing": ((*IDENTIFY, "--hold-out", "1e-300"), "is less than one row of 4"),
    "papers into a stranger's folder": (("reproduce", "goswami", "--out", "."), "holds other files"),
    "papers into the folder of no name": (("reproduce", "goswami", "--out", ""), "holds other files"),
    "papers into a file": (("reproduce", "renders", "--out", "t.csv"), "cannot be used as a folder"),
    "a demo into a stranger's folder": (("demo", "--out", "."), "holds other files"),
    "a rate that is not a number": (
        ("demo", "--rate", "nan", "--out", "new"),
        "--rate must be a finite number, is nan",
    ),
    "a device of no address": (("record", "--box", "socket://", "--out", "s.mcap"), "is not an address"),
    "an endless time": (("record", "--box", "x", "--out", "s.mcap", "--duration-s", "inf"), "must be a finite number"),
    "a port beyond": (("simulate", "--port", "99999"), "65535"),
    "a rate in real time": (("simulate", "--rate", "300", "--out", "new"), "--rate has no effect without --fast"),
    "a level that is none": (("simulate", "--fast", "--level", "abc", "--out", "new"), "choose vm or chip"),
    "a seed that draws nothing": ((*IDENTIFY, "--seed", "3"), "--seed draws a fraction to hold out"),
    "a seed with a group": ((*IDENTIFY, "--seed", "3", "--hold-out", "bar=b"), "--seed draws a fraction to hold out"),
    "points of no line": ((*IDENTIFY, "--line-points", "9"), "--line-points has no effect"),
    "a stage in virtual time": (("simulate", "--fast", "--stage", "--out", "new"), "in real time: leave out --fast"),
    "no command": (("",), "No such command"),
}


@pytest.mark.parametrize(("arguments", "message"), CASES.values(), ids=CASES.keys())
def test_odd_input_is_one_line(run: Run, tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    before = sorted(p.name for p in tmp_path.iterdir())
    code, said = run(*arguments)
    assert code == 2
    assert message in said
    assert sorted(p.name for p in tmp_path.iterdir()) == before
    assert (tmp_path / "t.csv").read_text() == TABLE
