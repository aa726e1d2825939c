"""What stands between a recording and whoever runs it. This one wants nothing and looks at nothing: a recording by a program."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from truearm.record.status import Status
from truearm.session.box_frames import Data
from truearm.session.box_ident import Ident
from truearm.session.joint_readings import JointLine


class OperatorEvent(NamedTuple):
    """An event to write: ``fields`` beside ``kind``. The kind "end" ends the recording, and is no event."""

    kind: str
    fields: Mapping[str, Any]


class Operator:
    """All of it is called by the recorder, between two reads: what takes its time belongs into a thread of the operator's own."""

    def approve(self, ident: Ident) -> None:
        """The box is about to be started, at the beginning and after it restarted. Raise InputError to refuse it."""

    def block(self, t_host_ns: int, data: Data) -> None:
        """Samples came, and are stored."""

    def reading(self, t_host_ns: int, reading: JointLine) -> None:
        """A joint reading came, and is stored."""

    def exchange(self, t0_ns: int, t1_us: int, t2_us: int, t3_ns: int) -> None:
        """The box answered a clock request."""

    def status(self, status: Status) -> None:
        """Four times a second."""

    def wishes(self) -> list[OperatorEvent]:
        """What the operator asked for since the last call; asked at least every 50 ms."""
        return []

    def last_wishes(self) -> list[OperatorEvent]:
        """The recording has ended: what is still to be written. It may wait for half a second, no longer."""
        return []
