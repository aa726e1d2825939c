"""The state of a recording, and the interface between it and its operator.

The default operator does nothing, for recordings made by a program.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from truearm.session.frames import Data, Ident
from truearm.session.joint_format import JointLine


@dataclass
class Counters:
    """Counts so far, for display; the session file's ``session-end`` repeats them. ``truearm inspect`` counts again."""

    frames: int = 0
    samples: int = 0
    lost_frames: int = 0
    odd_frames: int = 0  # behind the count: of a restarted box, or doubled
    console_bytes: int = 0
    probes: int = 0
    unanswered_probes: int = 0
    robot_lines: int = 0
    robot_other_joints: int = 0  # readings with a different number of joints from the first
    robot_console_bytes: int = 0  # these and everything else that is not a reading
    robot_unstored: int = 0  # pieces of the robot's stream that were still waiting when the recording ended
    restarts: int = 0
    link_losses: int = 0
    robot_losses: int = 0
    held_up: int = 0  # how often a link's reader had to wait for the recorder
    robot_held_up: int = 0  # how often the robot's reader had to: the robot sends more than can be stored
    robot_missing: int = 0  # readings, by the gaps in their numbers since the reader first had to wait
    robot_dropped: int = 0  # 1 if readings without numbers may be lost: the link drops what cannot be stored
    robot_foreign: int = 0  # datagrams from other addresses than the robot's, not stored
    dropped_in_box: int = 0  # trigger edges, by the heartbeats since the first
    overruns_in_box: int = 0  # samples, by the heartbeats since the first


@dataclass(frozen=True)
class Status:
    """State for a progress display. ``rtt_us``: the shortest exchange with the box so far."""

    elapsed_s: float  # since the start of the stream; 0 before it
    state: str  # "identifying" | "recording" | "link lost" | "stopping"
    rtt_us: float | None
    robot_ok: bool | None  # None: no robot
    counters: Counters
    faults: tuple[str, ...] = ()  # faults of the box, for the operator
    box_ok: bool = True  # False while its link is lost or it is silent
    robot_age_s: float | None = None  # of the last stored reading
    file_losses: tuple[str, ...] = ()  # what happened to the session's file, one sentence each
    robot_waits: bool = False  # readings are waiting to be stored
    robot_closed: bool = False  # it ended its stream deliberately


@dataclass(frozen=True)
class RecordSummary:
    """How a recording ended.

    ``reason`` is "duration", "operator", "robot closed", "robot lost", "no readings", "interrupted" or "link
    lost"; ``text`` explains what was lost or closed. ``duration_s`` counts from the start of the stream. ``faults`` and
    ``file_losses`` are as in ``Status``. ``box_gone``: since when and why the box could not be reached at
    the end, "" if it was stopped. ``robot_gone``: that the robot was lost or silent at the end, "" if not.
    """

    reason: str
    text: str
    duration_s: float
    counters: Counters
    faults: tuple[str, ...] = ()
    file_losses: tuple[str, ...] = ()
    box_gone: str = ""
    robot_gone: str = ""


class OperatorEvent(NamedTuple):
    """An event to write, with ``kind`` and ``fields``. The kind "end" ends the recording and is not written."""

    kind: str
    fields: Mapping[str, Any]


class Operator:
    """Callbacks of the recorder, called between two reads. Anything slow must run in a thread of the operator's own."""

    def approve(self, ident: Ident) -> None:
        """Called before the box is started, at the beginning and after a restart. Raise InputError to refuse it."""

    def block(self, t_host_ns: int, data: Data) -> None:
        """Called when samples have arrived and are stored."""

    def reading(self, t_host_ns: int, reading: JointLine) -> None:
        """Called when a joint reading has arrived and is stored."""

    def box_temperature(self, degc: float) -> None:
        """Called when the box has reported its temperature, about once a second."""

    def status(self, status: Status) -> None:
        """Called four times a second."""

    def wishes(self) -> list[OperatorEvent]:
        """Return the operator's requests since the last call; called every 50 ms at least, and at the end."""
        return []
