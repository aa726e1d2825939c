"""What more to measure: which further poses, pairing, chuck, sphere, line or place would let which parameter be told.

Asked only where the rank falls short of what is free, or where it does not but some of it is hardly seen. Each proposal is
tried: some rows as it would give them, at the estimate, are folded into the information that there is, and pivoted QR is
asked which columns beyond the suggested set have become independent (``identifiability.suggested_free``), or are told to
better than their units (``identifiability.told_apart``). The rows need not be reachable to the millimetre or free of
collisions, since a rank does not depend on where exactly they stand: it is the same for nearly all poses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.identifiability import suggested_free, told_apart
from truearm.estimate.information import fold, observe, with_prior
from truearm.estimate.problem import Rigs, build_problem, settled
from truearm.model.chain import Chain, point_forward, point_jacobians
from truearm.types import Addition, AdditionKind, BallBar, Device, Floats, ObservationTable, Point, Rig

NEW = "(new)"  # brackets cannot stand in a rig's names
TRIES = 40  # rows of each kind that a proposal is tried with; a new line or place has up to 6 unknowns of its own
AWAY = np.array([0.11, -0.17, 0.07])  # m: a new chuck or sphere stands off the middle of the others, in line with none
SPREAD = 0.6  # rad or 0.1 m: how far joints stray from a measured pose in a trial
LINE_SIGMA = 1e-4  # m; any noise gives the same rank


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
    """Proposals that help, each alone, the most useful first.

    root (k, k): what is known of the free parameters ``names`` (k,), of which the first ``taken.size`` are the robot's;
    ``taken`` of them can be told apart, to better than ``unit`` (taken.size,) if it is given. ``known``: the estimate by
    name.
    """
    if taken.all() or len(table) == 0:
        return ()
    here = _at(chain, known)
    one, prefix = _first_rig(rig, table)
    found = []
    for kind, labels, their_rig, rows in _proposals(here, one, table):
        wide, n_robot = _with(here, their_rig, rows, prefix, names, root, known, taken.size)
        more = suggested_free(wide, n_robot, taken, taken) if unit is None else told_apart(wide, n_robot, unit, taken)
        gained = np.flatnonzero(more & ~taken).tolist()
        if gained:
            found.append(Addition(kind, labels, int(more.sum()), tuple(names[i] for i in gained)))
    return tuple(sorted(found, key=lambda a: -a.rank))


def _with(
    here: Chain,
    rig: Rig,
    rows: ObservationTable,
    prefix: str,
    names: Sequence[str],
    root: Floats,
    known: Mapping[str, float],
    n_robot: int,
) -> tuple[Floats, int]:
    """The root with the rows of a proposal folded in, its new unknowns behind all others; and ``n_robot``."""
    problem = build_problem(here, rig, rows)
    of_problem = [*problem.names[: problem.n_robot], *(prefix + name for name in problem.names[problem.n_robot :])]
    x = np.array([known.get(name, start) for name, start in zip(of_problem, problem.start, strict=True)])
    columns = np.array([name in names or name not in known for name in of_problem])
    theirs = [name for name, wanted in zip(of_problem, columns, strict=True) if wanted]
    every = [*names, *(name for name in theirs if name not in names)]
    wide = np.zeros((len(theirs), len(every)))
    # What is known of the new: the prior of the rest is in the root already.
    sigma = np.where([name in names for name in theirs], np.inf, problem.prior_sigma[columns])
    data = with_prior(observe(settled(problem, x), x, columns), np.zeros(len(theirs)), sigma)
    wide[:, [every.index(name) for name in theirs]] = data.root
    padded = np.zeros((len(every), len(every)))
    padded[: len(names), : len(names)] = root
    return fold(padded, wide), n_robot


def _proposals(
    here: Chain, rig: Rig, table: ObservationTable
) -> Iterator[tuple[AdditionKind, tuple[str, ...], Rig, ObservationTable]]:
    """Kind, names, the rig with what is new, and rows as the proposal would give them at the estimate."""
    rng = np.random.default_rng(0)
    bars = table.select(table.kind == "ball_bar")
    if len(bars):
        yield from _with_bars(here, rig, bars, rng)
    else:
        yield AdditionKind.BALL_BAR, (), *_first_bar(here, rig, rng)
    ball = next(iter(rig.targets.values()), Point("", (0.0, 0.0, 0.0)))
    q = _about_one_point(here, table.q[len(table) // 2], np.array(ball.xyz), rng, reach=0.1)
    if len(q):
        p_base = point_forward(here, here.params_nominal, q, np.array(ball.xyz))
        cov = tuple(tuple(LINE_SIGMA**2 * (i == k) for k in range(3)) for i in range(3))
        lines = {**rig.lines, NEW: Device(NEW, cov)} if rig.lines else rig.lines
        yield AdditionKind.LINE, (), replace(rig, lines=lines), _rows(q, "line", xyz=p_base, line=NEW, target=ball.name)
    ball = next(iter(rig.spheres.values()), Point("", (0.0, 0.0, 0.0)))
    q = _about_one_point(here, table.q[len(table) // 2], np.array(ball.xyz), rng, reach=0.0)
    if len(q):
        yield AdditionKind.PLACE, (), rig, _rows(q, "seat", sphere=ball.name, place=NEW)


def _with_bars(
    here: Chain, rig: Rig, bars: ObservationTable, rng: np.random.Generator
) -> Iterator[tuple[AdditionKind, tuple[str, ...], Rig, ObservationTable]]:
    bar = str(bars.bar[0])
    used = list(dict.fromkeys(zip(bars.chuck.tolist(), bars.sphere.tolist(), strict=True)))
    chucks, spheres = list(dict.fromkeys(c for c, _ in used)), list(dict.fromkeys(s for _, s in used))
    few = bars.q[:: max(len(bars) // TRIES, 1)][:TRIES]
    anywhere = _anywhere(here, TRIES, rng)

    def rows(q: Floats, pairs: Sequence[tuple[str, str]]) -> ObservationTable:
        which = [pair for pair in pairs for _ in range(len(q))]
        chuck, sphere = np.array([c for c, _ in which]), np.array([s for _, s in which])
        length = np.ones(len(which))  # any: the derivatives do not depend on what was read
        return _rows(np.tile(q, (len(pairs), 1)), "ball_bar", value=length, bar=bar, chuck=chuck, sphere=sphere)

    yield AdditionKind.POSES, (), rig, rows(anywhere, used)
    for chuck in rig.chucks:
        for sphere in rig.spheres:
            if (chuck, sphere) not in used:
                yield AdditionKind.PAIRING, (chuck, sphere), rig, rows(few, [(chuck, sphere)])
    new_chuck = _another([p.xyz for p in rig.chucks.values()])
    new_sphere = _another([p.xyz for p in rig.spheres.values()])
    more_chucks = replace(rig, chucks={**rig.chucks, NEW: new_chuck})
    more_spheres = replace(rig, spheres={**rig.spheres, NEW: new_sphere})
    yield AdditionKind.CHUCK, (), more_chucks, rows(few, [(NEW, s) for s in spheres])
    yield AdditionKind.SPHERE, (), more_spheres, rows(few, [(c, NEW) for c in chucks])


def _first_bar(here: Chain, rig: Rig, rng: np.random.Generator) -> tuple[Rig, ObservationTable]:
    """Three chucks at known places, three spheres on the end, a bar between them."""
    corners = {
        f"{NEW}{i}": Point(f"{NEW}{i}", (float(x), float(y), float(z))) for i, (x, y, z) in enumerate(np.diag(AWAY))
    }
    more = replace(rig, chucks=corners, spheres=corners, bars={NEW: BallBar(NEW, 1.0, 1.0, 0.1, LINE_SIGMA)})
    pairs = [(chuck, sphere) for chuck in corners for sphere in corners]
    chuck, sphere = (np.repeat([pair[k] for pair in pairs], TRIES) for k in (0, 1))
    q = _anywhere(here, TRIES * len(pairs), rng)
    return more, _rows(q, "ball_bar", value=np.ones(len(q)), bar=NEW, chuck=chuck, sphere=sphere)


def _another(points: Sequence[tuple[float, float, float]]) -> Point:
    middle = np.mean(points, axis=0) + AWAY
    return Point(NEW, (float(middle[0]), float(middle[1]), float(middle[2])))


def _anywhere(here: Chain, n: int, rng: np.random.Generator) -> Floats:
    """(n, j) joint readings anywhere within the limits, a turn where there are none."""
    lower = np.array([max(j.lower, -np.pi) for j in here.joints])
    upper = np.array([min(j.upper, np.pi) for j in here.joints])
    return rng.uniform(lower, upper, (n, len(here.joints)))


def _about_one_point(here: Chain, q: Floats, p_end: Floats, rng: np.random.Generator, reach: float) -> Floats:
    """(m, j) readings with the point of the end where q (j,) has it, or within ± ``reach`` of it along a line."""
    goal = point_forward(here, here.params_nominal, q, p_end)
    along = rng.normal(size=3)
    # A few per mille of the way beside the line: points exactly on it would not show the line's roll.
    offset = np.linspace(-reach, reach, TRIES)[:, None] * (along + 3e-3 * rng.normal(size=(TRIES, 3)))
    strayed = q + SPREAD * rng.uniform(-1.0, 1.0, (TRIES, q.size))
    for _ in range(30):
        p, _, jac = point_jacobians(here, here.params_nominal, strayed, p_end)
        strayed = strayed + (np.linalg.pinv(jac, rcond=1e-3) @ (goal + offset - p)[..., None])[..., 0]
    p = point_forward(here, here.params_nominal, strayed, p_end)
    return np.asarray(strayed[np.linalg.norm(p - goal - offset, axis=1) < 1e-9])


def _rows(q: Floats, kind: str, **columns: Any) -> ObservationTable:
    n = len(q)
    given: dict[str, Any] = {
        name: np.full(n, value) if isinstance(value, str) else value for name, value in columns.items()
    }
    return ObservationTable(q=q, kind=np.full(n, kind), sigma=np.full(n, LINE_SIGMA), **given)


def _at(chain: Chain, known: Mapping[str, float]) -> Chain:
    """The chain with the estimate for its nominal values, so that what is new is placed where the estimate has it."""
    return replace(chain, parameters=tuple(replace(p, nominal=known[p.name]) for p in chain.parameters))


def _first_rig(rig: Rigs, table: ObservationTable) -> tuple[Rig, str]:
    """The rig of the first row, which the proposals extend, and the prefix of its unknowns' names."""
    if isinstance(rig, Rig):
        return rig, ""
    name = str(table.rig[0])
    return rig[name], f"{name}." if name else ""
