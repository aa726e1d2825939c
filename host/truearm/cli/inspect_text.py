"""What ``truearm inspect`` prints, from the document that ``--json`` prints."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from truearm.session.dwells import MOUNTING, NEED_DECISION
from truearm.session.losses import COUNTERS, EXTREMES
from truearm.text import counted, faster, one_line
from truearm.types import BAR_MOUNTED
from truearm.units import DEGC, MM_S, NS, ONE, UM, URAD, US, Scale

DWELLS = 24  # listed one by one
LOSSES = (
    ("frames_lost", "frames lost on the link"),
    ("frames_duplicated", "frames doubled"),
    ("frames_late", "frames too late"),
    ("frames_malformed", "frames malformed"),
    ("frames_unknown", "frames of unknown types"),
    ("samples_lost", "samples lost with frames"),
    ("samples_overrun", "samples overrun in the box"),
    ("blocks_without_ident", "blocks of a stream that the box never described"),
    ("converter_faults", "blocks with a converter fault"),
    ("console_runs", "runs of bytes that are not a frame"),
    ("restarts", "restarts of the box"),
    ("sync_unanswered", "clock requests unanswered"),
)
BOX_WORDS = {  # of the box's counters; others are called by their names
    "dropped": "frames dropped by the box",
    "short_writes": "frames that the link accepted only in pieces (nothing lost)",
    "overruns": "overruns by the box's count",
    "bad_frames": "bad frames received by the box",
    "crc_errors": "damaged frames of the box's converter",
    "converter_resets": "resets of the box's converter by itself",
    "missing_stops": "magnetostrictive interrogations without a stop pulse",
    "thermometer_errors": "failed readings of a thermometer",
}
MEANINGS = {  # of reasons of a rejected dwell; the others say it themselves
    "clock": "the error of the box's clock is not known well enough",
    "drift": "the bar's length still changed",
    "gap": "samples are missing",
    "no clock": "the box answered no clock request",
    "noisy": "five times the noise of the other dwells",
    "rail": "the sensor was saturated, or the converter had a fault",
    "ringing": "the bar's length still oscillated",
}
EDGE_WORDS = (  # of trigger edges that are not used
    ("unseen", "not visible in any reading"),
    ("unclear", "with several possible matches"),
    ("rejected", "contradicting the others"),
)
EXTREME_WORDS = {
    "loop_max_us": "longest loop {} µs",
    "gc_max_us": "longest garbage collection {} µs",
    "heap_free_min": "least free heap {} bytes",
}


def lines(document: Mapping[str, Any]) -> Iterator[str]:
    """The lines to print. Names from the file have their control characters made visible; console text has so already."""
    state = ", incomplete: what followed is lost, or its recorder is still running" if document["truncated"] else ""
    yield f"{one_line(document['file'])}: {document['duration_s']:.1f} s{state}"
    yield from _damage(document["damage"])
    yield from _session(document)
    yield from _topics(document["topics"])
    yield from _streams(document["streams"])
    yield from _losses(document["losses"], len(document["streams"]))
    yield from _console(document)
    yield from _temperature(document["temperature_degc"])
    yield from _clock(document["clock"])
    yield from _robot(document["robot"], document["metadata"]["joints-added"])
    foreign = document["metadata"]["session-end"].get("robot_foreign", "0")
    if foreign != "0":
        yield one_line(f"  datagrams from other addresses than the robot's, not stored: {foreign}")
    yield from _dwells(document)


def _damage(damage: list[Mapping[str, Any]]) -> Iterator[str]:
    from truearm.session.session_file import words_of

    for piece in damage:
        yield "  " + words_of(**piece)
    if damage:
        yield "  the losses below include these, although no link lost them; not those before the first message that is left"


def _session(document: Mapping[str, Any]) -> Iterator[str]:
    session = document["metadata"]["session"]
    if recovered := document["metadata"]["recovered"]:
        lost = recovered.get("messages_lost", "?")
        yield "  " + one_line(
            f"recovered from {recovered.get('source', '?')}: {counted(lost, 'message')} known to be lost"
        )
    lines = [f"truearm {session['version']}"] if "version" in session else []
    lines += [f"{session['clock']} clock"] if "clock" in session else []
    lines += [f"firmware {', '.join(document['firmware'])}"] if document["firmware"] else []
    lines += [f"attached {', '.join(document['attachments'])}"] if document["attachments"] else []
    if lines:
        yield "  " + one_line("; ".join(lines))


def _topics(topics: Mapping[str, Any]) -> Iterator[str]:
    yield f"{'topic':24} {'messages':>9} {'rate/Hz':>9} {'longest gap/s':>13} {'bytes':>11}"
    for name, topic in topics.items():
        rate = _number(topic["rate_hz"], ".2f")
        silence = f"{topic['longest_silence_s']:.3f}"
        yield f"{one_line(name):24} {topic['messages']:>9} {rate:>9} {silence:>13} {topic['bytes']:>11}"


def _streams(streams: list[Mapping[str, Any]]) -> Iterator[str]:
    for stream in streams:
        yield (
            f"stream {one_line(stream['name'])} ({one_line(', '.join(stream['channels']))}): {counted(stream['samples'], 'sample')}, "
            f"{_number(stream['rate_nominal_hz'], '.4f')} Hz nominal, {_number(stream['rate_measured_hz'], '.4f')} by the "
            f"box's stamps, {_number(stream['rate_by_host_hz'], '.4f')} by the host's clock; uninterrupted pieces: {stream['pieces']}"
        )


def _losses(losses: Mapping[str, Any], n_streams: int) -> Iterator[str]:
    together = f" of {n_streams} streams" if n_streams > 1 else ""
    yield (
        f"frames: {losses['frames']} received, {counted(losses['samples'], 'sample')}{together} in "
        f"{counted(losses['blocks'], 'block')}"
    )
    box = losses["box"]
    counts = [(losses[key], text) for key, text in LOSSES]
    counts += [(box[key], BOX_WORDS.get(key, f"{key} by the box's count")) for key in COUNTERS if key != "sent"]
    wrong = [f"  {count:>6} {_singular(text) if count == 1 else text}" for count, text in counts if count]
    wrong += [f"  the box was silent from {gap['from_s']:.1f} to {gap['to_s']:.1f} s" for gap in losses["silences"]]
    if losses["samples_missing"]:
        wrong.append(
            f"  {losses['samples_missing']:>6} {'sample' if losses['samples_missing'] == 1 else 'samples'} missing by the nominal rate while it was silent"
        )
    yield from wrong or ["  nothing lost, nothing duplicated, no restart"]
    if box["heartbeats"]:
        worst = ((key, box[key]) for _, key in EXTREMES.values() if box[key] is not None)
        worst_words = ", ".join(EXTREME_WORDS.get(key, key + " {}").format(value) for key, value in worst)
        yield f"  {box['heartbeats']} heartbeats: {worst_words}"


def _singular(text: str) -> str:
    """Return a text with its first plural in the singular: "frame lost on the link"."""
    return re.sub(r"\b([a-z]{2,})s\b", r"\1", text, count=1)


def _console(document: Mapping[str, Any]) -> Iterator[str]:
    losses = document["losses"]
    if not losses["console_runs"]:
        return
    yield (
        f"not frames: {counted(losses['console_runs'], 'run')}, {counted(losses['console_bytes'], 'byte')}; "
        f"runs of text: {losses['console_text_runs']}"
    )
    for run in document["console"]:
        for line in run.splitlines():
            yield "  | " + line
    if losses["console_runs"] > len(document["console"]):
        yield f"  | … {losses['console_runs'] - len(document['console'])} more"


def _temperature(degc: Mapping[str, Any]) -> Iterator[str]:
    """Nothing for a box that sends none."""
    read = [("box", degc["box"]), *((one_line(name) or "unnamed", of) for name, of in degc["thermometers"].items())]
    texts = [f"{name} {DEGC.of(of[0]):.1f} to {DEGC.text(of[1], '.1f')}" for name, of in read if of is not None]
    if texts:
        yield f"temperature: {', '.join(texts)}"


def _clock(reports: list[Mapping[str, Any]]) -> Iterator[str]:
    if not reports:
        yield "clock: no exchange was answered; samples cannot be placed in time"
    for report in reports:
        varies = f" (varies by {report['rate_range_ppm']:.3f} ppm)" if report["windows"] > 1 else ""
        yield (
            f"clock, segment {report['segment']}: host − box {NS.to_si(report['offset_ns']):.6f} s, the host counts "
            f"{faster(report['rate_ppm'], 3)}{varies}"
        )
        yield (
            f"  error at most {_of_ns(report['bound_ns'], '.1f')} µs; of this, {_of_ns(report['half_asymmetry_ns'], '.1f')} µs is half the shortest "
            "round trip, because the two directions may differ"
        )
        yield (
            f"  {counted(report['exchanges'], 'exchange')} ({report['rejected']} rejected) in "
            f"{counted(report['windows'], 'window')}{_spread(report['spread_ns'], '.2f')}"
        )
        yield f"  round trip {_of_ns(report['rtt_min_ns'], '.1f')} µs (shortest), {_of_ns(report['rtt_median_ns'], '.1f')} µs (median)"
        for change in report["changes"]:
            begin, end = (US.to_si(at) for at in change["device_us"])
            yield (
                f"  host − device changed by {_of_ns(change['by_ns'], '+.1f')} µs between {begin:.3f} s and {end:.3f} s of "
                "the box's clock: a clock stepped or was slewed"
            )


def _robot(robot: Mapping[str, Any], added: Mapping[str, str]) -> Iterator[str]:
    if not robot["readings"]:
        sent = (
            f"; {counted(robot['console_bytes'], 'byte that is no reading', 'bytes that are no readings')}"
            if robot["console_bytes"]
            else ""
        )
        yield f"robot: no joint readings{sent}"
        return
    yield (
        f"robot: {counted(robot['readings'], 'reading')} of {robot['joints']} joints at {_number(robot['rate_hz'], '.2f')} Hz; "
        f"{'an unknown number' if robot['lost'] is None else robot['lost']} lost, {counted(robot['gaps'], 'gap')}, {robot['late']} late, {robot['duplicated']} duplicated, "
        f"{robot['malformed']} malformed, {counted(robot['restarts'], 'restart')}"
    )
    if added:
        when = added.get("time", "?")
        yield "  " + one_line(
            f"added afterwards from {added.get('source', '?')}; their arrival was not observed. Controller time: {when}; its error is unknown"
        )
        return
    for report in robot["clock"]:
        yield from _edges(report["edges"])
        yield (
            f"  clock: the host counts {faster(report['rate_ppm'], 3)}{_spread(report['spread_ns'], '.1f')}; readings arrive "
            f"{_of_ns(report['jitter_ns'], '.0f')} µs later than the fastest one (mean); a constant latency cannot be determined"
        )


def _edges(edges: Mapping[str, Any] | None) -> Iterator[str]:
    if edges is None:
        return
    wrong = [f"{edges[key]} {text}" for key, text in EDGE_WORDS if edges[key]]
    if edges["stray"]:
        wrong.append(f"{counted(edges['stray'], 'change', 'changes')} of the input without an edge")
    counts = "; ".join([f"{edges['used']} of {edges['edges']} edges agree", *wrong])
    if not edges["used"]:
        yield f"  trigger: no input follows the box's output ({counted(edges['edges'], 'edge')}); is it wired, and are the readings' inputs recorded?"
        return
    use = "in use" if edges["in_use"] else "not applied, because arrivals are more accurate"
    inverted = "inverted, " if edges["inverted"] else ""
    yield (
        f"  trigger on input {edges['input']} ({inverted}{use}): {counts}; error of robot to box at most {_of_ns(edges['to_box_ns'], '.0f')} µs (median), of "
        f"robot to host at most {_of_ns(edges['bound_ns'], '.0f')} µs, not counting a filter of the input; the link's shortest latency is "
        f"{_of_ns(edges['shortest_latency_ns'], '.0f')} µs"
    )
    least, most = edges["falling_later_ns"]
    if least is not None:
        yield f"  the input's delay of falling edges, minus that of rising edges: {_of_ns(least, '.0f')} to {_of_ns(most, '.0f')} µs"


def _dwells(document: Mapping[str, Any]) -> Iterator[str]:
    dwells, passes = document["dwells"], document["passes"]
    if passes["found"] and not document["plan_poses"] and not any("bar" in row for row in dwells["table"]):
        yield f"dwells: {counted(dwells['found'], 'stop')}, none with a ball-bar"
        yield from _passes(passes)
        yield from _events(document)
        return
    became = f", {counted(dwells['observations'], 'observation')}" if dwells["observations"] is not None else ""
    mountings = f"; {counted(dwells['mountings'], 'stop')} for mounting" * bool(dwells["mountings"])
    planned = f" ({document['plan_poses']} poses planned)" if document["plan_poses"] else ""
    yield f"dwells: {dwells['found'] - dwells['mountings']} found{planned}{became}{mountings}"
    for reason, count in dwells["rejected"].items():
        yield f"  {count:>6} rejected: {reason}{_explained(reason, bool(document['plan_poses']))}"
    yield from _dwell_table(dwells["table"])
    if dwells["not_paired"]:
        yield f"  not paired with bars: {dwells['not_paired']}"
    yield from _passes(passes)
    yield from _events(document)


def _events(document: Mapping[str, Any]) -> Iterator[str]:
    if document["events"]:
        yield "events: " + one_line(", ".join(f"{count} {kind}" for kind, count in document["events"].items()))


def _passes(passes: Mapping[str, Any]) -> Iterator[str]:
    """Nothing where no line was planned or driven."""
    if not passes["planned"] and not passes["found"]:
        return
    if passes["found"] is None:
        yield f"lines: {passes['planned']} planned; not paired"
        return
    yield f"lines: {passes['planned']} planned, {passes['found']} driven, {counted(passes['points'], 'point')}"
    for reason, count in passes["rejected"].items():
        yield f"  {count:>6} rejected: {reason}"
    good = [row for row in passes["table"] if not row["reason"]]
    if good:
        late_s = max(row["time_sigma_s"] for row in good)
        off_m = max(row["time_sigma_s"] * row["speed_m_s"] for row in good)
        yield (
            f"  each point uses {max(row['window_s'] for row in good):.2f} s of samples; its time is known to {US.text(late_s, '.0f')} "
            f"({UM.text(off_m, '.0f')} at this speed); a constant delay remains, which identify estimates from lines driven there and back"
        )
    yield f"  {'pass':>6} {'robot time/s':>12} {'mm/s':>7} {'points':>6} {'noise x, y, z/µm':>17} {'joints/µrad':>11}  line"
    shown = passes["table"] if len(passes["table"]) <= DWELLS else [row for row in passes["table"] if row["reason"]]
    for row in shown[:DWELLS]:
        yield _pass_line(row)
    if len(shown) > DWELLS:
        yield f"  … {len(shown) - DWELLS} more; --json has all"


def _pass_line(row: Mapping[str, Any]) -> str:
    noise = " ".join(_number(value, ".1f", UM) for value in row["noise_m"])
    joints = _number(max(row["joint_noise"], default=None), ".1f", URAD)
    way = {1: ", y increases", -1: ", y decreases"}.get(row["direction"], "")
    dropped = "".join(f", {counted(count, 'point')} not made: {reason}" for reason, count in row["dropped"].items())
    became = f", {row['reason']}" if row["reason"] else ""
    return (
        f"  {row['pass']:>6} {row['t_robot_s']:>12.1f} {_number(row['speed_m_s'], '.1f', MM_S):>7} {row['points']:>6} {noise:>17} "
        f"{joints:>11}  {one_line(row['line'])}{way}{became}{dropped}"
    )


def _dwell_table(rows: list[Mapping[str, Any]]) -> Iterator[str]:
    """All dwells of a short session; of a long one those that were rejected."""
    good = sorted(row["settling_s"] for row in rows if not row["reason"])
    if good:
        yield f"  settling time: median {good[len(good) // 2]:.2f} s, longest {good[-1]:.2f} s"
    shown = rows if len(rows) <= DWELLS else [row for row in rows if row["reason"] not in ("", MOUNTING)]
    if shown:
        yield f"  {'dwell':>6} {'robot time/s':>12} {'settling/s':>10} {'used/s':>7} {'pose':>5}  mounted"
    for row in shown[:DWELLS]:
        fittings = " ".join(row[key] for key in BAR_MOUNTED if key in row)
        became = f"{row['reason']}: {row['detail']}" if row["detail"] else row["reason"]
        pose = "-" if row["pose"] is None else row["pose"]
        yield (
            f"  {row['dwell']:>6} {row['t_robot_s']:>12.1f} {row['settling_s']:>10.2f} {row['used_s']:>7.2f} {pose:>5}  "
            f"{one_line(fittings) or '-'}{', ' if became else ''}{one_line(became)}"
        )
    if len(shown) > DWELLS:
        yield f"  … {len(shown) - DWELLS} more; --json has all"


def _explained(reason: str, planned: bool) -> str:
    if reason in NEED_DECISION:
        return " (decide what was mounted with truearm session relabel)"
    if reason in MEANINGS:
        return f" ({MEANINGS[reason]})"
    if reason != "no plan match":
        return ""
    if planned:
        return " (the robot stood where the plan has no pose, probably between two poses)"
    return " (the session does not say which bar, chuck and sphere were mounted; decide with truearm session relabel)"


def _number(value: float | None, form: str, scale: Scale = ONE) -> str:
    return "-" if value is None else format(scale.of(value), form)


def _spread(spread_ns: float | None, form: str) -> str:
    """Return how far neighbouring windows of a clock fit disagree; empty if there is one window."""
    return "" if spread_ns is None else f"; neighbouring windows differ by {_of_ns(spread_ns, form)} µs (RMS)"


def _of_ns(time_ns: float | None, form: str) -> str:
    """In µs."""
    return _number(None if time_ns is None else NS.to_si(time_ns), form, US)
