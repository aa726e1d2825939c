"""What several commands have: the descriptions of their arguments and options, and readers of their values.

``--help`` imports this module, so it imports nothing slow. An option has the same meaning in every command. Where it
reads or writes something of the command's own, the command describes it again. The value that ``{name}`` stands for is in ``TEXTS``.

Arguments
---------
session : SESSION
    Session file (.mcap) of truearm record.
inputs : INPUT...
    Sessions (.mcap) and tables (.csv), which are read as one table.
result : RESULT
    What truearm identify --out wrote (.json).

Options
-------
model : ROBOT
    Built-in robot ({robots}), robot file (.toml) or URDF (.urdf).
rig : FILE
    Rig: chucks, spheres, bars, sockets, devices (.toml).
plan : FILE
    Plan: what the robot visits (.csv).
box : DEVICE
    Port of the box: /dev/ttyACM0, COM3 or socket://127.0.0.1:7007. Default: the box that is plugged in.
address : URL
    Source of the robot's joint readings: {sources}.
tolerance_mm : MM
    Permitted error of the tool, for the certificate: pass or fail.
own_frames
    Use the robot's own base and flange frames: leave out the mounting of base and tool.
minutes : M
    Budget in minutes of the operator's time.
result : FILE
    Plan with the robot of an earlier result.json instead of the nominal one.
program_out : FILE
    Write the program: {dialects} (repeatable).
worn
    Simulate a worn arm: backlash, slow settling, oscillation, noisy readings.
duration_s : S
    End after S seconds. Ctrl-C ends earlier.
topic : NAME
    Topic of the joint states in a bag.
joints : LIST
    Names of a bag's joints, from the base on: a,b,c. Default: those of --model.
columns : OURS=THEIRS,…
    Names of a table's columns, {} for a joint's number: t_s=timestamp,q{}_rad=actual_q_{}. Other columns keep their titles, and are skipped if unknown.
json
    Print JSON and nothing else.

Expert options
--------------
number : TEXT
    Number of the certificate.
base : LINK
    First link of a URDF. Default: that of the result, or the root.
tip : LINK
    Last link of a URDF. Default: that of the result, or the only leaf.
branch : LOW:HIGH,…
    Bounds of every joint [deg], within which the arm keeps one configuration. Default: the robot file's [branch], which
    {branches} have.
payload : KG[,X,Y,Z]
    Payload [kg], and its centre in the end frame [mm]. Needs a result that was identified under different payloads.
allow_damaged
    Read the intact part of a file that is damaged or unfinished.
allow_unusable
    Use the result although its fit is not usable.
line_points : N
    Largest number of points of each pass along a line. Default: as many as the noise allows.
stop
    Stop the box first if it is streaming, for example after a recorder was killed.
plain
    Print lines instead of a live view. Always so if the output is not a terminal.
force
    Overwrite the output file if it is of the kind that this command writes.
seed : N
    Random seed.
criterion
    What to minimise. {criteria}.
reserve_mm : MM
    Travel reserved for errors of the model. Default: {reserves} with --result.
dwell_s : S
    Duration of the rest at each pose.
output_line : N
    Digital output that is on while the robot rests at a pose or drives a line (UR).
input_line : N
    Digital input of the controller on which another device acknowledges --output-line: the program waits up to 5 s for
    this input. The box does not acknowledge. Default: no waiting.
tolerance : MM,DEG
    Standard deviations of the true lengths and angles about the nominal ones. Default: 0.5,0.1146; for the PUMA 560,
    Goswami's Table II instead.
gear_error_mrad : MRAD
    Amplitude of the gear error at each period.
gear_periods_deg : DEG,…
    Periods of the gear error, in joint angle. Default: 180,90.
masses_kg : KG,…
    Masses of the links, one per joint: the joints sag under them. Default: no sag.
stiffness_nm_rad : NM/RAD
    Stiffness of each joint that sags.
repeatability_mm : MM
    Repeatability of the bars, which the rig declares too. Default: 0.084.
truth_out : FILE
    Write the hidden truth (.json).
truth_seed : N
    Random seed of the hidden truth. The same value with another --seed is the same arm on another day. Default: --seed.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain, cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from truearm import option_defaults
from truearm.bounds import Within
from truearm.errors import InputError
from truearm.model.builtin import builtin_names, names_with_branch
from truearm.plan.criteria import Criterion
from truearm.plan.route_program import languages_help
from truearm.record.robots.sources import sources_help
from truearm.units import DEG, KG, MM, Scale, from_shown

if TYPE_CHECKING:
    from truearm.model.chain import Chain
    from truearm.model.poses import Six
    from truearm.model.workspace import Branch
    from truearm.plan.region import Region
    from truearm.types import Payload
    from truearm.workflows.certificates import Issue
    from truearm.workflows.inputs import Sources

LARGEST_MM, LARGEST_DEG = 1e5, 720.0  # of a frame
LONGEST_NAME = 64  # letters of a rig's name, as of a table's identifiers
TEXTS = {
    "robots": ", ".join(builtin_names()),
    "branches": ", ".join(names_with_branch()),
    "sources": sources_help(),
    "dialects": languages_help(),
    "criteria": ". ".join(f"{criterion}: {criterion.summary}" for criterion in Criterion),
    "reserves": f"{MM.of(option_defaults.DESIGN_RESERVE):g}, {MM.of(option_defaults.RESULT_RESERVE):g}",
    "named_rigs": "NAME=FILE is for rows with NAME in their column rig and for the session NAME.mcap (repeatable)",
}


def issue_of(number: str, tolerance_mm: float | None) -> Issue:
    """Return whom a certificate is for, from two options and the project's file."""
    from truearm.workflows.certificates import Issue
    from truearm.workflows.project_file import Project
    from truearm.workflows.project_folder import project_of

    project, _ = project_of(Path.cwd()) or (Project(""), None)
    return Issue(project, number, None if tolerance_mm is None else MM.to_si(tolerance_mm))


def rigs_of(texts: Sequence[str]) -> dict[str, Path]:
    """Return the files of ``--rig`` by rig name, "" for one without a name, such as ./a=b.toml.

    Raises InputError if several rigs have the same name or none.
    """
    files: dict[str, Path] = {}
    for text in texts:
        name, equals, file = text.partition("=")
        named = bool(equals) and re.fullmatch(rf"[\w-]{{1,{LONGEST_NAME}}}", name, re.ASCII) is not None
        name, path = (name, Path(file)) if named else ("", Path(text))
        if name in files:
            problem = f"rig {name} is given twice" if name else "several rigs need names, --rig NAME=FILE"
            raise InputError(f"--rig {text}: {problem}")
        files[name] = path
    if "" in files and len(files) > 1:
        raise InputError(f"--rig {files['']}: several rigs need names; write --rig NAME=FILE")
    return files


def sources_of(inputs: Sequence[Path], rig: Sequence[str] = (), **options: Any) -> Sources:
    """Return what a command reads: sessions with their further parts, tables, and the rigs of ``--rig``; it warns on standard error."""
    from truearm.cli.output import warn
    from truearm.workflows.inputs import Sources
    from truearm.workflows.session_parts import with_parts

    return Sources(tuple(with_parts(inputs)), rigs_of(rig), say=warn, **options)


def command_line(context: click.Context) -> str:
    """Return what was typed, as reports quote it."""
    return shlex.join(["truearm", *(context.obj or [])])


def numbers_of(option: str, text: str, count: int | None = None) -> tuple[float, ...]:
    """Return the numbers of an option, separated by commas. Raises InputError."""
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if not values or (count is not None and (len(values) != count or not all(map(math.isfinite, values)))):
        raise InputError(
            "wrong-value", place=option, value=text[:60], form=f"{count or 'one or more'} numbers, separated by commas"
        )
    return values


def payload_of(text: str) -> Payload:
    """Return the payload of the option. Raises InputError."""
    from truearm.types import Payload

    mass, *centre = numbers_of("--payload", text)
    if len(centre) not in (0, 3):
        raise InputError(
            "wrong-value", place="--payload", value=text[:60], form="KG, or KG,X,Y,Z with the centre in mm"
        )
    x, y, z = map(MM.to_si, centre or (0.0, 0.0, 0.0))
    return Payload(mass, (x, y, z))


def spans_of(
    option: str, text: str, scale: Scale, count: int | None = None
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the lower and upper ends in SI of an option "LOW:HIGH,LOW:HIGH,…" in a unit, as many as ``count`` says if it
    does. Raises InputError.
    """
    try:
        spans = [(float(low), float(high)) for low, high in (span.split(":") for span in text.split(","))]
    except ValueError:
        spans = []
    rising = all(low < high and math.isfinite(high - low) for low, high in spans)
    if len(spans) != (count or len(spans) or 1) or not rising:
        times = f"{count} times " if count else ""
        form = f"{times}LOW:HIGH in {scale.suffix}, LOW below HIGH, separated by commas"
        raise InputError("wrong-value", place=option, value=text[:60], form=form)
    return tuple(scale.to_si(low) for low, _ in spans), tuple(scale.to_si(high) for _, high in spans)


def joints_of(option: str, shown: Sequence[float] | None, arm: Chain) -> tuple[float, ...] | None:
    """Return the joints [rad, m] of an option in deg and mm; those of mimic joints may be missing. Raises InputError."""
    from truearm.model.mimic import units_of

    if shown is None:
        return None
    units = units_of(len(shown), arm.joint_units, arm.mimics)
    if len(shown) != len(units) or not all(map(math.isfinite, shown)):
        text = ",".join(f"{value:g}" for value in shown)
        raise InputError(
            "wrong-value", place=option, value=text[:60], form=f"{len(units)} numbers, separated by commas"
        )
    return tuple(from_shown(value, unit) for value, unit in zip(shown, units, strict=True))


def frame_of(option: str, text: str) -> Six:
    """Return position [m] and rotation vector [rad] of an option in mm and deg. Raises InputError."""
    x, y, z, rx, ry, rz = numbers_of(option, text, 6)
    if max(map(abs, (x, y, z))) > LARGEST_MM or max(map(abs, (rx, ry, rz))) > LARGEST_DEG:
        raise InputError("wrong-value", place=option, value=text, form="x, y, z in mm and a rotation vector in deg")
    return MM.to_si(x), MM.to_si(y), MM.to_si(z), DEG.to_si(rx), DEG.to_si(ry), DEG.to_si(rz)


def branch_given(text: str) -> Branch:
    """Return the joint bounds [rad] of the option in deg. Raises InputError."""
    import numpy as np

    from truearm.model.workspace import Branch

    lower, upper = spans_of("--branch", text, DEG)
    return Branch(np.array(lower), np.array(upper))


def region_of(text: str) -> Region:
    """Return the box [m] of the option in mm. Raises InputError."""
    import numpy as np

    from truearm.plan.region import Region

    lower, upper = spans_of("--region", text, MM, 3)
    return Region(np.array(lower), np.array(upper))


def span_of(text: str) -> tuple[float, ...]:
    """Return u0, u1, v0, v1 [m] of the option in mm. Raises InputError."""
    return tuple(chain.from_iterable(zip(*spans_of("--within", text, MM, 2), strict=True)))


def size_of(text: str) -> tuple[float, float]:
    """Return the width and height [m] of the option in mm. Raises InputError."""
    match = re.fullmatch(r"([0-9]{1,6}(?:\.[0-9]{1,6})?)x([0-9]{1,6}(?:\.[0-9]{1,6})?)", text)
    if match is None or min(float(match[1]), float(match[2])) <= 0.0:
        raise InputError("wrong-value", place="--task", value=text[:40], form="width and height in mm, such as 300x200")
    return MM.to_si(float(match[1])), MM.to_si(float(match[2]))


def joint_pair(text: str) -> tuple[int, int]:
    """Return the numbers of the two joints of the option. Raises InputError."""
    match = re.fullmatch(r"([1-9][0-9]?),([1-9][0-9]?)", text)
    if match is None:
        raise InputError("wrong-value", place="--vary", value=text[:40], form="two joints, such as 2,3")
    return int(match[1]), int(match[2])


def renames_of(text: str) -> tuple[tuple[str, str], ...]:
    """Return the titles of columns with those of a file. Raises InputError."""
    from truearm.record.robots.joint_table import parse_renames

    return parse_renames(text)


def scaled_numbers(option: str, rule: Within, scales: Sequence[Scale], text: str) -> tuple[float, ...]:
    """Return the numbers in SI of an option, one in each of several units, or any number in one. Raises InputError."""
    values = numbers_of(option, text, len(scales) if len(scales) > 1 else None)
    rule.check(option.removeprefix("--").replace("-", "_"), values)
    return tuple(scale.to_si(value) for scale, value in zip(cycle(scales), values, strict=False))


def named_frames(option: str, texts: Sequence[str]) -> dict[str, Six]:
    """Return frames of an option in mm and deg by name, "" for one without a name. Raises InputError."""
    frames: dict[str, Six] = {}
    for text in texts:
        name, equals, pose = text.rpartition("=")
        if equals and not name.isidentifier():
            raise InputError(
                f"{option} {text[:60]}: {name[:40]!r} is not a name of a tool or work object; use letters, digits and _"
            )
        if name.lower() in frames:
            raise InputError("given-twice", place=f"{option} {text[:60]}", what="it")
        frames[name.lower()] = frame_of(option, pose)
    return frames


READERS: dict[str, Callable[[Any], Any]] = {  # of arguments that are no texts, from those of the command line
    "at": partial(numbers_of, "--at"),
    "columns": renames_of,
    "home": partial(numbers_of, "--home"),
    "joints": joint_pair,
    "region": region_of,
    "task": size_of,
    "within": span_of,
    "flange": partial(frame_of, "--flange"),
    "tools": partial(named_frames, "--tool"),
    "works": partial(named_frames, "--work"),
    "branch": branch_given,
    "payload": payload_of,
    "tolerance": partial(scaled_numbers, "--tolerance", Within(0.0), (MM, DEG)),
    "masses": partial(scaled_numbers, "--masses-kg", Within(0.0, 1e4), (KG,)),
    "gear_periods": partial(scaled_numbers, "--gear-periods-deg", Within(0.1, 3600.0), (DEG,)),
}
REPEATED = ("tools", "works")  # fields that are read from several texts
