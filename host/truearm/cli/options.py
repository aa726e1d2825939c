"""What several commands have: the descriptions of their arguments and options, and readers of their values.

``--help`` imports this module, so it imports nothing slow. An option has the same meaning in every command. Where it
reads or writes something of the command's own, the command describes it again. The value that ``{name}`` stands for is
in ``TEXTS``.

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
    Names of a table's columns, {} for a joint's number: t_s=timestamp,q{}_rad=actual_q_{}. Other columns keep their
    titles, and are skipped if unknown.
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
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from truearm import option_defaults
from truearm.errors import InputError
from truearm.model.robot_file import builtin_names, names_with_branch
from truearm.plan.options import Criterion, languages_help
from truearm.record.robots.sources import sources_help
from truearm.units import DEG, KG, MM, Scale, from_shown

if TYPE_CHECKING:
    from truearm.model.chain import Chain
    from truearm.model.robot import Branch
    from truearm.model.transforms import Six
    from truearm.plan.measurement_limits import Region
    from truearm.types import Payload
    from truearm.workflows.inputs import Sources
    from truearm.workflows.report import Issue

LARGEST_MM, LARGEST_DEG = 1e5, 720.0  # of a frame
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
    from truearm.workflows.project_file import Project, project_of
    from truearm.workflows.report import Issue

    project, _ = project_of(Path.cwd()) or (Project(""), None)
    return Issue(project, number, None if tolerance_mm is None else MM.to_si(tolerance_mm))


def rigs_of(texts: Sequence[str]) -> dict[str, Path]:
    """Return the files of ``--rig`` by rig name, "" for one without a name, such as ./a=b.toml.

    Raises InputError if several rigs have the same name or none.
    """
    files: dict[str, Path] = {}
    for text in texts:
        match = re.fullmatch(r"(?:([\w-]{1,64})=)?(.*)", text, re.ASCII | re.DOTALL)  # a name as in a table
        name, file = ("", text) if match is None else (match[1] or "", match[2])
        if name and name in files:
            raise InputError("given-twice", place=f"--rig {text}", what=f"rig {name}")
        if files and "" in (name, *files):
            raise InputError(f"--rig {text}: several rigs need names, --rig NAME=FILE")
        files[name] = Path(file)
    return files


def sources_of(inputs: Sequence[Path], rig: Sequence[str] = (), **options: Any) -> Sources:
    """Return what a command reads: sessions with their further parts, tables, and the rigs of ``--rig``."""
    from truearm.workflows.inputs import Sources
    from truearm.workflows.recorded_session import with_parts

    return Sources(tuple(with_parts(inputs)), rigs_of(rig), **options)


def command_line(context: click.Context) -> str:
    """Return what was typed, as reports quote it."""
    return shlex.join(["truearm", *(context.obj or [])])


def joints_of(shown: tuple[float, ...] | None, arm: Chain) -> tuple[float, ...] | None:
    """Return the joints [rad, m] of an option in deg and mm; those of mimic joints may be missing.

    Another number is kept.
    """
    from truearm.model.chain_structure import units_of

    units = units_of(len(shown or ()), arm.joint_units, arm.mimics)
    if shown is None or len(shown) != len(units):
        return shown
    return tuple(from_shown(value, unit) for value, unit in zip(shown, units, strict=True))


# Parsers of an option's text: they raise ValueError for a text in another form.


def numbers_of(text: str) -> tuple[float, ...]:
    """Return finite numbers that commas separate."""
    values = tuple(map(float, text.split(",")))
    if not all(map(math.isfinite, values)) or "_" in text or not text.isascii():
        raise ValueError(text)
    return values


def payload_of(text: str) -> Payload:
    """Return a payload from KG,X,Y,Z, or KG alone, with the centre in mm."""
    from truearm.types import Payload

    mass, x, y, z = numbers_of(text if "," in text else f"{text},0,0,0")
    return Payload(mass, (MM.to_si(x), MM.to_si(y), MM.to_si(z)))


def spans_of(scale: Scale, text: str, count: int | None = None) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the lower and upper ends in SI of LOW:HIGH,LOW:HIGH,… in a unit."""
    spans = [numbers_of(span.replace(":", ",")) for span in text.split(",")]
    if len(spans) != (count or len(spans)) or not all(low < high for low, high in spans):
        raise ValueError(text)
    lower, upper = zip(*spans, strict=True)
    return tuple(map(scale.to_si, lower)), tuple(map(scale.to_si, upper))


def frame_of(text: str) -> Six:
    """Return position [m] and rotation vector [rad] from a text in mm and deg."""
    x, y, z, rx, ry, rz = numbers_of(text)
    if max(map(abs, (x, y, z))) > LARGEST_MM or max(map(abs, (rx, ry, rz))) > LARGEST_DEG:
        raise ValueError(text)
    return MM.to_si(x), MM.to_si(y), MM.to_si(z), DEG.to_si(rx), DEG.to_si(ry), DEG.to_si(rz)


def branch_of(text: str) -> Branch:
    """Return joint bounds [rad] from a text in deg."""
    import numpy as np

    from truearm.model.robot import Branch

    lower, upper = spans_of(DEG, text)
    return Branch(np.array(lower), np.array(upper))


def region_of(text: str) -> Region:
    """Return a box [m] from a text in mm."""
    import numpy as np

    from truearm.plan.measurement_limits import Region

    lower, upper = spans_of(MM, text, 3)
    return Region(np.array(lower), np.array(upper))


def span_of(text: str) -> tuple[float, ...]:
    """Return u0, u1, v0, v1 [m] from a text in mm."""
    (u0, v0), (u1, v1) = spans_of(MM, text, 2)
    return u0, u1, v0, v1


def size_of(text: str) -> tuple[float, float]:
    """Return a width and a height [m] from a text in mm."""
    width, height = (numbers_of(side)[0] for side in text.split("x"))
    if "," in text or not 0.0 < min(width, height) <= max(width, height) <= LARGEST_MM:
        raise ValueError(text)
    return MM.to_si(width), MM.to_si(height)


def joint_pair(text: str) -> tuple[int, int]:
    """Return the numbers of two joints."""
    first, second = numbers_of(text)
    if not (first.is_integer() and second.is_integer()):
        raise ValueError(text)
    return int(first), int(second)


def renames_of(text: str) -> tuple[tuple[str, str], ...]:
    """Return the titles of columns with those of a file."""
    from truearm.record.robots.text_lines import parse_renames

    return parse_renames(text)


def scaled_numbers(scales: tuple[Scale, ...], lowest: float, highest: float, text: str) -> tuple[float, ...]:
    """Return numbers in SI within bounds, one in each of several units, or any number in one."""
    values = numbers_of(text)
    if not all(lowest <= value <= highest for value in values):
        raise ValueError(text)
    units = scales * len(values) if len(scales) == 1 else scales
    return tuple(scale.to_si(value) for scale, value in zip(units, values, strict=True))


class Reader(NamedTuple):
    """How an option is read: the ``form`` of its text, and what makes a value of it.

    ``named``: NAME=TEXT, several times.
    """

    form: str
    parse: Callable[[str], Any]
    named: bool = False

    def read(self, option: str, typed: Any) -> Any:
        """Return the value of a text, or those of NAME=TEXT by name, "" for one without a name. Raises InputError."""
        if not self.named:
            return self._value(option, typed)
        values: dict[str, Any] = {}
        for text in typed:
            name, equals, value = text.rpartition("=")
            if equals and not name.isidentifier():
                reason = f"{name[:40]!r} is not a name of a tool or work object; use letters, digits and _"
                raise InputError(f"{option} {text[:60]}: {reason}")
            if name.lower() in values:
                raise InputError("given-twice", place=f"{option} {text[:60]}", what="it")
            values[name.lower()] = self._value(option, value)
        return values

    def _value(self, option: str, text: str) -> Any:
        try:
            return self.parse(text)
        except InputError:
            raise
        except (ValueError, OverflowError):
            raise InputError("wrong-value", place=option, value=text[:60], form=self.form) from None


NUMBERS = "finite numbers, separated by commas"
SPANS = "LOW:HIGH in {}, LOW below HIGH, separated by commas"
POSE = "6 numbers: x, y, z in mm and a rotation vector in deg"
READERS = {  # of arguments that are no texts
    "at": Reader(NUMBERS, numbers_of),
    "home": Reader(NUMBERS, numbers_of),
    "columns": Reader("", renames_of),
    "joints": Reader("two joints, such as 2,3", joint_pair),
    "branch": Reader(SPANS.format("deg"), branch_of),
    "region": Reader("3 times " + SPANS.format("mm"), region_of),
    "within": Reader("2 times " + SPANS.format("mm"), span_of),
    "task": Reader("width and height in mm, such as 300x200", size_of),
    "flange": Reader(POSE, frame_of),
    "tools": Reader(POSE, frame_of, named=True),
    "works": Reader(POSE, frame_of, named=True),
    "payload": Reader("KG, or KG,X,Y,Z with the centre in mm", payload_of),
    "tolerance": Reader(
        "a length in mm and an angle in deg, 0 or more", partial(scaled_numbers, (MM, DEG), 0.0, math.inf)
    ),
    "masses": Reader(f"{NUMBERS}, from 0 to 10000", partial(scaled_numbers, (KG,), 0.0, 1e4)),
    "gear_periods": Reader(f"{NUMBERS}, from 0.1 to 3600", partial(scaled_numbers, (DEG,), 0.1, 3600.0)),
    "ball_xyz": Reader("x, y, z in mm", partial(scaled_numbers, (MM, MM, MM), -LARGEST_MM, LARGEST_MM)),
    "lengths": Reader("lengths from 50 to 5000 mm", partial(scaled_numbers, (MM,), 50.0, 5000.0)),
}
