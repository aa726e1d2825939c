"""Paths between poses with the bar on: straight in joint space, with via points where the bar would exceed its travel.

A straight joint move between two poses of a shell leaves the shell halfway. If some sample of a move violates the
limits, the middle of the move is brought back onto the shell by the smallest change of joints. With J_d = ∂d/∂q, this
is Δq = J_dᵀ(J_d J_dᵀ)⁻¹(zero − d). The middle becomes a via point (Goswami 1993, Data collection). Both halves are then
treated in the same way, up to DEEPEST halvings.

Where the tool would tilt too far or touch something, a chain of candidates leads around it (a probabilistic roadmap).
Each edge of the graph is first checked at three points, the paths along a chain then at every sample. If no path is
found, the bar must be removed for the move; moves without a bar may detour through postures of the branch.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from truearm.errors import Argument, PlanError
from truearm.model.chain import along, point_forward, trace_point
from truearm.plan.measurement_limits import (
    STEP,
    Limits,
    Pairing,
    Site,
    allowed,
    arm_allows,
    device_allows,
    of_pairing,
    pairing_at,
)
from truearm.progress import steps_of
from truearm.types import Floats, Plan

DEEPEST = 4  # halvings: at most 15 via points
STEPS = 5  # of Newton's method; the third is exact to rounding for half the bulge of a shell
PEAK = 15.0 / 8.0  # peak speed of a quintic relative to its mean
SHORTEST = 0.2  # s for a move
BETWEEN = 1.005  # a speed may peak between two samples: by at most (6 joints · STEP/2)²/6 = 0.24 %; twice that
DETOURS = 200  # random postures towards which a way without a bar is sought, the nearest first
ROUNDS = 5  # of further postures
SHORT = np.array([[0.0], [0.5], [0.75], [0.88], [0.94]])  # shares of the way to one that may be left
NEIGHBOURS = 8
TRIES = 6  # chains
SHARES = (0.25, 0.5, 0.75)  # of a path, where an edge is checked


@dataclass(frozen=True)
class Pace:
    """Highest speeds of joints [rad/s] and of the bar's end [m/s], dwell at a pose and work at the bar [s]."""

    joint_speed: float = 0.8
    bar_speed: float = 0.25
    dwell: float = 2.0
    mount: float = 30.0


def samples(start: Floats, end: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Return joints (n, j) on straight moves from start to end (m, j), at most STEP apart, and the move (n,) of each.

    Both ends of a move belong to it.
    """
    count = 2 + (np.abs(end - start).max(axis=1) / STEP).astype(np.intp)
    move = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(move)) - (np.cumsum(count) - count)[move]) / (count - 1)[move]
    return start[move] + share[:, None] * (end - start)[move], move


def moves_allowed(
    site: Site, start: Floats, end: Floats, pairing: Pairing | None, limits: Limits | None = None
) -> NDArray[np.bool_]:
    """Return a mask (m,) of the straight moves that keep the limits, with the bar on or, for None, removed.

    ``limits``: by default those of samples.
    """
    q, move = samples(start, end)
    good, limits = np.ones(len(start), dtype=bool), limits or site.limits.tightened()
    for allows in (device_allows, arm_allows):  # the cheap check first
        unchecked = good[move]
        good[move[unchecked][~allows(site, q[unchecked], pairing, limits)]] = False
    return good


def ways_with_bar(site: Site, start: Floats, end: Floats, pairing: Pairing) -> list[Floats | None]:
    """Return via points (v, j) of each move between start and end (m, j) with the bar on throughout; None for no path.

    All moves are halved together, so that their checks are a few large computations instead of many small ones.
    """
    n = len(start)
    lost = np.zeros(n, dtype=bool)
    # of each section: its way, and where on it it begins and ends
    path, low, high = np.arange(n), np.zeros(n), np.ones(n)
    vias = [(path[:0], low[:0], start[:0])]
    for halving in range(DEEPEST + 1):
        blocked = ~moves_allowed(site, start, end, pairing)
        if halving == DEEPEST:
            lost[path[blocked]] = True
            break
        middle = onto_shell(site, 0.5 * (start[blocked] + end[blocked]), pairing)
        lost[path[blocked][~allowed(site, middle, pairing, site.limits.tightened())]] = True
        middle, rows = middle[~lost[path[blocked]]], blocked & ~lost[path]
        path, low, high, start, end = path[rows], low[rows], high[rows], start[rows], end[rows]
        share = 0.5 * (low + high)
        vias.append((path, share, middle))
        path, low, high = np.tile(path, 2), np.append(low, share), np.append(share, high)
        start, end = np.concatenate([start, middle]), np.concatenate([middle, end])
    path, share, q = (np.concatenate(column) for column in zip(*vias, strict=True))
    order = np.lexsort((share, path))
    vias_of_paths = np.split(q[order], np.searchsorted(path[order], np.arange(1, n)))
    return [None if failed else via for failed, via in zip(lost.tolist(), vias_of_paths, strict=True)]


def onto_shell(site: Site, q: Floats, pairing: Pairing) -> Floats:
    """Return the joints (n, j) nearest to q (n, j) at which the bar is at mid-travel."""
    bar, mounted = pairing.of(site.rig)
    for _ in range(STEPS):
        trace = trace_point(site.arm.chain, site.arm.params, q, mounted.p_sphere)
        vector = trace.p_base - mounted.p_chuck
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        jacobian = along(trace, vector / length).jac_joints
        q = q + jacobian * (bar.zero - length) / np.sum(jacobian**2, axis=1, keepdims=True)
    return q


class _Tree:
    """Postures (j,) that free straight moves connect with the first one."""

    def __init__(self, root: Floats) -> None:
        self.nodes, self.parents = [root], [0]

    def extend(self, site: Site, goal: Floats) -> Floats | None:
        """Add the farthest free posture on the way to ``goal`` from the nearest node, and return it.

        None if none is free.
        """
        nearest = int(np.argmin(np.abs(np.array(self.nodes) - goal).max(axis=1)))
        start = self.nodes[nearest]
        ends = goal + SHORT * (start - goal)
        is_free = moves_allowed(site, np.broadcast_to(start, ends.shape), ends, None)
        if not is_free.any():
            return None
        self.nodes.append(ends[np.argmax(is_free)])
        self.parents.append(nearest)
        return self.nodes[-1]

    def path(self) -> list[Floats]:
        """Return the postures from the first to the last node."""
        k, path = len(self.nodes) - 1, [self.nodes[-1]]
        while k:
            k = self.parents[k]
            path.insert(0, self.nodes[k])
        return path


def way_without_bar(site: Site, start: Floats, end: Floats, goal: str, seed: int = 0) -> Floats:
    """Return via points (v, j) of a collision-free move. Raises PlanError, with the goal's name.

    Trees grow from both ends by turns, one towards a random posture, the other towards its new node, until they meet
    (RRT-Connect: Kuffner and LaValle 2000). Via points that a straight move makes needless are left out.
    """
    branch = site.arm.branch
    random = np.random.default_rng([seed, 0xDE700])
    postures = random.uniform(branch.lower, branch.upper, (ROUNDS * DETOURS, len(start)))
    detour = np.abs(postures - start).max(axis=1) + np.abs(postures - end).max(axis=1)
    postures = postures[np.lexsort((detour, np.arange(len(detour)) // DETOURS))]
    tree, other_tree = first, last = _Tree(start), _Tree(end)
    for posture in (end, *postures):
        added = tree.extend(site, posture)
        met = None if added is None else other_tree.extend(site, added)
        if added is not None and met is not None and (met == added).all():
            return _straightened(site, np.array([*first.path(), *last.path()[-2::-1]]))
        tree, other_tree = other_tree, tree
    raise PlanError(f"no collision-free path to {goal} was found; try another ", Argument("seed"))


def _straightened(site: Site, stops: Floats) -> Floats:
    """Return the stops (v, j) between the first and the last that straight moves cannot leave out."""
    kept = [0]
    while kept[-1] < len(stops) - 1:
        ahead = stops[kept[-1] + 1 :]
        is_free = moves_allowed(site, np.broadcast_to(stops[kept[-1]], ahead.shape), ahead, None)
        is_free[0] = True  # as the tree found
        kept.append(len(stops) - 1 - int(np.argmax(is_free[::-1])))
    return stops[kept[1:-1]]


def move_seconds(site: Site, start: Floats, end: Floats, p_end_point: Floats, pace: Pace) -> Floats:
    """Return the durations (m,) of quintic moves in which neither a joint nor a point of the end exceeds the pace.

    start, end (m, j), p_end_point (m, 3).
    """
    q, move = samples(start, end)
    p = point_forward(site.arm.chain, site.arm.params, q, p_end_point[move])
    last = np.diff(move, append=len(start)) > 0
    count = np.bincount(move)
    chord = np.where(last, 0.0, np.linalg.norm(np.diff(p, axis=0, append=p[-1:]), axis=1)) * (count - 1)[move]
    fastest = BETWEEN * np.maximum.reduceat(chord, np.cumsum(count) - count)  # |∂p/∂s| [m], s from 0 to 1
    by_joints = np.abs(end - start).max(axis=1) / pace.joint_speed
    return np.asarray(np.maximum(PEAK * np.maximum(by_joints, fastest / pace.bar_speed), SHORTEST))


@dataclass(frozen=True, eq=False)
class Roadmap:
    """The graph of one pairing: candidates (n, j), and lengths (n, n) [rad] of edges not yet known to fail, else 0.

    ``legs``: via points of the moves between two candidates that were checked, or None for a move that fails.
    """

    site: Site
    pairing: Pairing
    stock: Floats
    edges: Floats
    legs: dict[tuple[int, int], Floats | None] = field(default_factory=dict)

    def check(self, moves: Iterable[tuple[int, int]]) -> None:
        """Enter the via points of moves (candidate, candidate) into ``legs``, all that it lacks in one search."""
        new = [move for move in dict.fromkeys(moves) if move not in self.legs]
        if new:
            start, end = np.array(new).T
            vias = ways_with_bar(self.site, self.stock[start], self.stock[end], self.pairing)
            self.legs.update(zip(new, vias, strict=True))

    def way(self, start: int, end: int) -> Floats | None:
        """Return via points (v, j) of a path with the bar on, straight or over candidates; None if there is none."""
        chain = [start, end]
        for _ in range(TRIES + 1):
            moves = list(pairwise(chain))
            self.check(moves)
            failed = [move for move in moves if self.legs[move] is None]
            if not failed:
                stops = [(self.legs[move], self.stock[move[1] : move[1] + 1]) for move in moves]
                return np.concatenate([q for stop in stops for q in stop if q is not None])[:-1]
            for a, b in failed:
                self.edges[a, b] = self.edges[b, a] = 0.0
            length, predecessor = dijkstra(
                csr_array(self.edges), directed=False, indices=start, return_predecessors=True
            )
            if not np.isfinite(length[end]):
                return None
            chain = [end]
            while chain[0] != start:
                chain.insert(0, int(predecessor[chain[0]]))
        return None


def roadmaps(site: Site, poses: Plan) -> tuple[Plan, dict[Pairing, Roadmap]]:
    """Return the candidates reachable from most others of their pairing with the bar on, and their graphs."""
    reachable, graphs = [], {}
    pairings = list(dict.fromkeys(pairing_at(poses, i) for i in range(len(poses))))
    for pairing in steps_of(pairings, f"looking for paths between {len(poses)} poses"):
        rows = np.flatnonzero(of_pairing(poses, pairing))
        edges = _edges(site, pairing, poses.q[rows])
        _, label = connected_components(csr_array(edges), directed=False)
        main = np.flatnonzero(label == np.argmax(np.bincount(label)))  # the largest set that appears to be connected
        reachable.append(rows[main])
        graphs[pairing] = Roadmap(site, pairing, poses.q[rows[main]], edges[np.ix_(main, main)])
    return poses.select(np.concatenate(reachable)), graphs


def _edges(site: Site, pairing: Pairing, q: Floats) -> Floats:
    """Return the lengths (n, n) of apparently passable edges between near neighbours, 0 elsewhere."""
    edges = np.zeros((len(q), len(q)))
    if len(q) < 2:
        return edges
    _, neighbours = KDTree(q).query(q, min(NEIGHBOURS + 1, len(q)), p=np.inf)
    first, second = np.repeat(np.arange(len(q)), neighbours.shape[1] - 1), neighbours[:, 1:].ravel()
    first, second = np.unique(np.sort(np.stack([first, second]), axis=0), axis=1)
    good = passable(site, q[first], q[second], pairing)
    first, second = first[good], second[good]
    edges[first, second] = edges[second, first] = np.abs(q[first] - q[second]).max(axis=1)
    return edges


def passable(site: Site, start: Floats, end: Floats, pairing: Pairing) -> NDArray[np.bool_]:
    """Return a mask (n,) of straight moves that appear free, ignoring the bar's length, which via points correct."""
    shares = np.array(SHARES)[:, None, None]
    between = (start + shares * (end - start)).reshape(-1, start.shape[1])
    any_length = replace(site.limits.tightened(), reserve=-np.inf)
    return np.asarray(allowed(site, between, pairing, any_length).reshape(len(SHARES), -1).all(axis=0))
