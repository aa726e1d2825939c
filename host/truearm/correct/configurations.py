"""The configurations in which an arm reaches its targets, and the one that is nearest to where the robot comes from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain import Chain
from truearm.model.inverse import CHUNK, LEVER, inverse, singular_value
from truearm.progress import steps_of
from truearm.types import Floats

N_STARTS = 40  # of a search: an arm with six joints has up to 16 configurations
PASSES = 4  # continuations from the previous solution, whose configuration the starts may have missed
EDGE = 0.01  # rad beyond a quarter turn: an axis at 0 is there to within the digits of the program's numbers
SAME = 1e-6  # rad, m between solutions
ROUNDING = 1e-10  # rad, m beyond a limit
ROOM = 0.05  # rad, m: typical motion of a joint by a correction
CELL = 0.1  # LEVERs and of axes: targets in one cell start from each other's solutions
SINGULAR = 0.1  # twice the margin of corrections


class Origins(NamedTuple):
    """The robot's previous position for each of n targets.

    Either another target (n,), -1 for the one before, or joint readings (n, j), NaN where it is a target.
    """

    target: NDArray[np.int_]
    q: Floats


def search(
    chain: Chain,
    params: Floats,
    targets: Floats,
    oriented: bool = True,
    home: Floats | None = None,
    quadrants: Floats | None = None,
    origins: Origins | None = None,
) -> Floats:
    """Return solutions (n, j) within the joint limits for targets (n, 4, 4), NaN for none.

    Among an arm's configurations (``solutions``), the one nearest to the robot's previous position is taken. That
    position is given by ``origins`` or is the previous solution; for the first target it is ``home`` (j,) (default: the
    middle of the limits), which positions without orientation stay near. Joints with a range of more than one turn use
    the number of turns that brings them nearest. ``quadrants`` (n, j), NaN where it does not matter, has priority: the
    quarter turn in which a reading must lie, as ⌊q/90°⌋.
    """
    stock, (lower, upper) = solutions(chain, params, targets, oriented), _sampled_range(chain)
    n, _, j = stock.shape
    first = 0.5 * (lower + upper) if home is None else home
    quadrants = np.full((n, j), np.nan) if quadrants is None else quadrants
    origins = Origins(np.full(n, -1), np.full((n, j), np.nan)) if origins is None else origins
    if home is not None and not oriented:  # among a continuum of joints, those that the least motion from home reaches
        from_home = inverse(chain, params, targets, np.tile(home, (n, 1)), oriented)
        stock[within(chain, from_home, ROOM) & (singular_value(chain, params, from_home, oriented) > SINGULAR)] = np.nan
        stock = np.concatenate([stock, from_home[:, None]], axis=1)
    chosen, near = _chosen(chain, params, stock, first, quadrants, oriented, origins)
    for _ in range(PASSES if oriented else 0):
        stock = np.concatenate([stock, inverse(chain, params, targets, near)[:, None]], axis=1)
        near_before = near
        chosen, near = _chosen(chain, params, stock, first, quadrants, oriented, origins)
        if np.abs(near - near_before).max(initial=0.0) < SAME:
            break
    return chosen


def several_fit(
    chain: Chain, params: Floats, targets: Floats, quadrants: Floats, oriented: bool = True
) -> NDArray[np.bool_]:
    """Return for which targets (n, 4, 4) several solutions fit the quarter turns (n, j) best, as in ``search``.

    Solutions are those within the joint limits.
    """
    stock = solutions(chain, params, targets, oriented)
    middle = np.where(np.isnan(quadrants), 0.0, 0.5 * np.pi * (quadrants + 0.5))
    q = turned(chain, params, stock, middle[:, None])
    misplaced = np.where(within(chain, q), _misplaced(q, quadrants[:, None]), np.inf)
    least = misplaced.min(axis=1, keepdims=True)
    return np.asarray(((misplaced == least) & np.isfinite(least)).sum(axis=1) > 1)


def solutions(chain: Chain, params: Floats, targets: Floats, oriented: bool) -> Floats:
    """Return solutions (n, k, j) for targets, each once; those of targets near another start from its solutions.

    NaN where there are fewer. An arm with more joints than needed stays within its limits; others ignore them.
    """
    j = len(chain.joints)
    bounded = j > (6 if oriented else 3)
    lower, upper = _sampled_range(chain)
    starts, middle = lower + (upper - lower) * _covering(N_STARTS, j), 0.5 * (lower + upper)

    def searched(rows: NDArray[np.int_]) -> Floats:
        """Return the solutions of targets (rows,) from all starts."""
        chunks = []
        firsts = range(0, max(len(rows), 1), CHUNK)
        for first in steps_of(firsts, f"solving for the joints of {len(rows)} targets"):
            goals = np.repeat(targets[rows[first : first + CHUNK]], N_STARTS, axis=0)
            q_start = np.tile(starts, (len(goals) // N_STARTS, 1))
            ends = inverse(chain, params, goals, q_start, oriented, bounded)
            chunks.append(turned(chain, params, ends, middle).reshape(-1, N_STARTS, j))
        stock = np.concatenate(chunks)
        return _distinct(chain, params, stock) if oriented else stock

    if not oriented or not len(targets):
        return searched(np.arange(len(targets)))
    cells = np.floor(np.concatenate([targets[:, :3, 3] / LEVER, targets[:, :3, 2], targets[:, :3, 0]], axis=1) / CELL)
    _, leaders, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    stock = _packed(searched(leaders))
    singular = singular_value(chain, params, stock.reshape(-1, j)).reshape(stock.shape[:2])
    least = np.fmin.reduce(singular, axis=1, initial=np.inf)[cell.reshape(-1)]
    stock = stock[cell.reshape(-1)]
    n_reached = _is_solved(stock).sum(axis=1)
    follows = _is_solved(stock) & ~np.isin(np.arange(len(targets)), leaders)[:, None]
    stock[follows] = inverse(chain, params, targets[np.nonzero(follows)[0]], stock[follows], bounded=bounded)
    stock = _distinct(chain, params, stock)
    # A solution may be lost on the way if it merges with another, or begins between the two targets.
    lost = follows.any(axis=1) & ((_is_solved(stock).sum(axis=1) < n_reached) | (least < SINGULAR))
    again = _packed(searched(np.flatnonzero(lost)))
    every = np.full((len(stock), max(stock.shape[1], again.shape[1]), j), np.nan)
    every[:, : stock.shape[1]] = np.where(lost[:, None, None], np.nan, stock)
    every[lost, : again.shape[1]] = again
    return _packed(every)


def _is_solved(stock: Floats) -> NDArray[np.bool_]:
    """Return a mask (n, k) of the solutions (n, k, j) that there are."""
    return np.isfinite(stock[..., 0])


def _packed(stock: Floats) -> Floats:
    """Return solutions (n, k, j), as many as any target has, with those that there are first."""
    width = max(1, int(_is_solved(stock).sum(axis=1).max(initial=1)))
    order = np.argsort(~_is_solved(stock), axis=1, kind="stable")[:, :width]
    return np.take_along_axis(stock, order[..., None], axis=1)


def _covering(n: int, j: int) -> Floats:
    """Return n points (n, j) that cover the unit cube evenly: Roberts' sequence of a generalised golden ratio."""
    ratio = np.roots([1.0, *np.zeros(j - 1), -1.0, -1.0]).real.max()
    return np.asarray(np.outer(np.arange(1, n + 1), ratio ** -np.arange(1.0, j + 1)) % 1.0)


def _distinct(chain: Chain, params: Floats, stock: Floats) -> Floats:
    """Return solutions (n, k, j), NaN for those that differ from an earlier one only by whole turns."""
    distinct = stock.copy()
    for first in range(0, len(stock), CHUNK // N_STARTS):  # all pairs of a chunk's solutions take 3 MB
        rows = slice(first, first + CHUNK // N_STARTS)
        difference = stock[rows, :, None] - stock[rows, None]
        difference -= _turns(chain, params) * np.round(difference / _turns(chain, params))
        same = (np.abs(difference) < SAME).all(axis=-1)
        distinct[rows][np.tril(same, -1).any(axis=-1)] = np.nan
    return distinct


def _turns(chain: Chain, params: Floats) -> Floats:
    """Return by how much the readings (j,) change in a whole turn; without end for joints that slide or are coupled."""
    coupled = {*chain.mimics, *(mimic.followed for mimic in chain.mimics.values())}
    turning = np.array([joint.kind == "revolute" and i not in coupled for i, joint in enumerate(chain.joints)])
    return np.where(turning, 2.0 * np.pi / np.abs(chain.law.gain.of(params)), 1e300)


def _chosen(
    chain: Chain, params: Floats, stock: Floats, first: Floats, quadrants: Floats, oriented: bool, origins: Origins
) -> tuple[Floats, Floats]:
    """Return, of solutions (n, k, j), those nearest to the robot's previous positions, and these positions (n, j)."""
    middle, free = 0.5 * np.pi * (quadrants + 0.5), np.isnan(quadrants)
    singular = np.zeros(stock.shape[:2], dtype=bool)
    if not oriented:
        values = singular_value(chain, params, stock.reshape(-1, stock.shape[-1]), oriented)
        singular = values.reshape(singular.shape) < SINGULAR

    def nearest(rows: NDArray[np.int_], near: Floats) -> Floats:
        q = turned(chain, params, stock[rows], np.where(free[rows], near, middle[rows])[:, None])
        usable = within(chain, q)
        # Without orientation, joints at a limit or a singularity are the worse choice.
        poor = ~within(chain, q, ROOM) | singular[rows] if not oriented else np.zeros_like(usable)
        motion = np.abs(q - near[:, None])
        # Solutions that differ in other joints alone tie but for rounding, as do those of parallel axes in a mere sum.
        largest, total = motion.max(axis=-1).round(9), (motion**2).sum(axis=-1)
        order = np.lexsort((total, largest, poor, _misplaced(q, quadrants[rows, None]), ~usable), axis=1)
        best = np.arange(len(rows)), order[:, 0]
        return np.where(usable[best][:, None], q[best], np.nan)

    # All targets are chosen at once from where the robot is likely to be, twice; if it is elsewhere, again.
    order, every = _followed(origins.target), np.arange(len(quadrants))
    is_given: NDArray[np.bool_] = np.asarray(np.isfinite(origins.q).all(axis=1))
    chosen = nearest(every, np.broadcast_to(first, quadrants.shape))
    previous = np.empty_like(every)
    previous[order] = np.roll(order, 1)
    source, position = np.where(origins.target < 0, previous, origins.target), first
    for _ in range(2):
        near = np.where(is_given[:, None], origins.q, chosen[source])
        chosen = nearest(every, near)
    settled, is_reached = np.zeros(len(quadrants), dtype=bool), np.isfinite(chosen[:, 0])
    for row in order:
        origin = origins.target[row]
        if is_given[row]:
            position = origins.q[row]
        elif origin >= 0 and settled[origin] and is_reached[origin]:
            position = chosen[origin]
        if not (near[row] == position).all():
            near[row] = position
            chosen[row] = nearest(every[row : row + 1], near[row : row + 1])[0]
            is_reached[row] = np.isfinite(chosen[row, 0])
        settled[row] = True
        position = chosen[row] if is_reached[row] else position
    return chosen, near


def _followed(origin: NDArray[np.int_]) -> list[int]:
    """Return the targets in an order in which each follows the robot's previous target, unless that is circular."""
    order: list[int] = []
    seen = np.zeros(len(origin), dtype=bool)
    for target in range(len(origin)):
        path = []
        while target >= 0 and not seen[target]:
            seen[target] = True
            path.append(target)
            target = int(origin[target])
        order += reversed(path)
    return order


def turned(chain: Chain, params: Floats, q: Floats, near: Floats) -> Floats:
    """Return joint readings (…, j) shifted by whole turns as close to ``near`` (…, j) as the limits allow.

    A reading that is beyond a limit only by rounding is returned as the limit.
    """
    turn, law = _turns(chain, params), chain.law
    lower, upper = chain.limits + np.array([[-ROUNDING], [ROUNDING]])
    turns = np.clip(np.round((near - q) / turn), np.ceil((lower - q) / turn), np.floor((upper - q) / turn))
    turns = np.where(turn < 1e300, turns, 0.0)
    q_turned = q + turn * turns
    if turns.any() and not law.affine:
        same = law.angles(params, q) + 2.0 * np.pi * np.sign(law.gain.of(params)) * turns
        q_turned = np.where(turns.any(axis=-1, keepdims=True), law.readings(params, same, near=q_turned), q)
    inside = np.clip(q_turned, *chain.limits)
    return np.where(np.abs(inside - q_turned) < ROUNDING, inside, q_turned)


def within(chain: Chain, q: Floats, room: float = 0.0) -> NDArray[np.bool_]:
    """Return whether joint readings (…, j) are inside the limits by ``room`` [rad, m]."""
    lower, upper = chain.limits
    return np.asarray(((q >= lower + room) & (q <= upper - room)).all(axis=-1))


def _sampled_range(chain: Chain) -> tuple[Floats, Floats]:
    """Return the limits for sampling: one turn for a revolute joint without limits or with a larger range."""
    middle = [0.5 * (j.lower + j.upper) if np.isfinite(j.lower + j.upper) else 0.0 for j in chain.joints]
    half = [min(0.5 * (j.upper - j.lower), np.pi) for j in chain.joints]
    return np.array(middle) - half, np.array(middle) + half


def _misplaced(q: Floats, quadrants: Floats) -> Floats:
    """Return the number (…) of joints of q (…, j) outside the required quarter turns (…, j), NaN where any will do."""
    beyond = np.abs(q - 0.5 * np.pi * (quadrants + 0.5)) > 0.25 * np.pi + EDGE  # never true for NaN
    return np.asarray(beyond.sum(axis=-1), dtype=float)
