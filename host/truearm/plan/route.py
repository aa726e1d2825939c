"""From chosen poses to a route: its stops, grouped by pairing, with short paths, via points, and the total time."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.plan.bar_paths import Pace, Roadmap, move_seconds, passable, way_without_bar
from truearm.plan.measurement_limits import Pairing, Site, of_pairing, pairing_at
from truearm.plan.shells import move_costs
from truearm.progress import steps_of
from truearm.types import Floats, Move, Plan, Triple

TIMEOUT = 5.0  # s within which the box must answer
SETTLE = 0.3  # s between arriving and signalling it
SLOW = 0.2  # rad/s, rad/s² of the first move, from any position of the arm; RAPID: 50 mm/s
LONGEST = 72  # characters of a text: RAPID's strings have 80, and a program needs some of them
NEAR = 12  # poses to which the path is checked before the order is chosen


class Stop(NamedTuple):
    """One stop of a program, one row of the plan file.

    Joints (j,); seconds of the move to it (0 for the first); what is measured there or on the way (``Move``); what the
    operator must do before the arm moves off and when it has arrived ("" for nothing, otherwise as ``plain`` returns
    it); the speed [m/s] of a line; what is mounted or driven along on the way, by the columns of a plan.
    """

    q: Floats
    seconds: float
    move: Move = Move.DWELL
    before: str = ""
    there: str = ""
    speed: float = float("nan")
    names: Mapping[str, str] = {}


class Signals(NamedTuple):
    """Digital lines of the controller to and from the box.

    They are numbers (UR) or names (RAPID's ``doTruearm``, ``diTruearm``).
    """

    output: int = 0
    input: int | None = None


class Task(NamedTuple):
    """The content of a program other than its stops.

    Dwell at a pose [s]; the point (x, y, z) [m] of the end frame that lines keep straight.
    """

    name: str
    dwell: float = 2.0
    signals: Signals = Signals()
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0)


def visits_of(stops: Sequence[Stop]) -> Plan:
    """Return stops as a plan, row by row."""
    names = {name: np.array([stop.names.get(name, "") for stop in stops]) for name in (*Plan.IDS, "line", "target")}
    move, speed = np.array([stop.move.value for stop in stops]), np.array([stop.speed for stop in stops])
    return Plan(np.array([stop.q for stop in stops]), move=move, speed=speed, **names)


def plain(text: str) -> str:
    """Return a text without characters that have a meaning in a controller's language."""
    return re.sub(r"[^\w: .-]", "_", text, flags=re.ASCII)[:LONGEST]


def identifier(name: str) -> str:
    """Return a name that is valid in both languages, is not one of their keywords, and fits RAPID's 32 characters."""
    return f"truearm_{re.sub(r'[^a-z0-9]+', '_', name.lower()).strip('_')}"[:32].rstrip("_")


def short_tour(from_start: Floats, cost: Floats) -> NDArray[np.int64]:
    """Return an order of n points with a small sum of move ``cost`` (n, n); ``from_start`` (n,) selects the first."""
    order = [int(np.argmin(from_start))]
    unvisited = np.ones(len(cost), dtype=bool)
    for _ in range(len(cost) - 1):
        unvisited[order[-1]] = False
        order.append(int(np.argmin(np.where(unvisited, cost[order[-1]], np.inf))))
    return untangled(np.array(order), cost)


def untangled(order: NDArray[np.int64], cost: Floats) -> NDArray[np.int64]:
    """Return the tour after reversing sections of it as long as this reduces the cost (2-opt).

    Going always to the nearest remaining point ends with long moves back to skipped points; this corrects them.
    """
    order = order.copy()
    improved = True
    while improved:
        improved = False
        for i in range(len(order) - 2):
            # Reverse order[i+1 .. k]: the moves i→i+1 and k→k+1 become i→k and i+1→k+1; the last k has no k+1.
            start, next_point, k = order[i], order[i + 1], order[i + 2 :]
            gain = cost[start, next_point] - cost[start, k]
            gain[:-1] += cost[k[:-1], k[1:]] - cost[next_point, k[1:]]
            if gain.max() > 1e-12:
                end = i + 3 + int(np.argmax(gain))
                order[i + 1 : end] = order[i + 1 : end][::-1]
                improved = True
    return order


class Visits(NamedTuple):
    """How often mounts are visited, so that drift or slip can be detected (docs/how-to/rig.md).

    ``times``: visits of every mount, which share its poses. ``check_poses``: number of poses of the first mount that
    are visited again when half the mounts are done and at the end, and of another mount, at the end.
    """

    times: int = 1
    check_poses: int = 0


ONCE = Visits()


class Route(NamedTuple):
    """A plan in the order of its visits, and the stops on the way: its poses, and via points between them.

    All bars are removed on the way to a mount. If the pairing stays the same, a via point records this.
    """

    plan: Plan
    stops: list[Stop]
    pace: Pace

    @property
    def n_mounts(self) -> int:
        return sum(bool(stop.there) for stop in self.stops)

    @property
    def n_via(self) -> int:
        return len(self.stops) - len(self.plan)

    @property
    def seconds(self) -> float:
        """Return the seconds of all moves."""
        return sum(stop.seconds for stop in self.stops)

    @property
    def minutes(self) -> float:
        """Return the minutes, with an operator present."""
        return (self.seconds + len(self.plan) * self.pace.dwell + self.n_mounts * self.pace.mount) / 60.0

    @property
    def visits(self) -> Plan:
        """Return all stops as a plan, row by row: via points name what is mounted, or nothing on the way to a mount."""
        return visits_of(self.stops)


def travelled(site: Site, plan: Plan, legs: Iterable[tuple[Iterable[Floats], bool]], pace: Pace) -> Route:
    """Return the route to each pose of a plan by ``legs``: via points on the way, and whether a bar is mounted there.

    The operator removes the bar before the move to a mount, and mounts it there. At the first stop no bar is mounted,
    unless an earlier run was broken off: the operator makes sure. In a move, neither a joint nor the bar's sphere
    exceeds the pace.
    """
    stops: list[Stop] = []
    spheres: list[Triple] = []
    for pose, (via, is_mount) in enumerate(legs):
        names = {name: str(getattr(plan, name)[pose]) for name in Plan.IDS}
        underway = {} if is_mount else names
        leg = [*(Stop(q, 0.0, Move.VIA, names=underway) for q in via), Stop(plan.q[pose], 0.0, names=names)]
        if is_mount:
            mounted = f"bar {names['bar']} from {names['chuck']} to {names['sphere']}"
            remove = "Remove the bar" if stops else "Check that no bar is mounted"
            leg[0] = leg[0]._replace(before=plain(f"{remove}. Next: {mounted}"))
            leg[-1] = leg[-1]._replace(there=plain(f"Mount {mounted}"))
        stops += leg
        spheres += [site.rig.spheres[names["sphere"]].xyz] * len(leg)
    return Route(plan, timed(site, stops, np.array(spheres), pace), pace)


def timed(site: Site, stops: Sequence[Stop], p_end_point: Floats, pace: Pace) -> list[Stop]:
    """Return stops with the seconds of the moves to them, by the speed of points of the end (s, 3); 0 for lines."""
    q = np.array([stop.q for stop in stops])
    seconds = [0.0, *move_seconds(site, q[:-1], q[1:], p_end_point[1:], pace).tolist()]
    return [stop._replace(seconds=move * (stop.move != Move.LINE)) for stop, move in zip(stops, seconds, strict=True)]


def route(site: Site, plan: Plan, pace: Pace, graphs: Mapping[Pairing, Roadmap], visits: Visits) -> Route:
    """Return a route through all poses of a plan in an order of its own, with check poses visited more than once.

    Where a straight path fails, the route may pass through candidates by the ``graphs`` of ``roadmaps``. Raises
    PlanError if no path to a pose is free.
    """
    plan = ordered(site, plan, pace, visits)
    pairing = [pairing_at(plan, i) for i in range(len(plan))]
    node = np.zeros(len(plan), dtype=np.intp)  # of each pose in the graph of its pairing
    for name in dict.fromkeys(pairing):
        rows = np.flatnonzero(of_pairing(plan, name))
        node[rows] = (graphs[name].stock[None] == plan.q[rows, None]).all(axis=2).argmax(axis=1)
        graphs[name].check((int(node[i - 1]), int(node[i])) for i in rows[1:] if pairing[i - 1] == name)
    legs: list[tuple[Iterable[Floats], bool]] = [((), True)]
    for i in steps_of(range(1, len(plan)), f"planning the path through {len(plan)} poses"):
        via = graphs[pairing[i]].way(int(node[i - 1]), int(node[i])) if pairing[i] == pairing[i - 1] else None
        legs.append((_without_bar(site, plan, i), True) if via is None else (via, False))
    return travelled(site, plan, legs, pace)


def ordered(site: Site, plan: Plan, pace: Pace, visits: Visits = ONCE) -> Plan:
    """Return the poses in the order of visits, by pairing; successive pairings share a chuck or a sphere."""
    rig, start = site.rig, 0.5 * (site.arm.branch.lower + site.arm.branch.upper)
    weights = np.full(len(start), 1.0 / pace.joint_speed)
    visited: list[NDArray[np.intp]] = []
    pairings = _pairings_in_order(site, plan)
    for visit, pairing in ((visit, pairing) for visit in range(visits.times) for pairing in pairings):
        rows = np.flatnonzero(of_pairing(plan, pairing))[visit :: visits.times]
        if not rows.size:
            continue
        q = plan.q[rows]
        cost = move_costs(
            site.arm, q, weights, rig.bars[pairing.bar], rig.chucks[pairing.chuck], rig.spheres[pairing.sphere]
        )
        cost = cost + pace.mount**2 * ~_passable(site, q, cost, pairing)
        order = short_tour(np.abs((q - start) * weights).max(axis=1), cost)
        visited.append(rows[order])
        start = q[order[-1]]
    return plan.select(np.concatenate(_with_checks(visited, pairings, visits.check_poses)))


def n_checks(site: Site, plan: Plan, visits: Visits) -> int:
    """Return the number of visits of check poses that ``route`` adds to a plan."""
    pairings = _pairings_in_order(site, plan)
    mounts = [np.flatnonzero(of_pairing(plan, pairing)) for pairing in pairings]
    return sum(mount.size for mount in _with_checks(mounts, pairings, visits.check_poses)) - len(plan)


def _with_checks(
    mounts: Sequence[NDArray[np.intp]], pairings: Sequence[Pairing], check_poses: int
) -> list[NDArray[np.intp]]:
    """Return the poses of the mounts, with some of the first repeated in the middle and at the end.

    At the end, so are some of the first mount with another chuck, if any: one chuck alone does not show every tilt of
    the table.
    """
    if check_poses == 0 or len(mounts) < 2:
        return list(mounts)
    elsewhere = [i for i, pairing in enumerate(pairings) if pairing.chuck != pairings[0].chuck]
    first, last = (
        mount[np.unique(np.linspace(0, mount.size - 1, check_poses).astype(np.intp))]
        for mount in (mounts[0], mounts[elsewhere[0] if elsewhere else 1])
    )
    middle = (len(mounts) + 1) // 2
    between = [first] if middle > 1 else []  # next to the first mount it would be one long visit
    return [*mounts[:middle], *between, *mounts[middle:], first, last]


def _passable(site: Site, q: Floats, cost: Floats, pairing: Pairing) -> NDArray[np.bool_]:
    """Return a mask (n, n) of moves between near poses that appear free, but for the bar's length.

    Via points correct that length.

    Each pose is checked against its NEAR nearest; other moves count as not free.
    """
    is_near = np.zeros(cost.shape, dtype=bool)
    nearest = np.argsort(cost, axis=1, kind="stable")[:, : NEAR + 1]
    np.put_along_axis(is_near, nearest, True, axis=1)
    first, second = np.nonzero(np.triu(is_near | is_near.T, 1))
    good = passable(site, q[first], q[second], pairing)
    out = np.eye(len(q), dtype=bool)
    out[first, second] = out[second, first] = good
    return out


def _pairings_in_order(site: Site, plan: Plan) -> list[Pairing]:
    """Order pairings by bar, then chuck, with spheres in alternating order, so that one end of the bar stays."""
    used = {pairing_at(plan, i) for i in range(len(plan))}
    spheres = list(site.rig.spheres)
    ends = zip(product(site.rig.bars, site.rig.chucks), cycle([spheres, spheres[::-1]]))
    pairings = (Pairing(bar, chuck, sphere) for (bar, chuck), row in ends for sphere in row)
    return [pairing for pairing in pairings if pairing in used]


def _without_bar(site: Site, plan: Plan, i: int) -> Floats:
    """Return via points to pose i from the previous one with the bar removed: at least one within a pairing."""
    start, end = plan.q[i - 1], plan.q[i]
    pairing = pairing_at(plan, i)
    goal = f"pose {i} ({pairing.bar}, {pairing.chuck}, {pairing.sphere})"
    via = way_without_bar(site, start, end, goal, seed=i)
    return via if len(via) or pairing != pairing_at(plan, i - 1) else 0.5 * (start + end)[None]
