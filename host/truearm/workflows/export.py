"""The work of ``truearm export``: refit what must be, write, say what is lost."""

from __future__ import annotations

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
from truearm.units import MM
from truearm.workflows.calibration import Calibration, check_names, mounting_lines, read_calibration
from truearm.workflows.selection import matching

WITHOUT_GAINS = ("urdf", "ur")
N_POSES = 600  # of a refit that names none; 2400 marks for some 60 unknowns
MARK = "written by truearm export"


class Choice(NamedTuple):
    """The command line."""

    form: str
    robot: RobotChoice
    own_frames: bool
    adjust: tuple[str, ...]
    over: Path | None


def export_file(result: Path, out: Path, choice: Choice) -> list[str]:
    """Write the calibrated robot; returns what is to be said of it. Raises InputError in one line, and writes nothing."""
    check_names(result, out, choice.over)
    check_writable(out, inputs=[result, *choice.robot.files, *filter(None, [choice.over])], ours=_looks_like_ours)
    calibration = read_calibration(result, choice.robot)
    fitted = _fitted(calibration, choice)
    text = _text(calibration, fitted.params, choice)
    write_atomic(out, text)
    return [
        *_mountings_said(calibration, fitted.params, choice),
        *_refit_said(fitted, choice.over),
        f"Written: {one_line(str(out))}",
    ]


def _looks_like_ours(head: bytes) -> bool:
    """A URDF that was changed in place bears no mark, since nothing but its numbers may change: it is not replaced."""
    return not head.strip() or MARK.encode() in head


def _fitted(calibration: Calibration, choice: Choice) -> Refit:
    """Parameters that the format holds and the user may adjust."""
    chain, identified = calibration.chain, calibration.identified
    gains = np.array([p.unit == "1" for p in chain.parameters])
    adjustable = np.ones(identified.size, dtype=bool)
    start = identified.copy()
    if choice.adjust:
        adjustable = matching(chain.parameter_names, "--adjust", choice.adjust)
        start = np.where(adjustable, identified, calibration.nominal)
    if choice.form in WITHOUT_GAINS:
        adjustable = adjustable & ~gains
        start = np.where(gains, 1.0, start)
    if np.array_equal(start, identified):
        return Refit(identified, np.zeros(0), np.zeros(0))
    if not adjustable.any():
        raise InputError(f"--adjust {choice.adjust[0]}: leaves nothing that --format {choice.form} can hold")
    return refit(chain, identified, start, adjustable, _poses(chain, calibration.joint_units, choice.over))


def _poses(chain: Chain, units: tuple[str, ...], over: Path | None) -> Floats:
    if over is None:
        lower, upper = (np.array([getattr(joint, end) for joint in chain.joints]) for end in ("lower", "upper"))
        return np.random.default_rng(0).uniform(
            np.maximum(lower, -np.pi), np.minimum(upper, np.pi), (N_POSES, lower.size)
        )
    is_plan = read_text(over, MAX_BYTES, InputError).lstrip().startswith("pose,")
    q = read_plan(over).q if is_plan else read_table(over, units).q
    if q.shape[1] != len(chain.joints):
        raise InputError(f"{over}: has {q.shape[1]} joints, robot {chain.name} has {len(chain.joints)}")
    return np.asarray(q[np.unique(np.linspace(0, len(q) - 1, min(len(q), N_POSES)).astype(int))])


def _text(calibration: Calibration, params: Floats, choice: Choice) -> str:
    chain, nominal = calibration.chain, calibration.nominal
    with_mountings = not choice.own_frames
    if choice.form == "urdf" and calibration.robot.is_urdf:
        template = read_text(Path(calibration.robot.file), MAX_BYTES, InputError)
        return edited(template, joint_origins(chain, nominal, params, with_mountings))
    robot = own(chain, nominal, params, with_mountings)
    described = own(chain, nominal, nominal)
    comment = "\n".join([MARK, *(one_line(line) for line in _mountings_said(calibration, params, choice))])
    return _written(robot, described, choice.form, comment)


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


def _mountings_said(calibration: Calibration, params: Floats, choice: Choice) -> list[str]:
    """Where the mountings are, and what they are."""
    kept = "left out" if choice.own_frames or choice.form == "ur" else "written at both ends"
    return [
        f"Mountings ({kept}):",
        *(f"  {one_line(line)}" for line in mounting_lines(calibration.chain, calibration.nominal, params)),
    ]


def _refit_said(fitted: Refit, over: Path | None) -> list[str]:
    if not fitted.left.size:
        return ["Nothing was refitted: the file holds all that was identified."]
    return [
        f"Refitted over {fitted.left.size} poses: what the file cannot hold or you do not adjust costs {_of(fitted.dropped)}",
        f"where it is simply left out, and {_of(fitted.left)} after the rest has made up for it.",
        *["Give --over FILE, a plan or a table, to have it best where you work."] * (over is None),
    ]


def _of(error: Floats) -> str:
    return f"{MM.text(np.sqrt(np.mean(error**2)), '.3f')} RMS ({MM.of(error.max()):.3f} at most)"
