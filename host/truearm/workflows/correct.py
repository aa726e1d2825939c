"""Correct targets or refuse them (``truearm correct``): read, correct, write. Programs are a file or a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from truearm.correct.configurations import several_fit
from truearm.correct.correction import Configuration, Correction, ModelPair, at_tools
from truearm.correct.methods import with_steps
from truearm.correct.programs.languages import ALL_SUFFIXES, SUFFIXES, ProgramLanguage, language_of
from truearm.correct.target_table import check_is_table, format_corrected, read_targets
from truearm.disk import check_new_folder, check_outputs, check_writable, read_bytes, write_atomic, write_folder
from truearm.errors import Argument, InputError, RobotError, TargetError
from truearm.finding_texts import UNDETERMINED
from truearm.findings import Finding, entries, ordered
from truearm.model.chain import Chain, forward
from truearm.model.robot_file import RobotChoice, load_robot
from truearm.model.robot_mounting import mountings
from truearm.model.transforms import frame_of, inverted
from truearm.progress import step
from truearm.report.correction_page import render
from truearm.types import Floats
from truearm.workflows.calibration import Calibration, check_joints, chosen_mountings, mounting_values, undetermined
from truearm.workflows.correct_program import CalibrationFrames, HowCorrected, correct_program
from truearm.workflows.correction_findings import (
    Corrected,
    CorrectedTargets,
    comparison,
    correction_findings,
    document_of,
)
from truearm.workflows.requests import CorrectFiles, CorrectOptions, ProgramOptions
from truearm.workflows.scene import correction_scene

SHOWN = 12  # targets printed one by one
NOTHING = 1e-7  # m, rad: less than the last digit that is printed


@step("correcting")
def correct_file(calibration: Calibration, files: CorrectFiles, options: CorrectOptions) -> dict[str, Any]:
    """Correct a table or a program by the calibration of ``files.result`` and write it; return what was done as JSON.

    Without ``options.document`` and a report, its targets are left out.

    Raises InputError with a one-line message, and then writes nothing.
    """
    read = [files.result, files.targets, *files.robot.files]
    is_folder, method = files.targets.is_dir(), _how(calibration, options)
    check_outputs([("page", files.report)], files.force, [*read, files.out])
    are_programs = is_folder or files.targets.suffix.lower() in ALL_SUFFIXES
    done = (_correct_programs if are_programs else _correct_table)(files, read, method, options)
    spread, configurations = comparison(calibration, method.pair, done.configurations)
    stated = [
        *correction_findings(calibration, done),
        _frames(calibration, options.own_frames),
        *calibration.payload_findings(),
        *undetermined(calibration, done.targets.correction.q[:SHOWN], options.own_frames),
        *done.notes,
        *spread,
    ]
    names = {"file": files.targets.name, "out": files.out.name, "result": files.result.name}
    findings = entries(ordered(stated, calibration.simulated))
    document = {"refused": done.refused, "findings": findings, "configurations": configurations}
    if options.document or files.report is not None:
        document |= document_of(calibration, method.pair, done, names)
    page = ""
    if files.report is not None:
        page = render(document, correction_scene(calibration, method.pair, done.targets, document))
    if is_folder:
        write_folder(files.out, done.contents)
    else:
        write_atomic(files.out, done.contents[files.targets.name])
    if files.report is not None:
        write_atomic(files.report, page)
    return document


def _refuse_for_table(targets: Path, options: ProgramOptions) -> None:
    """Raise InputError for an option that would have no effect on a table."""
    for name in ("joint_moves", "strict", "partial", "unchanged", "flange"):
        if getattr(options, name) != getattr(ProgramOptions, name):
            raise InputError(f"{targets}: is a table, and ", Argument(name), " is for programs; leave it out")
    for name, poses in (("tool", options.tools), ("work", options.works)):
        if any(poses):
            raise InputError(f"{targets}: is a table, which names none; give ", Argument(name), " without a name")


def corrected_poses(
    calibration: Calibration, poses: Floats, options: CorrectOptions, partial: bool = False
) -> Correction:
    """Correct poses (n, 4, 4) of the end frame in the base frame.

    ``partial``: what cannot be commanded is NaN. Otherwise raises TargetError for the first pose that is out of reach
    or near a singularity. Raises it also if nothing determines the arm's configuration.
    """
    places = [f"pose {i}" for i in range(len(poses))]
    done, commanded = _corrected(_how(calibration, options), poses, options, places)
    if not partial:
        _refuse(done, places, consequence="")
    refused = np.array([problem != "" for problem in done.problem])
    q, commanded = np.where(refused[:, None], np.nan, done.q), np.where(refused[:, None, None], np.nan, commanded)
    return replace(done, q=q, commanded=commanded, joint_units=calibration.joint_units, simulated=calibration.simulated)


def _how(calibration: Calibration, options: CorrectOptions) -> HowCorrected:
    """Return how to correct.

    Raises InputError for a number of steps that would have no effect, and for a wrong home.
    """
    if options.steps > 1 and not options.method.steps:
        text = f": {options.steps} has no effect with method {options.method}; leave it out, or use method "
        raise InputError(Argument("steps"), text, " or ".join(with_steps()))
    removed = chosen_mountings(calibration, options.own_frames)
    pair = ModelPair(calibration.chain, calibration.nominal, calibration.identified, removed)
    home = check_joints("home", options.home, calibration.chain)
    return HowCorrected(pair, options.method, options.steps, home, options.margin, calibration.simulated)


def _corrected(
    method: HowCorrected,
    poses: Floats,
    options: CorrectOptions,
    sources: Sequence[str],
    q_start: Floats | None = None,
    oriented: bool = True,
) -> tuple[Correction, Floats]:
    """Return the correction of the tool's poses (n, 4, 4) in the work frame, and the poses to command, in it too."""
    work, tool = map(frame_of, options.frames)
    ends = work @ poses @ inverted(tool)
    if q_start is None and method.home is None:
        anywhere = np.full((1, len(method.pair.chain.joints)), np.nan)
        if several_fit(method.pair.chain, method.pair.nominal, ends[:1], anywhere, oriented).any():
            raise TargetError("uncorrectable", place=sources[0], reason=UNDETERMINED, home=True)
    done = at_tools(method.pair, method.correct(ends, Configuration(q_start, method.home), oriented), tool)
    return done, inverted(work) @ done.commanded @ tool


def _correct_table(files: CorrectFiles, read: list[Path], method: HowCorrected, options: CorrectOptions) -> Corrected:
    path = files.targets
    check_is_table(path, ALL_SUFFIXES)
    _refuse_for_table(path, options.program)
    check_outputs([("targets", files.out)], files.force, read)
    chain, tool = method.pair.chain, frame_of(options.frames[1])
    targets = read_targets(path, chain.joint_units, chain.mimics)
    if not targets.oriented and not np.array_equal(tool, np.eye(4)):
        raise TargetError(
            f"{path}: positions without orientations cannot be moved by ", Argument("tool"), "; give rx, ry, rz too"
        )
    done, commanded = _corrected(method, targets.pose, options, targets.source, targets.q_start, targets.oriented)
    _refuse(done, targets.source)
    q, units = done.q[:, chain.motors], [chain.joint_units[joint] for joint in chain.motors]
    text = format_corrected(targets, commanded, q, done.before, done.after, units, method.simulated)
    rows = tuple(f"row {source.rpartition(' ')[2]}" for source in targets.source)
    tools = np.broadcast_to(tool, commanded.shape)
    corrected = CorrectedTargets(rows, np.zeros(len(rows), dtype=bool), targets.pose, commanded, tools, done)
    return Corrected(corrected, contents={path.name: text.encode()})


def tool0_in_flange(robot: RobotChoice, chain: Chain) -> Floats | None:
    """Return the pose (4, 4) of a URDF's link tool0 in its link flange; None if it has none behind the same joints."""
    if robot.robot is None or not robot.is_urdf or chain.end_frame != "flange":
        return None
    try:
        flange, tool0 = (load_robot(robot.robot, chain.base_frame, tip).chain for tip in ("flange", "tool0"))
    except RobotError:
        return None
    if [joint.name for joint in flange.joints] != [joint.name for joint in tool0.joints]:
        return None
    q = np.zeros((1, len(flange.joints)))
    poses = (forward(arm, arm.params_nominal, q)[0] for arm in (flange, tool0))
    return np.asarray(inverted(next(poses)) @ next(poses))


def _refuse(done: Correction, sources: Sequence[str], consequence: str = "; nothing was written") -> None:
    """Raise TargetError for the first target that cannot be corrected."""
    bad = [i for i, problem in enumerate(done.problem) if problem]
    if bad:
        count = f" ({len(bad)} of {len(sources)} targets cannot be corrected)" if len(bad) > 1 else ""
        raise TargetError("uncorrectable", place=sources[bad[0]], reason=f"{done.problem[bad[0]]}{count}{consequence}")


def _frames(calibration: Calibration, own_frames: bool) -> Finding:
    """Return in which frames the targets are, and which mountings are corrected."""
    frames = calibration.chain, calibration.nominal, calibration.identified
    held = not own_frames and np.allclose(mountings(*frames), np.eye(4), rtol=0.0, atol=NOTHING)
    stated = {"own": own_frames, "held": held, "corrected": not (own_frames or held)}
    return Finding("targets-frames", {**stated, **mounting_values(*frames)})


MAX_BYTES = 64 * 2**20  # of all files together


def _correct_programs(
    files: CorrectFiles, read: list[Path], method: HowCorrected, options: CorrectOptions
) -> Corrected:
    language, contents = _read_programs(files.targets)
    if files.targets.is_dir():
        check_new_folder(files.out, files.targets)
    else:
        check_writable(files.out, inputs=read, suffixes=SUFFIXES[language])
        if files.out.exists():
            raise InputError("file-exists", place=files.out)
    chain, is_brought = method.pair.chain, not files.robot.is_urdf
    tool0 = tool0_in_flange(files.robot, chain)
    frames = CalibrationFrames(chain.base_frame, chain.end_frame, is_brought, options.own_frames, tool0)
    return correct_program(contents, language, method, frames, options.program)


def _read_programs(path: Path) -> tuple[ProgramLanguage, dict[str, bytes]]:
    """Return the language and the contents of a program by its name, or of a folder's by paths with slashes.

    Raises InputError.
    """
    files = {path.name: path}
    if path.is_dir():
        files = {file.relative_to(path).as_posix(): file for file in sorted(path.rglob("*")) if file.is_file()}
    try:
        language = language_of(files)
    except InputError as exc:
        raise exc.within(path) from exc
    if language is None:
        raise InputError("no-program", place=path, suffixes=list(ALL_SUFFIXES))
    names = [name for name in files if name.lower().endswith(SUFFIXES[language])]
    contents: dict[str, bytes] = {}
    room = MAX_BYTES
    for name in names:
        contents[name] = read_bytes(files[name], room, InputError)
        room -= len(contents[name])
    return language, contents
