"""Proposals for further measurements: each kind of observation proposes rows as they would be measured at the estimate.

The rows need not be exactly reachable or collision-free: the rank is the same for nearly all poses, so it does not
depend on their exact position. ``estimate.identifiability`` tries each proposal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain, point_forward, point_jacobians
from truearm.types import Floats, Rig

NEW = "(new)"  # brackets are not allowed in the names of a rig
TRIES = 40  # rows that a proposal is tried with; a new line or place has up to 6 unknowns of its own
TRIAL_SIGMA = 1e-4  # m; any noise gives the same rank
SPREAD = 0.6  # rad or 0.1 m: how far joints deviate from a measured pose in a trial


class Proposal(NamedTuple):
    """A further measurement: the rig with the new items, and rows as it would give them.

    ``kind`` is its name in result.json, ``text`` the instruction to a person ("measure a new line with the line
    device"), and ``names`` the identifiers of the rig that it involves.
    """

    kind: str
    text: str
    rig: Rig
    rows: ObservationTable
    names: tuple[str, ...] = ()


# arguments: a chain whose nominal values are the estimate, a rig, the measured rows
Proposing = Callable[[Chain, Rig, ObservationTable, np.random.Generator], Iterator[Proposal]]


def trial_rows(q: Floats, kind: str, **columns: Any) -> ObservationTable:
    """Return rows of a kind at joint readings q (n, j)."""
    return ObservationTable(columns, q=q, kind=kind, sigma=TRIAL_SIGMA)


def anywhere(chain: Chain, n: int, rng: np.random.Generator) -> Floats:
    """Return random joint readings (n, j) within the limits, or within one turn if there are none."""
    lower, upper = np.clip(chain.limits, -np.pi, np.pi)
    return rng.uniform(lower, upper, (n, len(chain.joints)))


def about_one_point(chain: Chain, q: Floats, p_end: Floats, rng: np.random.Generator, reach: float) -> Floats:
    """Return readings (m, j) with the point of the end where q (j,) has it, or within ± ``reach`` of it on a line."""
    goal = point_forward(chain, chain.params_nominal, q, p_end)
    along = rng.normal(size=3)
    # A few per mille off the line: points exactly on it would not determine the line's roll.
    offset = np.linspace(-reach, reach, TRIES)[:, None] * (along + 3e-3 * rng.normal(size=(TRIES, 3)))
    readings = q + SPREAD * rng.uniform(-1.0, 1.0, (TRIES, q.size))
    for _ in range(30):
        p, _, jac = point_jacobians(chain, chain.params_nominal, readings, p_end)
        readings = readings + (np.linalg.pinv(jac, rcond=1e-3) @ (goal + offset - p)[..., None])[..., 0]
    p = point_forward(chain, chain.params_nominal, readings, p_end)
    return np.asarray(readings[np.linalg.norm(p - goal - offset, axis=1) < 1e-9])
