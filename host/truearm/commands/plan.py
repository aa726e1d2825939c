"""``truearm plan``: which poses to measure, in which order, and what they will tell, before anything is measured."""

from __future__ import annotations

import json
import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from truearm.errors import InputError

if TYPE_CHECKING:
    from truearm.model.robot import Robot
    from truearm.plan.forecast import Forecast, Known
    from truearm.plan.region import Region
    from truearm.plan.stops import Signals, Stop

app = typer.Typer(
    name="plan",
    help="Plan what to measure; say what it will tell before anything is measured.",
    rich_markup_mode=None,
    no_args_is_help=False,
)

DESIGN_RESERVE_MM = 22.0
RESULT_RESERVE_MM = 3.0


class Criterion(StrEnum):
    """Names of ``plan.choose.CRITERIA``."""

    D = "D"
    A = "A"
    E = "E"
    I = "I"  # noqa: E741


RobotOption = Annotated[str, typer.Option(metavar="ROBOT", help="Built-in robot, robot file (.toml) or URDF.")]
RigOption = Annotated[Path, typer.Option(metavar="FILE", help="Chucks, spheres, bars, targets (.toml).")]
CriterionOption = Annotated[
    Criterion,
    typer.Option(help="I: the error in the region. D: all parameters at once. A: their mean. E: the worst of them."),
]
RegionOption = Annotated[
    str | None,
    typer.Option(
        metavar="X0:X1,Y0:Y1,Z0:Z1", help="Where accuracy is wanted [mm, base frame]; default: around the poses."
    ),
]
ResultOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Plan with the model of an earlier result.json instead of the design."),
]
MeasuredOption = Annotated[
    list[Path] | None,
    typer.Option(metavar="FILE", help="Sessions and tables that count as measured already (repeatable)."),
]
BranchOption = Annotated[
    str | None,
    typer.Option(
        metavar="LOW:HIGH,…",
        help="Joint bounds of the configuration to stay in [deg]; known for irb120, puma560, ur5e.",
    ),
]
ProgramOption = Annotated[
    list[Path] | None,
    typer.Option(
        metavar="FILE", help="Write the program: .script (URScript), .mod (RAPID), .csv (all stops) (repeatable)."
    ),
]
InputOption = Annotated[
    int | None,
    typer.Option(min=0, metavar="N", help="Digital input on which the box answers; default: not waited for."),
]
OutputOption = Annotated[int, typer.Option(min=0, metavar="N", help="Digital output that says 'at rest' (UR).")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the forecast as JSON and nothing else.")]


@app.command("ballbar")
def ballbar(
    robot: RobotOption,
    rig: RigOption,
    poses: Annotated[int | None, typer.Option(min=1, metavar="N", help="Budget in poses.")] = None,
    minutes: Annotated[
        float | None, typer.Option(min=1.0, metavar="M", help="Budget in an operator's minutes.")
    ] = None,
    criterion: CriterionOption = Criterion.I,
    region: RegionOption = None,
    bar: Annotated[list[str] | None, typer.Option(metavar="NAME", help="Only this bar (repeatable).")] = None,
    candidates: Annotated[int, typer.Option(min=9, max=100_000, metavar="N", help="Poses to choose from.")] = 5000,
    result: ResultOption = None,
    measured: MeasuredOption = None,
    branch: BranchOption = None,
    reserve_mm: Annotated[
        float | None,
        typer.Option(
            min=0.0, metavar="MM", help="Travel kept for what the model does not know; default 22, 3 with --result."
        ),
    ] = None,
    spread_mm: Annotated[
        float, typer.Option(min=0.0, metavar="MM", help="Vary the bar's length about mid-travel, to tell its gain.")
    ] = 0.0,
    dwell_s: Annotated[float, typer.Option(min=0.5, metavar="S", help="Rest at a pose.")] = 2.0,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Of everything that is drawn by chance.")] = 0,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the plan that record follows (CSV).")] = None,
    program: ProgramOption = None,
    output_line: OutputOption = 0,
    input_line: InputOption = None,
    as_json: JsonOption = False,
) -> None:
    """Plan ball-bar poses on shells about the chucks.

    Prints rank, what stays unseen, the sigma of every parameter, the error to be expected in the region, and minutes.

    \b
    Example:
      truearm plan ballbar --robot puma560 --rig rig.toml --minutes 40 --out plan.csv --program plan.script
    """
    import numpy as np

    from truearm.files.plan import write_plan
    from truearm.plan.ballbar import Wanted, all_pairings, make_site, plan_ballbar
    from truearm.plan.branches import branch_of
    from truearm.plan.shapes import Sizes
    from truearm.plan.site import Limits
    from truearm.plan.stops import Signals
    from truearm.plan.way import Pace

    _check_outputs([robot, rig, *(measured or []), result], out, program or [])
    _check_finite(minutes=minutes, reserve_mm=reserve_mm, spread_mm=spread_mm, dwell_s=dwell_s)
    if (poses is None) == (minutes is None):
        raise InputError("give a budget: --poses N or --minutes M")
    known = _known(robot, rig, result, measured or [])
    reserve = reserve_mm if reserve_mm is not None else DESIGN_RESERVE_MM if result is None else RESULT_RESERVE_MM
    limits = Limits(reserve=1e-3 * reserve)
    _check_travel(known, limits.reserve, spread_mm)
    site = make_site(known, branch_of(known.chain, branch), limits, Sizes(), seed)
    wanted = Wanted(poses, minutes, criterion.value, 1, candidates, 1e-3 * spread_mm, seed)
    planned = plan_ballbar(
        site,
        known,
        all_pairings(known.rig, bar or ()),
        wanted,
        Pace(dwell=dwell_s),
        _region(region),
        (lambda _: None) if as_json else _say,
    )
    if out is not None:
        write_plan(out, planned.route.visits)
    _write_programs(planned.route.stops, dwell_s, program or [], Signals(output_line, input_line))
    document = _document(planned.forecast) | {
        "poses": len(planned.route.plan),
        "via_points": int(np.sum(planned.route.pose < 0)),
        "mounts": planned.route.n_mounts,
        "minutes": planned.route.minutes,
    }
    if as_json:
        typer.echo(json.dumps(document, indent=1))
    else:
        _show(document, out, program or [])


@app.command("line")
def line(
    robot: RobotOption,
    rig: RigOption,
    lines: Annotated[int, typer.Option(min=1, max=100, metavar="N", help="How many lines.")] = 6,
    points: Annotated[int, typer.Option(min=3, max=500, metavar="N", help="Stops along each.")] = 12,
    length_mm: Annotated[float, typer.Option(min=10.0, max=5000.0, metavar="MM", help="The device's reach.")] = 500.0,
    transverse_mm: Annotated[
        float, typer.Option(min=1.0, max=500.0, metavar="MM", help="Full range of the transverse sensors.")
    ] = 15.0,
    target: Annotated[
        str | None, typer.Option(metavar="NAME", help="The rig's target that is measured; default: its only one.")
    ] = None,
    criterion: CriterionOption = Criterion.I,
    region: RegionOption = None,
    candidates: Annotated[int, typer.Option(min=1, max=5000, metavar="N", help="Lines to choose from.")] = 120,
    result: ResultOption = None,
    measured: MeasuredOption = None,
    branch: BranchOption = None,
    dwell_s: Annotated[float, typer.Option(min=0.5, metavar="S", help="Rest at a point.")] = 2.0,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Of everything that is drawn by chance.")] = 0,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write where the lines lie and their points (CSV).")
    ] = None,
    program: ProgramOption = None,
    output_line: OutputOption = 0,
    input_line: InputOption = None,
    as_json: JsonOption = False,
) -> None:
    """Plan lines for a line device inside the workspace, preferring where the a-priori error is large.

    Prints where each line lies, what stays unseen, the sigma of every parameter, the error to be expected, and minutes.

    \b
    Example:
      truearm plan line --robot ur5e --rig rig.toml --lines 6 --out lines.csv --program lines.script
    """
    from truearm.files.disk import write_atomic
    from truearm.plan.ballbar import make_site
    from truearm.plan.branches import branch_of
    from truearm.plan.lines import LinesWanted, lines_csv, plan_lines
    from truearm.plan.shapes import Sizes
    from truearm.plan.site import Limits
    from truearm.plan.stops import Signals
    from truearm.plan.way import Pace

    _check_outputs([robot, rig, *(measured or []), result], out, program or [])
    _check_finite(length_mm=length_mm, transverse_mm=transverse_mm, dwell_s=dwell_s)
    known = _known(robot, rig, result, measured or [])
    site = make_site(known, branch_of(known.chain, branch), Limits(), Sizes(), seed)
    wanted = LinesWanted(
        lines, points, 1e-3 * length_mm, 1e-3 * transverse_mm, max(candidates, lines), criterion.value, seed
    )
    planned = plan_lines(site, known, wanted, Pace(dwell=dwell_s), _region(region), _target(known, target))
    if out is not None:
        write_atomic(out, lines_csv(planned))
    _write_programs(planned.stops, dwell_s, program or [], Signals(output_line, input_line))
    places = [
        {
            "line": device.name,
            "from_mm": (1e3 * p[0]).tolist(),
            "to_mm": (1e3 * p[-1]).tolist(),
            "rotation_rad": list(device.rotation),
            "a_priori_mm": 1e3 * error,
        }
        for device, p, error in zip(planned.devices.values(), planned.p_base, planned.error.tolist(), strict=True)
    ]
    document = _document(planned.forecast) | {"lines": places, "minutes": planned.minutes}
    if as_json:
        typer.echo(json.dumps(document, indent=1))
    else:
        _show(document, out, program or [])


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


def _region(text: str | None) -> Region | None:
    from truearm.plan.region import parse_region

    return None if text is None else parse_region(text)


def _check_outputs(read: list[Any], out: Path | None, programs: list[Path]) -> None:
    from truearm.files.disk import check_writable
    from truearm.plan.programs import check_suffix

    if out == Path("-"):
        raise InputError("-: is no file name; --json prints the forecast to standard output")
    for path in programs:
        check_suffix(path.suffix.lower())
    inputs = [Path(path) for path in read if path is not None and Path(path).exists()]
    outputs = [*([out] if out else []), *programs]
    for i, path in enumerate(outputs):
        check_writable(path, inputs=[*inputs, *outputs[:i]])


def _check_finite(**given: float | None) -> None:
    """typer's bounds let nan and inf pass."""
    for name, value in given.items():
        if value is not None and not math.isfinite(value):
            raise InputError(f"--{name.replace('_', '-')} must be a finite number, is {value}")


def _known(robot: str, rig: Path, result: Path | None, measured: list[Path]) -> Known:
    """Robot, rig, model and what was measured, from files."""
    from truearm.commands.inputs import observed
    from truearm.files.rig import read_rig
    from truearm.files.robot import joint_units, load_robot
    from truearm.plan.forecast import Known, with_rig_values
    from truearm.types import Rig

    loaded = load_robot(robot)
    params, values = _model(loaded, result)
    around = with_rig_values(read_rig(rig), values)
    table = None
    if measured:
        same, table = observed(measured, {"": rig}, joint_units(loaded.chain), False)
        if not isinstance(same, Rig):
            raise InputError("--measured: rows of several rigs cannot be planned on; give those of one rig")
    return Known(loaded.chain, around, params, loaded.free, table, values)


def _model(robot: Robot, result: Path | None) -> tuple[Any, dict[str, float]]:
    """Parameters (p,) to plan with, and what is known of the rig by name."""
    from truearm.files.result import read_result

    if result is None:
        return robot.chain.params_nominal, {}
    stored = read_result(result)
    found = dict(zip(stored.parameter_names, stored.value.tolist(), strict=True))
    missing = [name for name in robot.chain.parameter_names if name not in found]
    if missing or stored.robot.name != robot.chain.name:
        raise InputError(f"{result}: is of robot {stored.robot.name}, not of {robot.chain.name}")
    import numpy as np

    params = np.array([found[name] for name in robot.chain.parameter_names])
    return params, {name: value for name, value in found.items() if np.isfinite(value)}


def _check_travel(known: Known, reserve: float, spread_mm: float) -> None:
    for bar in known.rig.bars.values():
        left = 0.5 * abs(bar.gain) * bar.travel - reserve - 1e-3 * spread_mm
        if left < 2e-3:
            raise InputError(
                f"bar {bar.name}: of {500 * bar.travel:g} mm travel either way {1e3 * reserve:g} mm are reserve and "
                f"{spread_mm:g} mm spread; 2 mm must be left to the way, so lower --reserve-mm or --spread-mm"
            )


def _write_programs(stops: list[Stop], dwell: float, paths: list[Path], signals: Signals) -> None:
    from truearm.files.disk import write_atomic
    from truearm.plan.programs import program
    from truearm.plan.stops import Task

    for path in paths:
        write_atomic(path, program(stops, path.suffix.lower(), Task(path.stem, dwell, signals)))


def _document(told: Forecast) -> dict[str, Any]:
    """The forecast as it is printed and as JSON has it."""
    import numpy as np

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
        "cartesian_rms_mm": number(1e3 * told.cartesian_rms),
        "cartesian_worst_mm": None if told.cartesian is None else 1e3 * float(told.cartesian.max()),
        "cartesian_relative": told.relative,
    }


def _show(document: dict[str, Any], out: Path | None, programs: list[Path]) -> None:
    say = typer.echo
    for place in document.get("lines", ()):
        ends = " to ".join(", ".join(f"{v:.0f}" for v in place[end]) for end in ("from_mm", "to_mm"))
        turn = ", ".join(f"{v:.4f}" for v in place["rotation_rad"])
        say(f"{place['line']:<8} {ends} mm, rotation_rad = [{turn}]; error before about {place['a_priori_mm']:.1f} mm")
    if "lines" in document:
        say(f"{len(document['lines'])} lines: {document['minutes']:.0f} minutes")
    else:
        say(
            f"{document['poses']} poses, {document['via_points']} via points, {document['mounts']} mounts of the bar: "
            f"{document['minutes']:.0f} minutes"
        )
    say(f"rank {document['rank']}; what will be known after {document['rows']} observations:")
    for parameter in document["parameters"]:
        say(f"  {parameter['name']:<24}{_in_words(parameter)}")
    for key, what in (("null_space", "not seen"), ("hardly_seen", "hardly seen")):
        for direction in document[key]:
            terms = " ".join(f"{weight:+.2f}·{name}" for name, weight in direction.items())
            say(f"{what}: {terms}")
    if document["cartesian_rms_mm"] is None:
        say("error in the region: none can be given, something unseen moves the tool")
    else:
        relative = ", but for how the base stands" * document["cartesian_relative"]
        say(
            f"error in the region: {document['cartesian_rms_mm']:.3f} mm RMS, "
            f"{document['cartesian_worst_mm']:.3f} mm at its worst pose{relative}"
        )
    for path in [*([out] if out else []), *programs]:
        say(f"written: {path}")


def _in_words(parameter: dict[str, Any]) -> str:
    from truearm.commands.show import BORDER

    unit, factor, _ = BORDER[parameter["unit"]]
    sigma = parameter["sigma"]
    return "not seen" if sigma is None else f"± {factor * sigma:.2g} {unit}".rstrip()
