"""The operator of a recording in virtual time: confirms every mount of a bar, as the Enter key does."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from truearm.record.operator import Operator, OperatorEvent, Status
from truearm.types import BAR_MOUNTED
from truearm_sim.lab import Lab
from truearm_sim.robot import READY


class Confirming(Operator):
    """Confirms the bar, chuck and sphere that the plan requests as soon as the bar is on.

    ``advance`` is called with the share of the recording.
    """

    def __init__(self, lab: Lab, advance: Callable[[float], object] = lambda share: None) -> None:
        controller, plan = lab.world.controller, lab.world.controller.plan
        self._lab = lab
        self._advance = advance
        self._due = deque[tuple[int, OperatorEvent]]()
        for stop in controller.mounting.nonzero()[0].tolist():
            row = controller.pose[stop]
            mounted = {key: str(getattr(plan, key)[row]) for key in BAR_MOUNTED}
            self._due.append((int(1e9 * (controller.leave[stop] - READY)), OperatorEvent("mounted", mounted)))

    def status(self, status: Status) -> None:
        """See ``Operator``."""
        self._advance(status.elapsed_s / self._lab.world.duration)

    def wishes(self) -> list[OperatorEvent]:
        """See ``Operator``."""
        said = []
        while self._due and self._due[0][0] <= self._lab.now_ns:
            said.append(self._due.popleft()[1])
        return said
