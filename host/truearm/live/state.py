"""What the operator of a recording is shown: the recorder's counts, the sensors, and the progress through the plan.

The recorder calls it in its own thread; an error ends the view alone. A row of the view has a text and ``alarms`` that
need the operator's attention. Every alarm that begins, changes or ends is also a message.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.box.condition import LINE_CHANNELS, LVDT, Purpose, check_box, far_from_calibration
from truearm.box.monitor import LastSecond, value_of
from truearm.errors import Argument, InputError
from truearm.finding_texts import Severity
from truearm.findings import Finding, option
from truearm.record.intake import SILENCE_S
from truearm.record.operator import Operator, OperatorEvent, Status
from truearm.session.dwells import DRIFT_SIGMAS, LEAST_LAGS, MICRON, mean_of
from truearm.session.frames import Channel, Data, Ident, Stream
from truearm.session.joint_format import JointLine
from truearm.session.samples import counts_of, extension, railed
from truearm.text import counted, one_line
from truearm.types import BAR_MOUNTED, LINE_MOUNTED, MOUNTED, Floats, Move, Rig
from truearm.units import MM, NS, UM, US

MOUNTABLE = (*BAR_MOUNTED, "shell", *LINE_MOUNTED)
TOLERANCE = np.pi / 180.0  # rad or m, as in session.dwells
JOINT_RANGE, SENSOR_RANGE = 1e-3, 2e-4  # rad or m, and m: the readings of a rest lie within this
GAP_S = 0.3  # after such a gap the state is not known
STANDING_S = 0.3  # is displayed
ENOUGH_S = 1.6  # half a second to settle, a second of samples, and a guard, as in session.dwells
NEAR_END = 0.1  # of the travel, at each end
DISPLAYED_BLOCKS = 8  # a tenth of a second: the bar may be moving
DRY_S = 2.0  # a stream without samples for this long is reported
CONTRADICTION = "contradiction"  # the row about a conflict between plan and operator
HELP = "Enter: mounted as asked · bar=NAME,chuck=NAME,sphere=NAME or line=NAME,target=NAME: this is mounted · note TEXT · q: end"
LOSSES = {
    "lost_frames": "frames lost on the link",
    "overruns_in_box": "samples lost in the box",
    "restarts": "restarts of the box",
    "link_losses": "lost connections",
    "robot_held_up": "waits, as the robot sends more than can be stored",
    "robot_foreign": "datagrams not stored, as they are not the robot's",
}


@dataclass
class SessionProgress:
    """Progress through the plan.

    ``rows`` is the plan as in ``/plan``, [] without one. ``mounted`` is what is mounted according to the operator or
    the beginning of the plan. ``confirmed``: the operator stated it. ``done``: rows that were taken. ``unplanned``:
    number of dwells and lines that are not in the plan, or without a plan. ``next``: the expected row. ``planned``: the
    rows by kind of move.
    """

    rows: Sequence[Mapping[str, Any]] = ()
    mounted: dict[str, str] = field(default_factory=dict)
    done: set[int] = field(default_factory=set)
    unplanned: Counter[str] = field(default_factory=Counter)
    next: int = 0

    def __post_init__(self) -> None:
        self.confirmed = bool(self.mounted)
        self.mounted = self.mounted or self.wanted() or {}
        self._q = np.array([row["q"] for row in self.rows])
        self._place: set[int] = set()  # rows at the last planned joints
        moves = [row.get("move", Move.DWELL) for row in self.rows]
        self.planned: dict[str, list[int]] = {move: [k for k, m in enumerate(moves) if m == move] for move in Move}

    def taken(self, move: str) -> int:
        """Return the number of dwells or lines, each row of the plan counted once."""
        rows = self.planned[move]
        return len(self.done.intersection(rows)) if rows else self.unplanned[move]

    @property
    def complete(self) -> bool:
        """Whether all of the plan has been taken."""
        return bool(self.rows) and self.done.issuperset(self.planned[Move.DWELL] + self.planned[Move.LINE])

    def wanted(self) -> dict[str, str] | None:
        """Return what the next row needs mounted; None at the plan's end and without a plan."""
        return next((p for row in self.rows[self.next :] if (p := pairing_of(row))), None)

    def change(self) -> dict[str, str] | None:
        """Return what must be mounted now, None if it already is."""
        pairing = self.wanted()
        return None if pairing is None or pairing.items() <= self.mounted.items() else pairing

    def mount(self, pairing: Mapping[str, str]) -> None:
        """Note that a part is mounted from now on; a bar and a line exclude each other."""
        self.confirmed = True
        excluded = LINE_MOUNTED if "bar" in pairing else BAR_MOUNTED if "line" in pairing else ()
        self.mounted = {k: v for k, v in self.mounted.items() if k not in excluded} | dict(pairing)

    def visit(self, q: Floats | None) -> int | None:
        """Note a dwell at joints ``q`` (None: unknown); return its row of the plan, None if it is not in the plan."""
        rows_in_reach = None if q is None else self._near(q)
        rows = [k for k in self.planned[Move.DWELL] if rows_in_reach is None or k in rows_in_reach]
        row = next((k for k in rows if k >= self.next), rows[-1] if rows and q is not None else None)
        self.note(Move.DWELL, row)
        return row

    def note(self, move: str, row: int | None) -> None:
        """Note a dwell or a line of this row of the plan, None if it is not in the plan."""
        if row is None:
            self.unplanned[move] += 1
        else:
            self.done.add(row)
            self.next = row + 1

    def arrive(self, q: Floats) -> int | None:
        """Note joints ``q``; return the line of the plan that ends there, if the arm came from its beginning."""
        rows_in_reach = self._near(q) if self.planned[Move.LINE] else set()
        if not rows_in_reach or rows_in_reach == self._place:
            return None
        row = next((k for k in self.planned[Move.LINE] if k in rows_in_reach and k - 1 in self._place), None)
        self._place = rows_in_reach
        if row is not None:
            self.note(Move.LINE, row)
        return row

    def _near(self, q: Floats) -> set[int]:
        """Return the rows of the plan at joints ``q``."""
        if self._q.shape[1:] != q.shape:
            return set()
        return {*np.flatnonzero(np.max(np.abs(self._q - q), axis=1) <= TOLERANCE).tolist()}


def pairing_of(row: Mapping[str, Any]) -> dict[str, str]:
    """Return what a row of the plan needs mounted."""
    return {key: str(row[key]) for key in MOUNTED if row.get(key)}  # a shell is a position of the robot


def words_of(pairing: Mapping[str, str]) -> str:
    """Format a pairing on one line."""
    return ", ".join(f"{key} {name}" for key, name in pairing.items()) or "nothing confirmed"


def parse_mounted(text: str) -> dict[str, str]:
    """Parse ``bar=bar46,chuck=c1`` into a mapping. Raises InputError."""
    mounting: dict[str, str] = {}
    for entry in text.split(","):
        key, separator, name = (word.strip() for word in entry.partition("="))
        if key not in MOUNTABLE or not separator or not name:
            form = f"KEY=NAME, such as bar=bar46; KEY is one of {', '.join(MOUNTABLE)}"
            raise InputError("wrong-value", place=Argument("mounted"), value=entry[:40], form=form)
        if key in mounting:
            raise InputError("given-twice", place=Argument("mounted"), what=key)
        mounting[key] = name
    return mounting


def check_mounted(mounting: Mapping[str, str], rig: Rig) -> None:
    """Raise InputError for a part that the rig does not have; any line is accepted if the rig lists none."""
    for key, names in rig.mounted().items():
        if key in mounting and (names or key in BAR_MOUNTED) and mounting[key] not in names:
            where, name = Argument("mounted"), mounting[key][:40]
            raise InputError("not-in-rig", place=where, what=key, name=name, names=sorted(names))


class Rest:
    """The current rest of the joints or of a sensor, from ``begin_s`` to ``last_s``."""

    def __init__(self) -> None:
        self.begin_s, self.last_s, self.duration_s = -np.inf, -np.inf, 0.0  # as of the last reading
        self._extremes = np.empty((0, 0))

    def extend(self, t_s: float, values: Floats, largest_range: float) -> bool:
        """Take readings (n, k); return whether they continue the rest.

        Otherwise they came after a gap, or the range of all since ``begin_s`` exceeds ``largest_range``, and a new rest
        begins.
        """
        is_continued = 0.0 <= t_s - self.last_s <= GAP_S
        together = np.vstack([self._extremes, values]) if is_continued else values
        rests = is_continued and bool(np.all(np.ptp(together, axis=0) <= largest_range))
        if not rests:
            self.begin_s, together = t_s, values
        self._extremes = np.array([together.min(axis=0), together.max(axis=0)])
        self.last_s, self.duration_s = t_s, t_s - self.begin_s
        return rests


@dataclass(frozen=True)
class ViewLine:
    """A row of the view."""

    name: str
    text: str
    alarms: tuple[Finding, ...] = ()

    @property
    def words(self) -> str:
        return one_line("; ".join(filter(None, (self.text, *(alarm.text(option) for alarm in self.alarms)))))


def _shielded(method: Callable[..., None]) -> Callable[..., None]:
    """Catch all errors of a method: whatever they are, the recording matters more than its view."""

    def shielded(state: LiveState, *values: Any) -> None:
        try:
            if not state.trouble:
                method(state, *values)
        except Exception as exc:
            state.failed(exc)

    return shielded


@dataclass
class LiveState(Operator):
    """The state of the view. ``unchecked``: reasons to refuse the box are only displayed.

    ``rows``: the view as of ``elapsed_s``. ``messages`` for the operator and ``typed`` lines are removed by who uses
    them. ``trouble``: why the view has stopped.
    """

    progress: SessionProgress
    rig: Rig | None
    with_robot: bool
    purpose: Purpose = field(default_factory=Purpose)
    unchecked: bool = False
    rows: list[ViewLine] = field(default_factory=list)
    elapsed_s: float = 0.0
    messages: deque[str] = field(default_factory=lambda: deque(maxlen=1000))
    typed: deque[str] = field(default_factory=deque)
    trouble: str = ""
    _events: list[OperatorEvent] = field(default_factory=list)
    _ident: Ident | None = None
    _windows: dict[int, LastSecond] = field(default_factory=dict)  # by stream
    _heard_s: dict[int, float] = field(default_factory=dict)  # by stream
    _rest: Rest = field(default_factory=Rest)
    _lvdt: tuple[LastSecond, int, Channel] | None = None  # its stream, column and calibration
    _q: Floats | None = None
    _counted: bool = False  # whether the current rest has been counted as a dwell
    _contradiction: tuple[Finding, ...] = ()
    _temperature: Finding | None = None
    _alarms: dict[str, tuple[Finding, ...]] = field(default_factory=dict)  # by row

    # --- the recorder's calls

    def approve(self, ident: Ident) -> None:
        findings = list(check_box(ident, self.purpose, date.today()))
        refused = [finding.text(option) for finding in findings if finding.severity is not Severity.WARNING]
        if refused and not self.unchecked:
            raise InputError("unready-box", problems=refused)
        self.messages.extend(f"warning: {finding.text(option)}" for finding in findings)
        self._ident = ident
        self._windows.clear()

    @_shielded
    def box_temperature(self, degc: float) -> None:
        if self._ident is not None and self.purpose.ball_bar and not self._temperature:
            self._temperature = far_from_calibration(self._ident, LVDT, degc)

    @_shielded
    def block(self, t_host_ns: int, data: Data) -> None:
        stream = None if self._ident is None else self._ident.streams.get(data.stream)
        counts = None if stream is None else counts_of(data, stream)
        if stream is None or counts is None:
            return
        window = self._windows.setdefault(stream.id, LastSecond())
        window.take(data.n0, counts, data.period_ns)
        self._heard_s[stream.id] = self.elapsed_s
        for k, channel in enumerate(stream.channels):
            if channel.name == LVDT and channel.length_unit is not None:
                self._lvdt = window, k, channel
                if not self.with_robot and not railed(counts[:, k]).any():
                    lengths = extension(counts[:, k : k + 1], channel)
                    self._follow(t_host_ns, US.to_si(data.t0_us), lengths, SENSOR_RANGE)

    @_shielded
    def reading(self, t_host_ns: int, reading: JointLine) -> None:
        self._q = np.array(reading.q)
        if (row := self.progress.arrive(self._q)) is not None:
            self._say_taken("line", f"line to pose {row}: driven", {"pose": row})
        self._follow(t_host_ns, reading.t, self._q[None], JOINT_RANGE)

    @_shielded
    def status(self, status: Status) -> None:
        self.elapsed_s, self.rows = status.elapsed_s, [row for row in self._rows(status) if row.words]
        for row in self.rows:
            if row.alarms != self._alarms.get(row.name, ()):
                self._alarms[row.name] = row.alarms
                self.messages.append(f"{row.name}: {row.words}")

    def wishes(self) -> list[OperatorEvent]:
        while self.typed:
            self._command(self.typed.popleft())
        wishes, self._events = self._events, []
        return wishes

    def failed(self, exc: Exception) -> None:
        """Note an error that ends the view."""
        self.trouble = f"the live view failed ({type(exc).__name__}: {exc}); the recording was not affected"

    # --- operator input

    @_shielded
    def _command(self, text: str) -> None:
        """Execute a typed line, as HELP describes; anything else prints it."""
        text = text.strip()
        word, _, note = text.partition(" ")
        if text == "q":
            self._events.append(OperatorEvent("end", {}))
        elif word == "note" and note.strip():
            self._events.append(OperatorEvent("note", {"text": note.strip()[:500]}))
            self.messages.append(f"noted: {note.strip()[:500]}")
        elif text == "" and (change := self.progress.change()) is not None:
            self._mount(change)
        elif "=" in text:
            try:
                pairing = parse_mounted(text)
                if self.rig is not None:
                    check_mounted(pairing, self.rig)
                self._mount(pairing)
            except InputError as exc:
                self.messages.append(str(exc))
        else:
            self.messages.append(HELP)

    def _mount(self, pairing: Mapping[str, str]) -> None:
        self.progress.mount(pairing)
        self._events.append(OperatorEvent("mounted", dict(self.progress.mounted)))
        self.messages.append(f"mounted: {words_of(self.progress.mounted)}")
        self._alarms.pop("mounted", None)
        self._contradiction = ()

    # --- dwells and lines

    def _follow(self, t_ns: int, t_s: float, values: Floats, largest_range: float) -> None:
        """Take readings (n, k) that show whether the arm stands."""
        if not self._rest.extend(t_s, values, largest_range):
            self._counted = False
        elif not self._counted and self._rest.duration_s >= ENOUGH_S:
            self._counted = True
            if self.progress.planned[Move.DWELL] or not self.progress.rows:  # else a stop is no dwell
                self._count_dwell(t_ns)

    def _count_dwell(self, t_ns: int) -> None:
        """Count and describe the current rest, which is long enough."""
        pose = self.progress.visit(self._q)
        # Other commands number dwells otherwise: they count the stops for mounting too.
        label = "stop not in the plan" if self.progress.rows else f"dwell {self.progress.taken(Move.DWELL)}"
        if pose is not None:
            label, row, mounted = f"pose {pose}", self.progress.rows[pose], self.progress.mounted
            planned = {key: row[key] for key in BAR_MOUNTED if row.get(key) and row[key] != mounted.get(key)}
            if planned and self.progress.confirmed:  # if nobody has stated what is mounted, only the plan counts
                values = {"place": label, "needed": words_of(planned), "confirmed": words_of(mounted)}
                self._contradiction = (Finding("other-mounted", values),)
        fields: dict[str, Any] = {"begin_ns": t_ns - int(NS.of(self._rest.duration_s)), "end_ns": t_ns, "pose": pose}
        text = Finding("sensor-silent", {"place": label}).text(option)
        window, k, channel = self._lvdt or (LastSecond(), 0, None)
        counts = np.concatenate(window.blocks)[:, k] if channel else np.empty(0)
        if channel and counts.size >= 2 * LEAST_LAGS and not railed(counts).any():
            length = mean_of(extension(counts, channel))
            settled = abs(length.drift) <= max(MICRON, DRIFT_SIGMAS * length.drift_sigma)
            fields |= {"mean_m": length.value, "noise_m": length.noise, "settled": settled}
            drift = None if settled else {"um": UM.of(length.drift)}
            sizes = {"length": {"mm": MM.of(length.value)}, "noise": {"um": UM.of(length.noise)}, "drift": drift}
            text = Finding("not-settled" if drift else "dwell-taken", {"place": label, **sizes}).text(option)
        self._say_taken("dwell", text, fields)

    def _say_taken(self, kind: str, text: str, fields: Mapping[str, Any]) -> None:
        self.messages.append(text)
        self._events.append(OperatorEvent(kind, {key: value for key, value in fields.items() if value is not None}))

    # --- display

    def _rows(self, status: Status) -> Iterator[ViewLine]:
        progress = self.progress
        alarms = [Finding("box-fault", {"fault": fault, "recorded": True}) for fault in status.faults]
        alarms += filter(None, [self._temperature])
        if not status.box_ok:
            alarms.insert(0, Finding("box-lost" if status.state == "link lost" else "box-silent"))
        text = f"{status.state}, {status.elapsed_s:.0f} s, {counted(status.counters.samples, 'sample')}"
        text += "" if status.rtt_us is None else f", shortest round trip {status.rtt_us:.0f} µs"
        yield ViewLine("box", text, tuple(alarms))
        for stream in () if self._ident is None else self._ident.streams.values():
            if (window := self._windows.get(stream.id)) is None or not window.period_ns:
                continue
            dry = status.elapsed_s - self._heard_s[stream.id] > DRY_S
            self._lvdt = None if dry else self._lvdt
            yield ViewLine(stream.name, f"{NS.factor / window.period_ns:.1f} Hz", (Finding("no-samples"),) * dry)
            counts = np.concatenate([*window.blocks][-DISPLAYED_BLOCKS:])
            for column, channel in zip(counts.T, stream.channels, strict=True):
                yield self._position(column, channel, stream)
        for name, words in LOSSES.items():
            if number := getattr(status.counters, name):
                yield ViewLine(words, f"{number}", (Finding("lost-so-far"),))
        if self.with_robot:
            yield self._robot(status)
        yield self._progress(status)
        pairing = progress.change()
        ask = () if pairing is None else (Finding("mount-next", {"what": words_of(pairing)}),)
        yield ViewLine("mounted", words_of(progress.mounted), ask)  # the arm still stands at the old pose
        yield ViewLine(CONTRADICTION, "", self._contradiction)
        yield ViewLine("file", "", tuple(Finding("file-loss", {"loss": loss}) for loss in status.file_losses))

    def _position(self, counts: NDArray[np.int32], channel: Channel, stream: Stream) -> ViewLine:
        """Return a sensor's value, and whether it is within its travel."""
        bar = self.rig.bars.get(self.progress.mounted.get("bar", "")) if self.rig else None
        travel = bar.travel if bar and channel.name == LVDT else None
        if self.rig and channel.name in LINE_CHANNELS[1:] and "line" in self.progress.mounted:
            travel = self.rig.line_travel
        text, code = value_of(counts, channel, stream), ""
        if travel and channel.length_unit and not railed(counts).any():
            text += f", travel ±{MM.text(0.5 * travel, '.1f')}"
            share = abs(float(extension(counts, channel).mean())) / (0.5 * travel)
            if share > 1.0 - 2.0 * NEAR_END:
                code = "near-travel-end" if share <= 1.0 else "beyond-travel"
        return ViewLine(one_line(channel.name), text, (Finding(code),) * bool(code))

    def _robot(self, status: Status) -> ViewLine:
        """Return the rate of the robot's readings, the age of the last one, and what is wrong with its link."""
        age_s, alarms = status.robot_age_s, list[Finding]()
        if not status.robot_ok:
            alarms = [Finding("robot-closed" if status.robot_closed else "robot-lost")]
        elif (age_s or 0.0) > SILENCE_S and not status.robot_waits:
            alarms = [Finding("robot-silent", {"time": {"s": SILENCE_S}})]
        text = f"{status.counters.robot_lines / max(status.elapsed_s, 1.0):.1f} readings/s"
        text += "" if age_s is None else f", last {age_s:.1f} s ago"
        if status.robot_closed or self.progress.complete:  # as usual at the end
            text, alarms = ", ".join([text, *(alarm.text() for alarm in alarms)]), []
        return ViewLine("robot", text, tuple(alarms))

    def _progress(self, status: Status) -> ViewLine:
        """Return the number of dwells and lines taken, and whether the robot may move on."""
        progress = self.progress
        texts = []
        for move in (Move.DWELL, Move.LINE):
            number, planned = progress.taken(move), len(progress.planned[move])
            text = f"{number} of {planned} {move}s" if planned else counted(number, move)
            texts += [text] * bool(number or planned)
        if progress.rows and (unplanned := progress.unplanned[Move.DWELL]):
            texts.append(f"{unplanned} not in the plan")
        if self._rest.duration_s >= STANDING_S and (status.robot_ok if self.with_robot else status.box_ok):
            texts.append(f"standing for {self._rest.duration_s:.1f} s" + (", long enough" if self._counted else ""))
        return ViewLine("taken", ", ".join(texts) or "nothing yet", (Finding("plan-complete"),) * progress.complete)
