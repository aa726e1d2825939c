"""`truearm session export --format mcap`, read by the official reader and by the rules of Foxglove and PlotJuggler, on one time axis."""

import json
import os

import numpy as np
import pytest
from line_stream import line_session, some_lines, true_params
from mcap.reader import make_reader
from record_box import Lab
from session_stream import RIG
from session_stream import session as ball_bar_session

from truearm.cli.main import main
from truearm.files.column_writers import Placement
from truearm.files.mcap_tables import McapTables
from truearm.files.rig_file import write_rig
from truearm.record.session_writer import SessionWriter
from truearm.types import Message

TYPES = {"integer": int, "number": (int, float), "string": str}


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """One line there and back past a line device, with an event."""
    rng = np.random.default_rng(4)
    made = line_session(rng, some_lines(rng, 1), true_params(rng), there_and_back=True, speed=0.2)
    messages = [*made.messages, Message("/events", made.messages[-1].t_host_ns, b'{"kind":"note","text":"x"}')]
    path = tmp_path_factory.mktemp("session") / "s.mcap"
    with SessionWriter(path, Lab()) as writer:
        for message in messages:
            writer.add(*message)
    return path


def export(session, out, *more):
    assert main(["session", "export", str(session), "--out", str(out), *more]) == 0
    return out


def read(out):
    """By channel: its schema, and (log time, row) of every message."""
    channels = {}
    with (out / "session.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None  # PlotJuggler looks up every channel's schema
            assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
            said = channels.setdefault(channel.topic, (json.loads(schema.data), []))
            assert schema.name
            assert said[0]["type"] == "object"  # Foxglove plots the properties of a named object
            said[1].append((message.log_time, json.loads(message.data, parse_constant=pytest.fail)))
    return channels


def utc_less_host(session):
    with session.open("rb") as file:
        entries = [r.metadata for r in make_reader(file).iter_metadata() if r.name == "session"][-1]
    return int(entries["utc_ns"]) - int(entries["monotonic_ns"])


def test_all_streams_stand_on_one_axis_with_a_schema_that_holds(session, tmp_path, capsys):
    channels = read(export(session, tmp_path / "x", "--format", "mcap", "--rate", "0"))
    assert {"/box_adc", "/box_mag", "/joints", "/events", "/sync"} <= channels.keys()
    assert channels["/box_adc"][0]["properties"]["transverse_a_m"] == {"type": "number"}
    for schema, rows in channels.values():
        for _, row in rows:
            for title, value in row.items():
                assert isinstance(value, TYPES[schema["properties"][title]["type"]])
    offset = utc_less_host(session)
    for name in ("/box_adc", "/box_mag", "/joints"):
        assert all(t == row["host_time_ns"] + offset for t, row in channels[name][1])
    assert channels["/events"][1][-1][0] == channels["/events"][1][-1][1]["arrival_ns"] + offset
    ends = [(rows[0][0], rows[-1][0]) for rows in (channels[name][1] for name in ("/box_adc", "/box_mag", "/joints"))]
    assert max(first for first, _ in ends) - min(first for first, _ in ends) < 1e9  # the same second
    assert max(last for _, last in ends) - min(last for _, last in ends) < 1e9


def test_every_number_is_that_of_the_tables(session, tmp_path):
    """All samples, at --rate 0, against the .npz of the same session: no tolerance."""
    channels = read(export(session, tmp_path / "x", "--format", "mcap", "--rate", "0"))
    tables = export(session, tmp_path / "y", "--format", "npz")
    for name in ("box_adc", "box_mag", "joints", "events", "sync"):
        with np.load(tables / f"{name}.npz", allow_pickle=False) as table:
            rows = [row for _, row in channels[f"/{name}"][1]]
            for title, column in table.items():
                given = [row.get(title, np.nan) for row in rows]
                np.testing.assert_array_equal(np.array(given), column)
    said = json.loads((tmp_path / "x" / "session.json").read_text())["tables"]
    assert said["session.mcap /box_mag"]["rows"] == len(channels["/box_mag"][1])
    assert sorted(os.listdir(tmp_path / "x")) == ["session.json", "session.mcap"]


def test_samples_are_thinned_out_and_all_else_is_whole(session, tmp_path):
    whole = read(export(session, tmp_path / "x", "--format", "mcap", "--rate", "0"))
    thin = read(export(session, tmp_path / "y", "--format", "mcap", "--rate", "20"))
    for name in ("/box_adc", "/box_mag", "/joints"):
        times = np.array([t for t, _ in thin[name][1]])
        assert len(times) == pytest.approx(20 * (times[-1] - times[0]) / 1e9, abs=2)
        assert set(times) <= {t for t, _ in whole[name][1]}
    for name in whole.keys() - {"/box_adc", "/box_mag", "/joints"}:
        assert thin[name][1] == whole[name][1]


def test_observations_stand_at_their_times(session, tmp_path):
    """Of a session with a rig: each row of a dwell is a message at the dwell's time, not at the start of the session."""
    path = tmp_path / "s.mcap"
    with SessionWriter(path, Lab()) as writer:
        for message in ball_bar_session(np.random.default_rng(1), dwells=4)[0]:
            writer.add(*message)
    write_rig(tmp_path / "rig.toml", RIG)
    channels = read(export(path, tmp_path / "x", "--format", "mcap", "--rig", str(tmp_path / "rig.toml")))
    rows, dwells = channels["/observations"][1], [row for _, row in channels["/dwells"][1] if not row["reason"]]
    offset = utc_less_host(path)
    assert len(rows) == len(dwells) >= 3
    for (t, row), dwell in zip(rows, dwells, strict=True):
        assert abs(t - offset - 1e9 * row["time_s"]) <= 1e3  # a double holds seconds of a host's clock to 0.1 µs
        assert dwell["host_start_ns"] <= t - offset <= dwell["host_end_ns"]


def test_a_row_without_a_time_stands_at_the_start(tmp_path):
    tables = McapTables(tmp_path, Placement(utc_offset_ns=10**18, begin_ns=5 * 10**9))
    columns = {"time_s": np.array([6.5, np.nan]), "length_m": np.array([0.4, 0.5])}
    tables.begin("observations", columns)[1].write(columns)
    tables.close()
    ((_, rows),) = read(tmp_path).values()
    assert rows == [(10**18 + 5 * 10**9, {"length_m": 0.5}), (10**18 + 6_500_000_000, {"time_s": 6.5, "length_m": 0.4})]


@pytest.mark.parametrize("more", [[], ["--format", "mcap"]])
def test_samples_are_those_that_inspect_counts(session, tmp_path, capsys, more):
    export(session, tmp_path / "x", *more)
    tables = json.loads((tmp_path / "x" / "session.json").read_text())["tables"]
    printed = capsys.readouterr().out
    assert main(["inspect", str(session), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert len(document["streams"]) == 2
    for stream in document["streams"]:
        ((name, table),) = ((name, table) for name, table in tables.items() if f"box_{stream['name']}" in name)
        assert table["session_rows"] == stream["samples"]
        fewer = f"{table['rows']} of " if more else ""
        assert f"{name}: {fewer}{stream['samples']} samples" in printed
    assert sum(stream["samples"] for stream in document["streams"]) == document["losses"]["samples"]
