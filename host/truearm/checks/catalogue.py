"""The list of hypotheses: every item that can be off, in each form in which it can.

A form is a set of candidates: profiles over the rows (an offset, a drift, what follows a joint's last move), or spans
of rows in which an item is off (a step, a run). A hypothesis holds the columns of its item; a candidate multiplies them.
Items and what can happen to them come from the kinds (``Fault`` and ``Group.faults``); joints, the arm, base and tool are
listed here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from truearm.checks.whitened import WhitenedFit
from truearm.estimate.systematic_effects import Cause
from truearm.kinds.registry import kinds
from truearm.results import DriftWith
from truearm.types import Floats, Indices

# The typical size of a fault [SI]; a hypothesis has the sizes 0.2, 1 and 5 times this (``evidence.SCALES``).
TYPICAL = {"m": 0.3e-3, "rad": 0.3e-3, "1": 5e-3, "1/K": 5e-6, "s": 1e-3}
GROWTH = 3e-4  # relative: an arm of 0.5 m that warms by 15 K
MOVED_SHARE = 1e-3  # of its last move, by which a joint that has not settled is off
LEAST_ROWS = 4  # in a span, and before it
KNOTS = 25  # rows at which a run may begin or end; the best is refined row by row
LEAST_WARMING = 0.2  # K
BEND = 3.0  # of a drift that settles: 1 − exp(−BEND t)


class Profiles(NamedTuple):
    """Candidates that multiply an item's columns by ``values`` (c, n) over the rows.

    Of a drift, ``rows`` [first, after last) and what it is linear in, None if it settles.
    """

    values: Floats
    drifts: tuple[tuple[int, int, DriftWith | None], ...] = ()


class Spans(NamedTuple):
    """Candidates by which an item is off from a row up to but excluding another: ``edges`` (c, 2)."""

    edges: Indices


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """All candidates of one item and form.

    ``columns`` (m, d) are the whitened changes of the predictions by each number that is off by its typical size
    ``sizes`` (d,) [SI ``units``]. ``nuisance`` (m, f) are columns that are fitted with it. ``kind`` says which hypotheses
    share one prior probability.
    """

    kind: str
    item: str
    form: str
    columns: Floats
    sizes: Floats
    units: tuple[str, ...]
    candidates: Profiles | Spans
    nuisance: Floats | None = None

    @property
    def name(self) -> str:
        return f"{self.item}.{self.form}"

    @property
    def count(self) -> int:
        """Return the number of candidates."""
        return len(self.candidates[0])

    def candidate(self, number: int, row: Indices) -> Floats:
        """Return the columns (m, d) of a candidate; ``row`` (m,) are the rows of the residuals."""
        if isinstance(self.candidates, Profiles):
            return np.asarray(self.columns * self.candidates.values[number][row][:, None])
        first, last = self.candidates.edges[number]
        return np.asarray(self.columns * ((row >= first) & (row < last))[:, None])


class Catalogue:
    """The hypotheses about a fit; ``add`` is the only way in."""

    def __init__(self, fit: WhitenedFit) -> None:
        self.fit = fit
        self.hypotheses: list[Hypothesis] = []
        self.always = Profiles(np.ones((1, fit.n)))
        self.drifts = drift_profiles(fit)
        self.steps = Spans(steps_from(np.arange(LEAST_ROWS, fit.n - LEAST_ROWS + 1), fit.n))
        self.runs = Spans(runs_between(np.unique(np.linspace(0, fit.n, KNOTS).astype(np.intp)), fit.n))

    def add(
        self,
        item: str,
        form: str,
        columns: Floats,
        units: Sequence[str],
        candidates: Profiles | Spans,
        sizes: Floats | None = None,
        nuisance: Floats | None = None,
    ) -> None:
        """Add a hypothesis; ``columns`` (m, d) are per SI unit, ``sizes`` (d,) typical ones if not those of the units."""
        if not (len(candidates[0]) and columns.any()):
            return
        size = np.array([TYPICAL[unit] for unit in units]) if sizes is None else sizes
        kind = f"{kind_of(item, self.fit)} {form}"
        self.hypotheses.append(Hypothesis(kind, item, form, columns * size, size, tuple(units), candidates, nuisance))

    def rows_used(self, columns: Floats) -> Indices:
        """Return the rows (u,) that some columns (m, d) touch."""
        return np.flatnonzero(np.bincount(self.fit.row[columns.any(axis=1)], minlength=self.fit.n))

    def steps_within(self, columns: Floats) -> Spans:
        """Return steps that begin in a row which the columns touch, with LEAST_ROWS of them on either side."""
        return Spans(steps_from(self.rows_used(columns)[LEAST_ROWS : 1 - LEAST_ROWS], self.fit.n))


def catalogue(fit: WhitenedFit) -> list[Hypothesis]:
    """Return all hypotheses about a fit."""
    out = Catalogue(fit)
    for cause in fit.causes:
        add_item(out, cause)
    add_groups(out)
    add_tilt(out)
    add_joints(out)
    add_arm(out)
    add_loose_flange(out)
    for fault in fit.kind_faults:
        out.add(fault.item, fault.form, fault.columns, [fault.unit] * fault.columns.shape[1], out.always)
    return out.hypotheses


def add_item(out: Catalogue, cause: Cause) -> None:
    """Add an item of the rig, the base or the tool in the forms that its kind declares, and its drift."""
    fit, fault = out.fit, cause.fault
    index = fit.errors.indices(cause.numbers)
    columns, units = fit.fault_jac[:, index], [fit.errors.units[i] for i in index]
    rows_used = out.rows_used(columns)
    if fault.moved or rows_used.size < 2 * LEAST_ROWS:  # joints have functions of their own
        return
    if is_constant(cause, fit):
        out.add(cause.name, "offset", columns, units, out.always)
    if fault.step:
        out.add(cause.name, "step", columns, units, out.steps_within(columns))
    if fault.run or fault.window:
        out.add(cause.name, "run", columns, units, out.runs)
    out.add(cause.name, "drift", columns, units, out.drifts)


def is_constant(cause: Cause, fit: WhitenedFit) -> bool:
    """Return whether an item can be off in all rows: the fit does not estimate all of its numbers anyway."""
    return cause.fault.constant and not fit.fitted.issuperset(cause.numbers)


def add_groups(out: Catalogue) -> None:
    """Add "all chucks", "all spheres": several items of one type that are off from the start."""
    constant = [cause for cause in out.fit.causes if is_constant(cause, out.fit) and len(cause.numbers) > 1]
    types = dict.fromkeys(cause.name.rpartition(".")[0] for cause in constant)
    for prefix in filter(None, types):
        rows = [number for cause in constant if cause.name.rpartition(".")[0] == prefix for number in cause.numbers]
        index = out.fit.errors.indices(rows)
        columns = out.fit.fault_jac[:, index]
        if len(rows) > len(constant[0].numbers) and columns.any():
            out.add(f"{prefix}.all", "offset", columns, [out.fit.errors.units[i] for i in index], out.always)


def add_tilt(out: Catalogue) -> None:
    """Add a base that tilts about its level axes: the usual one of its six motions, and so a hypothesis by itself."""
    columns = out.fit.fault_jac[:, out.fit.errors.indices(["base.rx", "base.ry"])]
    out.add("base.tilt", "step", columns, ["rad"] * 2, out.steps)
    out.add("base.tilt", "drift", columns, ["rad"] * 2, out.drifts)


def add_joints(out: Catalogue) -> None:
    """Add a joint whose encoder jumps, that drifts, has play, had not settled, or has an eccentric code wheel."""
    fit = out.fit
    q = fit.how.table.q[fit.how.row]
    joints = [cause.name for cause in fit.causes if cause.fault.moved]
    for number, name in enumerate(joints):
        index = fit.errors.indices([name])
        columns, units = fit.fault_jac[:, index], [fit.errors.units[index[0]]]
        reading = q[:, number][fit.row]
        z = (reading - reading.mean()) / max(float(reading.std()), 1e-9)
        polynomial = columns * np.stack([z, z**2, z**3], axis=1) * TYPICAL[units[0]]
        out.add(name, "run", columns, units, out.runs)
        out.add(name, "step", columns, units, out.steps)
        out.add(name, "drift", columns, units, out.drifts)
        direction, move = (moves_of(fit, name, drift) for drift in (DriftWith.DIRECTION, DriftWith.MOVE))
        out.add(name, "backlash", columns, units, direction, nuisance=polynomial)
        out.add(name, "settling", columns, units, move, np.array([MOVED_SHARE]), nuisance=polynomial)
        if units == ["rad"]:
            wheel = columns * np.stack([np.cos(reading), np.sin(reading)], axis=1)
            out.add(name, "eccentricity", wheel, units * 2, out.always)


def moves_of(fit: WhitenedFit, joint: str, drift: DriftWith) -> Profiles:
    """Return the profile of a joint's last direction or move; none if the rows do not know it."""
    course = fit.how.table.during(joint, drift, 0, fit.how.total)
    return Profiles(np.zeros((0, fit.n)) if course is None else course[fit.how.row][None])


def add_arm(out: Catalogue) -> None:
    """Add a drift of each free parameter of the robot, and a growth of all its lengths together."""
    fit = out.fit
    usual = [i for i in np.flatnonzero(fit.robot) if fit.units[i] in TYPICAL]
    for i in usual:
        out.add(fit.names[i], "drift", fit.jac[:, [i]], [fit.units[i]], out.drifts)
    lengths = [i for i in usual if fit.units[i] == "m"]
    growth = fit.jac[:, lengths] @ fit.values[lengths]
    out.add("arm", "growth", growth[:, None], ["1"], out.drifts, np.array([GROWTH]))


def add_loose_flange(out: Catalogue) -> None:
    """Add a tool with play: it lies on either side along each of its axes, whichever gravity chooses."""
    fit = out.fit
    side = np.sign(-fit.axes[:, 2, :])  # (n, 3) of gravity along the axes of the end
    points = {kind.point for kind in kinds().values() if kind.point}
    ends = [cause for cause in fit.causes if points & set(cause.name.split(".")[:-1])]
    if not ends:
        return
    columns = sum(fit.fault_jac[:, fit.errors.indices(cause.numbers)] for cause in ends)
    out.add("tool", "loose", np.asarray(columns) * side[fit.row], ["m"] * 3, out.always)


def drift_profiles(fit: WhitenedFit) -> Profiles:
    """Return the profiles of a drift in each session: linear in time, settling, and linear in the temperature."""
    values, drifts = [], []
    for session in np.unique(fit.how.session):
        rows = np.flatnonzero(fit.how.session == session)
        first, last = int(fit.how.row[rows[0]]), int(fit.how.row[rows[-1]]) + 1
        for drift in (DriftWith.TIME, DriftWith.TEMPERATURE):
            course = fit.how.table.during("", drift, first, last)
            if course is None or (drift is DriftWith.TEMPERATURE and np.ptp(course) < LEAST_WARMING):
                continue
            share = (course - course[0]) / np.ptp(course)
            bent = -np.expm1(-BEND * share) / -np.expm1(-BEND)
            for linear, profile in ((drift, share), (None, bent))[: 2 if drift is DriftWith.TIME else 1]:
                whole = np.zeros(fit.n)
                whole[rows] = profile[fit.how.row[rows] - first]
                values.append(whole)
                drifts.append((int(rows[0]), int(rows[-1]) + 1, linear))
    return Profiles(np.array(values).reshape(-1, fit.n), tuple(drifts))


def steps_from(first: Indices, n: int) -> Indices:
    """Return spans (c, 2) from some rows to the last of n."""
    return np.stack([first, np.full(first.size, n)], axis=1)


def runs_between(knots: Indices, n: int) -> Indices:
    """Return spans (c, 2) between every two knots, at least LEAST_ROWS long and not all of the n rows."""
    first, last = (knots[edge] for edge in np.triu_indices(knots.size, 1))
    enough = (last - first >= LEAST_ROWS) & (last - first < n)
    return np.stack([first[enough], last[enough]], axis=1)


def kind_of(item: str, fit: WhitenedFit) -> str:
    """Return the type of an item: "chuck" for "chuck.c1", "joint" for each joint, "arm" for the robot's parameters."""
    if any(cause.name == item and cause.fault.moved for cause in fit.causes):
        return "joint"
    return "arm" if item in fit.names and item not in fit.errors.names else item.partition(".")[0]
