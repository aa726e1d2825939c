"""A session that continues in further files: what is carried over, what is read together, and that recorded data is unchanged."""

import json
import shutil

import numpy as np
import pytest
from record_files import events
from record_real import box_on_a_socket
from test_record_command import CALIBRATED, RIG
from tests.host.findings_bench import listed
from tests.refusals import ended

from truearm.cli.main import main
from truearm.live.state import SessionProgress
from truearm.plan.plan_file import write_plan
from truearm.record.links import HostClock
from truearm.record.session_writer import SessionWriter
from truearm.session.session_file import open_session
from truearm.types import Plan
from truearm.workflows.recorded_session import earlier, first_stem, gone_on, is_part, session_parts, with_parts

ROWS = [
    {"pose": k, "shell": "a", "bar": bar, "chuck": "c1", "sphere": "s1", "q": [0.5 * k, 0.0]}
    for k, bar in enumerate(("b46", "b46", "b61"))
]


def session(path, *happened, setup=None, rows=ROWS, rig=None):
    """Write a file as the recorder leaves it, with these events."""
    with SessionWriter(path, HostClock(), overwrite=True) as writer:
        writer.metadata("setup", {"robot": "", "osr": "2048", **(setup or {})})
        if rig:
            writer.attach("rig.toml", rig)
        for row in rows:
            writer.add_json("/plan", 1, row)
        for k, (kind, fields) in enumerate(happened):
            writer.event(kind, 2 + k, **fields)
    return path


class TestEarlier:
    def test_how_far_it_had_come(self, tmp_path):
        pairing = {"bar": "b46", "chuck": "c1", "sphere": "s1"}
        first = session(
            tmp_path / "s.mcap", ("mounted", pairing), ("dwell", {"pose": 0}), ("dwell", {}), ("line", {"pose": 7})
        )
        second = session(
            tmp_path / "s.2.mcap", ("dwell", {"pose": 1}), ("mounted", {"bar": "b61"}), setup={"of": "s.mcap"}
        )
        for path in (first, second):
            before = earlier(path)
            assert (before.first, before.out, before.number) == (first, tmp_path / "s.3.mcap", 3)
            assert before.rows == ROWS
            assert before.mounted == {"bar": "b61"}
            assert before.stops == (("dwell", 0), ("dwell", None), ("line", 7), ("dwell", 1))
            assert before.setup["osr"] == "2048"
        course = SessionProgress(before.rows)
        gone_on(course, before)
        assert (course.done, course.unplanned, course.next) == ({0, 1}, {"dwell": 1, "line": 1}, 2)

    def test_a_session_that_is_still_being_written_is_refused(self, tmp_path, capsys):
        """Two recorders would take box and robot from each other; neither is opened."""
        first = session(tmp_path / "s.mcap", ("dwell", {"pose": 0}))
        with SessionWriter(tmp_path / "s.2.mcap", HostClock(), overwrite=True) as writer:
            writer.metadata("setup", {"robot": "", "of": "s.mcap"})
            writer.event("dwell", 1, pose=1)
            writer.tick(2_000_000_000)  # writes what it has
            assert main(["record", "--resume", str(first), "--box", "/dev/nothing"]) == 2
            said = capsys.readouterr().err
            ended(said, "in-use", place="s.2.mcap")
        assert earlier(first).number == 3

    def test_a_session_that_is_still_being_written_is_not_overwritten(self, tmp_path, capsys):
        out = tmp_path / "s.mcap"
        with SessionWriter(out, HostClock()) as writer:
            writer.event("note", 1, text="an afternoon")
            writer.tick(2_000_000_000)
            before = out.read_bytes()
            assert main(["record", "--out", str(out), "--force", "--box", "/dev/nothing"]) == 2
            ended(capsys.readouterr().err, "in-use", place="s.mcap")
            assert out.read_bytes() == before
            assert main(["identify", str(out), "--model", "puma560"]) == 2
            ended(capsys.readouterr().err, "in-use", place="s.mcap")
            assert main(["session", "export", str(out), "--out", str(tmp_path / "tables")]) == 2
            ended(capsys.readouterr().err, "in-use", place="s.mcap")

    def test_a_part_of_a_session_that_was_overwritten_is_not_of_this_one(self, tmp_path):
        """Recorded again under the old name (--force): what lay beside it is neither read with it nor in its way."""
        first = session(tmp_path / "s.mcap", ("dwell", {"pose": 0}))
        begun = open_session(first).metadata["session"]["utc_ns"]
        part = session(tmp_path / "s.2.mcap", ("dwell", {"pose": 1}), setup={"of": "s.mcap", "begun": begun})
        assert session_parts(first) == [first, part]
        assert earlier(part).first == first
        session(first, ("dwell", {"pose": 2}))
        assert session_parts(first) == [first]
        before = earlier(first)
        assert (before.stops, before.out) == ((("dwell", 2),), tmp_path / "s.3.mcap")
        assert before.begun == open_session(first).metadata["session"]["utc_ns"]
        assert earlier(part).first == part

    def test_a_part_that_was_cut_off(self, tmp_path):
        """Its recorder was killed: its intact part counts."""
        path = session(tmp_path / "s.mcap", *[("dwell", {"pose": k}) for k in range(2)])
        path.write_bytes(path.read_bytes()[:-60])
        assert earlier(path).stops == (("dwell", 0), ("dwell", 1))

    def test_a_damaged_file_that_is_continued_is_named(self, tmp_path, monkeypatch, capsys):
        """Other commands refuse it, and what recover makes of it does not name its further parts."""
        monkeypatch.setattr("truearm.record.links.list_ports.comports", list)
        path = session(tmp_path / "s.mcap", ("dwell", {"pose": 0}))
        for damaged in (False, True):
            if damaged:
                path.write_bytes(path.read_bytes()[:-60])
            assert main(["record", "--resume", str(path)]) == 1
            said = capsys.readouterr().err
            assert (f"{path}: " in said) == damaged
            assert (f"--resume {tmp_path / 's-recovered.mcap'}" in said) == damaged
        assert main(["session", "recover", str(path)]) == 0
        assert earlier(tmp_path / "s-recovered.mcap").stops == (("dwell", 0),)
        assert earlier(tmp_path / "s-recovered.mcap").damaged == ()

    @pytest.mark.parametrize("of", ["", ".", "..", "/", "x/..", "none.mcap", "a\0b", "s.mcap"])
    def test_a_part_of_what_is_not_there(self, tmp_path, of):
        path = session(tmp_path / "t.mcap", setup={"of": of})
        assert earlier(path).first == path

    @pytest.mark.parametrize("name", ["none.mcap", "."])
    def test_refused(self, tmp_path, capsys, name):
        assert main(["record", "--box", "/dev/none", "--resume", str(tmp_path / name)]) == 2
        assert "no such file" in capsys.readouterr().err

    def test_options_that_contradict(self, tmp_path, capsys):
        path = session(tmp_path / "s.mcap")
        for options in ([], ["--resume", str(path), "--out", str(tmp_path / "t.mcap")]):
            assert main(["record", "--box", "/dev/none", *options]) == 2
            ended(capsys.readouterr().err, "exclusive", first="out", second="resume")

    def test_a_plan_that_is_none(self, tmp_path, capsys):
        path = session(tmp_path / "s.mcap", rows=[{"q": "x"}])
        assert main(["record", "--box", "/dev/none", "--resume", str(path)]) == 2
        assert "its plan" in capsys.readouterr().err


class TestParts:
    def test_in_order_and_only_its_own(self, tmp_path):
        first = session(tmp_path / "s.mcap")
        for number in (10, 2):
            session(tmp_path / f"s.{number}.mcap", setup={"of": "s.mcap", "part": str(number)})
        session(tmp_path / "s.3.mcap")  # somebody's own of that name
        session(tmp_path / "s.x.mcap", setup={"of": "s.mcap"})
        other = session(tmp_path / "other.mcap")
        parts = [tmp_path / name for name in ("s.mcap", "s.2.mcap", "s.10.mcap")]
        assert session_parts(first) == parts
        assert session_parts(parts[1]) == [parts[1]]
        assert with_parts([other, first]) == [other, *parts]
        assert with_parts([first, parts[2]]) == [first, parts[1], parts[2]]
        assert with_parts([tmp_path / "none.csv", tmp_path / "none.mcap"]) == [
            tmp_path / "none.csv",
            tmp_path / "none.mcap",
        ]
        assert [is_part(path, [other, *parts]) for path in (other, *parts)] == [False, True, True, True]
        assert [first_stem(path) for path in (other, *parts)] == ["other", "s", "s", "s"]
        assert first_stem(tmp_path / "v1.2.mcap") == "v1.2"

    def test_commands_of_one_file_name_the_others(self, tmp_path, capsys):
        first = session(tmp_path / "s.mcap")
        session(tmp_path / "s.2.mcap", setup={"of": "s.mcap"})
        (tmp_path / "j.csv").write_text("t_s,q1_rad\n0,0\n0,0.1\n")
        for arguments in (
            ["session", "export", str(first), "--out", str(tmp_path / "tables")],
            [
                "session",
                "add-joints",
                str(first),
                str(tmp_path / "j.csv"),
                "--zero-s",
                "0",
                "--out",
                str(tmp_path / "o.mcap"),
            ],
        ):
            assert main([*arguments, "--json"]) == 0
            assert listed(json.loads(capsys.readouterr().out))["further-parts"]["parts"] == ["s.2.mcap"]
        first.write_bytes(first.read_bytes()[:-60])
        assert main(["session", "recover", str(first), "--json"]) == 0
        assert listed(json.loads(capsys.readouterr().out))["further-parts"]["out"] == "s-recovered.mcap"

    def test_inspect_tells_all_of_them(self, tmp_path, printed):
        session(tmp_path / "s.mcap")
        session(tmp_path / "s.2.mcap", setup={"of": "s.mcap"})
        assert f"{tmp_path / 's.2.mcap'} continues it:" in printed("inspect", tmp_path / "s.mcap")
        (part,) = json.loads(printed("inspect", tmp_path / "s.mcap", "--json"))["parts"]
        assert part["file"].endswith("s.2.mcap")


def test_recorded_on(tmp_path, capsys):
    """Plan, rig, rate and what was mounted last come from the first file, which stays as it is to the byte."""
    out = tmp_path / "s.mcap"
    (tmp_path / "rig.toml").write_text(RIG)
    plan = Plan(np.array([[0.1, 0.2]]), *(np.array([name]) for name in ("a", "bar46", "c1", "s1")))
    write_plan(tmp_path / "plan.csv", plan)
    given = ["--rig", str(tmp_path / "rig.toml"), "--plan", str(tmp_path / "plan.csv"), "--rate", "2000"]
    mounted = ["--mounted", "bar=bar46,chuck=c1,sphere=s1"]
    for options in (
        ["--out", str(out), *given, *mounted],
        ["--resume", str(out)],
        ["--resume", str(tmp_path / "s.2.mcap")],
    ):
        with box_on_a_socket() as (box, device):
            box.lvdt = CALIBRATED
            assert main(["record", "--box", device, "--duration-s", "0.3", *options]) == 0
        if options[0] == "--out":
            shutil.copy(out, tmp_path / "copy")
    assert out.read_bytes() == (tmp_path / "copy").read_bytes()
    files = session_parts(out)
    assert [path.name for path in files] == ["s.mcap", "s.2.mcap", "s.3.mcap"]
    first, *more = [open_session(path) for path in files]
    for number, part in enumerate(more, start=2):
        begun = first.metadata["session"]["utc_ns"]
        of = {"of": "s.mcap", "part": str(number), "begun": begun}
        assert part.metadata["setup"] == {"robot": "", "osr": "2048", **of}
        assert part.attachments == first.attachments
        assert [m.data for m in part.messages({"/plan"})] == [m.data for m in first.messages({"/plan"})]
        assert json.loads(part.metadata["box"]["ident"])["streams"][0]["osr"] == 2048
        assert events(part.path, "mounted") == events(out, "mounted")
    assert f"{files[2]}: 0.3 s" in capsys.readouterr().out
