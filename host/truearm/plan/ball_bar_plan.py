"""A plan of ball-bar poses: candidates on shells, the choice among them, their route, and a forecast of the result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import Argument, PlanError
from truearm.model.chain import point_forward
from truearm.plan.bar_paths import Pace, roadmaps
from truearm.plan.branches import check_joints
from truearm.plan.choose import TIE, Setup, as_blocks, choose
from truearm.plan.forecast import Aim, Forecast, Knowledge, arm_of, bar_table, candidate_rows, forecast, region_root
from truearm.plan.measurement_limits import Limits, Pairing, Region, Site, Sizes, around, make_shapes, poses_in
from truearm.plan.options import Budget, Criterion, PoseOptions
from truearm.plan.route import ONCE, Route, Visits, n_checks, route
from truearm.plan.shells import candidates
from truearm.progress import step
from truearm.text import counted
from truearm.types import Displayed, Plan, Rig
from truearm.units import UNITS

TRIALS = 6  # numbers of poses tried to meet a time budget
# Shares of a gain that count as equal, with each of which minutes are planned, for the least error: a mount is chosen
# by its first pose, before it shows what its others are worth.
TIES = (TIE, 0.01, 0.1)
# Shares of the work, for the progress: candidates found, and the ways between them; by a budget of minutes or poses.
LOOKING, LOOKING_ONCE = (0.17, 0.24), (0.45, 0.6)
# Poses per free parameter of the robot from which bars are considered uncertain. With two bars, 40 poses for 36
# parameters would cost 11 %, 150 poses 5 %.
DOUBTED_FROM = 8
MOVE = 5.0  # s from one pose to the next, including via points, as in plans for the three arms
COORDINATES = 3  # of a point that was not measured
MEETS, AIM = 0.95, 0.98  # of the budget: a plan that uses this much is not improved further; and what the next aims at
FIRST = 0.75  # of the poses that the budget would allow without mounts
SHORTER = 0.6  # of a move, that a further pose costs: with n poses on the same shells, moves are about n^0.6 together
TRIMMED = 0.9  # of the poses of a plan that was too long: with fewer, other mounts may be worth their time


@dataclass(frozen=True, eq=False, repr=False)
class BallBarPlan(Displayed):
    """A route and its forecast.

    ``route.plan`` has the poses, ``route.visits`` the plan including via points, ``route.minutes`` its duration.
    ``forecast`` has the ``names`` of the free parameters, their ``sigma`` and the expected ``rank``.

    Examples
    --------
    >>> import truearm
    >>> robot, rig = truearm.load_robot("puma560"), truearm.read_rig("bench.toml")
    >>> planned = truearm.plan_ball_bar(robot, rig, poses=8, options=truearm.BallBarOptions(candidates=60))
    >>> len(planned.route.visits) >= 8, planned.route.minutes > 0.0
    (True, True)
    """

    route: Route
    forecast: Forecast

    def _headline(self) -> str:
        return f"{len(self.route.plan)} poses, {self.route.minutes:.0f} min, rank {self.forecast.rank}"

    def _columns(self) -> Mapping[str, Any]:
        visits = self.route.visits
        return {name: getattr(visits, name) for name in visits.columns()}


def make_site(knowledge: Knowledge, limits: Limits, sizes: Sizes, seed: int = 0) -> Site:
    """Return the arm without its rig, at the current parameters.

    Raises PlanError unless the arm has a branch and at least six joints.
    """
    check_joints(knowledge.chain)
    shapes = make_shapes(knowledge.chain, knowledge.params, knowledge.rig, sizes, knowledge.links)
    return Site(arm_of(knowledge, np.random.default_rng([seed, 0xA2])), knowledge.rig, shapes, limits)


def all_pairings(rig: Rig, bars: Sequence[str] = ()) -> list[Pairing]:
    """Return every chuck with every sphere, for some bars or, by default, all. Raises PlanError for missing items."""
    if not (rig.bars and rig.chucks and rig.spheres):
        raise PlanError("the rig needs at least one chuck, one sphere and one bar")
    missing = [bar for bar in bars if bar not in rig.bars]
    if missing:
        raise PlanError("not-in-rig", place=Argument("bars"), what="bar", name=missing[0], names=list(rig.bars))
    return [Pairing(bar, c, s) for bar in (bars or rig.bars) for c in rig.chucks for s in rig.spheres]


def plan_ballbar(
    site: Site,
    knowledge: Knowledge,
    pairings: Sequence[Pairing],
    budget: Budget,
    options: PoseOptions,
    visits: Visits = ONCE,
    region: Region | None = None,
) -> BallBarPlan:
    """Plan ball-bar poses: candidates, choice, route and forecast. ``region``: by default the box around the shells.

    Raises PlanError for a missing budget or one that is too small, and the errors of the steps.
    """
    if (budget.n is None) == (budget.minutes is None):
        raise PlanError(
            "exclusive", first=Argument("poses"), second=Argument("minutes"), neither=budget.minutes is None
        )
    pace, minutes = Pace(dwell=options.dwell), budget.minutes or 0.0
    with step("planning poses") as advance:
        looked, linked = LOOKING if budget.n is None else LOOKING_ONCE
        candidate_poses = candidates(site, pairings, options.candidates, options.seed, options.spread)
        advance(looked)
        candidate_poses, graphs = roadmaps(site, candidate_poses)
        advance(linked)
        if (budget.n or 0) > len(candidate_poses):
            raise PlanError(
                f"only {len(candidate_poses)} candidates are within reach with the bar attached, too few for "
                f"{counted(budget.n or 0, 'pose')}; ask for fewer ",
                *(Argument("poses"), " or more ", Argument("candidates"), ", lower ", Argument("reserve"), ", widen "),
                *(Argument("branch"), ", or move the chucks"),
            )
        aim = _aim(site, candidate_poses, region, options.seed)
        table = bar_table(knowledge, candidate_poses)
        poses = budget.n if budget.n is not None else int(60.0 * minutes / (pace.dwell + MOVE))
        doubted = with_doubted_bars(knowledge) if poses >= DOUBTED_FROM * int(knowledge.free.sum()) else knowledge
        rows, information = candidate_rows(doubted, table)
        blocks, root = as_blocks(rows), region_root(doubted, table, aim)

        pairing = np.unique(pairing_names(candidate_poses), axis=0, return_inverse=True)[1].reshape(-1)
        cost = 0.0 if budget.minutes is None else pace.mount / (pace.dwell + MOVE)

        def chosen(n: int, tie: float = TIE) -> Plan:
            """Return the n best, the most important first."""
            stock = np.arange(len(candidate_poses))
            while True:
                setup = Setup(pairing[stock], cost)
                order = choose(blocks[stock], information, n, options.criterion, root, setup=setup, tie=tie)
                best = candidate_poses.select(stock[order])
                is_worth = _worth_mounting(knowledge, candidate_poses.select(stock), best)
                if is_worth.all() or is_worth.sum() < n:
                    return best
                stock = stock[is_worth]

        if budget.n is not None:
            best = _with_room(site, chosen, budget.n, visits)
            routes = [route(site, best, pace, graphs, visits)]
        else:
            ties = TIES if options.criterion == Criterion.I else TIES[:1]
            trials = (linked + (1.0 - linked) * k / (TRIALS * len(ties)) for k in count(1))
            longest: list[Plan] = []

            def tried(n: int, tie: float) -> Route:
                if longest and TRIMMED * len(longest[0]) < n < len(longest[0]):
                    best = longest[0].select(np.arange(n))  # the same mounts, without the least important poses
                    best = best.select(_worth_mounting(knowledge, best, best))
                else:
                    best = chosen(n, tie)
                    longest[:] = [best]
                planned_route = route(site, best, pace, graphs, visits)
                advance(min(next(trials), 1.0))
                return planned_route

            n_most, first = min(len(candidate_poses), int(60.0 * minutes / pace.dwell)), max(1, int(FIRST * poses))
            routes = []
            for tie in ties:
                longest.clear()
                within = _within(partial(tried, tie=tie), first, n_most, minutes, pace)
                routes += [] if within is None else [within]
            if not routes:
                text = f"{minutes:g} min are too few, mounting one pairing takes {pace.mount:g} s; give more "
                raise PlanError(text, Argument("minutes"))
        plans = [BallBarPlan(each, forecast(knowledge, bar_table(knowledge, each.plan), aim)) for each in routes]
        return min(plans, key=_loss)


def _loss(planned: BallBarPlan) -> tuple[bool, float]:
    """Return what the expected error lacks, and the error; the least is best."""
    return planned.forecast.relative, float(np.nan_to_num(planned.forecast.cartesian_rms, nan=np.inf))


def _worth_mounting(knowledge: Knowledge, candidate_poses: Plan, best: Plan) -> NDArray[np.bool_]:
    """Return a mask (n,) of the candidates whose chuck and sphere are worth mounting.

    These have none of the ``best`` poses, or enough of them to determine more than their own position. A chuck that was
    not measured has three unknown coordinates: three readings or fewer carry no information on the arm, and cost a
    mount.
    """
    is_worth = np.ones(len(candidate_poses), dtype=bool)
    for column, points in (("chuck", knowledge.rig.chucks), ("sphere", knowledge.rig.spheres)):
        names, poses = np.unique(getattr(best, column), return_counts=True)
        measured = () if knowledge.measured is None else knowledge.measured[column]
        idle = [
            name
            for name, count in zip(names.tolist(), poses.tolist(), strict=True)
            if count <= COORDINATES and points[name].sigma is None and name not in measured
        ]
        is_worth &= ~np.isin(getattr(candidate_poses, column), idle)
    return is_worth


def with_doubted_bars(knowledge: Knowledge) -> Knowledge:
    """Return what is known if the bars' zeros are known only to a weak σ (1 mm).

    Poses chosen this way still determine the arm if a bar turns out to be wrong or to drift and must be estimated. For
    the demo's arm with one bar, the tool's error is then 1.20 times that with a correct bar, compared with 1.31
    otherwise. With a correct bar this costs 1 to 2 %.
    """
    weak = UNITS["m"].weak_sigma
    bars = {name: replace(bar, zero_sigma=max(bar.zero_sigma, weak)) for name, bar in knowledge.rig.bars.items()}
    return replace(knowledge, rig=replace(knowledge.rig, bars=bars))


def _with_room(site: Site, chosen: Callable[[int], Plan], n: int, visits: Visits) -> Plan:
    """Return poses that make ``n`` visits including check poses; the first mount may have fewer poses than wanted."""
    best = chosen(max(n - 3 * visits.check_poses, 1))
    for _ in range(TRIALS):
        short = n - len(best) - n_checks(site, best, visits)
        if short < 0:
            # Another pose of the first mount is also a check pose, so the number may jump; the largest one drops some.
            _, mount, size = np.unique(pairing_names(best), axis=0, return_inverse=True, return_counts=True)
            spared = np.flatnonzero(mount.ravel() == np.argmax(size))[short:]
            best = best.select(np.setdiff1d(np.arange(len(best)), spared))
        if short <= 0:
            break
        best = chosen(len(best) + short)
    return best


def pairing_names(plan: Plan) -> NDArray[np.str_]:
    """Return bar, chuck and sphere of each pose (n, 3)."""
    return np.stack([plan.bar, plan.chuck, plan.sphere], axis=1)


def _within(planned: Callable[[int], Route], first: int, n_most: int, minutes: float, pace: Pace) -> Route | None:
    """Return as many poses as the minutes allow, at most ``n_most``, None if none; ``first``: the number to begin with.

    The next number lies between one that is too long and one that is not, by their minutes. Without the one or the
    other, it follows from what a further pose of this route would take: a dwell, and a share of a move because moves
    become shorter.
    """
    n, best, short, long = min(first, n_most), None, (0, 0.0), (n_most + 1, np.inf)
    for _ in range(TRIALS):
        if not short[0] < n < long[0]:
            break
        trial = planned(n)
        if trial.minutes <= minutes:
            short, best = (n, trial.minutes), trial
            if trial.minutes >= MEETS * minutes:
                break
        else:
            long = (n, trial.minutes)
        further = (pace.dwell + SHORTER * trial.seconds / len(trial.plan)) / 60.0
        if best is not None and np.isfinite(long[1]):
            further = (long[1] - short[1]) / (long[0] - short[0])
        n = int(np.clip(n + (AIM * minutes - trial.minutes) / further, max(short[0] + 1, n // 2), max(long[0] - 1, 1)))
    return best


def _aim(site: Site, candidate_poses: Plan, region: Region | None, seed: int) -> Aim:
    """Return poses of the region that contain the centre of the spheres; all spheres count."""
    spheres = {name: np.array(sphere.xyz) for name, sphere in site.rig.spheres.items()}
    if region is None:
        p_sphere = np.array([spheres[name] for name in candidate_poses.sphere])
        region = around(point_forward(site.arm.chain, site.arm.params, candidate_poses.q, p_sphere))
    return Aim(poses_in(site, region, np.mean([*spheres.values()], axis=0), seed=seed), tuple(spheres))
