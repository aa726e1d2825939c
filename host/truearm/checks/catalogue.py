"""The list of hypotheses: every item that can be off, in each form in which it can.

A form is a set of candidates. These are profiles over the rows (an offset, a drift, what follows a joint's last move),
or spans of rows in which an item is off (a step, a run). A hypothesis holds the columns of its item; a candidate
multiplies them. Items and what can happen to them come from the kinds (``Fault`` and ``Group.faults``); joints, the
arm, base and tool are listed here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from truearm.checks.whitened import WhitenedFit
from truearm.estimate.circumstances import Measured
from truearm.estimate.systematic_effects import Cause
from truearm.kinds.registry import kinds
from truearm.results import DriftWith
from truearm.types import Floats, Indices, thinned

# The typical size of a fault [SI]; a hypothesis has the sizes 0.2, 1 and 5 times this (``evidence.SCALES``).
TYPICAL = {"m": 0.3e-3, "rad": 0.3e-3, "1": 5e-3, "1/K": 5e-6, "s": 1e-3}
GROWTH = 3e-4  # relative: an arm of 0.5 m that warms by 15 K
MOVED_SHARE = 1e-3  # of its last move, by which a joint that has not settled is off
LAST_MOVE = {"backlash": DriftWith.DIRECTION, "settling": DriftWith.MOVE}  # forms of what follows a joint's last move
LEAST_ROWS = 4  # in a span, and before it
KNOTS = 25  # rows at which a run may begin or end; the best is refined row by row
STEPS = 60  # rows at which a step may begin
OWN_EDGE = 8  # rows
LEAST_WARMING = 0.2  # K
MOST_TOGETHER = 600  # columns times profiles
BEND = 3.0  # of a drift that settles: 1 − exp(−BEND t)


class Candidates(NamedTuple):
    """Profiles (c, n) by which an item's columns are multiplied over the rows.

    ``spans`` (c, 2) are the first row that each concerns and the one after the last. ``drifts`` are what each is linear
    in, or its other shape. Steps and runs are differences of ``profiles`` by their numbers in ``pairs`` (c, 2): few
    rows begin or end many spans. ``among``: how many spans are equally probable, if these are not all of them.
    """

    profiles: Floats
    spans: Indices
    drifts: tuple[str, ...] = ()
    pairs: Indices | None = None
    among: float | None = None

    @property
    def number(self) -> float:
        """Return of how many equally probable candidates these are all, or some."""
        return self.among or len(self.spans)

    def profile(self, number: int) -> Floats:
        """Return the profile (n,) of one candidate."""
        if self.pairs is None:
            return np.asarray(self.profiles[number])
        first, last = self.pairs[number]
        return np.asarray(self.profiles[last] - self.profiles[first])

    def products(self, columns: Floats, row: Indices, vectors: Floats, power: int = 1) -> Floats:
        """Return (columns · profile ** power)ᵀ vectors (p, d, x) for each of the p profiles.

        ``columns`` (m, d) and ``vectors`` (m, x) are those of m residuals, ``row`` (m,) has the row of each.
        """
        if self.pairs is None:
            return np.stack([(columns * profile[row, None] ** power).T @ vectors for profile in self.profiles])
        edges = [0, *np.searchsorted(row, np.unique(np.asarray(self.spans))).tolist()]  # sums before each
        return np.cumsum([columns[a:b].T @ vectors[a:b] for a, b in pairwise(edges)], axis=0)

    def of_profiles(self, values: Floats) -> Floats:
        """Return what each candidate has of ``values`` (h, p, …) that each profile has."""
        return values if self.pairs is None else np.asarray(values[:, self.pairs[:, 1]] - values[:, self.pairs[:, 0]])

    def of_squares(self, values: Floats) -> Floats:
        """Return what each candidate has (h, c, d, d) of the products (h, p, d, p, d) of all profiles."""
        if self.pairs is None:
            return np.asarray(np.einsum("hpdpe->hpde", values))
        first, last = self.pairs.T
        crossed = values[:, last, :, first]  # (c, h, d, d)
        squares = values[:, last, :, last] + values[:, first, :, first] - crossed - crossed.swapaxes(2, 3)
        return np.asarray(squares.swapaxes(0, 1))


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """All candidates of one item and form.

    ``columns`` (m, d + f) are the whitened changes of the predictions by each number that is off by its typical size
    ``sizes`` (d,) [SI ``units``], then those that are fitted with it. ``kind`` says which hypotheses share one prior
    probability.
    """

    fit: WhitenedFit
    kind: str
    item: str
    form: str
    columns: Floats
    sizes: Floats
    units: tuple[str, ...]
    candidates: Candidates

    @property
    def name(self) -> str:
        return f"{self.item}.{self.form}"

    def candidate(self, number: int, row: int | None = None) -> Floats:
        """Return the columns (m, d) of a candidate; with a ``row``, as if all were measured when that one was."""
        profile = self.candidates.profile(number)
        along = profile[self.fit.row, None] if row is None else profile[row]
        return np.asarray(self.columns[:, : self.sizes.size] * along)

    def course(self, number: int, measured: Measured) -> Floats:
        """Return the profile of a candidate over other rows of the same table (n,).

        NaN near an end, where it is unknown: rows of other items do not tell it.
        """
        candidates, examined = self.candidates, self.fit.measured
        if not candidates.drifts:
            touched = rows_used(self.columns, self.fit)
            profile = np.interp(measured.row, examined.row[touched], candidates.profile(number)[touched])
            return np.where(np.isin(profile, (0.0, 1.0)), profile, np.nan)
        drifts, own = drifts_of(measured), (examined.session[candidates.spans[number, 0]], candidates.drifts[number])
        sessions = measured.session[drifts.spans[:, 0]]
        return drifts.profile([*zip(sessions, drifts.drifts, strict=True)].index(own))

    def by_unit(self, size: Floats) -> dict[str, Floats]:
        """Return a ``size`` (d, …) in typical ones as its numbers of each SI unit."""
        units, scaled = np.array(self.units), (size.T * self.sizes).T
        return {unit: scaled[units == unit] for unit in dict.fromkeys(self.units)}


class Catalogue:
    """The hypotheses about a fit; ``add`` is the only way in. ``every``: also those of which its rows show nothing."""

    def __init__(self, fit: WhitenedFit, every: bool) -> None:
        self.fit = fit
        self.every = every
        self.hypotheses: list[Hypothesis] = []
        self.always = Candidates(np.ones((1, fit.n)), np.array([[0, fit.n]]))
        self.drifts = drifts_of(fit.measured)
        self._spans: dict[tuple[str, bytes], Candidates] = {}

    def add(
        self,
        item: str,
        form: str,
        columns: Floats,
        units: Sequence[str],
        candidates: Candidates,
        sizes: Floats | None = None,
        nuisance: Sequence[Floats] = (),
    ) -> None:
        """Add a hypothesis; ``columns`` (m, d) are per SI unit, ``sizes`` (d,) typical ones if not those of the units.

        Columns of a ``nuisance`` are fitted with it.
        """
        if not (self.every or (candidates.profiles.any() and columns.any())):
            return
        size = np.array([TYPICAL[unit] for unit in units]) if sizes is None else sizes
        kind = f"{kind_of(item, self.fit)} {form}"
        joined = np.column_stack([columns * size, *nuisance])
        self.hypotheses.append(Hypothesis(self.fit, kind, item, form, joined, size, tuple(units), candidates))

    def add_in_time(
        self, item: str, columns: Floats, units: Sequence[str], forms: Sequence[str] = ("step", "run", "drift")
    ) -> None:
        """Add an item that is off from some row on, for a while, or more and more."""
        for form in forms:
            self.add(item, form, columns, units, self.drifts if form == "drift" else self.spans(columns, form))

    def spans(self, columns: Floats, form: str) -> Candidates:
        """Return the steps or runs between the rows that some columns (m, d) touch.

        LEAST_ROWS of them are on either side.

        A step lasts to the end; a run that does is a step. Columns that touch the same rows have the same candidates.
        """
        rows = away_from_edges(rows_used(columns, self.fit)[LEAST_ROWS : 1 - LEAST_ROWS], self.fit)
        key = form, rows.tobytes()
        if key not in self._spans:
            knots = rows[thinned(rows.size, STEPS if form == "step" else KNOTS)]
            first, last = np.triu_indices(knots.size, 1)
            ends = (knots, np.full_like(knots, self.fit.n)) if form == "step" else (knots[first], knots[last])
            self._spans[key] = spans_of(np.stack(ends, axis=1), self.fit.n)
        return self._spans[key]


def alike(hypotheses: Sequence[Hypothesis]) -> list[list[Hypothesis]]:
    """Return the hypotheses in sets with the same candidates and as many columns, which are weighed together.

    Products of all columns of a set grow with the square of their number, so large sets are divided.
    """
    by_shape, sets = dict[tuple[int, int, int], list[Hypothesis]](), []
    for hypothesis in hypotheses:
        shape = id(hypothesis.candidates), hypothesis.columns.shape[1], hypothesis.sizes.size
        by_shape.setdefault(shape, []).append(hypothesis)
    for (_, columns, _), members in by_shape.items():
        most = max(MOST_TOGETHER // (columns * len(members[0].candidates.profiles)), 1)
        sets += [members[first : first + most] for first in range(0, len(members), most)]
    return sets


def catalogue(fit: WhitenedFit, every: bool = False) -> list[Hypothesis]:
    """Return all hypotheses about a fit; ``every``: also those of which its rows show nothing."""
    out = Catalogue(fit, every)
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
    columns, units = fit.by_numbers(cause.numbers)
    if cause.is_joint or not (out.every or rows_used(columns, fit).size >= 2 * LEAST_ROWS):
        return  # joints have functions of their own
    if is_constant(cause, fit):
        out.add(cause.name, "offset", columns, units, out.always)
    out.add_in_time(cause.name, columns, units, ("step", "run", "drift") if fault.step else ("drift",))


def is_constant(cause: Cause, fit: WhitenedFit) -> bool:
    """Return whether an item can be off in all rows: the fit does not estimate all of its numbers anyway."""
    return cause.fault.constant and not fit.fitted.issuperset(cause.numbers)


def add_groups(out: Catalogue) -> None:
    """Add "all chucks", "all spheres": several items of one type that are off from the start."""
    groups: dict[str, list[Sequence[str]]] = {}
    for cause in out.fit.causes:
        if is_constant(cause, out.fit) and len(cause.numbers) > 1:
            groups.setdefault(cause.name.rpartition(".")[0], []).append(cause.numbers)
    for prefix, items in groups.items():
        if prefix and len(items) > 1:
            columns, units = out.fit.by_numbers([number for numbers in items for number in numbers])
            out.add(f"{prefix}.all", "offset", columns, units, out.always)


def add_tilt(out: Catalogue) -> None:
    """Add a base that tilts about its level axes: the usual one of its six motions, and so a hypothesis by itself."""
    columns, units = out.fit.by_numbers(["base.rx", "base.ry"])
    out.add_in_time("base.tilt", columns, units, ("step", "drift"))


def add_joints(out: Catalogue) -> None:
    """Add a joint whose encoder jumps, that drifts, has play, had not settled, or has an eccentric code wheel."""
    fit = out.fit
    q = fit.measured.table.q[fit.measured.row]
    joints = [cause.name for cause in fit.causes if cause.is_joint]
    for number, name in enumerate(joints):
        columns, units = fit.by_numbers([name])
        reading = q[:, number][fit.row]
        z = (reading - reading.mean()) / max(float(reading.std()), 1e-9)
        polynomial = columns * np.stack([z, z**2, z**3], axis=1) * TYPICAL[units[0]]
        out.add_in_time(name, columns, units)
        for form, drift in LAST_MOVE.items():
            course = fit.measured.table.during(name, drift, 0, fit.measured.total)
            if course is not None:
                size = np.array([MOVED_SHARE if drift is DriftWith.MOVE else TYPICAL[units[0]]])
                by_move = columns * course[fit.measured.row][fit.row, None]
                out.add(name, form, by_move, units, out.always, size, nuisance=[polynomial])
        if units == ["rad"] and name not in fit.curved:
            wheel = columns * np.stack([np.cos(reading), np.sin(reading)], axis=1)
            out.add(name, "eccentricity", wheel, units * 2, out.always)


def add_arm(out: Catalogue) -> None:
    """Add a drift of each free parameter of the robot, and a growth of all its lengths together."""
    fit = out.fit
    usual = {name: parameter for name, parameter in fit.arm.items() if parameter.unit in TYPICAL}
    for name, parameter in usual.items():
        out.add(name, "drift", fit.jac[:, [parameter.column]], [parameter.unit], out.drifts)
    lengths = [parameter for parameter in usual.values() if parameter.unit == "m"]
    growth = fit.jac[:, [length.column for length in lengths]] @ np.array([[length.value] for length in lengths])
    out.add("arm", "growth", growth, ["1"], out.drifts, np.array([GROWTH]))


def add_loose_flange(out: Catalogue) -> None:
    """Add a tool with play: it lies on either side along each of its axes, whichever gravity chooses."""
    fit = out.fit
    side = np.sign(-fit.axes[:, 2, :])  # (n, 3) of gravity along the axes of the end
    points = {kind.point for kind in kinds().values() if kind.point}
    ends = [cause for cause in fit.causes if points & set(cause.name.split(".")[:-1])]
    if not ends:
        return
    columns = np.sum([fit.by_numbers(cause.numbers)[0] for cause in ends], axis=0)
    out.add("tool", "loose", columns * side[fit.row], ["m"] * 3, out.always)


def drifts_of(measured: Measured) -> Candidates:
    """Return the profiles of a drift by session: linear in time, settling, returning; linear in the temperature."""
    n = measured.row.size
    courses: list[tuple[Floats, tuple[int, int], str]] = []
    for session in np.unique(measured.session):
        rows = np.flatnonzero(measured.session == session)
        first, last = int(measured.row[rows[0]]), int(measured.row[rows[-1]]) + 1
        for drift in (DriftWith.TIME, DriftWith.TEMPERATURE):
            course = measured.table.during("", drift, first, last)
            if course is None or (drift is DriftWith.TEMPERATURE and np.ptp(course) < LEAST_WARMING):
                continue
            share = (course - course[0])[measured.row[rows] - first] / np.ptp(course)
            shapes: list[tuple[str, Floats]] = [(drift, share)]
            if drift is DriftWith.TIME:
                shapes += [("settling", np.expm1(-BEND * share) / np.expm1(-BEND))]
                shapes += [("returning", np.sin(np.pi * share))]
            span = int(rows[0]), int(rows[-1]) + 1
            courses += [(np.bincount(rows, course, n).astype(float), span, shape) for shape, course in shapes]
    profiles, spans, drifts = zip(*courses, strict=True) if courses else ((), (), ())
    return Candidates(np.reshape(profiles, (-1, n)), np.reshape(spans, (-1, 2)), drifts)


def spans_of(spans: Indices, n: int, among: float | None = None) -> Candidates:
    """Return candidates by which an item is off from a row up to but excluding another, at least LEAST_ROWS later."""
    spans = spans[np.diff(spans)[:, 0] >= LEAST_ROWS]
    edges, pairs = np.unique(spans, return_inverse=True)
    return Candidates((np.arange(n) < edges[:, None]).astype(float), spans, (), pairs.reshape(-1, 2), among)


def away_from_edges(rows: Indices, fit: WhitenedFit) -> Indices:
    """Return those of some rows that are not near an edge of a place, where errors of the model make steps."""
    if fit.measured.place is None:
        return rows
    edges = np.flatnonzero(np.diff(fit.measured.place)) + 1
    return np.asarray(rows[(np.abs(rows[:, None] - edges) > OWN_EDGE).all(axis=1)])


def rows_used(columns: Floats, fit: WhitenedFit) -> Indices:
    """Return the rows (u,) that some columns (m, d) touch."""
    return np.flatnonzero(np.bincount(fit.row[columns.any(axis=1)], minlength=fit.n))


def kind_of(item: str, fit: WhitenedFit) -> str:
    """Return the type of an item: "chuck" for "chuck.c1", "joint" for each joint, "arm" for the robot's parameters."""
    if any(cause.name == item and cause.is_joint for cause in fit.causes):
        return "joint"
    return "arm" if item in fit.arm else item.partition(".")[0]
