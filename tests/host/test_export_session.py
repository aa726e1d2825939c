"""`truearm session export`: tables equal bit for bit to the synchronised data, in memory that does not grow with the session."""

import csv
import io
import json
import os
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from itertools import islice

import cbor2
import numpy as np
import pyarrow.parquet
import pytest
from blocks_bench import read
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from session_stream import BLOCK, PERIOD_NS, RIG, Box, metres_of, session, stream_of, write_session
from session_stream import columns_of as message_columns
from tests.refusals import ended

from truearm.cli.main import main
from truearm.errors import SessionError
from truearm.kinds.rig_file import write_rig
from truearm.kinds.table_file import read_table
from truearm.session.frames import recorded_ident
from truearm.session.joint_format import parse_lines
from truearm.session.observations import observations, survey
from truearm.session.session_file import open_session
from truearm.session.session_tables import MAX_TABLES, tabulate
from truearm.types import Message
from truearm.workflows.session_files import ArrowTable
from truearm_wire import messages as wire

WORDS = ("reason", "kind", "event", "shell", "bar", "chuck", "sphere")
FORMATS = ("csv", "npz", "parquet")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Return a session with six dwells, in one of which 400 frames are lost: its messages and its file."""
    messages, _ = session(np.random.default_rng(1), dwells=4, joint_noise=1e-5)
    data = [k for k, message in enumerate(messages) if message.topic == "/box/adc"]
    gone = set(data[300:310])
    messages = [message for k, message in enumerate(messages) if k not in gone]
    messages.insert(50, Message("/events", messages[50].t_host_ns, b'{"kind":"mounted","bar":"b46"}'))
    path = tmp_path_factory.mktemp("session") / "s.mcap"
    write_session(path, messages, RIG)
    return messages, path


def columns_of(path):
    """Return titles and columns of a table in any of the formats."""
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as file:
            return dict(file)
    if path.suffix == ".parquet":
        return {title: column.to_numpy() for title, column in zip(*_parquet(path), strict=True)}
    with path.open(newline="") as file:
        titles, *rows = csv.reader(file)
    columns = {title: [row[k] for row in rows] for k, title in enumerate(titles)}
    return {title: np.array(cells) if title in WORDS else _typed(cells) for title, cells in columns.items()}


def _parquet(path):
    table = pyarrow.parquet.read_table(path)
    return table.column_names, table.columns


def _typed(cells):
    for kind in (np.int64, np.float64):
        try:
            return np.array([kind(cell) if cell or kind is np.int64 else np.nan for cell in cells])
        except ValueError:
            continue
    return np.array(cells)


def export(path, out, format="csv", *more):
    assert main(["session", "export", str(path), "--out", str(out), "--format", format, *more]) == 0
    tables = {name.partition(".")[0]: columns_of(out / name) for name in os.listdir(out) if name != "session.json"}
    return tables, json.loads((out / "session.json").read_text(), parse_constant=pytest.fail)


@pytest.mark.parametrize("format", FORMATS)
def test_what_sync_sees(made, tmp_path, format):
    """Every number of every table equals that of the synchronisation's own functions, without a tolerance."""
    messages, path = made
    tables, said = export(path, tmp_path / "x", format)
    opened = open_session(path)
    found = survey(opened.batches, recorded_ident(opened))
    blocks = read(messages)[0]
    adc = tables["box_adc"]
    counts = np.concatenate([block.counts for block in blocks])
    np.testing.assert_array_equal(adc["lvdt_counts"], counts[:, 0])
    np.testing.assert_array_equal(adc["ch3_counts"], counts[:, 3])
    np.testing.assert_array_equal(adc["lvdt_V"], counts[:, 0] * 143e-9)
    np.testing.assert_allclose(adc["lvdt_m"], metres_of(counts[:, 0]), rtol=1e-12)
    index = np.concatenate([block.data.n0 + np.arange(block.n) for block in blocks])
    np.testing.assert_array_equal(adc["index"], index)
    device_ns = np.concatenate([1000 * block.data.t0_us + PERIOD_NS * np.arange(block.n) for block in blocks])
    np.testing.assert_array_equal(adc["device_time_ns"], device_ns)
    host = np.concatenate(
        [found.clocks[0].to_host_ns([b.data.t0_us])[0] + PERIOD_NS * np.arange(b.n) - 1_500_000 for b in blocks]
    )
    np.testing.assert_array_equal(adc["host_time_ns"], host)
    bounds = np.concatenate([np.repeat(found.clocks[0].to_host_ns([b.data.t0_us])[1], b.n) for b in blocks])
    np.testing.assert_array_equal(adc["host_bound_ns"], bounds)
    # the one gap stands where samples are missing
    np.testing.assert_array_equal(np.flatnonzero(adc["gap"])[1:], np.flatnonzero(np.diff(adc["index"]) != 1) + 1)
    assert said["losses"]["samples_lost"] == 10 * BLOCK == np.diff(adc["index"]).max() - 1

    lines = [message for message in messages if message.topic == "/robot/joints"]
    parsed = parse_lines([line.data for line in lines], [line.t_host_ns for line in lines])
    joints = tables["joints"]
    np.testing.assert_array_equal(joints["controller_time_s"], parsed.t)
    np.testing.assert_array_equal(np.stack([joints[f"q{j}_rad"] for j in range(1, 7)], axis=1), parsed.q)
    np.testing.assert_array_equal(joints["arrival_ns"], [line.t_host_ns for line in lines])
    np.testing.assert_array_equal(joints["host_time_ns"], found.joints.clocks[0].to_host_ns(parsed.t))

    exchanges = [json.loads(message.data) for message in messages if message.topic == "/sync"]
    for title in ("t0_ns", "t1_us", "t2_us", "t3_ns"):
        np.testing.assert_array_equal(tables["sync"][title], [row[title] for row in exchanges])

    result = observations(survey(opened.batches), RIG, name="s.mcap")
    dwells = tables["dwells"]
    np.testing.assert_array_equal(dwells["value_m"], [dwell.value for dwell in result.dwells])
    assert dwells["reason"].tolist() == [dwell.reason for dwell in result.dwells]
    np.testing.assert_array_equal(tables["observations"]["length_m"], result.table.value)
    np.testing.assert_array_equal(tables["observations"]["q4_rad"], result.table.q[:, 3])
    assert tables["plan"]["chuck"].tolist() == ["c1"] * 4
    assert tables["events"]["kind"].tolist() == ["mounted"]
    assert tables["box_heartbeat"]["t_us"].size == sum(m.topic == "/box/heartbeat" for m in messages)
    assert {name: table["rows"] for name, table in said["tables"].items()} == {
        f"{name}.{format}": len(next(iter(columns.values()))) for name, columns in tables.items()
    }


def test_the_observations_are_a_table_for_identify(made, tmp_path):
    _, path = made
    export(path, tmp_path / "x")
    result = observations(survey(open_session(path).batches), RIG)
    read = read_table(tmp_path / "x" / "observations.csv")
    np.testing.assert_array_equal(read.value, result.table.value)
    np.testing.assert_array_equal(read.q, result.table.q)


def test_without_a_rig(made, tmp_path):
    messages, _ = made
    write_session(tmp_path / "s.mcap", messages)
    tables, said = export(tmp_path / "s.mcap", tmp_path / "x")
    assert "observations" not in tables
    assert "rig" in said["not_paired"]
    assert len(tables["dwells"]["q1_rad"]) >= 3
    write_rig(tmp_path / "rig.toml", RIG)
    tables, said = export(tmp_path / "s.mcap", tmp_path / "y", "npz", "--rig", str(tmp_path / "rig.toml"))
    assert len(tables["observations"]["length_m"]) >= 3
    assert said["not_paired"] == ""
    write_rig(tmp_path / "other.toml", replace(RIG, chucks={}))
    _, said = export(tmp_path / "s.mcap", tmp_path / "w", "npz", "--rig", str(tmp_path / "other.toml"))
    assert said["not_paired"].endswith(" --rig")
    (tmp_path / "s.labels.json").write_text("{}")
    tables, said = export(tmp_path / "s.mcap", tmp_path / "z", "npz", "--rig", str(tmp_path / "rig.toml"))
    assert "s.labels.json" in said["not_paired"]
    assert len(tables["dwells"]["q1_rad"]) >= 3


@pytest.mark.parametrize("format", FORMATS)
def test_a_recording_that_ended_before_the_first_dwell(made, tmp_path, format):
    """There is a rig and no observation: a table without rows, as for dwells, not an error."""
    messages, _ = made
    write_session(tmp_path / "s.mcap", [message for message in messages if message.t_host_ns < 3 * 10**9], RIG)
    tables, _ = export(tmp_path / "s.mcap", tmp_path / "out", format)
    assert tables["observations"].keys() == {"kind", *(f"q{i}_rad" for i in range(1, 7))}
    assert not any(map(len, tables["observations"].values()))


def test_a_box_without_a_clock_and_a_reboot():
    """Times that nobody can know are said to be unknown; the new life is another segment."""
    box = Box()
    box.ident(0)
    for k in range(20):
        box.data(10**9 + k * BLOCK * PERIOD_NS, np.arange(4 * BLOCK).reshape(BLOCK, 4))
    box.reboot(2 * 10**9)
    box.ident(2 * 10**9)
    for k in range(5):
        box.data(3 * 10**9 + k * BLOCK * PERIOD_NS, np.arange(4 * BLOCK).reshape(BLOCK, 4))
    messages = stream_of(box.messages)
    batches = list(tabulate(survey(messages)))
    assert [name for name, _ in batches] == ["box_adc", "box_adc"]
    (first, second) = (columns for _, columns in batches)
    assert set(first["host_time_ns"]) == {-1}
    assert np.isnan(first["host_bound_ns"]).all()
    assert (set(first["segment"]), set(second["segment"])) == ({0}, {1})
    assert np.flatnonzero(second["gap"]).tolist() == [0]


@pytest.mark.parametrize("value", [2**63, -(2**63) - 1, -(2**64)])
def test_integers_of_the_box_that_need_more_than_64_bits(value):
    """Frames with them are left out; the others remain."""
    box = Box()
    box.ident(0)
    for number, level in enumerate((-(2**63), value, 2**63 - 1)):
        box.frame("temperature", 10**9 + number, wire.TEMPERATURE, 10**6 + number, 0, level)
    ((name, columns),) = tabulate(survey(stream_of(box.messages)))
    assert name == "box_temperature"
    assert columns["temperature_mdegc"].tolist() == [-(2**63), 2**63 - 1]


def joint_lines(rows):
    return [Message("/robot/joints", 10**9 * (k + 1), json.dumps(row).encode()) for k, row in enumerate(rows)]


def test_keys_of_readings_are_optional_or_begin_another_table(monkeypatch):
    # They have columns from where they first come; restarts of the controller are segments; no number is -1.
    rows = [{"t": 0.1 * k, "seq": k, "q": [0.1, k]} for k in range(3)]
    rows += [{"t": 0.01 * k, "q": [0.1, k], "qd": [1.0, 2.0], "inputs": 5} for k in range(2)]
    messages = stream_of(joint_lines([{**row, "t": row["t"] + (5 if "seq" in row else 0)} for row in rows]))
    ((name, columns),) = tabulate(survey(messages), ("rad", "m"))
    assert name == "joints"
    assert list(columns)[-3:] == ["qd1_rad_s", "qd2_m_s", "inputs"]
    assert columns["segment"].tolist() == [0, 0, 0, 1, 1]
    assert columns["seq"].tolist() == [0, 1, 2, -1, -1]
    assert columns["q2_m"].tolist() == [0.0, 1.0, 2.0, 0.0, 1.0]
    np.testing.assert_array_equal(columns["qd1_rad_s"], [np.nan] * 3 + [1.0, 1.0])
    monkeypatch.setattr("truearm.session.joint_readings.CHUNK", 4)
    rows = [{"t": 0.1 * k, "q": [0.1], **({"effort": [2.0]} if k >= 5 else {})} for k in range(12)]
    messages = stream_of(joint_lines(rows), size=4)
    batches = list(tabulate(survey(messages)))
    assert [(name, len(columns["q1_rad"])) for name, columns in batches] == [
        ("joints", 4),
        ("joints-2", 4),
        ("joints-2", 4),
    ]
    np.testing.assert_array_equal(batches[1][1]["effort1_Nm"], [np.nan] + [2.0] * 3)


def test_a_box_that_is_ever_another():
    """A stranger's file cannot make files without end."""
    from session_stream import ident_document

    box = Box()
    for k in range(MAX_TABLES + 2):
        document = ident_document(7)
        document["streams"][0]["channels"][1]["name"] = f"other{k}"
        for page, pages, data in wire.pages(cbor2.dumps(document)):
            box.frame("ident", k, wire.IDENT, 1, page, pages, data)
        box.data(10**9 + k * BLOCK * PERIOD_NS, np.zeros((BLOCK, 4), int))
    messages = stream_of(box.messages)
    with pytest.raises(SessionError, match="more than 100 tables"):
        list(tabulate(survey(messages)))


def test_memory_does_not_grow(made):
    """Four times the data needs no more memory; 20 % is allowed for the allocator."""
    box = [message for message in made[0] if message.topic != "/robot/joints"]
    found = survey(stream_of(made[0]))
    q = [0.1] * 6

    def of_boot(message, number):
        """A message of the box as it is after another boot, because bytes that arrive twice are counted only once."""
        if message.topic == "/box/heartbeat":
            frame = cbor2.loads(message.data)
            return message._replace(data=bytes(wire.encode_payload([*frame[:2], frame[2] + number, *frame[3:]])))
        return message._replace(data=message.data.replace(b"boot_id\x07", b"boot_id" + cbor2.dumps(7 + number)))

    def told(times):
        for part in range(times):
            yield from (of_boot(message, part) for message in box)
            for k in range(3000 * part, 3000 * (part + 1)):
                yield Message("/robot/joints", 10**7 * k, json.dumps({"t": 0.01 * k, "seq": k, "q": q}).encode())

    def peak(times):
        tracemalloc.start()
        messages = told(times)
        parts = iter(lambda: list(islice(messages, 1000)), [])
        again = tabulate(replace(found, source=lambda: map(message_columns, parts)))
        rows = sum(len(columns["segment"]) for name, columns in again if name == "joints")
        _, peak_bytes = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert rows == 3000 * times
        return peak_bytes

    peak(1)
    assert peak(12) < 1.2 * peak(3) + 100_000


class TestRefusals:
    def refused(self, capsys, *arguments):
        assert main(["session", "export", *map(str, arguments)]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        return said

    @pytest.mark.parametrize(
        ("options", "said"),
        [
            (("--out", "x"), "file-exists"),
            (("--out", "a/b"), "missing-file"),
            (("--out", "y", "--format", "xlsx"), "'xlsx'"),
            (("--out", "y", "--rate", "5"), "--rate"),
        ],
    )
    def test_what_is_wrong(self, made, tmp_path, capsys, monkeypatch, options, said):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "x").mkdir()
        (tmp_path / "x" / "mine").write_text("precious")
        ended(self.refused(capsys, made[1], *options), said)
        assert [str(path) for path in sorted(tmp_path.rglob("*"))] == [
            str(tmp_path / "x"),
            str(tmp_path / "x" / "mine"),
        ]

    def test_an_empty_folder_is_filled(self, made, tmp_path):
        (tmp_path / "y").mkdir()
        export(made[1], tmp_path / "y")

    def test_damaged(self, made, tmp_path, capsys):
        messages, path = made
        cut = tmp_path / "cut.mcap"
        cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        assert "--allow-damaged" in self.refused(capsys, cut, "--out", tmp_path / "x")
        tables, said = export(cut, tmp_path / "x", "npz", "--allow-damaged")
        assert said["truncated"]
        assert 0 < len(tables["joints"]["seq"]) < sum(m.topic == "/robot/joints" for m in messages)

    @pytest.mark.skipif(os.name != "posix", reason="needs a limit of file sizes")
    @pytest.mark.parametrize("format", FORMATS)
    def test_a_full_disk(self, made, tmp_path, format):
        """Nothing is left behind, not even part of a table."""
        code = (
            "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
            "from truearm.cli.main import main; sys.exit(main(sys.argv[1:]))"
        )
        arguments = ["session", "export", str(made[1]), "--out", str(tmp_path / "x"), "--format", format]
        done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=60)
        assert done.returncode == 1, done.stderr
        assert done.stderr.count("\n") == 1
        assert "nothing was exported" in done.stderr
        assert os.listdir(tmp_path) == []


def urdf_of(joints):
    """A chain of ``joints``, of which the last is prismatic, with two end links on it."""
    parts = [
        f'<joint name="j{k}" type="{"prismatic" if k == joints else "revolute"}"><parent link="l{k - 1}"/><child link="l{k}"/>'
        '<axis xyz="0 0 1"/><limit lower="-9" upper="9" effort="1" velocity="1"/></joint>'
        for k in range(1, joints + 1)
    ]
    parts += [
        f'<joint name="to_{end}" type="fixed"><parent link="l{joints}"/><child link="{end}"/></joint>'
        for end in ("tool", "camera")
    ]
    links = [*(f"l{k}" for k in range(joints + 1)), "tool", "camera"]
    return (
        f'<robot name="r">{"".join(f"<link name={chr(34)}{name}{chr(34)}/>" for name in links)}{"".join(parts)}</robot>'
    )


def test_a_urdf_with_two_ends(made, tmp_path, capsys):
    _, path = made
    joints = sum(title.endswith("_rad") for title in export(path, tmp_path / "x")[0]["dwells"] if title.startswith("q"))
    robot = tmp_path / "r.urdf"
    robot.write_text(urdf_of(joints))
    asked = ["session", "export", str(path), "--out", str(tmp_path / "y"), "--model", str(robot)]
    assert main(asked) == 2
    assert "choose --tip among" in capsys.readouterr().err
    tables, _ = export(path, tmp_path / "y", "csv", "--model", str(robot), "--base", "l0", "--tip", "tool")
    assert f"q{joints}_m" in tables["dwells"]
    assert f"q{joints}_m" in tables["joints"]
    assert "q1_rad" in tables["joints"]


def test_samples_are_those_that_inspect_counts(made, tmp_path, capsys):
    _, said = export(made[1], tmp_path / "x")
    printed = " ".join(capsys.readouterr().out.split())
    assert main(["inspect", str(made[1]), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    for stream in document["streams"]:
        assert said["tables"][f"box_{stream['name']}.csv"]["rows"] == stream["samples"]
        assert f"box_{stream['name']}.csv ({stream['samples']} samples)" in printed
    assert sum(stream["samples"] for stream in document["streams"]) == document["losses"]["samples"] > 0


# CSV tables: numbers are read back bit for bit; NaN is an empty cell

floats = arrays(np.float64, 5, elements=st.floats(width=64))
whole = arrays(np.int64, 5, elements=st.integers(-(2**63), 2**63 - 1))


def written_columns(path, *batches):
    table = ArrowTable(path, batches[0])
    for batch in batches:
        table.write(batch)
    table.close()
    header, *rows = csv.reader(io.StringIO(path.read_text(encoding="utf-8"), newline=""))
    assert header == list(batches[0])
    assert table.rows == len(rows)
    return list(zip(*rows, strict=True))


@settings(max_examples=30)
@example(x=np.array([0.0, -0.0, -0.0, 0.0, -0.0]), n=np.zeros(5, dtype=np.int64), text=[""] * 5)
@given(x=floats, n=whole, text=st.lists(st.text('a,"é\n ', max_size=5), min_size=5, max_size=5))
def test_bit_for_bit(tmp_path_factory, x, n, text):
    """Numbers alone go another way than numbers beside text; infinities and the empty batch too."""
    path = tmp_path_factory.mktemp("t") / "t.csv"
    numbers = {"x": x, "n": n}
    for columns in (numbers, {**numbers, "text": np.array(text, dtype=np.str_)}):
        cells = written_columns(path, columns, {title: column[:0] for title, column in columns.items()}, columns)
        read = np.array([np.nan if cell == "" else float(cell) for cell in cells[0]])
        np.testing.assert_array_equal(
            read.view(np.int64)[~np.isnan(read)], np.tile(x, 2).view(np.int64)[~np.isnan(read)]
        )
        np.testing.assert_array_equal(np.isnan(read), np.isnan(np.tile(x, 2)))
        assert [int(cell) for cell in cells[1]] == np.tile(n, 2).tolist()


def test_memory_of_npz_does_not_grow_with_its_rows(tmp_path):
    n, peaks = 50_000, []
    names = np.array(["bar", "gauge ä", ""])[np.arange(n) % 3]
    columns = {"x": np.arange(n) / 7.0, "name": names, "none": np.full(n, "", dtype=np.str_)}
    for batches in (4, 16):
        table = ArrowTable(tmp_path / "t.npz", columns)
        for _ in range(batches):
            table.write(columns)
        tracemalloc.start()
        table.close()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.2 * peaks[0]
    with np.load(tmp_path / "t.npz") as read:
        for title, column in columns.items():
            np.testing.assert_array_equal(read[title], np.tile(column, batches))
