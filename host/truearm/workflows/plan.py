"""The work of ``truearm plan``: read what is known, plan, write plan file and programs, hand back the forecast."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import typer

from truearm.errors import InputError
from truearm.files.disk import check_writable, write_atomic
from truearm.files.plan_file import write_plan
from truearm.files.rig_file import read_rig, write_rig
from truearm.files.robot_file import RobotChoice, load_robot, robot_file
from truearm.model.robot import Robot
from truearm.plan.approaches import ApproachesWanted, plan_approaches
from truearm.plan.ball_bar_plan import Wanted, all_pairings, make_site, plan_ballbar
from truearm.plan.bar_paths import Pace
from truearm.plan.branches import branch_of
from truearm.plan.cartesian_lines import Shape
from truearm.plan.collision_shapes import Sizes
from truearm.plan.forecast import Forecast, Known, with_rig_values
from truearm.plan.line_plan import LinePlan, LinesWanted, plan_lines
from truearm.plan.measurement_limits import Limits, Pairing, Site
from truearm.plan.region import Region, parse_region
from truearm.plan.route_program import check_suffix, program
from truearm.plan.stops import Signals, Stop, Task
from truearm.types import Floats, Rig
from truearm.units import MM, MM_S
from truearm.workflows.calibration import read_calibration
from truearm.workflows.identify import PRIORS, default_free
from truearm.workflows.inputs import Sources, observed
from truearm.workflows.session_parts import with_parts

DESIGN_RESERVE_MM = 22.0
RESULT_RESERVE_MM = 3.0
# how what is written here begins, by its suffix; a rig begins with the first key of format_rig()
WRITTEN = {
    ".script": (b"def truearm_",),
    ".mod": (b"MODULE truearm_",),
    "": (b"pose,", b"seat_sigma_m = "),
}
LEFT = 2e-3  # m of travel that the ways between poses need at least


class Common(NamedTuple):
    """The command line's options that all plans have."""

    robot: str
    base: str | None  # of a URDF
    tip: str | None
    rig: Path
    minutes: float | None
    criterion: str
    region: str | None
    candidates: int
    result: Path | None
    measured: tuple[Path, ...]
    branch: str | None
    dwell_s: float
    seed: int
    out: Path | None
    programs: tuple[Path, ...]
    output_line: int
    input_line: int | None


class BallBars(NamedTuple):
    """Those of ``plan ballbar``."""

    poses: int | None
    bars: tuple[str, ...]
    reserve_mm: float | None
    spread_mm: float


class LineDevice(NamedTuple):
    """Those of ``plan line``."""

    lines: int | None
    length_mm: float
    transverse_mm: float
    speed_mm_s: float
    passes: int
    points: int
    target: str | None
    rig_out: Path | None


class Approaches(NamedTuple):
    """Those of ``plan characterize``."""

    bar: str | None
    chuck: str | None
    sphere: str | None
    poses: int
    rounds: int
    long_s: float
    reserve_mm: float | None


def plan_ballbar_files(common: Common, given: BallBars, quiet: bool) -> dict[str, Any]:
    """Plan, write what was asked for, and tell what will be known. Raises InputError in one line."""
    _check(common)
    _check_finite(reserve_mm=given.reserve_mm, spread_mm=given.spread_mm, dwell_s=common.dwell_s)
    if (given.poses is None) == (common.minutes is None):
        raise InputError("give a budget: --poses N or --minutes M")
    known = _known(common)
    limits = _limits(common, given.reserve_mm)
    _check_travel(known, limits.reserve, given.spread_mm)
    planned = plan_ballbar(
        _site(common, known, limits),
        known,
        all_pairings(known.rig, given.bars),
        Wanted(
            given.poses, common.minutes, common.criterion, 1, common.candidates, MM.to_si(given.spread_mm), common.seed
        ),
        Pace(dwell=common.dwell_s),
        _region(common),
        (lambda _: None) if quiet else _say,
    )
    route = planned.route
    if common.out is not None:
        write_plan(common.out, route.visits)
    _write_programs(common, route.stops)
    return {
        **_document(planned.forecast),
        "poses": len(route.plan),
        "via_points": int(np.sum(route.pose < 0)),
        "mounts": route.n_mounts,
        "minutes": route.minutes,
        "written": _written(common),
    }


def plan_line_files(common: Common, given: LineDevice) -> dict[str, Any]:
    """Plan, write what was asked for, and tell what will be known. Raises InputError in one line."""
    _check(common, given.rig_out)
    _check_finite(length_mm=given.length_mm, transverse_mm=given.transverse_mm, speed_mm_s=given.speed_mm_s)
    if (given.lines is None) == (common.minutes is None):
        raise InputError("give a budget: --lines N or --minutes M")
    known = _known(common)
    target = _target(known, given.target)
    shape = Shape(MM.to_si(given.length_mm), MM.to_si(given.transverse_mm), MM_S.to_si(given.speed_mm_s), given.points)
    wanted = LinesWanted(
        given.lines, common.minutes, shape, given.passes, common.candidates, common.criterion, common.seed
    )
    planned = plan_lines(_site(common, known, Limits()), known, wanted, Pace(), _region(common), target)
    if common.out is not None:
        write_plan(common.out, planned.visits)
    if given.rig_out is not None:
        write_rig(given.rig_out, planned.rig)
    tool = known.rig.targets[target].xyz if target else (0.0, 0.0, 0.0)
    _write_programs(common, planned.stops, tool)
    return {
        **_document(planned.forecast),
        "lines": _places(planned, known, np.array(tool)),
        "minutes": planned.minutes,
        "written": _written(common, given.rig_out),
    }


def plan_approaches_files(common: Common, given: Approaches, quiet: bool) -> dict[str, Any]:
    """Plan, write what was asked for, and tell what is planned. Raises InputError in one line."""
    _check(common)
    _check_finite(long_s=given.long_s, reserve_mm=given.reserve_mm, dwell_s=common.dwell_s)
    known = _known(common)
    limits = _limits(common, given.reserve_mm)
    pairing = Pairing(
        _named("bar", given.bar, known.rig.bars),
        _named("chuck", given.chuck, known.rig.chucks),
        _named("sphere", given.sphere, known.rig.spheres),
    )
    wanted = ApproachesWanted(given.poses, given.rounds, given.long_s, common.candidates, common.seed)
    say = (lambda _: None) if quiet else _say
    route = plan_approaches(_site(common, known, limits), pairing, wanted, Pace(dwell=common.dwell_s), say)
    if common.out is not None:
        write_plan(common.out, route.visits)
    _write_programs(common, route.stops)
    return {
        "bar": pairing.bar,
        "chuck": pairing.chuck,
        "sphere": pairing.sphere,
        "poses": given.poses,
        "via_points": int(np.sum(route.pose < 0)),
        "mounts": route.n_mounts,
        "minutes": route.minutes,
        "written": _written(common),
    }


def _named(what: str, given: str | None, have: Iterable[str]) -> str:
    """One of the rig's names, the first by default."""
    names = list(have)
    if (given is None and not names) or (given is not None and given not in names):
        raise InputError(f"--{what} {given or 'is missing'}: the rig has {', '.join(names) or 'none'}")
    return names[0] if given is None else given


def _limits(common: Common, reserve_mm: float | None) -> Limits:
    default = DESIGN_RESERVE_MM if common.result is None else RESULT_RESERVE_MM
    return Limits(reserve=MM.to_si(default if reserve_mm is None else reserve_mm))


def _places(planned: LinePlan, known: Known, point: Floats) -> list[dict[str, Any]]:
    """Where each line lies, from end to end in the base frame, and how the device is turned."""
    from truearm.model.chain import point_forward

    ends = MM.of(point_forward(known.chain, known.params, planned.lines.q[:, [0, -1]], point))
    return [
        {
            "line": device.name,
            "from_mm": end[0].tolist(),
            "to_mm": end[1].tolist(),
            "rotation_rad": list(device.rotation),
            "a_priori_mm": MM.of(error),
        }
        for device, end, error in zip(planned.devices.values(), ends, planned.error.tolist(), strict=True)
    ]


def _target(known: Known, name: str | None) -> str:
    """The target's name; "" for the end's origin where the rig has none."""
    have = list(known.rig.targets)
    if name is None and len(have) <= 1:
        return have[0] if have else ""
    if name not in have:
        raise InputError(f"--target {name or 'is missing'}: the rig has {', '.join(have) or 'none'}")
    return name


def _say(text: str) -> None:
    typer.echo(f"planning: {text}", err=True)


def _region(common: Common) -> Region | None:
    return None if common.region is None else parse_region(common.region)


def _site(common: Common, known: Known, limits: Limits) -> Site:
    return make_site(known, limits, Sizes(), common.seed)


def _written(common: Common, *more: Path | None) -> list[str]:
    return [str(path) for path in (common.out, *more, *common.programs) if path is not None]


def _check(common: Common, *more: Path | None) -> None:
    """Outputs over inputs or over each other, suffixes that are none, numbers that are none."""
    outputs = [path for path in (common.out, *more, *common.programs) if path is not None]
    marks = {path: WRITTEN.get(path.suffix.lower(), WRITTEN[""]) for path in outputs}
    if Path("-") in outputs:
        raise InputError("-: is no file name; --json prints the forecast to standard output")
    for path in common.programs:
        check_suffix(path.suffix.lower())
    read = [robot_file(common.robot), common.rig, common.result, *common.measured]
    inputs = [path for path in read if path is not None and path.exists()]
    for i, path in enumerate(outputs):
        check_writable(path, inputs=[*inputs, *outputs[:i]], ours=partial(_begins, marks[path]))
    _check_finite(minutes=common.minutes)


def _begins(marks: tuple[bytes, ...], head: bytes) -> bool:
    """Whether a file that exists is a plan, a program or a rig of an earlier run."""
    return not head.strip() or head.startswith(marks)


def _check_finite(**given: float | None) -> None:
    """typer's bounds let nan and inf pass."""
    for name, value in given.items():
        if value is not None and not math.isfinite(value):
            raise InputError(f"--{name.replace('_', '-')} must be a finite number, is {value}")


def _known(common: Common) -> Known:
    """Robot, rig, model and what was measured, from files."""
    loaded, params, values = _model(common)
    around = with_rig_values(read_rig(common.rig), values)
    table = None
    if common.measured:
        sources = Sources(tuple(with_parts(list(common.measured))), {"": common.rig})
        same, table = observed(sources, loaded.chain.joint_units)
        if not isinstance(same, Rig):
            raise InputError("--measured: rows of several rigs cannot be planned on; give those of one rig")
    known = replace(
        Known.design(loaded, around),
        params=params,
        measured=table,
        rig_values=values,
        branch=branch_of(loaded, common.branch),
    )
    prior = PRIORS["weak"](known.chain) if loaded.is_urdf else None  # as identify does
    return replace(known, free=default_free(loaded), prior_sigma=prior)


def _model(common: Common) -> tuple[Robot, Floats, dict[str, float]]:
    """The robot, parameters (p,) to plan with, and what is known of the rig by name."""
    if common.result is None:
        robot = load_robot(common.robot, common.base, common.tip)
        return robot, robot.chain.params_nominal, {}
    found = read_calibration(common.result, RobotChoice(common.robot, common.base, common.tip))
    values = dict(zip(found.stored.parameter_names, found.stored.value.tolist(), strict=True))
    known = {name: value for name, value in values.items() if np.isfinite(value)}
    return found.robot, found.identified, known


def _check_travel(known: Known, reserve: float, spread_mm: float) -> None:
    for bar in known.rig.bars.values():
        left = 0.5 * abs(bar.gain) * bar.travel - reserve - MM.to_si(spread_mm)
        if left < LEFT:
            raise InputError(
                f"bar {bar.name}: of {MM.text(0.5 * bar.travel)} travel either way {MM.text(reserve)} are reserve and "
                f"{spread_mm:g} mm spread; {MM.text(LEFT)} must be left to the way, so lower --reserve-mm or --spread-mm"
            )


def _write_programs(common: Common, stops: list[Stop], tool: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
    for path in common.programs:
        task = Task(path.stem, common.dwell_s, Signals(common.output_line, common.input_line), tool)
        write_atomic(path, program(stops, path.suffix.lower(), task))


def _document(told: Forecast) -> dict[str, Any]:
    """The forecast as it is printed and as JSON has it."""

    def number(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    return {
        "rows": told.n_rows,
        "rank": told.rank,
        "free": int(told.free.sum()),
        "null_space": [dict(zip(d.names, d.weights, strict=True)) for d in told.null_space],
        "hardly_seen": [dict(zip(d.names, d.weights, strict=True)) for d in told.hardly_seen],
        "parameters": [
            {"name": name, "unit": unit, "sigma": number(sigma)}
            for name, unit, sigma, free in zip(told.names, told.units, told.sigma, told.free, strict=True)
            if free
        ],
        "cartesian_rms_mm": number(MM.of(told.cartesian_rms)),
        "cartesian_worst_mm": None if told.cartesian is None else MM.of(float(told.cartesian.max())),
        "cartesian_relative": told.relative,
    }
