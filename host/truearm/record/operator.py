"""The interface between a recording and its operator. This default does nothing, for recordings made by a program."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from truearm.record.status import Status
from truearm.session.box_ident import Ident
from truearm.session.frames import Data
from truearm.session.joint_format import JointLine


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
        """Return the operator's requests since the last call; called at least every 50 ms, and when the recording ends."""
        return []
