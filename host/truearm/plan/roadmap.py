"""Detours with the bar on: through candidates of the same pairing, along a graph of neighbours (a probabilistic
roadmap).

Straight paths fail where the tool would tilt too far or touch something. The candidates fill the space reachable with
the bar on, so a chain of them leads around the obstacle. When the graph is built, each edge is checked at three points.
The paths along the chain found are then checked at every sample, and an edge that fails is removed from the graph.
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

from truearm.plan.bar_paths import ways_with_bar
from truearm.plan.measurement_limits import Pairing, Site, allowed, of_pairing, pairing_at
from truearm.progress import steps_of
from truearm.types import Floats, Plan

NEIGHBOURS = 8
TRIES = 6  # chains
SHARES = (0.25, 0.5, 0.75)  # of a path, where an edge is checked


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
        """Find the ways of all moves between candidates that were not checked before, together."""
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
