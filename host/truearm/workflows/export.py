"""Export a calibrated robot (``truearm export``): refit where necessary, write, and report what is lost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from truearm.disk import HEAD, KINDS, check_outputs, check_writable, read_text, write_atomic
from truearm.errors import Argument, InputError, RobotError
from truearm.estimate.law_curves import SampledCurve, sampled_curves
from truearm.export.formats import FORMATS
from truearm.export.writing import FormatFit, RobotToWrite, fit_to, held, written
from truearm.findings import Finding, ordered
from truearm.kinds.table_file import read_table
from truearm.model.chain import Chain
from truearm.model.robot_file import MAX_BYTES
from truearm.plan.plan_file import read_plan
from truearm.progress import step
from truearm.text import one_line
from truearm.types import CurveKnots, Displayed, Floats, rms, thinned
from truearm.units import DEG, MM, MRAD
from truearm.workflows.calibration import Calibration, check_within, largest_readings, mounting_values, read_usable
from truearm.workflows.requests import ExportFiles
from truearm.workflows.selection import matching

N_POSES = 600  # of a refit without given poses; 2400 coordinates for about 60 unknowns
MARK = "written by truearm export"
CURVES_HEADER = "joint,reading_deg,error_mrad,sigma_mrad,covered"


@dataclass(frozen=True, repr=False)
class ExportedRobot(Displayed):
    """A calibrated robot as a file's text, and what the format cannot hold. Printing it shows the cost in mm.

    ``form`` is the format, ``text`` the file's text, and ``findings`` tell what it does not hold and where base and
    tool are mounted. ``fitted`` holds the written parameters: its ``left`` and ``left_turn`` (n,) are the file's errors
    of position [m] and orientation [rad] against the identified robot over n poses.

    Examples
    --------
    >>> import truearm
    >>> written = truearm.export_robot(truearm.read_result("result.json"), "urdf")
    >>> written.missing[0]
    'joint1.gain'
    >>> [finding.code for finding in written.findings]
    ['exported', 'format-lacks', 'file-mountings', 'refit-next']
    """

    form: str
    text: str
    findings: tuple[Finding, ...]
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
        return "\n".join(finding.text() for finding in self.findings)

    def _headline(self) -> str:
        return f"{self.form}, {len(self.missing)} parameters without a place, {MM.of(self.rms):.3f} mm RMS"


def export_findings(form: str, fitted: FormatFit, is_default: bool = False) -> list[Finding]:
    """Return what the file does not hold, and the resulting error.

    ``is_default``: it was refitted over random poses.
    """
    values: dict[str, Any] = {"n": fitted.left.size, "largest": {"mm": float(MM.of(fitted.left.max()))}}
    for name in ("left", "dropped"):
        values[name] = {"mm": float(MM.of(rms(getattr(fitted, name))))}
        values[f"{name}_turn"] = {"deg": float(DEG.of(rms(getattr(fitted, f"{name}_turn"))))}
    if fitted.exact and not fitted.refitted:
        return [Finding("exported", {"exact": True})]
    findings = [Finding("exported", {**values, "refitted": fitted.refitted})]
    if fitted.missing:
        findings.append(Finding("format-lacks", {"format": form, "names": list(fitted.missing)}))
    if fitted.refitted and is_default:
        findings.append(Finding("refit-next"))
    return findings


@step("exporting the robot")
def export_file(files: ExportFiles) -> ExportedRobot:
    """Write the calibrated robot. Raises InputError, and then writes nothing."""
    inputs = [files.result, *files.robot.files, *filter(None, [files.over])]
    check_writable(files.out, files.force, inputs=inputs, kind="exported", suffixes=[FORMATS[files.format].suffix])
    check_outputs([("curves", files.curves_out)], files.force, [*inputs, files.out])
    calibration = read_usable(files)
    over = None if files.over is None else _poses_of(files.over, calibration.chain)
    robot = exported(calibration, files.format, over, files.own_frames, files.adjust)
    curves = files.curves_out
    table, laws = "", calibration.stored.laws
    if curves is not None:
        if not any(isinstance(law, CurveKnots) for law in laws):
            text = f"{curves}: the result has no error curves; identify with "
            raise InputError(text, Argument("joint_laws"), " auto")
        sampled = sampled_curves(calibration.chain, laws, calibration.identified, calibration.covariance)
        table = curve_table(sampled, calibration.simulated)
    write_atomic(files.out, robot.text)
    if curves is not None:
        write_atomic(curves, table)
    return robot


def curve_table(curves: Sequence[SampledCurve], simulated: bool = False) -> str:
    """Return the table's text: one row per joint and reading, ``covered`` 1 near a reading of the calibration, else 0.

    A table of a simulated calibration has a column ``simulated``, as a table of observations.
    """
    lines = [CURVES_HEADER + ",simulated" * simulated]
    for curve in curves:
        name, mark = one_line(curve.joint).replace(",", " "), ",yes" * simulated
        rows = zip(DEG.of(curve.readings), MRAD.of(curve.error), MRAD.of(curve.sigma), curve.covered, strict=True)
        lines += [f"{name},{q:.4f},{error:.6f},{sigma:.6f},{int(inside)}{mark}" for q, error, sigma, inside in rows]
    return "\n".join(lines) + "\n"


def exported(
    calibration: Calibration,
    form: str,
    over: Floats | None = None,
    own_frames: bool = False,
    adjust: Sequence[str] = (),
) -> ExportedRobot:
    """Return the calibrated robot in a format; ``over`` (n, j): poses for the refit, by default random ones.

    ``own_frames``: without the mountings of base and tool. ``adjust``: patterns of what may change, by default all.

    Raises InputError if the format can hold nothing of what may change, or nothing worth writing.
    """
    for mimic in calibration.chain.mimics if form != "urdf" else ():
        name = calibration.chain.joints[mimic].name
        raise InputError("unsuited-robot", place=form, reason=f"has no place for mimic joint {name}; use format urdf")
    fitted = _fitted(calibration, form, adjust, over)
    contained = FORMATS[form].mountings and not own_frames
    values = mounting_values(calibration.chain, calibration.nominal, fitted.params)
    mounted = Finding("file-mountings", {**values, "contained": contained})
    findings = [*export_findings(form, fitted, over is None), *calibration.payload_findings(), mounted]
    remarks = [*([Finding("simulated")] if calibration.simulated else []), mounted]
    source = calibration.robot
    robot = RobotToWrite(
        chain=calibration.chain,
        nominal=calibration.nominal,
        params=fitted.params,
        mountings=not own_frames,
        comment="\n".join([MARK, *(one_line(finding.text()) for finding in remarks)]),
        urdf=read_text(Path(source.file), MAX_BYTES, InputError) if source.is_urdf else None,
        drawing=source.drawing,
    )
    try:
        text = written(form, robot)
    except RobotError as exc:
        if not fitted.missing:
            raise
        texts = [finding.text() for finding in export_findings(form, fitted)[::-1]]
        raise RobotError(" ".join([f"{exc}.", *texts])) from exc
    return ExportedRobot(form, text, tuple(ordered(findings, calibration.simulated)), fitted)


def _fitted(calibration: Calibration, form: str, adjust: Sequence[str], over: Floats | None) -> FormatFit:
    """Return the parameters that the format holds and the user allows to change."""
    chain = calibration.chain
    adjustable = np.ones(len(chain.parameters), dtype=bool)
    if adjust:
        adjustable = matching(chain.parameter_names, "adjust", adjust)
        if not (adjustable & held(chain, FORMATS[form])).any():
            text = f" {adjust[0]}: leaves no parameter that {form} can hold; use another pattern or format"
            raise InputError(Argument("adjust"), text)
    if over is not None:
        # Poses that were measured may be beyond the limits that the robot file states.
        largest = largest_readings(chain)
        check_within("over", over, chain, -largest, largest)
    q = _anywhere(calibration) if over is None else over[thinned(len(over), N_POSES)]
    return fit_to(form, chain, calibration.nominal, calibration.identified, adjustable, q)


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
            interval = rng.choice(low.size, N_POSES, p=(high - low) / (high - low).sum())
            q[:, law.joint] = rng.uniform(low[interval], high[interval])
    return np.asarray(q)


def _poses_of(path: Path, chain: Chain) -> Floats:
    """Return the poses (n, j) of a table or a plan. Raises InputError."""
    is_plan = KINDS["plan"].fits(read_text(path, MAX_BYTES, InputError)[:HEAD].encode())
    q = read_plan(path).q if is_plan else read_table(path, chain.joint_units, chain.mimics).q
    if q.shape[1] not in (len(chain.joints), len(chain.motors)):
        raise InputError("other-robot", place=path, joints=q.shape[1], expected=len(chain.joints))
    return chain.completed(q)
