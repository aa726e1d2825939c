"""Which further poses, pairing, chuck, sphere, line or place would make which parameters identifiable.

This is computed only if the rank is less than the number of free parameters, or if some parameters are hardly
identifiable. Each proposal (``Kind.proposals``) is tried: rows such as it would give at the estimate are folded into
the existing information. Pivoted QR then finds the columns beyond the suggested set that have become independent
(``identifiability.suggested_free``) or are determined to better than their units (``identifiability.identifiable_columns``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.identifiability import identifiable_columns, suggested_free
from truearm.estimate.information import fold, observe, with_prior
from truearm.estimate.problem import build_problem, settled
from truearm.kinds.proposals import Proposal
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.results import Addition
from truearm.types import Floats, Rig, Rigs


def additions(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    names: Sequence[str],
    root: Floats,
    known: Mapping[str, float],
    taken: NDArray[np.bool_],
    unit: Floats | None = None,
) -> tuple[Addition, ...]:
    """Return the proposals that help, each on its own, the most useful first.

    root (k, k) is the information on the free parameters ``names`` (k,), of which the first ``taken.size`` are the
    robot's. Those ``taken`` are distinguishable, to better than ``unit`` (taken.size,) if it is given. ``known`` is the
    estimate by name.
    """
    if taken.all() or len(table) == 0:
        return ()
    estimated = _at(chain, known)
    helpful = []
    for proposal, prefix in _proposals(estimated, rig, table):
        wide = _with(estimated, proposal, prefix, names, root, known)
        determined = (
            suggested_free(wide, taken.size, taken, taken)
            if unit is None
            else identifiable_columns(wide, taken.size, unit, taken)
        )
        gained = np.flatnonzero(determined & ~taken).tolist()
        if gained:
            gained_names = tuple(names[i] for i in gained)
            text = f"{proposal.text} with the rig {prefix[:-1]}" if prefix else proposal.text
            helpful.append(Addition(proposal.kind, proposal.names, int(determined.sum()), gained_names, text))
    return tuple(sorted(helpful, key=lambda a: -a.rank))


def _with(
    estimated: Chain,
    proposal: Proposal,
    prefix: str,
    names: Sequence[str],
    root: Floats,
    known: Mapping[str, float],
) -> Floats:
    """Return the root with the rows of a proposal folded in, its new unknowns after all others."""
    problem = build_problem(estimated, proposal.rig, proposal.rows)
    of_problem = [*problem.names[: problem.n_robot], *(prefix + name for name in problem.names[problem.n_robot :])]
    x = np.array([known.get(name, start) for name, start in zip(of_problem, problem.start, strict=True)])
    columns = np.array([name in names or name not in known for name in of_problem])
    theirs = [name for name, is_unknown in zip(of_problem, columns, strict=True) if is_unknown]
    all_names = [*names, *(name for name in theirs if name not in names)]
    wide = np.zeros((len(theirs), len(all_names)))
    # Prior information on the new items; that on the rest is already in the root.
    sigma = np.where([name in names for name in theirs], np.inf, problem.prior_sigma[columns])
    data = with_prior(observe(settled(problem, x), x, columns), np.zeros(len(theirs)), sigma)
    wide[:, [all_names.index(name) for name in theirs]] = data.root
    padded = np.zeros((len(all_names), len(all_names)))
    padded[: len(names), : len(names)] = root
    return fold(padded, wide)


def _proposals(estimated: Chain, rigs: Rigs, table: ObservationTable) -> Iterator[tuple[Proposal, str]]:
    """Return what each kind of a rig's rows proposes at the estimate, and the prefix of the rig's unknowns' names.

    A kind without rows would propose equipment that the user does not have.
    """
    for name in dict.fromkeys(table.rig.tolist()):
        rig = rigs if isinstance(rigs, Rig) else rigs[name]
        rows = table.select(table.rig == name)
        for kind_name, kind in kinds().items():
            if kind.proposals is not None and kind_name in rows.kind:
                for proposal in kind.proposals(estimated, rig, rows, np.random.default_rng(0)):
                    yield proposal, f"{name}." if name and rig is not rigs else ""


def _at(chain: Chain, known: Mapping[str, float]) -> Chain:
    """Return the chain with the estimate as its nominal values, so that new items are placed according to the estimate."""
    return replace(chain, parameters=tuple(replace(p, nominal=known[p.name]) for p in chain.parameters))
