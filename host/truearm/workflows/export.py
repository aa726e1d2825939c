"""The work of ``truearm export``: refit what must be, write, and keep what is lost."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from truearm.errors import InputError
from truearm.export.link_frames import Own, own
from truearm.export.refit import Refit, refit
from truearm.export.toml_tables import dh_table, modified_dh_table, sheth_uicker_table
from truearm.export.ur import ur_yaml
from truearm.export.urdf import edited, joint_origins, new_urdf
from truearm.files.disk import check_writable, read_text, write_atomic
from truearm.files.observation_table import read_table
from truearm.files.plan_file import read_plan
from truearm.files.robot_file import MAX_BYTES, RobotChoice
from truearm.model.chain import Chain
from truearm.text import one_line
from truearm.types import Floats
from truearm.workflows.calibration import Calibration, check_names, mounting_lines, read_calibration
from truearm.workflows.selection import matching

WITHOUT_GAINS = ("urdf", "ur")
N_POSES = 600  # of a refit that names none; 2400 marks for some 60 unknowns
MARK = "written by truearm export"


class ExportOptions(NamedTuple):
    """What to write: a format, with or without the mountings of base and tool, and patterns of what may change (all by default)."""

    form: str
    own_frames: bool = False
    adjust: tuple[str, ...] = ()


@dataclass(frozen=True)
class Exported:
    """A calibrated robot as a file's text, where its mountings are, and what had to be refitted.

    ``refit`` holds the errors over the poses that were fitted: none where the format holds all that was identified.
    """

    text: str
    mountings: tuple[str, ...]
    refit: Refit


def export_file(
    result: Path, robot: RobotChoice, out: Path, options: ExportOptions, over: Path | None = None
) -> Exported:
    """Write the calibrated robot; ``over``: a table or a plan of poses to refit over. Raises InputError, and writes nothing."""
    check_names(result, out, over)
    check_writable(out, inputs=[result, *robot.files, *filter(None, [over])], ours=looks_like_ours)
    calibration = read_calibration(result, robot)
    found = exported(calibration, options, None if over is None else _poses_of(over, calibration.chain))
    write_atomic(out, found.text)
    return found


def exported(calibration: Calibration, options: ExportOptions, over: Floats | None = None) -> Exported:
    """The calibrated robot in a format; ``over`` (n, j): where a refit shall be good, anywhere within the limits by default.

    Raises InputError where nothing of what may change can be held by the format.
    """
    fitted = _fitted(calibration, options, over)
    return Exported(
        _text(calibration, fitted.params, options), tuple(_mountings(calibration, fitted.params, options)), fitted
    )


def looks_like_ours(head: bytes) -> bool:
    """A URDF that was changed in place bears no mark, since nothing but its numbers may change: it is not replaced."""
    return not head.strip() or MARK.encode() in head


def _fitted(calibration: Calibration, options: ExportOptions, over: Floats | None) -> Refit:
    """Parameters that the format holds and the user may adjust."""
    chain, identified = calibration.chain, calibration.identified
    gains = np.array([p.unit == "1" for p in chain.parameters])
    adjustable = np.ones(identified.size, dtype=bool)
    start = identified.copy()
    if options.adjust:
        adjustable = matching(chain.parameter_names, "--adjust", options.adjust)
        start = np.where(adjustable, identified, calibration.nominal)
    if options.form in WITHOUT_GAINS:
        adjustable = adjustable & ~gains
        start = np.where(gains, 1.0, start)
    if np.array_equal(start, identified):
        return Refit(identified, np.zeros(0), np.zeros(0))
    if not adjustable.any():
        raise InputError(f"--adjust {options.adjust[0]}: leaves nothing that --format {options.form} can hold")
    return refit(chain, identified, start, adjustable, _anywhere(chain) if over is None else _thinned(over))


def _anywhere(chain: Chain) -> Floats:
    """(n, j) poses within the joints' limits and a half turn either way, drawn by chance."""
    lower, upper = (np.array([getattr(joint, end) for joint in chain.joints]) for end in ("lower", "upper"))
    return np.random.default_rng(0).uniform(np.maximum(lower, -np.pi), np.minimum(upper, np.pi), (N_POSES, lower.size))


def _thinned(q: Floats) -> Floats:
    """As many poses of q (n, j) as a refit needs."""
    return np.asarray(q[np.unique(np.linspace(0, len(q) - 1, min(len(q), N_POSES)).astype(int))])


def _poses_of(path: Path, chain: Chain) -> Floats:
    """(n, j) of a table or a plan. Raises InputError."""
    is_plan = read_text(path, MAX_BYTES, InputError).lstrip().startswith("pose,")
    q = read_plan(path).q if is_plan else read_table(path, chain.joint_units).q
    if q.shape[1] != len(chain.joints):
        raise InputError(f"{path}: has {q.shape[1]} joints, robot {chain.name} has {len(chain.joints)}")
    return q


def _text(calibration: Calibration, params: Floats, options: ExportOptions) -> str:
    chain, nominal = calibration.chain, calibration.nominal
    with_mountings = not options.own_frames
    if options.form == "urdf" and calibration.robot.is_urdf:
        template = read_text(Path(calibration.robot.file), MAX_BYTES, InputError)
        return edited(template, joint_origins(chain, nominal, params, with_mountings))
    robot = own(chain, nominal, params, with_mountings)
    described = own(chain, nominal, nominal)
    comment = "\n".join([MARK, *(one_line(line) for line in _mountings(calibration, params, options))])
    return _written(robot, described, options.form, comment)


def _written(robot: Own, described: Own, form: str, comment: str) -> str:
    match form:
        case "urdf":
            return new_urdf(robot, comment)
        case "ur":
            return ur_yaml(robot, described, comment)
        case "dh" | "dh-hayati":
            return dh_table(robot, described, form == "dh-hayati", comment)
        case "mdh":
            return modified_dh_table(robot, described, comment)
        case _:
            return sheth_uicker_table(robot, comment)


def _mountings(calibration: Calibration, params: Floats, options: ExportOptions) -> list[str]:
    """Where the mountings are, and what they are."""
    kept = "left out" if options.own_frames or options.form == "ur" else "written at both ends"
    return [
        f"Mountings ({kept}):",
        *(f"  {one_line(line)}" for line in mounting_lines(calibration.chain, calibration.nominal, params)),
    ]
