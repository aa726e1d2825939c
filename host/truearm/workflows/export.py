"""Export a calibrated robot (``truearm export``): refit where necessary, write, and report what is lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from truearm.display import Displayed
from truearm.errors import Argument, InputError, RobotError
from truearm.estimate.law_curves import SampledCurve, sampled_curves
from truearm.export.formats import FORMATS
from truearm.export.writing import FormatFit, RobotToWrite, fit_to, held, named, written
from truearm.files.disk import check_writable, read_text, write_atomic
from truearm.files.observation_table import read_table
from truearm.files.plan_file import read_plan
from truearm.files.robot_file import MAX_BYTES, RobotChoice
from truearm.findings import Finding
from truearm.model.chain import NO_PAYLOAD, Chain
from truearm.progress import step
from truearm.text import counted, one_line
from truearm.types import CurveKnots, Floats, Payload, rms, thinned
from truearm.units import DEG, MM, MRAD
from truearm.workflows.calibration import (
    Calibration,
    check_names,
    check_within,
    largest_readings,
    mounting_lines,
    read_usable,
)
from truearm.workflows.selection import matching

N_POSES = 600  # of a refit without given poses; 2400 coordinates for about 60 unknowns
MARK = "written by truearm export"
CURVES_HEADER = "joint,reading_deg,error_mrad,sigma_mrad,covered"


class ExportOptions(NamedTuple):
    """What to write: a format, with or without the mountings of base and tool, and patterns of what may change
    (default: all).

    ``payload`` is that of the robot that a file is written for.
    """

    form: str
    own_frames: bool = False
    adjust: tuple[str, ...] = ()
    payload: Payload = NO_PAYLOAD


@dataclass(frozen=True, repr=False)
class ExportedRobot(Displayed):
    """A calibrated robot as a file's text, and what the format cannot hold. Printing it shows the cost in mm.

    ``form`` is the format, ``text`` the file's text, and ``mountings`` the poses of base and tool; if the calibration is
    from a simulated box, a line that says so precedes them. ``fitted`` holds the written parameters: its ``left`` and ``left_turn`` (n,) are the file's errors of position [m] and orientation [rad]
    against the identified robot over n poses.

    Examples
    --------
    >>> import truearm
    >>> written = truearm.export_robot(truearm.read_result("result.json"), "urdf")
    >>> written.missing[0]
    'joint1.gain'
    >>> print(written)  # doctest: +ELLIPSIS
    Mountings (the file contains them):
    ...
    The format urdf has no place for joint1.gain, ...
    Refitted over 600 poses. Error without the parameters that the file cannot hold or that are not adjusted: ... mm RMS (... at most), ... deg RMS;
    with the other parameters refitted to compensate: ... mm RMS (... at most), ... deg RMS.
    """

    form: str
    text: str
    mountings: tuple[str, ...]
    fitted: FormatFit

    @property
    def missing(self) -> tuple[str, ...]:
        """The identified parameters that the format cannot hold."""
        return self.fitted.missing

    @property
    def exact(self) -> bool:
        """Whether the file holds everything that was identified."""
        return self.fitted.exact

    @property
    def rms(self) -> float:
        """RMS [m] of the file's position error against the identified robot."""
        return rms(self.fitted.left)

    @property
    def largest(self) -> float:
        """The largest position error [m] of the file against the identified robot."""
        return float(self.fitted.left.max())

    def __str__(self) -> str:
        return "\n".join([*self.mountings, *cost_lines(self)])

    def _headline(self) -> str:
        return f"{self.form}, {len(self.missing)} parameters without a place, {MM.of(self.rms):.3f} mm RMS"


def cost_lines(found: ExportedRobot) -> list[str]:
    """Describe what the file does not hold, and the resulting error."""
    fitted = found.fitted
    lines = [f"The format {found.form} has no place for {named(found.missing)}."] if found.missing else []
    if fitted.refitted:
        return [
            *lines,
            f"Refitted over {counted(fitted.left.size, 'pose')}. Error without the parameters that the file cannot hold or that are not adjusted: {_of(fitted.dropped, fitted.dropped_turn)};",
            f"with the other parameters refitted to compensate: {_of(fitted.left, fitted.left_turn)}.",
        ]
    if found.exact:
        return ["The file holds everything that was identified; no refit was needed."]
    return [*lines, f"Error of what the file cannot hold: {_of(fitted.left, fitted.left_turn)}."]


def _of(error: Floats, turn: Floats) -> str:
    """Describe errors of position [m] and of orientation [rad]: a turn about the end itself moves it nowhere."""
    return f"{MM.text(rms(error), '.3f')} RMS ({MM.of(error.max()):.3f} at most), {DEG.text(rms(turn), '.4f')} RMS"


@step("exporting the robot")
def export_file(
    result: Path,
    robot: RobotChoice,
    out: Path,
    options: ExportOptions,
    over: Path | None = None,
    curves: Path | None = None,
    force: bool = False,
    allow_unusable: bool = False,
) -> ExportedRobot:
    """Write the calibrated robot.

    ``over``: a table or a plan of poses to refit over. ``curves``: where to write the joints' error curves. Raises
    InputError, and then writes nothing.
    """
    check_names(result, out, over, curves)
    inputs = [result, *robot.files, *filter(None, [over])]
    check_writable(out, force, inputs=inputs, ours=looks_like_ours, suffixes=[FORMATS[options.form].suffix])
    if curves is not None:
        check_writable(curves, force, inputs=[*inputs, out], ours=looks_like_curves, suffixes=[".csv"])
    calibration = read_usable(result, robot, allow_unusable).carrying(*options.payload)
    found = exported(calibration, options, None if over is None else _poses_of(over, calibration.chain))
    table = None if curves is None else curve_table(_curves(calibration, curves), calibration.simulated)
    write_atomic(out, found.text)
    if curves is not None and table is not None:
        write_atomic(curves, table)
    return found


def _curves(calibration: Calibration, curves: Path) -> tuple[SampledCurve, ...]:
    """Return the error curves of the joints. Raises InputError if the result has none."""
    laws = calibration.stored.laws
    if not any(isinstance(law, CurveKnots) for law in laws):
        raise InputError(f"{curves}: the result has no error curves; identify with ", Argument("joint_laws"), " auto")
    return sampled_curves(calibration.chain, laws, calibration.identified, calibration.covariance)


def curve_table(curves: Sequence[SampledCurve], simulated: bool = False) -> str:
    """Return the table's text: one row per joint and reading, ``covered`` 1 near a reading of the calibration, else 0.

    A table of a simulated calibration has a column ``simulated``, as a table of observations.
    """
    lines = [CURVES_HEADER + ",simulated" * simulated]
    for curve in curves:
        name = one_line(curve.joint).replace(",", " ")
        rows = zip(DEG.of(curve.readings), MRAD.of(curve.error), MRAD.of(curve.sigma), curve.covered, strict=True)
        lines += [
            f"{name},{q:.4f},{error:.6f},{sigma:.6f},{int(inside)}{',yes' * simulated}"
            for q, error, sigma, inside in rows
        ]
    return "\n".join(lines) + "\n"


def looks_like_curves(head: bytes) -> bool:
    """Return whether a file with this beginning is such a table, or empty."""
    return not head.strip() or head.startswith(CURVES_HEADER.encode())


def exported(calibration: Calibration, options: ExportOptions, over: Floats | None = None) -> ExportedRobot:
    """Return the calibrated robot in a format; ``over`` (n, j): poses for the refit, by default random ones.

    Raises InputError if the format can hold nothing of what may change, or nothing worth writing.
    """
    fitted = _fitted(calibration, options, over)
    simulated = [Finding("simulated").text()] if calibration.simulated else []
    mountings = (*simulated, *_mountings(calibration, fitted.params, options))
    robot = RobotToWrite(
        chain=calibration.chain,
        nominal=calibration.nominal,
        params=fitted.params,
        mountings=not options.own_frames,
        comment="\n".join([MARK, *map(one_line, mountings)]),
        urdf=_urdf_text(calibration),
    )
    try:
        text = written(options.form, robot)
    except RobotError as exc:
        if not fitted.missing:
            raise
        raise RobotError(
            f"{exc}. A file of this format would also have no place for {named(fitted.missing)}, which costs {_of(fitted.left, fitted.left_turn)}"
        ) from exc
    return ExportedRobot(options.form, text, mountings, fitted)


def _urdf_text(calibration: Calibration) -> str | None:
    """Return the robot's source text if it is a URDF."""
    robot = calibration.robot
    return read_text(Path(robot.file), MAX_BYTES, InputError) if robot.is_urdf else None


def looks_like_ours(head: bytes) -> bool:
    """Return whether truearm wrote the file.

    A URDF that was changed in place has no mark, since only its numbers may change, so it is not replaced.
    """
    return not head.strip() or MARK.encode() in head


def _fitted(calibration: Calibration, options: ExportOptions, over: Floats | None) -> FormatFit:
    """Return the parameters that the format holds and the user allows to change."""
    chain = calibration.chain
    adjustable = np.ones(len(chain.parameters), dtype=bool)
    if options.adjust:
        adjustable = matching(chain.parameter_names, "adjust", options.adjust)
        if not (adjustable & held(chain, FORMATS[options.form])).any():
            raise InputError(
                Argument("adjust"),
                f" {options.adjust[0]}: leaves no parameter that {options.form} can hold; use another pattern or format",
            )
    if over is not None:
        # Poses that were measured may be beyond the limits that the robot file states.
        largest = largest_readings(chain)
        check_within("over", over, chain, -largest, largest)
    q = _anywhere(calibration) if over is None else over[thinned(len(over), N_POSES)]
    return fit_to(options.form, chain, calibration.nominal, calibration.identified, adjustable, q)


def _anywhere(calibration: Calibration) -> Floats:
    """Return random poses (n, j) within the joints' limits and half a turn in each direction.

    Where error curves are unknown they are 0, so a robot with joint laws gets poses within its fitted readings.
    """
    chain, stored = calibration.chain, calibration.stored
    lower, upper = np.clip(chain.limits, -np.pi, np.pi)
    if stored.laws and stored.joint_range is not None:
        lower, upper = np.array(stored.joint_range.lower), np.array(stored.joint_range.upper)
    rng = np.random.default_rng(0)
    q = rng.uniform(lower, upper, (N_POSES, lower.size))
    for law in stored.laws:
        if isinstance(law, CurveKnots):
            low, high = np.array(law.covered).T
            which = rng.choice(low.size, N_POSES, p=(high - low) / (high - low).sum())
            q[:, law.joint] = rng.uniform(low[which], high[which])
    return np.asarray(q)


def _poses_of(path: Path, chain: Chain) -> Floats:
    """Return the poses (n, j) of a table or a plan. Raises InputError."""
    is_plan = read_text(path, MAX_BYTES, InputError).lstrip().startswith("pose,")
    q = read_plan(path).q if is_plan else read_table(path, chain.joint_units).q
    if q.shape[1] != len(chain.joints):
        raise InputError(
            f"{path}: has {q.shape[1]} joints, robot {chain.name} has {len(chain.joints)}; give poses of this robot"
        )
    return q


def _mountings(calibration: Calibration, params: Floats, options: ExportOptions) -> list[str]:
    """Describe where the mountings are, and their values."""
    kept = (
        "the file contains them"
        if FORMATS[options.form].mountings and not options.own_frames
        else "the file does not contain them"
    )
    return [
        f"Mountings ({kept}):",
        *(f"  {one_line(line)}" for line in mounting_lines(calibration.chain, calibration.nominal, params)),
    ]
