"""Identify a calibration from files of observations, or from a table and a rig (``truearm identify``)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import msgspec
import numpy as np

from truearm.arguments import Checked
from truearm.checks.alternatives import Robots
from truearm.checks.examination import MEAN, Examination, examined
from truearm.checks.inputs import checked_inputs
from truearm.disk import write_atomic
from truearm.errors import Argument, InputError, ProblemError, noting
from truearm.estimate.copied_rows import copied_rows
from truearm.estimate.defaults import choose_defaults, with_frames
from truearm.estimate.fit import fit
from truearm.estimate.frame_choice import mounting
from truearm.estimate.identify import SolverOptions, judged
from truearm.estimate.identify import identify as estimate_parameters
from truearm.estimate.joint_laws import LawRequest, WithLaws, is_of_joint, laws_and_outliers, with_joint_laws
from truearm.estimate.law_choice import LawChoice
from truearm.estimate.law_curves import SampledCurve, sampled_curves
from truearm.estimate.prediction import predicted_point_error, with_scatter_at_tool
from truearm.estimate.problem import build_problem
from truearm.estimate.result_document import copies_of, result_of
from truearm.estimate.result_file import RobotFrames, write_result
from truearm.estimate.robot_scale import with_scale
from truearm.estimate.solution import Options
from truearm.estimate.solvers import SOLVERS, LawMode, Loss, Prior, with_loss
from truearm.estimate.uncertainty import prior_named
from truearm.estimate.validation import with_gain
from truearm.findings import entries
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import write_table
from truearm.model.chain import Chain
from truearm.model.robot import Robot
from truearm.model.robot_file import RobotChoice, builtin_names, builtin_robot
from truearm.progress import step
from truearm.report.page import Certificate, Recording
from truearm.results import Effect, Estimate, Figures, Fold
from truearm.types import Floats, Mask, Rigs, rigs_by_name
from truearm.workflows import selection
from truearm.workflows.calibration import Identification, calibration_of
from truearm.workflows.inputs import Observed, Sources, check_files, hashed_inputs, read_sources
from truearm.workflows.requests import FitOptions

Progress = Callable[[int, Mapping[str, float]], None]  # iteration, RMS of the residuals by SI unit


@dataclass(frozen=True)
class IdentifyOptions(FitOptions, Checked):
    """Which parameters an identification estimates, and how.

    Parameters
    ----------
    free : tuple of str
        Patterns such as ``"joint*.offset"``. Only robot parameters that match one are identified. Default: the free
        parameters in the robot file; for a URDF all but the joint gains.
    also_free : tuple of str
        Patterns of additional parameters to identify.
    freeze : tuple of str
        Patterns of parameters to hold fixed.
    prior : str or None
        "none", "weak" (1 mm, 5 mrad) or "wide" (10 mm, 52 mrad), about the nominal values, or "where-needed": the weak
        one, but only for parameters that the observations determine less accurately. None: chosen by robot and solver.
    solver : str
        "lm", "map", "recursive", "renders-1991" or "ls".
    loss : str
        "linear", "huber" or "cauchy". All but the first require a solver with robust losses, such as "lm".
    max_iterations : int
        The solver stops after this many iterations, converged or not; at most 10000.
    seed : int
        Random seed for the rows of a held-out fraction; 0 or more.
    apply : tuple of str
        Faults that the result shall contain, by the names in its findings; ``"mean"`` is the mean of all possible
        causes. Those of rows and joints are estimated: ``"bar.b46.zero"`` in all rows, ``"chuck.c2@183"`` from row 183
        on, ``"joint2@91:270"`` in rows 91 to 270, ``"bar.b46.zero.drift"`` linear in time,
        ``"bar.b46.zero.thermal_drift"`` linear in the box's temperature, ``"joint1.backlash"`` in the direction of the
        joint's last move, and ``"joint1.settling"`` in proportion to it.
    fit_only : tuple of str
        Groups such as ``"place=front"``: only their rows are fitted, all others are used for judging.
    leave_out : tuple of str
        Rows that are neither fitted nor used for judging, such as ``"120:140"`` (counted from 1 over all inputs, in a
        file with times in their order) or ``"poses.csv row 100"`` (as messages and ``source`` name it).
    joint_laws : str
        "none", "curve" (error curves of the joints), "sag" (joints that deflect under gravity) or "auto" (both, if
        geometry and declared noise do not explain the residuals). Each law is included if the evidence in the fitted
        rows supports it.

    Raises
    ------
    TypeError, InputError
        If a field is invalid, or the solver does not support the loss or prior.

    Examples
    --------
    >>> import truearm
    >>> truearm.IdentifyOptions(solver="map", freeze=("joint1.*",)).solver
    'map'
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        solver, loss, prior = self.solver, self.loss, self.prior
        if loss != Loss.LINEAR and not SOLVERS[solver].has_loss:
            text = f" {loss} goes with the solvers {' and '.join(with_loss())}; {solver} has no robust loss"
            raise InputError(Argument("loss"), text)
        if prior not in (None, Prior.NONE) and SOLVERS[solver].prior is None:
            text = f" {solver}, which knows no prior; use map"
            raise InputError(Argument("prior"), f" {prior} does not apply to ", Argument("solver"), text)


DEFAULTS = IdentifyOptions()


@dataclass(frozen=True)
class IdentifyFiles:
    """Input and output files of ``truearm identify``; ``command`` is printed on the report.

    ``results``: every file to write the result to.
    """

    robot: RobotChoice
    sources: Sources
    results: tuple[Path, ...] = ()
    save_table: Path | None = None
    report: Path | None = None
    command: str = ""
    force: bool = False


@step("identifying")
def identify_files(files: IdentifyFiles, hold_out: Sequence[str], options: IdentifyOptions) -> Identification:
    """Read everything, identify, and write result, table and report as requested.

    Raises InputError with a one-line message, and ProblemError as ``identified`` does; then only the table is written.
    """
    sources = files.sources
    outputs = [*(("result", path) for path in files.results), ("table", files.save_table), ("page", files.report)]
    check_files(sources, files.robot, outputs, files.force)
    robot = files.robot.load()
    observed = read_sources(sources, robot.chain, robot)._replace(inputs=hashed_inputs(sources, files.robot))
    try:
        with noting(observed.findings):
            identification = identified(robot, observed, hold_out, options)
    except ProblemError:
        _save_table(files, observed.table, robot)  # it may show why
        raise
    _save_table(files, observed.table, robot)
    if files.report is not None:
        with step("drawing the report"):
            write_page(files.report, identification, files.command, observed.recordings)
    for path in files.results:
        write_result(path, identification.stored)
    return identification


def _save_table(files: IdentifyFiles, table: ObservationTable, robot: Robot) -> None:
    if files.save_table is not None:
        write_table(files.save_table, table, robot.chain.joint_units)


def _other_robots() -> Robots:
    """Return the built-in robots by name, to which observations may belong."""
    robots = {name: builtin_robot(name) for name in builtin_names()}
    return {name: (robot.chain, robot.free) for name, robot in robots.items()}


def split_causes(
    chain: Chain, rig: Rigs, table: ObservationTable, names: Sequence[str]
) -> tuple[tuple[Effect, ...], tuple[str, ...]]:
    """Return the faults that the fit estimates as parameters, and those of which the examination gives the effect."""
    items = {cause.name for cause in build_problem(chain, rig, table).causes} if names else set()
    effects = {name: Effect(name) if name in items else selection.parse_effect(name) for name in names if name != MEAN}
    fitted = {name: effect for name, effect in effects.items() if effect.what in items or effect.first or effect.last}
    return tuple(fitted.values()), tuple(name for name in names if name not in fitted)


def rivals_of_laws(chain: Chain, estimate: Estimate) -> tuple[str, ...]:
    """Return the causes of faults to apply beside joint laws: none of a joint, which laws describe.

    In rows sorted by a joint, an error curve of that joint passes for a joint that steps at certain rows. In any order
    a chuck that slipped or is elsewhere can be followed by curves to some extent.
    """
    causes = [fault.rivals[0] for fault in estimate.faults if not is_of_joint(chain, fault)]
    return tuple(cause.apply for cause in causes if cause.apply)


def examine(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    estimate: Estimate,
    effects: tuple[Effect, ...] = (),
    any_base: bool = False,
) -> Examination | None:
    """Return the examination of an estimate.

    It is None for a fit that did not converge, or that an analysis of first order does not suit.
    """
    if estimate.status != "converged" and not SOLVERS[estimate.solver].ends_by_recipe:
        return None
    with step("testing for faults"):
        return examined(chain, rig, table, estimate, effects, any_base)


def with_faults(estimate: Estimate, examination: Examination | None) -> Estimate:
    """Return the estimate with the faults of its examination and the parts of its error."""
    if examination is None:
        return estimate
    estimate = replace(estimate, faults=examination.faults, claim=examination.claim)
    if estimate.without_bad_rows is not None and estimate.faults and estimate.covariance_explains:
        excluded = np.isin(estimate.weight, 0.0)  # faults explain all rows, so none is bad
        estimate = replace(estimate, without_bad_rows=None, suspect=estimate.fitted & excluded)
    return estimate


def with_average(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    estimate: Estimate,
    examination: Examination | None,
    causes: Sequence[str] = (),
    effects: tuple[Effect, ...] = (),
) -> Estimate:
    """Return the estimate with some causes of faults applied, and its error averaged over all that may be wrong.

    The residuals of fitted rows stay those of the fit; held-out rows are judged again. Raises InputError for a cause
    that no fault has.
    """
    if examination is None:
        if causes:
            raise InputError(Argument("apply"), f" {causes[0]}: this fit does not show faults")
        return estimate
    change, covariance, claim = examination.applied(causes)
    sigma = np.where(np.isfinite(estimate.sigma), np.sqrt(np.diag(covariance)), np.nan)
    estimate = replace(estimate, value=estimate.value + change, covariance=covariance, sigma=sigma)
    if not causes:
        return estimate
    estimate = replace(estimate, applied=tuple(causes), claim=claim)
    return rejudged(chain, rig, table, estimate, effects)


def rejudged(
    chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate, effects: tuple[Effect, ...]
) -> Estimate:
    """Return the estimate, which has ``effects``, with the errors of its held-out rows at its values.

    It is unchanged if no row is held out.
    """
    held = ~(estimate.fitted | estimate.left_out)
    if not held.any():
        return estimate
    problem = build_problem(chain, rig, table, None, effects, estimate.fitted)
    x = problem.at(dict(zip(estimate.parameter_names, estimate.value, strict=True)))
    held_out, error = judged(problem, x, rig, table, held, effects)
    both = [{**errors} for errors in (estimate.residual, estimate.unfitted_error)]
    for unit, values in error.items():
        for errors in both:
            errors[unit] = errors[unit].copy()
            errors[unit][held] = values
    return replace(estimate, held_out=held_out, residual=both[0], unfitted_error=both[1])


def with_drawing(robot: Robot, rig: Rigs, table: ObservationTable, estimate: Estimate) -> Estimate:
    """Return the estimate of a robot whose nominal values are its controller's, with the drawing's held-out errors.

    As for the nominal robot, base, tool and the rig's unknowns are fitted.
    """
    held, drawing = ~(estimate.fitted | estimate.left_out), robot.drawing
    if drawing is None or not held.any():
        return estimate
    problem = build_problem(robot.chain, rig, table.select(estimate.fitted))
    places = mounting(robot.chain, drawing).either & estimate.free[: drawing.size]
    start = np.concatenate([drawing, problem.start[drawing.size :]])
    x = fit(problem, problem.columns(places), start, Options()).x
    return replace(estimate, held_out_drawing=judged(problem, x, rig, table, held, ())[0])


def held_out_in_turn(
    robot: Robot,
    rig: Rigs,
    table: ObservationTable,
    masks: Sequence[tuple[str, Mask]],
    always_held: Mask,
    options: IdentifyOptions,
) -> tuple[Fold, ...]:
    """Return the errors of folds, each in a fit without its rows, and those of all folds together."""
    folds, together = [], dict[str, Floats]()
    for name, rows in masks:
        held = rows & ~always_held
        with step(f"identifying without {name}"):
            fit = identified(robot, Observed(rig, table), rows | always_held, options).estimate
        folds.append(Fold(name, Figures.by_unit(fit.residual, held)))
        for unit, error in fit.residual.items():
            together.setdefault(unit, np.full(len(table), np.nan))[held] = error[held]
    return (*folds, Fold("", Figures.by_unit(together))) if folds else ()


def identified(
    robot: Robot,
    observed: Observed,
    hold_out: Sequence[str] | Mask = (),
    options: IdentifyOptions = DEFAULTS,
    *,
    progress: Progress | None = None,
) -> Identification:
    """Identify a robot; ``hold_out``: the rows to judge by, as the user names them (``held_out_rows``, ``folds_of``).

    A choice of frame and joints that do not move are held fixed, unless their parameters were requested by name. Raises
    InputError for a pattern or group that matches nothing, and ProblemError if observations and robot do not form a
    problem that can be solved.
    """
    chain, names, rig, table = robot.chain, robot.chain.parameter_names, observed.rigs, observed.table
    folds = selection.folds_of(table, hold_out, options.seed)
    held = selection.held_out_rows(table, () if folds else hold_out, options.seed, options.fit_only)
    held_rows = np.zeros(len(table), dtype=bool) if held is None else held
    groups = () if isinstance(hold_out, np.ndarray) else tuple(hold_out)
    held_out_by = ("a mask",) * bool(held_rows.any()) if isinstance(hold_out, np.ndarray) else groups
    requested = selection.free_parameters(names, robot.free, options.free, options.freeze, options.also_free)
    named = selection.matching(names, "free", options.free) | selection.matching(names, "also_free", options.also_free)
    prior = Prior(options.prior or selection.default_prior(robot, options.solver))
    copied = copied_rows(chain, rig, table)
    leave_out = np.any([copied >= 0, *(selection.rows_named(text, table.source) for text in options.leave_out)], axis=0)
    unused = leave_out | held_rows
    if unused.all():
        raise ProblemError("nothing-left", what="observations")
    selection.check_rows(chain, table, ~unused)
    fitted = table.select(~unused)
    effects, causes = split_causes(chain, rig, table, options.apply)
    where_needed = prior is Prior.WHERE_NEEDED
    free, weak, chosen = choose_defaults(chain, rig, table, requested, named, where_needed, effects, ~unused)
    sigma = weak if where_needed else prior_named(chain, prior)
    if where_needed and not chosen.believed:
        prior = Prior.NONE
    fields_of_solver = {name: getattr(options, name) for name in ("solver", "loss", "max_iterations")}
    solver_options = SolverOptions(
        **fields_of_solver, progress=progress, effects=effects, leave_out=leave_out, reject=True
    )

    def geometry(outliers: Mask | None = None) -> Estimate:
        chosen_options = replace(solver_options, outliers=outliers)
        masks = {"free": free, "hold_out": held, "prefer": robot.free}
        return estimate_parameters(chain, rig, table, prior_sigma=sigma, options=chosen_options, **masks)

    examinations: dict[bytes, Examination | None] = {}  # by values and weights of a fit

    def examine_once(chain: Chain, estimate: Estimate, nearly: bool = False) -> Examination | None:
        if nearly:  # the rows of the last one: a few more or less hide no fault and show none
            return next(reversed(examinations.values()))
        fit = estimate.value.tobytes() + estimate.weight.tobytes()
        if fit not in examinations:
            examinations[fit] = examine(chain, rig, table, estimate, effects, bool(chosen.base))
        return examinations[fit]

    def checked(estimate: Estimate, nearly: bool = False) -> Estimate:
        estimate = with_faults(estimate, examine_once(chain, estimate, nearly))
        offsets = [effect.what for effect in effects if effect == Effect(effect.what)]
        with step("trying other interpretations of the inputs"):
            estimate = checked_inputs(estimate, chain, rig, table, requested, robot.free, _other_robots, offsets)
        if estimate.explanations and estimate.unusable:
            # To first order about a fit that wrong inputs distort, other rows and items would seem to be off.
            estimate = replace(estimate, faults=())
        return with_scale(chain, estimate)

    def with_laws(estimate: Estimate, nearly: LawChoice | None) -> WithLaws:
        estimate = checked(estimate, nearly is not None)
        faults, _ = split_causes(chain, rig, fitted, rivals_of_laws(chain, estimate))
        request = LawRequest(LawMode(options.joint_laws), sigma, effects, faults, robot.gravity)
        with step("fitting joint laws"):
            return with_joint_laws(chain, rig, table, estimate, request, nearly)

    estimate = geometry()
    chosen = with_frames(chosen, chain, rig, fitted, requested, estimate.value)
    if options.joint_laws == LawMode.NONE:
        estimate = checked(estimate)
    else:
        chain, estimate, *_ = laws_and_outliers(estimate, geometry, with_laws)
    if not estimate.unusable:
        examination = examine_once(chain, estimate)
        estimate = with_faults(estimate, examination)
        estimate = with_average(chain, rig, table, estimate, examination, causes, effects)
    estimate = with_scatter_at_tool(chain, rig, table.select(~estimate.left_out), estimate)
    estimate = with_drawing(robot, rig, table, with_gain(table, estimate))
    estimate = replace(estimate, folds=held_out_in_turn(robot, rig, table, folds, held_rows, options))
    if estimate.rank == 0 and estimate.free[: estimate.n_robot_parameters].any():
        raise ProblemError(
            "these observations say nothing about the robot: unknowns of the rig fit each of them exactly; measure more rows, or give the rig's chucks, spheres and sockets the sigma_mm that you know instead of unknown"
        )
    predicted = None
    if estimate.status == "converged" and not estimate.unusable:
        judging = table.select(~estimate.left_out)
        predicted = predicted_point_error(chain, rig, judging, estimate, any_base=bool(chosen.base))
        if predicted and not estimate.covariance_explains and not predicted.exceeds(estimate.unexplained):
            predicted = None
    result = result_of(
        estimate,
        table,
        RobotFrames.of(chain),
        predicted,
        inputs=observed.inputs,
        findings=entries(observed.findings),
        prior=prior,
        defaults=chosen,
        sessions=observed.counts,
        copies=copies_of(copied, table),
        made_with={"hold_out": groups, **vars(options)},
        held_out_by=(*held_out_by, *(f"all but {group}" for group in options.fit_only)),
        all_held_out=selection.all_held_out(table, held_rows),
        hold_out_proposal=selection.proposed_hold_out(table, copied >= 0),
    )
    calibration = calibration_of(result, robot, chain.name, "the identification")
    result = msgspec.structs.replace(result, findings=tuple(entries(calibration.findings)))
    robot_fields = {field.name: getattr(calibration, field.name) for field in fields(calibration)} | {"stored": result}
    return Identification(**robot_fields, rig=rig, table=table, estimate=estimate, predicted=predicted)


def write_page(
    path: Path,
    identification: Identification,
    command: str = "",
    recordings: Sequence[Recording] = (),
    certificate: Certificate | None = None,
) -> None:
    """Write the page, completely or not at all; ``recordings`` are the sessions read.

    Raises InputError if it cannot be written.
    """
    from truearm.report.calibration_page import render
    from truearm.report.figures import rows_by_kind
    from truearm.report.page import facts_of
    from truearm.workflows.scene import calibration_scene

    table, estimate = identification.table, identification.estimate
    rows = rows_by_kind(estimate, table, longitudes(identification.chain, identification.rig, table, estimate))
    facts = (*facts_of(recordings), *_facts(table))
    scene = None if estimate.unusable else calibration_scene(identification)
    page = render(identification.document, rows, _curves(identification), facts, command, certificate, scene)
    write_atomic(path, page)


def _curves(identification: Identification) -> tuple[SampledCurve, ...]:
    laws = identification.estimate.joint_laws.kept if identification.estimate.joint_laws else ()
    return sampled_curves(identification.chain, laws, identification.identified, identification.covariance)


def _facts(table: ObservationTable) -> tuple[tuple[str, str], ...]:
    """Return label and value of the facts about the rows of each kind."""
    rows_of_kinds = ((kind, table.select(table.kind == name)) for name, kind in kinds().items())
    return tuple(fact for kind, rows in rows_of_kinds if kind.facts and len(rows) for fact in kind.facts(rows))


def longitudes(chain: Chain, rig: Rigs, table: ObservationTable, estimate: Estimate) -> Floats:
    """Return the longitude (n,) [rad] of the rows of each kind that has one, with the identified robot; else NaN.

    For a sphere it is measured about its chuck.
    """
    out, params = np.full(len(table), np.nan), estimate.value[: estimate.n_robot_parameters]
    for name, kind in kinds().items():
        for rig_name, named_rig in rigs_by_name(rig).items():
            rows = np.flatnonzero((table.kind == name) & (table.rig == rig_name))
            if kind.longitude and rows.size:
                out[rows] = kind.longitude(chain, params, named_rig, table.select(rows))
    return out
