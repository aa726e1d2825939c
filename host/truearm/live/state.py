"""State displayed to the operator of a recording, computed from the recorder's data.

It does no input or output and has no effect on the recording.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from truearm.box.monitor import LastSecond, value_of
from truearm.box.readiness import LINE_CHANNELS, LVDT
from truearm.live.live_dwells import ENOUGH_NS, ControllerTime, LiveDwell, LiveDwells, Strokes
from truearm.live.session_progress import SessionProgress, words_of
from truearm.record.operator import OperatorEvent
from truearm.session.box_ident import find_channel
from truearm.session.joint_format import JointLine
from truearm.session.samples import extension, railed, with_ratios
from truearm.text import counted, one_line
from truearm.types import BAR_MOUNTED
from truearm.units import MM, MM_S, NS, UM, US

if TYPE_CHECKING:
    from truearm.record.status import Status
    from truearm.session.box_frames import Data
    from truearm.session.box_ident import Ident
    from truearm.session.device_clock import OnlineEstimate
    from truearm.types import Floats, Rig

NEAR_END = 0.1  # of the travel, at each end
POSITION_BLOCKS = 8  # a tenth of a second: the bar may be moving
BAR_CELLS = 31
DRY_S = 2.0  # a stream without samples for this long is reported
SATURATED = "saturated: the bar is detached or a wire is broken"
CONTRADICTION = "contradiction"  # begins a line about a conflict between plan and operator
MOUNT_NEXT = (
    "at the next pose, mount"  # begins what to mount next: the arm still stands at the old pose when it is said
)
LATE_S = 1.0  # an older reading is shown as late


class ViewLine(NamedTuple):
    """A line of the view; ``alarm``: it needs the operator's attention."""

    name: str
    text: str
    alarm: bool = False


class LiveState:
    """State fed in order of arrival.

    ``wishes`` are events for the recorder to write and ``said`` lines for the operator; the caller removes both.
    """

    def __init__(self, session_progress: SessionProgress, rig: Rig | None, with_robot: bool) -> None:
        self.session_progress = session_progress
        self.wishes: deque[OperatorEvent] = deque()
        self.said: deque[str] = deque(maxlen=1000)
        self.last = ""
        self._rig, self._with_robot = rig, with_robot
        self._ident: Ident | None = None
        self._windows: dict[int, LastSecond] = {}
        self._dwells = LiveDwells(with_robot)
        self._box_time, self._robot_time = ControllerTime(), ControllerTime()
        self._strokes = Strokes()
        self._counted = False  # whether the current dwell has been counted
        self._pose: int | None = None  # of the plan; it has been announced
        self._label = ""
        self._readings: deque[int] = deque(maxlen=200)
        self._near_end: set[str] = set()  # channels
        self._asked: dict[str, str] | None = None
        self._lost = (0, 0)
        self._complete = session_progress.complete
        self.contradictions = 0  # dwells at which the confirmed parts differ from the plan
        self._came: dict[int, tuple[int | None, float]] = {}  # of a stream: its last n0, and since when

    # --- input from the recorder

    def ident(self, ident: Ident) -> None:
        """Take the box's description of itself, at the beginning and after a restart."""
        self._ident = ident
        self._windows.clear()

    def block(self, t_ns: int, data: Data) -> None:
        """Take samples of a stream."""
        stream = None if self._ident is None else self._ident.streams.get(data.stream)
        if stream is None or len(data.samples) % (4 * len(stream.channels)):
            return
        t_ns = self._box_time.host_ns(1000 * data.t0_us, t_ns)
        counts = with_ratios(np.frombuffer(data.samples, "<i4").reshape(-1, len(stream.channels)), stream.channels)
        self._windows.setdefault(stream.id, LastSecond()).take(data.n0, counts, data.period_ns)
        for k, channel in enumerate(stream.channels):
            if channel.length_unit is None:
                continue
            if channel.name == LVDT and not railed(counts[:, k]).any():
                self._ended(self._dwells.samples(t_ns, extension(counts[:, k], channel)))
            elif channel.name == LINE_CHANNELS[0] and (seen := counts[counts[:, k] != 0, k]).size:
                self._stroke(self._strokes.feed(t_ns, float(extension(seen, channel).mean())))

    def reading(self, t_ns: int, reading: JointLine) -> None:
        """Take a joint reading."""
        self._readings.append(t_ns)
        t_ns = self._robot_time.host_ns(int(NS.of(reading.t)), t_ns)
        self._ended(self._dwells.joints(t_ns, np.array(reading.q)))

    def look(self) -> None:
        """Update the state; call this regularly. A dwell may have become long enough, or a part may have to be changed."""
        standing = self._dwells.standing_ns
        if standing is None:
            self._counted = False
        elif standing >= ENOUGH_NS and not self._counted and self._may_count():
            self._take(self._dwells.q)
        change = self.session_progress.change()
        if change != self._asked:
            self._asked = change
            if change is not None:
                self.said.append(f"{MOUNT_NEXT} {words_of(change)}; then press Enter")
        self._watch_travel()

    def close(self) -> None:
        """End the current dwell, as the recording ends."""
        if self._counted:
            self._ended(self._dwells.under_way())

    # --- operator input

    def command(self, text: str) -> None:
        """Execute a typed line.

        Enter confirms what is asked for, a number selects a pairing of the plan, ``bar=…,chuck=…`` names one, ``note
        …`` is stored, and ``q`` ends the recording. Anything else prints help.
        """
        text = text.strip()
        word, _, rest = text.partition(" ")
        pairings = self.session_progress.pairings()
        if text == "q":
            self.wishes.append(OperatorEvent("end", {}))
        elif word == "note" and rest.strip():
            self.wishes.append(OperatorEvent("note", {"text": rest.strip()[:500]}))
            self.said.append(f"noted: {rest.strip()[:500]}")
        elif text == "" and (change := self.session_progress.change()) is not None:
            self._mount(change)
        elif text.isdecimal() and 1 <= int(text) <= len(pairings):
            self._mount(pairings[int(text) - 1])
        elif "=" in text:
            self._mount_named(text.removeprefix("m ").strip())
        else:
            self.said.append("; ".join(f"{n} {words_of(p)}" for n, p in enumerate(pairings, start=1)) + HELP)

    def _mount_named(self, text: str) -> None:
        from truearm.errors import InputError
        from truearm.live.mounted_parts import check_mounted, parse_mounted

        try:
            pairing = parse_mounted(text)
            if self._rig is not None:
                check_mounted(pairing, self._rig, "the rig")
        except InputError as exc:
            self.said.append(str(exc))
            return
        self._mount(pairing)

    def _mount(self, pairing: Mapping[str, str]) -> None:
        self.session_progress.mount(pairing)
        self.wishes.append(OperatorEvent("mounted", dict(self.session_progress.mounted)))
        self.said.append(f"mounted: {words_of(self.session_progress.mounted)}")

    # --- dwells and lines

    def _may_count(self) -> bool:
        return not self._lines_alone() and self._within_travel()

    def _take(self, q: Floats | None) -> None:
        """Count the current dwell, or the one that just ended."""
        session_progress = self.session_progress
        self._counted = True
        pose = session_progress.visit(q if self._with_robot else None)
        row = {} if pose is None else session_progress.rows[pose]
        self._pose = pose
        # Other commands number dwells otherwise: they count the stops for mounting too.
        self._label = f"dwell {session_progress.taken}" if pose is None else f"pose {pose}"
        if pose is None and session_progress.rows:
            self._label = "stop not in the plan"
        other = [key for key in BAR_MOUNTED if row.get(key) and row[key] != session_progress.mounted.get(key)]
        if other and session_progress.confirmed:  # if nobody has stated what is mounted, only the plan counts
            planned = ", ".join(f"{key} {row[key]}" for key in other)
            self.contradictions += 1
            self.said.append(
                f"{CONTRADICTION}: pose {pose} needs {planned}, but {words_of(session_progress.mounted)} was confirmed"
            )
        self._say_complete()

    def _ended(self, seen: LiveDwell | None) -> None:
        if seen is not None and not self._counted and self._may_count():
            self._take(seen.q)  # it became long enough and ended between two updates
        if seen is None or not self._counted:
            return
        self._counted = False
        fields: dict[str, Any] = {"begin_ns": seen.begin_ns, "end_ns": seen.end_ns, "settled": seen.settled}
        value = "no samples of the LVDT"
        if np.isfinite(seen.mean):
            value = (
                f"{MM.text(seen.mean, '+.4f')}, noise {UM.text(seen.noise, '.1f')}, drift {UM.text(seen.drift, '+.1f')}"
            )
            fields |= {"mean_m": seen.mean, "noise_m": seen.noise}
        if self._pose is not None:
            fields["pose"] = self._pose
        state = "settled" if seen.settled else "NOT settled"
        self.last = f"{self._label}: {NS.to_si(seen.end_ns - seen.begin_ns):.1f} s, {value}, {state}"
        self.said.append(self.last)
        self.wishes.append(OperatorEvent("dwell", fields))

    def _stroke(self, stroke: tuple[float, float] | None) -> None:
        if stroke is None:
            return
        row = self.session_progress.drive(self._dwells.q if self._with_robot else None)
        length, speed = stroke
        where = "line not in the plan"
        if row is not None or not self.session_progress.rows:
            where = f"line {self.session_progress.lines}" + (f" (row {row})" if row is not None else "")
        self.last = f"{where}: {MM.text(length, '.1f')} at {MM_S.text(speed, '.1f')}"
        self.said.append(self.last)
        fields: dict[str, Any] = {"length_m": length, "speed_m_s": speed}
        self.wishes.append(OperatorEvent("line", fields if row is None else {**fields, "pose": row}))
        self._say_complete()

    def _say_complete(self) -> None:
        if self.session_progress.complete and not self._complete:
            self._complete = True
            self.said.append("the plan is complete; type q and Enter to end the recording")

    def _lines_alone(self) -> bool:
        """Whether the plan has no dwells: a stop then is not a dwell."""
        return bool(self.session_progress.rows) and not self.session_progress.planned

    # --- sensor positions

    def _place(self, name: str) -> tuple[float | None, str]:
        """Return the position of a channel [m], None if unknown, and what is wrong."""
        found = None if self._ident is None else find_channel(self._ident, name)
        if found is None:
            return None, ""
        stream, index = found
        window, channel = self._windows.get(stream.id), stream.channels[index]
        if window is None or channel.length_unit is None:
            return None, ""
        counts = np.concatenate(list(window.blocks)[-POSITION_BLOCKS:])[:, index]
        if railed(counts).any():
            return None, SATURATED
        return float(extension(counts, channel).mean()), ""

    def _position(self) -> tuple[float | None, float | None, str]:
        """Return extension [m], half the travel [m] of the mounted bar, and what is wrong; None if unknown."""
        position, wrong = self._place(LVDT)
        bar = None if self._rig is None else self._rig.bars.get(self.session_progress.mounted.get("bar", ""))
        return position, None if bar is None else 0.5 * bar.travel, wrong

    def _needs_bar(self) -> bool:
        """Return whether a bar must be on now: at a dwell of the plan, or, if nothing shows dwells, once one is mounted."""
        session_progress = self.session_progress
        if not self._with_robot or not session_progress.planned:
            return bool(session_progress.mounted.get("bar"))
        if session_progress.complete or session_progress.change() is not None or self._dwells.standing_ns is None:
            return False
        return session_progress.is_pose(self._dwells.q)

    def _within_travel(self) -> bool:
        position, half, wrong = self._position()
        if position is None:
            return self._with_robot or not wrong
        return half is None or abs(position) <= half

    def _watch_travel(self) -> None:
        """Check the travel of the bar's LVDT, or of the transverse sensors of a line."""
        if "line" in self.session_progress.mounted:
            travel = None if self._rig is None else self._rig.line_travel
            half = None if travel is None else 0.5 * travel
            places = {name: self._place(name)[0] for name in LINE_CHANNELS[1:]}
        else:
            places, half = {LVDT: self._position()[0]}, self._position()[1]
        near = set[str]()
        for name, position in places.items():
            if position is None or half is None or abs(position) <= (1.0 - 2.0 * NEAR_END) * half:
                continue
            near.add(name)
            if name not in self._near_end:
                self.said.append(
                    f"warning: {name} is near the end of its travel: {MM.text(position, '+.2f')} of ±{MM.text(half, '.1f')}"
                )
        self._near_end = near

    # --- display

    def rows(self, status: Status, clock: OnlineEstimate | None) -> list[ViewLine]:
        """Return the complete view."""
        rows = [ViewLine("state", f"{status.state}, {status.elapsed_s:.0f} s", not status.box_ok)]
        rows += [] if "line" in self.session_progress.mounted else [self.travel()]
        for stream in () if self._ident is None else self._ident.streams.values():
            window = self._windows.get(stream.id)
            for k, channel in enumerate(stream.channels):
                if channel.name != LVDT and window is not None and window.blocks:
                    counts = np.concatenate(window.blocks)[:, k]
                    alarm = channel.name in self._near_end
                    rows.append(ViewLine(one_line(channel.name), value_of(counts, channel, stream), alarm))
        rows.append(self.rates(status))
        rows.append(ViewLine("clock", clock_words(status, clock)))
        if self._with_robot:
            rows.append(self.robot(status))
        rows.append(self.progress(status))
        change = self.session_progress.change()
        rows.append(ViewLine("mounted", words_of(self.session_progress.mounted)))
        if change is not None:
            rows.append(ViewLine("change", f"{MOUNT_NEXT} {words_of(change)}; then press Enter", True))
        if self.contradictions:
            text = f"at {counted(self.contradictions, 'dwell')}, something else was confirmed than the plan needs: name what is mounted, or correct them with truearm session relabel"
            rows.append(ViewLine(CONTRADICTION, text, True))
        rows.append(ViewLine("last", self.last or "nothing yet"))
        return rows

    def line(self, status: Status, clock: OnlineEstimate | None) -> str:
        """Return the view on one line, for a log."""
        place = self.along() if "line" in self.session_progress.mounted else self.travel(drawn=False)
        rows = [place, self.rates(status), ViewLine("clock", clock_words(status, clock))]
        rows += [self.robot(status)] if self._with_robot else []
        return "; ".join(f"{row.name} {row.text}" for row in (*rows, self.progress(status)))

    def travel(self, drawn: bool = True) -> ViewLine:
        """Return the position of the LVDT within its travel."""
        position, half, wrong = self._position()
        if wrong == SATURATED and not self._needs_bar():
            return ViewLine("lvdt", "saturated, as it is while the bar is detached")
        if position is None:
            return ViewLine("lvdt", wrong or "no calibrated LVDT", bool(wrong))
        text = MM.text(position, "+.4f")
        if half is None:
            return ViewLine("lvdt", text)
        text += f" of ±{MM.text(half, '.1f')}"
        place = round((BAR_CELLS - 1) * (0.5 + 0.5 * max(-1.0, min(1.0, position / half))))
        bar = "".join("●" if k == place else "┼" if k == BAR_CELLS // 2 else "─" for k in range(BAR_CELLS))
        alarm = abs(position) > (1.0 - 2.0 * NEAR_END) * half
        over = " BEYOND ITS TRAVEL" if abs(position) > half else " near its end" if alarm else ""
        return ViewLine("lvdt", f"├{bar}┤ {text}{over}" if drawn else text + over, alarm)

    def along(self) -> ViewLine:
        """Return the position of the magnet along the line device."""
        found = None if self._ident is None else find_channel(self._ident, LINE_CHANNELS[0])
        window = None if found is None else self._windows.get(found[0].id)
        if found is None or window is None or not window.blocks:
            return ViewLine("line", "no readings of its longitudinal sensor")
        counts = np.concatenate(window.blocks)[-1:, found[1]]
        return ViewLine("line", value_of(counts, found[0].channels[found[1]], found[0]).partition(" ±")[0])

    def rates(self, status: Status) -> ViewLine:
        """Return rates by the box's own stamps, and all losses."""
        counters = status.counters
        streams = {} if self._ident is None else self._ident.streams
        dry_s = {k: self._dry_s(k, w.next_n0, status) for k, w in self._windows.items()}
        rates = [
            f"{streams[k].name} "
            + (f"{NS.factor / w.period_ns:.1f} Hz" if dry_s[k] <= DRY_S else f"NO SAMPLES for {dry_s[k]:.0f} s")
            for k, w in sorted(self._windows.items())
            if k in streams and w.period_ns
        ]
        lost = (counters.lost_frames, counters.overruns_in_box)
        text = f"{', '.join(rates) or 'no samples'}; {counted(counters.samples, 'sample')}, {counted(lost[0], 'frame')} lost"
        more = (
            (lost[1], "samples lost in the box"),
            (counters.restarts, "restarts"),
            (counters.link_losses, "lost connections"),
        )
        text += "".join(f", {n} {what}" for n, what in more if n)
        alarm, self._lost = lost != self._lost, lost
        return ViewLine("samples", text, alarm or not rates or max(dry_s.values(), default=0.0) > DRY_S)

    def _dry_s(self, stream: int, n0: int | None, status: Status) -> float:
        """Return for how long a stream has not advanced although the box sends."""
        before = self._came.get(stream)
        if before is None or before[0] != n0 or not status.box_ok:
            before = self._came[stream] = n0, status.elapsed_s
        return status.elapsed_s - before[1]

    def robot(self, status: Status) -> ViewLine:
        """Return the state of the robot's link, its rate, and the age of its last reading."""
        age = status.robot_age_s
        if not status.robot_ok and status.robot_closed:
            return ViewLine("robot", f"closed its stream, last reading {_age(age)}")
        if not status.robot_ok:
            return ViewLine(
                "robot", f"lost, last reading {_age(age)}; trying to reach it again", not self.session_progress.complete
            )
        if status.robot_waits and age is not None and age > LATE_S:
            return ViewLine("robot", f"sends more than can be stored; the reading stored last came {_age(age)}", True)
        times = self._readings
        rate = (
            f"{NS.factor * (len(times) - 1) / (times[-1] - times[0]):.1f} readings/s"
            if len(times) > 1 and times[-1] > times[0]
            else "no readings yet"
        )
        late = age is None or age > LATE_S
        return ViewLine("robot", f"{rate}, last {_age(age)}", late and not self.session_progress.complete)

    def progress(self, status: Status) -> ViewLine:
        """Return the number of dwells and lines taken, and whether the robot may move on."""
        session_progress = self.session_progress
        if self._lines_alone():
            return ViewLine("lines", f"{session_progress.lines} of {session_progress.planned_lines}")
        parts = [
            f"{session_progress.taken} of {session_progress.planned}"
            if session_progress.planned
            else f"{session_progress.taken}"
        ]
        if session_progress.planned and session_progress.unplanned:
            parts.append(f"{session_progress.unplanned} not in the plan")
        if session_progress.lines or session_progress.planned_lines:
            parts.append(
                f"lines {session_progress.lines}"
                + (f" of {session_progress.planned_lines}" if session_progress.planned_lines else "")
            )
        standing = self._dwells.standing_ns
        if standing is not None and self._is_heard(status):
            parts.append(f"standing for {NS.to_si(standing):.1f} s" + (", long enough" if self._counted else ""))
        return ViewLine("dwells", ", ".join(parts))

    def _is_heard(self, status: Status) -> bool:
        """Return whether the source used for detecting dwells is sending."""
        if not self._with_robot:
            return status.box_ok
        return bool(status.robot_ok) and (status.robot_age_s or 0.0) <= LATE_S


HELP = " · Enter: mounted as asked · NUMBER, bar=NAME,chuck=NAME,sphere=NAME or line=NAME,target=NAME: this is mounted · note TEXT · q: end"


def clock_words(status: Status, clock: OnlineEstimate | None) -> str:
    """Describe how well the host knows the box's clock."""
    if clock is None:
        return "not known yet" if status.rtt_us is None else f"shortest round trip {status.rtt_us:.0f} µs"
    return f"± {US.text(NS.to_si(clock.bound_ns), '.0f')}, shortest round trip {US.text(NS.to_si(clock.rtt_min_ns), '.0f')}"


def _age(age_s: float | None) -> str:
    return "never" if age_s is None else f"{age_s:.1f} s ago"
