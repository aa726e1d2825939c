"""What an identification finds: the Estimate and its parts. All are in SI units and frozen.

The unit in an annotation is that of the number in result.json (``estimate.result_document``).

Shapes: ``n`` rows, ``p`` parameters of the problem.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.arguments import converted
from truearm.findings import Finding
from truearm.types import Displayed, Floats, Law, Payload, Residuals, as_column, not_left_out, rms
from truearm.units import DEG, MM, MRAD


class Figures(NamedTuple):
    """RMS, mean and largest magnitude of the residuals of n rows in one SI unit; NaN if there are no rows.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table, rig = truearm.read_table("poses.csv", robot), truearm.read_rig("rig.toml")
    >>> held_out = truearm.identify(robot, table, rig, hold_out="shell=outer").estimate.held_out
    >>> figures = held_out.figures["m"]
    >>> figures.rms <= figures.max, figures.n
    (True, 20)
    """

    rms: float
    mean: float
    max: float
    n: int

    @classmethod
    def of(cls, residual: Floats) -> Figures:
        """Return the figures of residuals in one unit, ignoring NaN. Raises TypeError for anything but real numbers."""
        values = as_column("residual", residual, text=False)
        size = np.abs(values[~np.isnan(values)])
        if not size.size:
            return cls(math.nan, math.nan, math.nan, 0)
        return cls(rms(size), float(size.mean()), float(size.max()), size.size)

    @classmethod
    def by_unit(cls, residuals: Residuals, rows: NDArray[Any] | slice = slice(None)) -> dict[str, Figures]:
        """Return the figures of the selected rows for each SI unit that any of them has."""
        converted("residuals", residuals, Mapping[str, Any])
        figures_of_all = {unit: cls.of(residual[rows]) for unit, residual in residuals.items()}
        return {unit: figures for unit, figures in figures_of_all.items() if figures.n}


@dataclass(frozen=True)
class HeldOut:
    """Errors on ``n`` rows that were not used to fit, by SI unit.

    ``n_settled`` unknowns of the rig (such as the positions of sockets that no fitted row touches) were estimated from
    these same rows. ``n_left_out`` rows are excluded from ``n``, because such unknowns fit them exactly whatever the
    reading.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table, rig = truearm.read_table("poses.csv", robot), truearm.read_rig("rig.toml")
    >>> held_out = truearm.identify(robot, table, rig, hold_out="shell=outer").estimate.held_out
    >>> held_out.n, list(held_out.figures)
    (20, ['m'])
    """

    figures: Mapping[str, Figures]
    n: int
    n_settled: int = 0
    n_left_out: int = 0


EXACT_FIT = 1e-9  # χ² per degree of freedom, of residuals that are the rounding of computed data


@dataclass(frozen=True)
class NullDirection:
    """A combination of free parameters that the observations cannot determine: names and weights (the largest is 1)."""

    names: tuple[str, ...]
    weights: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.names) != len(self.weights):
            raise ValueError("needs a weight for each of its names")


# m, rad by which a null direction, of the largest weight 1, may move a point that it leaves at rest. Complete
# directions move it by 1e-10 at most, stored ones, which lack up to a hundred parts of 1e-6, by up to this.
MOVES = 1e-4


def weights_of(directions: Sequence[NullDirection], names: Sequence[str]) -> Floats:
    """Return the weights (k, d) of k parameters in d directions; 0 for those that a direction does not contain."""
    row_of = {name: i for i, name in enumerate(names)}
    weights = np.zeros((len(names), len(directions)))
    for column, direction in enumerate(directions):
        for name, weight in zip(direction.names, direction.weights, strict=True):
            if name in row_of:
                weights[row_of[name], column] = weight
    return weights


def largest_terms(weights: Iterable[float], names: Iterable[str]) -> list[tuple[float, str]]:
    """Return the terms of a direction in descending order.

    Those that are equal but for rounding, in their own order.
    """
    return sorted(zip(weights, names, strict=True), key=lambda term: -round(abs(term[0]), 6))


def chi2_text(reduced: float) -> str:
    """Return χ² per degree of freedom in words: "1.03", or "0 within rounding" for exact data."""
    return f"{reduced:.3g}" if reduced >= EXACT_FIT else "0 within rounding"


class Observability(NamedTuple):
    """Observability indices of the identified parameters; ``estimate.identifiability`` defines the four."""

    o1: float
    o2: float
    o3: float
    o4: float


@dataclass(frozen=True)
class Addition:
    """A further measurement, and which parameters of the robot it would make identifiable."""

    kind: str  # name used by the kind of observation that proposes it: "poses", "pairing"
    names: tuple[str, ...]  # identifiers of the rig that it involves; empty for new ones
    rank: int  # of the robot's free parameters, including it
    parameters: tuple[str, ...]  # those that would become distinguishable
    text: str = ""  # what to do, as an instruction to a person


class Unusable(StrEnum):
    """Why a fit is not usable."""

    NOT_CONVERGED = "not converged"
    NO_FREEDOM = "no degrees of freedom"  # the parameters fit any readings
    WRONG_INPUTS = "wrong inputs"  # another interpretation of the inputs explains the observations better
    RESIDUALS = "residuals"  # residuals that nothing explains
    SCALE = "robot scale"  # all lengths differ from the described ones by one ratio
    WORSE = "worse than nominal"  # at poses that were not fitted, than the nominal robot with base and tool placed


class Explanation(NamedTuple):
    """Another interpretation of the inputs that explains the observations far better: a finding, by code and values.

    ``rms_given`` and ``rms`` are the RMS residuals of quick fits of some rows, by SI unit, with the inputs as given and
    as reinterpreted. ``chance`` is the probability that correct inputs appear this wrong.
    """

    code: str
    values: Mapping[str, Any]
    n: int  # rows that it explains
    rms_given: Mapping[str, float]
    rms: Mapping[str, float]
    chance: float


class DriftWith(StrEnum):
    """The variable that an error is linear in."""

    TIME = "time"  # of the rows; their order if they have no times
    TEMPERATURE = "temperature"  # of the box
    DIRECTION = "direction"  # in which a joint last moved: its backlash
    MOVE = "move"  # of the joint, from the pose before: as if it was read before it stood still

    @property
    def ending(self) -> str:
        """Return the suffix of the names of these parameters."""
        endings = {"time": ".drift", "temperature": ".thermal_drift", "direction": ".backlash", "move": ".settling"}
        return endings[self]

    @property
    def has_offset(self) -> bool:
        """Return whether the moment at which the item was correct is unknown, so that it also has an offset."""
        return self in (DriftWith.TIME, DriftWith.TEMPERATURE)  # a joint's offset is a parameter of the robot


@dataclass(frozen=True)
class Effect:
    """A systematic error of ``what`` in the rows from ``first`` to before ``last`` (None: to the end), from 0.

    ``what`` is an item of a rig ("chuck.c2", "bar.b46.zero"), a joint, or "base". The error is an offset in these rows
    or, if it ``drifts_with`` something, linear in that variable. That of a joint which ``drifts_with`` its direction is
    its backlash: the link lags the reading by half of it. One that drifts with its move was read before it had arrived.

    Examples
    --------
    >>> from truearm.results import Effect
    >>> str(Effect("chuck.c2", first=182))
    'chuck.c2@183'
    """

    what: str
    first: int = 0
    last: int | None = None
    drifts_with: DriftWith | None = None

    def __str__(self) -> str:
        return self.parameter(self.what)

    def parameter(self, number: str) -> str:
        """Return the name of the parameter for the error of ``number``. Rows in the name count from 1."""
        end = "" if self.last is None else f":{self.last}"
        rows = f"@{self.first + 1}{end}" if self.first or end else ""
        return f"{number}{self.drifts_with.ending if self.drifts_with else ''}{rows}"


class Rival(NamedTuple):
    """A possible cause of what the rows show, such as "chuck.c1.step", or "mean": the mean of all causes.

    ``apply`` is the name that an identification takes to apply it, "" if it cannot. ``rows`` [first, after last) are
    those of the user's table that it concerns, None for all.
    """

    name: str
    apply: str
    rows: tuple[int, int] | None
    weight: float  # its probability among the causes
    moves: Annotated[float, MM]  # m, RMS motion of the tool if it is applied
    error: Annotated[float, MM]  # m, RMS error of the tool that is then left
    gain: float  # share of the squares of left-out rows that it removes
    gain_t: float  # in standard errors


class Size(NamedTuple):
    """By how much something is off, over the numbers of one SI unit: their norm and its standard deviation."""

    unit: str
    value: float
    sigma: float


@dataclass(frozen=True)
class Diagnosis:
    """An error that the rows show and chance does not explain (docs/explanation/hypotheses.md).

    ``rivals`` are its possible causes, the most probable first; the rows do not decide between them. No measurement at
    these poses can distinguish the first from its ``aliases``. ``sizes`` are those of the first. ``deciding`` are the
    names that are mounted in the rows, such as chuck and sphere, that would decide best if they were measured again at
    the end.
    """

    rivals: tuple[Rival, ...]
    mean: Rival
    aliases: tuple[str, ...]
    sizes: tuple[Size, ...]
    chi2_drop: float  # with the first as a parameter
    freedom: int
    log_evidence: float  # nats, beside no fault
    deciding: tuple[str, ...] = ()


@dataclass(frozen=True)
class ToolClaim:
    """The stated RMS error of the tool [m] in parts whose squares add up.

    ``parameters``: by the noise of the rows. ``unnamed``: by faults that the rows neither show nor exclude. ``rivals``:
    by not knowing which cause a fault has. ``shift``: by not applying the mean of the causes. ``noise`` is the declared
    one or a kernel that was learned, of which the standard deviation is ``noise_factor`` times the declared one.
    ``chi2_reduced`` is that with the faults as parameters. ``unseen`` are the sizes, by SI unit, from which faults that
    need not show in these rows exceed twice the stated error, ``refused`` what is beyond chance but does not predict
    rows that were left out.
    """

    parameters: Annotated[float, MM]
    unnamed: Annotated[float, MM]
    rivals: Annotated[float, MM]
    shift: Annotated[float, MM]
    noise: str
    noise_factor: float
    chi2_reduced: float
    unseen: Mapping[str, Mapping[str, float]]
    refused: tuple[str, ...] = ()

    @property
    def applied(self) -> float:
        """Return the error if the mean of the causes were applied."""
        return math.hypot(self.parameters, self.unnamed, self.rivals)

    @property
    def total(self) -> float:
        """Return the stated error."""
        return math.hypot(self.applied, self.shift)


class RobotScale(NamedTuple):
    """The ratio ``factor`` ± ``sigma`` of ``n`` lengths of the robot to the nominal ones (``estimate.robot_scale``).

    ``chance`` is the probability that independent tolerances give such a common ratio.
    """

    factor: float
    sigma: float
    n: int
    chance: float


@dataclass(frozen=True)
class StillJoint:
    """A joint that does not move enough to determine its axis; rad or m."""

    joint: str
    unit: str
    spread: float  # largest minus smallest reading
    at: float  # the median reading


@dataclass(frozen=True)
class Defaults:
    """Defaults of an identification, where the user chose nothing else, as names of the robot's parameters.

    ``base`` and ``tool`` are fixed because they are a choice of frame, along the directions ``frames``. ``lost`` are
    fixed because the joints ``still`` do not move enough. ``believed`` have the weak prior because the data determine
    them less well than it does.
    """

    base: tuple[str, ...] = ()
    tool: tuple[str, ...] = ()
    frames: tuple[NullDirection, ...] = ()
    still: tuple[StillJoint, ...] = ()
    lost: tuple[str, ...] = ()
    believed: tuple[str, ...] = ()


class MeanError(NamedTuple):
    """The mean error of ``n`` poses that were not fitted (held out, or left out in turn) and its 95 % interval."""

    mean: float
    low: float
    high: float
    n: int
    held_out: bool


class Gain(StrEnum):
    """Whether a calibration reduces the errors of poses that were not fitted (``estimate.validation``)."""

    BETTER = "better"
    NONE = "no better"  # not significantly better, within the scatter of the poses
    WORSE = "worse"


class MeanChange(NamedTuple):
    """Mean errors of ``n`` poses that were not fitted: of the nominal robot as mounted, and after the fit."""

    before: float
    after: float
    n: int
    gain: Gain


class ResidualParts(NamedTuple):
    """RMS residual of the fitted rows in one SI unit, split into the parts due to declared noise and unexplained."""

    declared: float
    unexplained: float


class Scatter(NamedTuple):
    """Errors of the arm itself, as standard deviations.

    They are learned from the residuals by their evidence (``estimate.scatter``).

    ``shared`` [m] and ``turned`` [rad] are of a displacement along, and a rotation about, each axis of the end that the
    rows of a pose share; ``joint`` of an error of each joint [rad, m of ``linear`` ones]. Beside them, the sensors'
    variances are ``factor`` times the declared ones. ``nats``: by how much the arm's errors raise the log evidence over
    a factor alone. ``n``: poses with several rows; 0 if fewer than half of the rows are in one of these. ``at_tool``
    [m]: RMS motion of the measured points by each joint's error, which is what the rows show of it.
    """

    factor: float
    shared: float
    turned: float
    joint: Mapping[str, float]
    linear: tuple[str, ...]
    nats: float
    n: int
    at_tool: Mapping[str, float]


class OtherFit(NamedTuple):
    """A fit of other rows than the estimate's: with ``n`` outliers that it lacks, or without ``n`` bad ones."""

    n: int
    value: Floats  # (p,) of all parameters
    rms_after: Mapping[str, float]  # by SI unit
    chi2_reduced: float
    # m, RMS distance of the end from where the estimate has it, over the fitted poses
    tool_moves: Annotated[float, MM] = math.nan


class Period(NamedTuple):
    """A sinusoidal component of an error curve: cycles per turn and amplitude [rad]."""

    cycles: float
    amplitude: Annotated[float, MRAD]


@dataclass(frozen=True)
class TriedLaw:
    """A joint law that was tried.

    It raises the log evidence by ``nats``; ``estimate.law_choice`` says when it is ``kept``.

    ``rms`` [rad] is the RMS, about its mean, of its contribution to the joint angle over the fitted poses; NaN unless
    the law is kept. Of a curve that is kept, ``covered`` are the intervals of readings [rad] that it is known in,
    ``periods`` its strongest components, and ``resolution_cycles`` [per turn] how far apart components must be to be
    distinguished. The resolution is NaN if the intervals are too short for any component. Of sag that is kept,
    ``range_share`` is the part of its range over random poses that it has over the fitted ones.
    """

    joint: str
    term: str  # "curve" | "sag"
    nats: float
    kept: bool
    rms: Annotated[float, MRAD] = math.nan
    covered: Annotated[tuple[tuple[float, float], ...], DEG] = ()
    periods: tuple[Period, ...] = ()
    resolution_cycles: float = math.nan
    range_share: float = math.nan


class LawStep(NamedTuple):
    """A fit for comparison ("geometry" or "laws"): RMS residual of the fitted rows, and held-out error."""

    name: str
    rms_after: Mapping[str, float]  # by SI unit
    held_out: HeldOut | None


@dataclass(frozen=True)
class JointLaws:
    """The joint laws beyond offset and gain in an identification.

    ``kept`` are the laws whose parameters follow those of the robot in the estimate. ``reasons`` are why other laws, or
    all of them, were not tried. The noise that was learned beside them is the estimate's ``scatter``.
    """

    mode: str  # one of ``estimate.solvers.LawMode``
    kept: tuple[Law, ...]
    tried: tuple[TriedLaw, ...]
    steps: tuple[LawStep, ...]
    reasons: tuple[Finding, ...]
    gravity: tuple[float, float, float]
    gravity_known: bool  # from the robot file; otherwise z is assumed to point up
    payloads: tuple[Payload, ...]  # the different ones of the fitted rows


class PredictedError(NamedTuple):
    """Predicted error of the measured point over the measured poses: by the parameters' covariance and ``scatter``.

    ``scatter`` is that of the arm itself, learned from the rows; 0 if it was not. If ``relative``, the error excludes
    the part that moves all poses as one rigid body, which observations in sockets or by a device of unknown pose cannot
    determine.
    """

    rms: Annotated[float, MM]  # m, over the poses
    max: Annotated[float, MM]  # m, expected norm at the worst pose
    at: str  # the row of the worst pose
    n: int  # poses
    relative: bool
    scatter: Annotated[float, MM] = 0.0  # m, RMS

    def exceeds(self, unexplained: Mapping[str, MeanError]) -> bool:
        """Return whether it is larger than the mean error of poses that were not fitted.

        Those show only the errors that the rows measure: a tool error along a direction that no row sees is not in
        them.
        """
        return "m" in unexplained and self.rms > unexplained["m"].mean


class Fold(NamedTuple):
    """The errors, by SI unit, of rows that were held out of a fit of their own, and what was held out: "place=p1"."""

    held_out_by: str
    figures: Mapping[str, Figures]


@dataclass(frozen=True, eq=False, repr=False)
class Estimate(Displayed):
    """The result of an identification.

    Arrays cover all parameters of the problem: first those of the robot, then those of the rig (nuisance parameters).
    ``sigma`` is NaN where the observations do not determine a parameter or it was not free. ``covariance`` is (p, p),
    with zero rows for parameters that were not free. ``identifiable`` is False where a parameter takes part in a null
    direction. ``distance`` is standardised: for a clean row it has the χ distribution with the row's number of
    residuals; it is NaN where a row was held out. Fields that result.json has too
    (docs/reference/result-format.md) mean the same, in SI units.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table, rig = truearm.read_table("poses.csv", robot), truearm.read_rig("rig.toml")
    >>> estimate = truearm.identify(robot, table, rig).estimate
    >>> estimate.status, estimate.sigma.shape == estimate.value.shape
    ('converged', True)
    """

    status: str  # "converged" | "max_iterations" | "stalled"
    message: str
    solver: str
    iterations: int
    parameter_names: tuple[str, ...]
    units: tuple[str, ...]
    nominal: Floats  # (p,)
    value: Floats  # (p,)
    sigma: Floats  # (p,)
    free: NDArray[np.bool_]  # (p,)
    identifiable: NDArray[np.bool_]  # (p,)
    covariance: Floats  # (p, p)
    n_robot_parameters: int
    n_observations: int
    rank: int
    rank_gap: float  # smallest kept / largest dropped singular value
    null_space: tuple[NullDirection, ...]  # named: parts too small to print are left out
    rms_before: Mapping[str, float]  # by SI unit, of the fitted rows, once base and tool are placed
    rms_after: Mapping[str, float]
    rms_history: Mapping[str, tuple[float, ...]]  # one per iteration, first is rms_raw
    chi2_reduced: float
    held_out: HeldOut | None
    held_out_before: HeldOut | None
    residual: Residuals  # after; signed if a kind has one component in a unit, otherwise the norm
    residual_before: Residuals
    fitted: NDArray[np.bool_]  # (n,) True for fitting rows, False for held-out
    seconds: float
    rms_raw: Mapping[str, float] = field(default_factory=dict)  # of the nominal robot, placed where the rig specifies
    loss: str = "linear"
    chi2_band: tuple[float, float] = (float("nan"), float("nan"))  # of chi2_reduced, 95 %, if σ and model are right
    chi2_freedom: float = float("nan")  # effective: residuals minus the trace of the hat matrix
    distance: Floats = field(default_factory=lambda: np.zeros(0))  # (n,) from the prediction by all other rows, in σ
    weight: Floats = field(default_factory=lambda: np.zeros(0))  # (n,) 1 as declared, 0 left out, else by a robust loss
    suspect: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n,) beyond the gate
    observability: Observability | None = None  # of the suggested free set
    suggested_free: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n_robot_parameters,)
    hardly_seen: tuple[NullDirection, ...] = ()  # determined less well than by a drawing (estimate.identifiability)
    additions: tuple[Addition, ...] = ()  # if free parameters are unidentifiable or hardly identifiable
    alternatives_tried: int = 0  # interpretations of the inputs (checks.inputs)
    explanations: tuple[Explanation, ...] = ()  # of an absurd fit, the most probable first
    unusable: Unusable | None = None  # the reason, if unusable (checks.inputs)
    left_out: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n,) not fitted or held out
    outlying: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))  # (n,) by estimate.outliers
    scale: RobotScale | None = None  # of its lengths; None: 1 within the tolerances of a drawing
    faults: tuple[Diagnosis, ...] = ()  # beyond chance (checks)
    claim: ToolClaim | None = None  # of the tool's error, with ``covariance`` to match; None: not examined
    prior_sigma: Floats = field(default_factory=lambda: np.zeros(0))  # (p,) about ``nominal``; inf for none
    law_prior: Floats = field(default_factory=lambda: np.zeros((0, 0)))  # (l, l) a root of the laws' prior precision
    applied: tuple[str, ...] = ()  # causes that were added to ``value``; the residuals are those before
    unexplained: Mapping[str, MeanError] = field(default_factory=dict)  # by unit, if χ² is above its range
    # (n,) where a row was not fitted: held out or, if no row is, in a fit without its pose; NaN for others
    unfitted_error: Residuals = field(default_factory=dict)
    unfitted_error_before: Residuals = field(default_factory=dict)  # empty if only base and tool were fitted
    mean_change: Mapping[str, MeanChange] = field(default_factory=dict)  # by unit, from these two
    with_outliers: OtherFit | None = None  # all rows, if outliers were left out (estimate.outliers)
    without_bad_rows: OtherFit | None = None  # these are ``suspect``, but too many to leave out (estimate.outliers)
    parts: Mapping[str, ResidualParts] = field(default_factory=dict)  # of ``rms_after``, without rows left out
    scatter: Scatter | None = None  # of the arm, where it was learned; in ``covariance`` if rows share poses
    joint_laws: JointLaws | None = None  # laws beyond offset and gain; None: not requested
    unseen: Floats = field(default_factory=lambda: np.zeros((0, 0)))  # (p, d) the complete null space, in SI units
    held_out_drawing: HeldOut | None = None  # of the drawing, if the nominal robot is the controller's
    folds: tuple[Fold, ...] = ()  # rows that were held out in turn; the last entry has all of them

    def _headline(self) -> str:
        return f"{self.status}, rank {self.rank} of {int(self.free.sum())} free, {self.n_observations} observations"

    def _columns(self) -> Mapping[str, Any]:
        names = ("parameter_names", "units", "nominal", "value", "sigma", "free", "identifiable")
        return {name: getattr(self, name) for name in names}

    @property
    def covariance_explains(self) -> bool:
        """Return whether the covariance says how far the parameters are off, at least with the faults as parameters."""
        if self.claim is None or not self.faults:
            return not self.unexplained
        # That of the claim may be of a selection of the rows; faults as parameters make that of all rows no larger.
        return min(self.claim.chi2_reduced, self.chi2_reduced) <= self.chi2_band[1]

    @property
    def used(self) -> NDArray[np.bool_]:
        """Return a mask (n,) of the fitted rows that were not left out as outliers.

        ``rms_before`` and ``rms_after`` cover these rows. Where every row was left out, they cover all fitted rows.
        """
        used_rows = self.fitted.copy()
        if self.weight.size:
            used_rows[used_rows] = not_left_out(self.weight[used_rows])
        return used_rows

    @property
    def law_parameters(self) -> range:
        """Return the indices of the joint-law parameters, the last of the robot's parameters."""
        laws = self.joint_laws.kept if self.joint_laws else ()
        return range(self.n_robot_parameters - sum(law.size for law in laws), self.n_robot_parameters)
