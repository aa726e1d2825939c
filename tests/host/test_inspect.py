"""``truearm inspect`` from the user's point of view."""

import json

import numpy as np
import pytest
from mcap.reader import SeekingReader
from session_stream import PERIOD_NS, RIG, columns_of, ident_document, session, write_session
from tests.host.findings_bench import listed

from truearm.errors import SessionError
from truearm.finding_texts import STATEMENTS, Severity
from truearm.report.session_findings import REJECTED
from truearm.types import Message
from truearm.workflows.inputs import Sources, read_sources
from truearm.workflows.inspect import Contents
from truearm.workflows.recorded_session import observations_of_session, open_finished

EVIL = b'Traceback:\r\n  File "\x1b]0;owned\x07\x1b[2J\xff\x9b31m"\r\nline two\n'


@pytest.fixture(scope="module")
def stream():
    return session(np.random.default_rng(2), dwells=5)[0]


def test_json_says_what_was_put_in(stream, tmp_path, run):
    spoilt = list(stream)
    places = [i for i, m in enumerate(spoilt) if m.topic == "/box/adc"]
    spoilt.insert(places[40], Message("/box/console", 5 * 10**9, EVIL))
    spoilt.insert(places[30], spoilt[places[30]])
    del spoilt[places[20]]
    spoilt += [Message("/plan", 9 * 10**9, b'{"q": "x"}'), Message("/events", 9 * 10**9, b"{}")]
    code, out, err = run("inspect", write_session(tmp_path / "s.mcap", spoilt, RIG), "--json")
    assert (code, err) == (0, "")
    said = json.loads(out)
    losses = {key: value for key, value in said["losses"].items() if value}
    assert (losses["frames_lost"], losses["samples_lost"], losses["frames_malformed"]) == (1, 13, 1)
    assert (losses["console_runs"], losses["console_bytes"]) == (1, len(EVIL))
    assert not {"restarts", "samples_overrun", "sync_unanswered"} & set(losses)
    assert listed(said)["malformed-plan"]["plan_events_malformed"] == 2
    (adc,) = said["streams"]
    assert adc["rate_nominal_hz"] == pytest.approx(1e9 / PERIOD_NS)
    assert adc["rate_by_host_hz"] == pytest.approx(1e9 / PERIOD_NS, rel=1e-6)  # stamps are cut to 1 µs over 15 s
    assert adc["rate_measured_hz"] / adc["rate_by_host_hz"] == pytest.approx(1.0 - 31e-6, abs=1e-6)
    (clock,) = said["clock"]
    assert clock["rate_ppm"] == pytest.approx(-31.0, abs=2.0)
    assert clock["half_asymmetry_ns"] <= clock["bound_ns"]
    values = listed(said)["box-clock"]
    assert values["rate"] == f"{-clock['rate_ppm']:.3f} ppm slower"
    assert said["robot"]["rate_hz"] == pytest.approx(125.0, abs=0.1)
    assert (said["dwells"]["found"], said["dwells"]["observations"], said["dwells"]["rejected"]) == (5, 5, {})
    for row in said["dwells"]["table"]:
        assert row["t_robot_s"] == pytest.approx(row["controller_start_s"] - row["settling_s"], abs=1e-9)
        assert row["used_s"] == row["controller_end_s"] - row["controller_start_s"] > 1.0
        assert row["length_m"] == row["value_m"] > 0.0


def test_a_host_clock_that_stepped_is_said(stream, tmp_path, run):
    """5 ms ahead from the middle on: far beyond the round trip."""

    def stepped(message):
        row = json.loads(message.data)
        ahead = 5_000_000 if row["t0_ns"] > middle_ns else 0
        return message._replace(data=json.dumps(row | {key: row[key] + ahead for key in ("t0_ns", "t3_ns")}).encode())

    times = [json.loads(m.data)["t0_ns"] for m in stream if m.topic == "/sync"]
    middle_ns = (min(times) + max(times)) // 2
    path = write_session(tmp_path / "s.mcap", [stepped(m) if m.topic == "/sync" else m for m in stream], RIG)
    document = json.loads(run("inspect", path, "--json")[1])
    (change,) = document["clock"][0]["changes"]
    assert change["by_ns"] == pytest.approx(5e6, abs=5e5)  # a round trip
    assert listed(document)["clock-stepped"]["change"] == {"us": pytest.approx(1e-3 * change["by_ns"])}


def test_text_has_no_control_characters_of_the_file(stream, tmp_path, run):
    events = [Message("/events", 2, b'{"kind":"a\\u001b[2Jb"}')]
    console = [Message("/box/console", 3, EVIL)] * 12
    code, out, err = run("inspect", write_session(tmp_path / "s.mcap", [*events, *console, *stream]), "--details")
    assert (code, err) == (0, "")
    assert all(c.isprintable() or c == "\n" for c in out)
    for words in ("\\x1b]0;owned\\x07", "line two", "2 more"):
        assert words in out


def test_a_clean_session_says_so(stream, tmp_path, run):
    path = write_session(tmp_path / "s.mcap", stream, RIG)
    findings = listed(json.loads(run("inspect", path, "--json").out))
    assert next(iter(findings)) == "session-usable"
    assert findings["session-usable"]["observations"] == findings["session-usable"]["dwells"] == 5
    assert findings["received"]["complete"]
    assert not {STATEMENTS[code].severity for code in findings} & {Severity.REFUSAL, Severity.WARNING}
    lines = run("inspect", path).out.splitlines()
    assert lines[0].startswith("Usable: 5 observations")
    assert len(lines) <= 15


@pytest.mark.parametrize(
    ("rig", "says"), [(b"[[bar]]\nname=1", "rig.toml"), (b"\xff", "UTF-8"), (b"", "b46"), (b"x = [" * 9999, "rig.toml")]
)
def test_a_wrong_rig_hides_nothing_of_the_session(stream, tmp_path, run, rig, says):
    code, out, err = run("inspect", write_session(tmp_path / "s.mcap", stream, rig), "--json")
    assert (code, err) == (0, "")
    dwells = json.loads(out)["dwells"]
    assert says in dwells["not_paired"]
    assert dwells["found"] == 5


def test_without_a_rig_the_sentence_is_whole(stream, tmp_path, run):
    path = write_session(tmp_path / "s.mcap", stream)
    reason = listed(json.loads(run("inspect", path, "--json").out))["session-not-evaluated"]["reason"]
    assert reason.startswith("the session ")
    said = " ".join(run("inspect", path).out.split())
    assert f"because {reason}." in said
    assert said.count("--rig") == 1


def test_ident_of_the_metadata_serves(stream, tmp_path, run):
    without = [m for m in stream if m.topic != "/box/ident"]
    document = {**ident_document(), "uid": "0102"}
    code, out, _ = run(
        "inspect", write_session(tmp_path / "s.mcap", without, RIG, box={"ident": json.dumps(document)}), "--json"
    )
    assert code == 0
    assert json.loads(out)["dwells"]["observations"] == 5


def test_an_empty_session(tmp_path, run):
    path = write_session(tmp_path / "s.mcap", [])
    code, out, err = run("inspect", path)
    assert (code, err) == (0, "")
    assert out.startswith("Not usable")
    document = json.loads(run("inspect", path, "--json").out)
    assert document["duration_s"] == 0.0
    assert next(iter(listed(document))) == "no-box-data"


def test_bad_files_are_one_line_and_exit_2(stream, tmp_path, run):
    whole = write_session(tmp_path / "whole.mcap", stream).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "no.mcap").write_bytes(b"not a session")
    wrong_ident = write_session(tmp_path / "ident.mcap", stream, box={"ident": json.dumps(["no", "map"])})
    for path in (tmp_path / "missing.mcap", tmp_path / "cut.mcap", tmp_path / "no.mcap", tmp_path, wrong_ident):
        code, out, err = run("inspect", path)
        assert (code, out) == (2, ""), path
        assert err.startswith("truearm: ")
        assert err.count("\n") == 1
        assert "Traceback" not in err


def test_truncated_session_on_request(stream, tmp_path, run):
    whole = write_session(tmp_path / "whole.mcap", stream).read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: len(whole) * 3 // 4])
    code, out, err = run("inspect", path, "--allow-damaged", "--json")
    assert (code, err) == (0, "")
    said = json.loads(out)
    assert said["truncated"] is True
    assert 0 < said["losses"]["frames"] < sum(m.topic.startswith("/box/") for m in stream)
    assert said["losses"]["frames_lost"] == 0


def test_a_damaged_session_on_request(stream, tmp_path, run):
    path = write_session(tmp_path / "s.mcap", stream, RIG)
    whole = bytearray(path.read_bytes())
    with path.open("rb") as file:
        chunks = SeekingReader(file).get_summary().chunk_indexes
    at = chunks[len(chunks) // 2].chunk_start_offset
    whole[at + 200] ^= 4
    path.write_bytes(whole)
    code, out, err = run("inspect", path)
    assert (code, out) == (2, "")
    assert "--allow-damaged" in err
    with pytest.raises(SessionError):
        observations_of_session(open_finished(path))
    code, out, err = run("inspect", path, "--allow-damaged", "--json")
    assert (code, err) == (0, "")
    findings = listed(json.loads(out))
    assert findings["session-damaged"]["at"] == at
    assert 0.0 < findings["session-damaged"]["lost_s"] < findings["session-damaged"]["of_s"]
    assert "session-incomplete" not in findings
    assert not findings["received"]["complete"]
    observed = read_sources(Sources((path,), allow_damaged=True), None)
    assert len(observed.table) >= 3
    (damaged, *_) = observed.findings
    assert (damaged.code, damaged.values["at"], damaged.values["place"]) == ("session-damaged", at, str(path))


def test_a_box_that_falls_silent_is_a_loss(stream, tmp_path, run):
    """Frames end at 5 s, the robot goes on: the link was lost and never came back, so no count has a gap."""
    start = min(m.t_host_ns for m in stream)
    cut = [m for m in stream if not m.topic.startswith("/box/") or m.t_host_ns < start + 5 * 10**9]
    end = max(m.t_host_ns for m in cut)
    last = max(m.t_host_ns for m in cut if m.topic.startswith("/box/"))
    path = write_session(tmp_path / "s.mcap", cut)
    document = json.loads(run("inspect", path, "--json")[1])
    said = document["losses"]
    (gap,) = said["silences"]
    assert (gap["from_s"], gap["to_s"]) == pytest.approx((1e-9 * (last - start), 1e-9 * (end - start)))
    assert said["frames_lost"] == 0
    assert said["samples_missing"] == round((end - last) / PERIOD_NS)
    findings = listed(document)
    assert findings["lost-on-link"]["periods"][0].startswith("5.0 to ")
    assert findings["lost-on-link"]["missing"] == said["samples_missing"]
    assert not findings["received"]["complete"]


def test_a_short_silence_counts_where_the_link_was_lost(stream, tmp_path, run):
    start = min(m.t_host_ns for m in stream if m.topic.startswith("/box/"))
    lost_ns = start + 6 * 10**9
    rest = [m for m in stream if not m.topic.startswith("/box/") or not lost_ns < m.t_host_ns < lost_ns + 10**9]
    at = next(i for i, m in enumerate(rest) if m.t_host_ns > lost_ns)
    for event, silences in ((b'{"kind":"link-lost"}', 1), (b'{"kind":"other"}', 0)):
        path = write_session(
            tmp_path / f"{silences}.mcap", [*rest[:at], Message("/events", lost_ns, event), *rest[at:]]
        )
        losses = json.loads(run("inspect", path, "--json")[1])["losses"]
        assert len(losses["silences"]) == silences
        assert (losses["samples_missing"] >= 900) == bool(silences)


def test_what_came_late_after_a_silence_is_not_missing(stream, tmp_path, run):
    """The computer slept for 6 s and then received everything: 6107 samples were said to be missing of which none is."""
    start = min(m.t_host_ns for m in stream if m.topic.startswith("/box/"))
    asleep, awake = start + 5 * 10**9, start + 11 * 10**9
    late = [m._replace(t_host_ns=awake) if asleep < m.t_host_ns < awake else m for m in stream]
    document = json.loads(run("inspect", write_session(tmp_path / "s.mcap", late), "--json")[1])
    losses = document["losses"]
    assert len(losses["silences"]) == 1
    assert losses["samples_missing"] == losses["samples_lost"] == 0
    assert listed(document)["received"]["complete"]


def test_stops_between_poses_are_said_to_be_such(stream, tmp_path, run):
    plan = [m for m in stream if m.topic == "/plan"]
    rest = [m for m in stream if m.topic != "/plan"]
    path = write_session(tmp_path / "s.mcap", [plan[0], *rest], RIG)
    findings = listed(json.loads(run("inspect", path, "--json").out))
    assert findings["rejected-off-plan"] == {"rejected": "4 dwells"}
    assert "rejected-unlabelled" not in findings


def test_every_group_of_reasons_is_a_finding():
    assert set(REJECTED) <= set(STATEMENTS)


def test_readings_of_other_joints_are_malformed(stream, tmp_path, run):
    odd = [Message("/robot/console", m.t_host_ns, b'{"t": 1, "seq": 1, "q": [1]}') for m in stream[:7]]
    odd += [Message("/robot/console", m.t_host_ns, b"hello") for m in stream[:7]]
    robot = json.loads(run("inspect", write_session(tmp_path / "s.mcap", [*odd, *stream]), "--json")[1])["robot"]
    assert robot["malformed"] == 7


@pytest.mark.parametrize("batch", [1, 3, 1000])
def test_silences_of_the_box(batch):
    """Longer than two seconds, or however short if the recorder lost the box."""
    times = [t for k in range(400) if not 20.05e9 < (t := k * 10**8) < 25.95e9]
    rows = [Message("/box/adc", t, b"") for t in times] + [Message("/events", 35_050_000_000, b'{"kind":"link-lost"}')]
    rows = [*sorted(rows, key=lambda m: m.t_host_ns), Message("/events", 41_950_000_000, b"{}")]
    contents = Contents()
    list(contents.watched(columns_of(rows[at : at + batch]) for at in range(0, len(rows), batch)))
    expected = [(20_000_000_000, 26_000_000_000), (35_000_000_000, 35_100_000_000), (39_900_000_000, 41_950_000_000)]
    assert contents.silences == expected
