"""Plan measurements: read what is known, plan, write plan file and programs, return the forecast (``truearm plan``)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from truearm import option_defaults
from truearm.arguments import Checked
from truearm.disk import check_outputs, write_atomic
from truearm.errors import Argument, InputError
from truearm.findings import Finding, entries, ordered, stated
from truearm.kinds.rig_file import read_rig, write_rig
from truearm.kinds.table import ObservationTable
from truearm.model.chain import point_forward
from truearm.model.robot import Robot
from truearm.plan.approaches import plan_approaches
from truearm.plan.ball_bar_plan import MOVE, BallBarPlan, all_pairings, make_site, plan_ballbar
from truearm.plan.bar_paths import Pace
from truearm.plan.branches import branch_of
from truearm.plan.forecast import Forecast, Knowledge, bar_table, curve_forecasts, forecast, with_rig_values
from truearm.plan.line_plan import LinePlan, plan_lines
from truearm.plan.measurement_limits import Limits, Pairing, Region, Sizes
from truearm.plan.options import ApproachOptions, Budget, LineOptions, PoseOptions
from truearm.plan.plan_file import write_plan
from truearm.plan.route import Signals, Stop, Task, Visits
from truearm.plan.route_program import check_language, program
from truearm.progress import step
from truearm.report.result_findings import held_frames
from truearm.text import number_or_null
from truearm.types import BAR_MOUNTED, Floats, Plan, Rig
from truearm.units import MM
from truearm.workflows.calibration import Calibration, read_calibration
from truearm.workflows.requests import PlanFiles
from truearm.workflows.selection import all_held_out, default_prior, held_out_rows, proposed_hold_out

LEAST_CHECKS = 3  # fewer reveal little about a drift, and a short plan has no pose to spare
POSES_A_CHECK = 36  # check poses are visited three times more: at most a twelfth of the poses
LEFT = 2e-3  # m of travel that the motions between poses need at least


@dataclass(frozen=True)
class BallBarOptions(PoseOptions, Checked):
    """How ball-bar poses are chosen.

    Parameters
    ----------
    criterion : str
        What the poses minimise: "I", the error in the region; "D", the volume of the uncertainty of all parameters;
        "A", their mean uncertainty; "E", the uncertainty of the worst combination of parameters.
    region : Region, optional
        Where accuracy is required. Default: around the planned places of the spheres.
    candidates : int
        Poses to choose from, 9 to 100000.
    bars : tuple of str
        Use only these bars of the rig. Default: all.
    reserve : float, optional
        Travel of the bar [m] that is reserved for errors of the model. Default: 22 mm with the nominal robot, 3 mm with
        a result.
    spread : float
        The bar's length varies by up to this [m] to either side of mid-travel, which determines its gain.
    dwell : float
        Duration of the rest at each pose [s], 1.5 to 600.
    seed : int
        Random seed; 0 or more.
    visits : int
        How often each pairing is mounted, 1 to 10, each time for a share of its poses, to reveal drifts and slips.
    check_poses : int
        Poses that are visited again, 0 to 100: of the first mount in the middle and at the end, of another mount at the
        end. None with several visits; at most one in 36 poses, and none for fewer than 108 poses.
    joint_laws : bool
        Also predict how well the poses will determine the joints' error curves.

    Raises
    ------
    TypeError, InputError
        If a field is invalid.

    Examples
    --------
    >>> import truearm
    >>> truearm.BallBarOptions(criterion="D").candidates
    5000
    """

    region: Region | None = None


@step("planning")
def plan_ball_bar_files(files: PlanFiles, budget: Budget, options: BallBarOptions) -> dict[str, Any]:
    """Plan, write the requested files, and return the forecast. Raises InputError with a one-line message."""
    knowledge = _read_knowledge(files)
    planned = planned_ball_bar(knowledge, budget, options, files.result is not None)
    route = planned.route
    _write(files, knowledge, route.visits, route.stops, options.dwell)
    document = {
        **forecast_document(planned.forecast),
        "poses": len(route.plan),
        "via_points": route.n_via,
        "mounts": route.n_mounts,
        "visits": options.visits,
        "check_poses": _visits(budget, options).check_poses,
        "minutes": route.minutes,
        **_pairings(knowledge, route.plan),
        **({"curves": curve_forecasts(knowledge, bar_table(knowledge, route.plan))} if options.joint_laws else {}),
        "written": [str(path) for path in files.outputs],
    }
    return {**document, "findings": entries(forecast_findings(document, options.check_poses))}


def _pairings(knowledge: Knowledge, plan: Plan) -> dict[str, Any]:
    """Return the number of poses of each pairing, and what would be left to fit if some were held out."""
    of_pairing = Counter(zip(*(getattr(plan, name).tolist() for name in BAR_MOUNTED), strict=True))
    table, bars = bar_table(knowledge, plan), list(dict.fromkeys(plan.bar.tolist()))
    proposals = [(f"bar={bar}", 0) for bar in bars] if len(bars) > 1 else []
    if proposed := proposed_hold_out(table):
        proposals.insert(0, (str(proposed["fraction"]), proposed["seed"]))
    pairings = [{**dict(zip(BAR_MOUNTED, names, strict=True)), "poses": poses} for names, poses in of_pairing.items()]
    hold_outs = [_hold_out(knowledge, table, words, seed) for words, seed in proposals]
    return {"pairings": pairings, "hold_outs": hold_outs}


def _hold_out(knowledge: Knowledge, table: ObservationTable, words: str, seed: int) -> dict[str, Any]:
    """Return what holding some planned poses out would leave to the fit."""
    held = held_out_rows(table, [words], seed)
    assert held is not None
    return {
        "hold_out": words,
        "seed": seed,
        "poses": int(held.sum()),
        "rank": forecast(knowledge, table.select(~held)).rank,
        "all_held_out": all_held_out(table, held),
    }


def _visits(budget: Budget, options: BallBarOptions) -> Visits:
    """Return the number of visits to each mount; two or more visits need no check poses."""
    poses = budget.n if budget.n is not None else int(60.0 * (budget.minutes or 0.0) / (options.dwell + MOVE))
    checks = min(options.check_poses, poses // POSES_A_CHECK) if options.visits == 1 else 0
    return Visits(options.visits, checks if checks >= LEAST_CHECKS else 0)


def planned_ball_bar(knowledge: Knowledge, budget: Budget, options: BallBarOptions, is_identified: bool) -> BallBarPlan:
    """Return the best poses for a budget, in order, and the forecast. ``is_identified``: the robot is that of a result.

    Raises InputError for a bar with too little travel for the reserve, and PlanError as ``plan_ballbar`` does.
    """
    limits = _limits(options.reserve, is_identified)
    _check_travel(knowledge, limits.reserve, options.spread)
    site = make_site(knowledge, limits, Sizes(), options.seed)
    pairings = all_pairings(knowledge.rig, options.bars)
    if knowledge.measured is not None and knowledge.deciding:  # all poses on the mounts that decide
        items = {pairing: {f"chuck {pairing.chuck}", f"sphere {pairing.sphere}"} for pairing in pairings}
        pairings = [pairing for pairing in pairings if knowledge.deciding >= items[pairing]] or pairings
    return plan_ballbar(site, knowledge, pairings, budget, options, _visits(budget, options), options.region)


@step("planning")
def plan_line_files(files: PlanFiles, options: LineOptions, region: Region | None = None) -> dict[str, Any]:
    """Plan, write the requested files, and return the forecast. Raises InputError with a one-line message."""
    knowledge = _read_knowledge(files)
    target = _target(knowledge, options.target)
    planned = plan_lines(
        make_site(knowledge, Limits(), Sizes(), options.seed), knowledge, options, Pace(), region, target
    )
    if files.rig_out is not None:
        write_rig(files.rig_out, planned.rig)
    tool = knowledge.rig.targets[target].xyz if target else (0.0, 0.0, 0.0)
    _write(files, knowledge, planned.visits, planned.stops, 0.0, tool)
    document = {
        **forecast_document(planned.forecast),
        "lines": _places(planned, knowledge, np.array(tool)),
        "minutes": planned.minutes,
        "written": [str(path) for path in files.outputs],
    }
    return {**document, "findings": entries(forecast_findings(document))}


@step("planning")
def plan_approaches_files(files: PlanFiles, options: ApproachOptions) -> dict[str, Any]:
    """Plan, write the requested files, and return what is planned. Raises InputError with a one-line message."""
    knowledge = _read_knowledge(files)
    limits = _limits(options.reserve, files.result is not None)
    pairing = Pairing(
        *(_named(noun, getattr(options, noun), list(knowledge.rig.mounted()[noun])) for noun in BAR_MOUNTED)
    )
    site = make_site(knowledge, limits, Sizes(), options.seed)
    route = plan_approaches(site, pairing, options, Pace(dwell=options.dwell))
    _write(files, knowledge, route.visits, route.stops, options.dwell)
    document = {
        **vars(pairing),
        "poses": options.poses,
        "via_points": route.n_via,
        "mounts": route.n_mounts,
        "minutes": route.minutes,
        "written": [str(path) for path in files.outputs],
    }
    return {
        **document,
        "findings": entries([stated("planned-approaches", document, minutes=round(document["minutes"]))]),
    }


def knowledge_of(robot: Robot, rig: Rig, result: Calibration | None = None) -> Knowledge:
    """Return what is known before a plan: the design, or a result's robot, its estimate of the rig, open questions."""
    params, values, deciding = robot.chain.params_nominal, {}, frozenset[str]()
    if result is not None:
        estimates = {parameter.name: parameter.value for parameter in result.stored.parameters}
        params, values = result.identified, {name: value for name, value in estimates.items() if value is not None}
        deciding = frozenset(name for fault in result.stored.faults for name in cast("list[str]", fault["deciding"]))
    prior = default_prior(robot, option_defaults.SOLVER)
    knowledge = Knowledge.design(robot, with_rig_values(rig, values))
    return replace(knowledge, params=params, rig_values=values, free=robot.free, prior=prior, deciding=deciding)


def _named(noun: str, name: str | None, names: Sequence[str]) -> str:
    """Return one of the rig's names, by default the first. Raises InputError."""
    if not names:
        raise InputError(f"the rig has no {noun}; add a [[{noun}]] to it")
    if name is not None and name not in names:
        raise InputError("not-in-rig", place=Argument(noun), what=noun, name=name, names=names)
    return name or names[0]


def _limits(reserve: float | None, is_identified: bool) -> Limits:
    """Return the limits of the bar with this reserve, by default that of a nominal or of an identified robot."""
    if reserve is None and is_identified:
        reserve = option_defaults.RESULT_RESERVE
    return Limits() if reserve is None else Limits(reserve=reserve)


def _places(planned: LinePlan, knowledge: Knowledge, point: Floats) -> list[dict[str, Any]]:
    """Return the position of each line, from end to end in the base frame, and the rotation of the device."""
    ends = MM.of(point_forward(knowledge.chain, knowledge.params, planned.lines.q[:, [0, -1]], point))
    rows = zip(planned.devices.values(), ends.tolist(), planned.error.tolist(), strict=True)
    return [
        {
            "line": device.name,
            "from_mm": start,
            "to_mm": end,
            "rotation_rad": list(device.rotation),
            "a_priori_mm": MM.of(error),
        }
        for device, (start, end), error in rows
    ]


def _target(knowledge: Knowledge, name: str | None) -> str:
    """Return the target's name; "" for the end's origin if the rig has no target."""
    names = list(knowledge.rig.targets)
    if name is None and len(names) > 1:
        raise InputError(f"the rig has several targets; choose one of {', '.join(names)} with ", Argument("target"))
    return "" if name is None and not names else _named("target", name, names)


def _read_knowledge(files: PlanFiles) -> Knowledge:
    """Return robot, rig, model and earlier measurements, from files.

    Raises InputError if an output would replace an input or another output, and PlanError if no program can be for the
    robot.
    """
    inputs = [*files.robot.files, files.rig, files.result, *files.measured]
    outputs = [("plan", files.out), ("rig", files.rig_out), *(("program", path) for path in files.program_out)]
    check_outputs(outputs, files.force, filter(None, inputs))
    result = None if files.result is None else read_calibration(files.result, files.robot)
    robot = files.robot.load() if result is None else result.robot
    for path in files.program_out:
        check_language(path.suffix.lower(), len(robot.chain.joints))
    knowledge = replace(knowledge_of(robot, read_rig(files.rig), result), branch=branch_of(robot, files.branch))
    if not files.measured:
        return knowledge
    from truearm.workflows.inputs import Sources, read_sources  # slow to import, as it also reads sessions
    from truearm.workflows.recorded_session import with_parts

    rig, table, *_ = read_sources(Sources(tuple(with_parts(list(files.measured))), {"": files.rig}), robot.chain)
    if not isinstance(rig, Rig):
        raise InputError(
            Argument("measured"), ": rows of several rigs cannot be used for a plan; give the rows of one rig"
        )
    return replace(knowledge, measured=table)


def _check_travel(knowledge: Knowledge, reserve: float, spread: float) -> None:
    for bar in knowledge.rig.bars.values():
        remaining = 0.5 * abs(bar.gain) * bar.travel - reserve - spread
        if remaining < LEFT:
            raise InputError(
                f"bar {bar.name}: its travel of ±{MM.text(0.5 * bar.travel)}, less a reserve of {MM.text(reserve)} and a spread of "
                f"{MM.text(spread)}, leaves less than {MM.text(LEFT)}; lower ",
                *(Argument("reserve"), " or ", Argument("spread")),
            )


def _write(
    files: PlanFiles,
    knowledge: Knowledge,
    visits: Plan,
    stops: list[Stop],
    dwell: float,
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> None:
    """Write the plan and the programs that were requested."""
    if files.out is not None:
        write_plan(files.out, visits.of_robot(knowledge.chain.name))
    signals = Signals(files.output_line, files.input_line)
    for path in files.program_out:
        write_atomic(path, program(stops, path.suffix.lower(), Task(path.stem, dwell, signals, tool)))


def forecast_document(forecast: Forecast) -> dict[str, Any]:
    """Return the forecast as it is printed and as in JSON."""
    columns = forecast.names, forecast.units, forecast.sigma, forecast.free
    return {
        "rows": forecast.n_rows,
        "rank": forecast.rank,
        "free": int(forecast.free.sum()),
        "defaults": {name: list(getattr(forecast.defaults, name)) for name in ("base", "tool", "lost", "believed")},
        "null_space": [dict(zip(d.names, d.weights, strict=True)) for d in forecast.null_space],
        "hardly_seen": [dict(zip(d.names, d.weights, strict=True)) for d in forecast.hardly_seen],
        "parameters": [
            {"name": name, "unit": unit, "sigma": number_or_null(sigma)}
            for name, unit, sigma, is_free in zip(*columns, strict=True)
            if is_free
        ],
        "cartesian_rms_mm": number_or_null(MM.of(forecast.cartesian_rms)),
        "cartesian_worst_mm": None if forecast.cartesian is None else MM.of(float(forecast.cartesian.max())),
        "cartesian_relative": forecast.relative,
    }


def forecast_findings(document: Mapping[str, Any], n_checks: int = 0) -> list[Finding]:
    """Return the verdict, then what limits the plan. ``n_checks``: of the check poses that were asked for."""
    return ordered([_planned(document), *_limits_of_plan(document, n_checks)])


def _planned(document: Mapping[str, Any]) -> Finding:
    rms, largest = document["cartesian_rms_mm"], document["cartesian_worst_mm"]
    return stated(
        "planned",
        document,
        visits=document["visits"] if document.get("visits", 1) > 1 else None,
        checks=document.get("check_poses"),
        lines=len(document.get("lines", ())),
        minutes=round(document["minutes"]),
        rms=None if rms is None else {"mm": rms},
        largest=None if rms is None else {"mm": largest},
        relative=rms is not None and document["cartesian_relative"],
    )


def _limits_of_plan(document: Mapping[str, Any], n_checks: int) -> Iterator[Finding]:
    unseen, weak, defaults = document["null_space"], document["hardly_seen"], document["defaults"]
    yield stated("planned-rank", document, unseen=len(unseen), weak=len(weak))
    if "poses" in document and document["poses"] < document["rank"] + len(unseen):
        yield Finding("few-poses", {"n": document["poses"]})
    yield from held_frames(defaults)
    if defaults["lost"] or defaults["believed"]:
        yield stated("planned-held", defaults)
    checks = document.get("check_poses", 0)
    if n_checks not in (option_defaults.CHECK_POSES, checks):
        yield Finding("fewer-checks", {"asked": n_checks, "planned": checks, "visits": document["visits"] > 1})
