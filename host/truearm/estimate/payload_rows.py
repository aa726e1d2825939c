"""Rows under a payload: the known mass on the end, from the table or from the rig, and its effect on predictions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from truearm.errors import ProblemError
from truearm.kinds.group import Group, GroupOfOther
from truearm.kinds.linearised import Linearised
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.model.law_chain import carries
from truearm.types import Floats, Payload, Rigs, rigs_by_name


@dataclass(frozen=True, kw_only=True)
class PayloadRows(GroupOfOther):
    """n observations of another group, all with one payload on the robot."""

    SHARED = ("constants", "payload")

    payload: Payload

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Return residuals (n·w,) and their derivatives at x (P,), with the payload."""
        return self.inner.evaluate(carries(chain, self.payload), x)

    def opened(self, chain: Chain, x: Floats) -> Linearised:
        """Return the same as ``evaluate``, with the derivatives by the known constants appended to ``jac_rig``."""
        return self.inner.opened(carries(chain, self.payload), x)

    def settle(self, chain: Chain, x: Floats) -> PayloadRows:
        """Settle as ``inner`` does with the payload."""
        return replace(self, inner=self.inner.settle(carries(chain, self.payload), x))


def payloads_of(rig: Rigs, table: ObservationTable) -> list[Payload]:
    """Return the payload of each row (n): the row's own, otherwise that of its rig.

    Raises ProblemError for a negative mass.
    """
    mass = table.payload
    bad = np.flatnonzero(mass < 0.0)
    if bad.size:
        raise ProblemError(f"{table.source[bad[0]]}: a payload of {mass[bad[0]]:g} kg; give 0 kg (no payload) or more")
    of_rig = {name: Payload(named.payload, named.payload_centre) for name, named in rigs_by_name(rig).items()}
    return [
        of_rig[str(name)] if np.isnan(m) else Payload(float(m), (x, y, z))
        for name, m, (x, y, z) in zip(table.rig, mass, np.nan_to_num(table.payload_centre).tolist(), strict=True)
    ]


def with_payloads(groups: Sequence[Group], payloads: Sequence[Payload]) -> tuple[Group, ...]:
    """Return the groups split by the payload of their rows; knowledge that is not a row has none."""
    different = list(dict.fromkeys(payloads))
    number = np.array([different.index(payload) for payload in payloads], dtype=np.intp)
    out: list[Group] = []
    for group in groups:
        numbers = np.zeros(0, dtype=np.intp) if group.row is None else number[group.row]
        out += [PayloadRows.around(group.take(numbers == k), payload=different[k]) for k in np.unique(numbers)]
        out += [group] * (group.row is None)
    return tuple(out)
