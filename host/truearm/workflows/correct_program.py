"""Correct a robot's program: every move to a target, or none of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.correct.controller_frames import SAME, Frame, base_of, flange_of
from truearm.correct.correction import Configuration, Correction, at_tools, correct, joined
from truearm.correct.inverse import Origins, several_fit
from truearm.correct.joint_moves import JointMoves
from truearm.correct.methods import Method
from truearm.correct.model_pair import ModelPair, believed
from truearm.correct.straight_moves import straight_moves
from truearm.errors import Argument, ProgramError
from truearm.files.programs.corrected_text import changed_text, changes_of, joint_changes, marks_of, solved
from truearm.files.programs.program import (
    Program,
    Refused,
    Surroundings,
    parse_program,
    read_program,
    refused_at,
)
from truearm.files.programs.reread import Wanted, check_reread
from truearm.files.programs.suffixes import ProgramLanguage, language_of
from truearm.files.programs.syntax import Taught
from truearm.files.programs.target_poses import PoseTarget, literal_poses, nears_of, poses_of, quarters_of, readings_of
from truearm.files.programs.target_users import users_of
from truearm.files.programs.targets import ProgramTargets, targets_of
from truearm.files.programs.values import Pose, fixed_six
from truearm.model.chain import joint_jacobian
from truearm.model.poses import Six, apart, for_each, frame_of, inverted
from truearm.text import counted
from truearm.types import Floats
from truearm.workflows.configuration_notes import UNDETERMINED, configuration_notes
from truearm.workflows.correction_findings import CorrectedMoves, CorrectedTargets
from truearm.workflows.given_tools import check_names, check_used

N_READINGS = 6  # of a program's joint readings
SAME_TARGET = 1e-6  # m, rad between corrections of one target: below a controller's resolution
NEAR = 0.3  # rad, m from a program's joints to those of the target; if farther, the joints are searched for
MOST_MOVES = 20_000  # straight moves that are simulated: about 0.14 ms each
MOST_REREAD = 20_000  # targets of a program that is read again: about 0.05 ms each


class ProgramOptions(NamedTuple):
    """How to correct a program.

    ``joint_moves``: what to do with moves to joint readings, None to refuse a program with any. ``split``: write
    separate numbers into a move that would need different numbers from another move. ``partial``: write the file even
    if some moves cannot be corrected; ``mark`` marks these with a comment. ``base``: the controller's base in the
    calibration's base frame, and ``flange``: its flange in the calibration's end frame, if their names do not show
    this. ``tool``: the tool in force before a URScript sets one. ``tools`` and ``works``: tools and work objects
    declared elsewhere, by name. Poses are positions [m] and rotation vectors [rad]. ``harmless``: external routines
    that do not move the robot.
    """

    joint_moves: JointMoves | None = None
    split: bool = False
    partial: bool = False
    mark: bool = False
    base: Six | None = None
    flange: Six | None = None
    tool: Six | None = None
    tools: Mapping[str, Six] = {}
    works: Mapping[str, Six] = {}
    harmless: frozenset[str] = frozenset()


class ProgramRefused(ProgramError):
    """A program with moves that cannot be corrected with certainty; ``refused`` names them."""

    def __init__(self, text: Sequence[str], refused: Sequence[Refused]) -> None:
        super().__init__(*text)
        self.refused = tuple(refused)


class CalibrationFrames(NamedTuple):
    """The frames of a calibration.

    ``brought``: defined by a robot that is not a URDF. ``own``: targets are in the robot's own frames. ``tool0``: the
    pose (4, 4) in the end frame of the link of this name, if a URDF has it there.
    """

    base: str
    end: str
    brought: bool
    own: bool
    tool0: Floats | None = None


class HowCorrected(NamedTuple):
    """The robot, and how its targets are corrected."""

    pair: ModelPair
    method: Method | str
    steps: int
    home: Floats | None
    margin: float

    def correct(self, ends: Floats, configuration: Configuration, oriented: bool = True) -> Correction:
        """Return the correction of poses (n, 4, 4) of the end."""
        return correct(
            self.pair,
            ends,
            self.method,
            self.steps,
            oriented=oriented,
            configuration=configuration,
            margin=self.margin,
        )


class Corrected(NamedTuple):
    """A corrected file's text, its targets and straight moves. ``refused``: what was left unchanged; ``notes``: remarks."""

    text: str | bytes
    targets: CorrectedTargets
    moves: CorrectedMoves = CorrectedMoves()
    refused: tuple[Refused, ...] = ()
    notes: tuple[str, ...] = ()


def correct_program(path: Path, how: HowCorrected, names: CalibrationFrames, options: ProgramOptions) -> Corrected:
    """Correct a program. Raises ProgramRefused if a move cannot be corrected, ProgramError if it is not a valid
    program.
    """
    language = language_of(path)
    check_names(path, language, options.tool, options.tools, options.works)
    tool = None if options.tool is None and language == "urscript" else fixed_six(options.tool or (0.0,) * 6)
    tool_of, work_of = ({name.lower(): six for name, six in of.items()} for of in (options.tools, options.works))
    surroundings = Surroundings(tool, tool_of, work_of, options.harmless)
    program = read_program(path, surroundings)
    check_used(path, program, options.works)
    base, flange = _placed(language, names, options, _last_axis(how.pair))
    at_joints = [m.start for m in program.motions if any(not isinstance(goal.target, Pose) for goal in m.goals)]
    if at_joints and options.joint_moves is None:
        lines = sorted({program.source.line(at) for at in at_joints})
        raise ProgramError(
            f"{path} line {lines[0]}: the program moves to joint values, in {counted(len(lines), 'line')}; to keep or to correct these, give ",
            Argument("joint_moves"),
            " keep or correct",
        )
    targets = targets_of(program, options.joint_moves is JointMoves.CORRECT, options.split)
    literals = literal_poses(targets.poses)
    place, frame, tools = poses_of(targets.poses, literals)
    n_joints = len(how.pair.chain.joints)
    goals = [*(one.goal for one in targets.poses), *(one.goal for one in targets.revisits)]
    near, quarters = nears_of(goals, n_joints), quarters_of(goals, n_joints)
    ends = _ends(base, flange, (place, frame, tools), targets)
    determined = _determined(how.pair, ends, targets, near, quarters)
    users = users_of(program, targets)
    if how.home is None and not determined.all():
        open_moves = [
            refused_at(program, at, UNDETERMINED, "home")
            for i in np.flatnonzero(~determined).tolist()
            for at in users.poses[i]
        ]
        message = f"{path}: the program does not determine the arm's configuration at {counted(int((~determined).sum()), 'target')}, so nothing was written; give joints near those of the first target with "
        raise ProgramRefused((message, Argument("home")), sorted(set(open_moves)))
    every = _corrected_poses(how, ends, near, quarters, targets)
    done = _rows(every, range(len(targets.poses)))
    readings = [literal for literal, _ in targets.joints]
    joints = _corrected_joints(how, readings)
    refused = [*targets.refused, *_problems(program, done, users.poses)]
    refused += _other_configurations(program, targets, every)
    refused += _problems(program, joints, users.joints)
    good = [i for i, problem in enumerate(done.problem) if not problem]
    poses = [targets.poses[i] for i in good]
    frames = for_each(lambda one: np.asarray(inverted(one) @ inverted(base.pose)), _taken(frame, good))
    asked = frames @ _taken(done.commanded, good) @ flange.pose @ _taken(tools, good)
    new = solved(poses, asked, literals)
    index_of = dict(zip(poses, good, strict=True)) if new.circular else {}
    refused += [
        refused_at(program, at, "its target and another's depend on each other", "" if options.split else "split")
        for one in new.circular
        for at in users.poses[index_of[one]]
    ]
    refused = sorted(set(refused))
    if refused and not options.partial:
        count, total = len({(one.line, one.statement) for one in refused}), len(program.motions)
        said = f"{path}: {count} of {counted(total, 'statement')} that may move the robot cannot be corrected, so nothing was written; change these lines as their reasons say"
        others = (", or correct the others alone with ", Argument("partial")) if count < total else ()
        raise ProgramRefused((said, *others), refused)
    kept = [i for i, one in enumerate(poses) if one not in new.circular]
    moved = [i for i, problem in enumerate(joints.problem) if not problem]
    told = _taken(asked, kept)
    changes = changes_of(program, [poses[i] for i in kept], told, new)
    changes += joint_changes([readings[i] for i in moved], joints.q[moved])
    if not changes:
        raise ProgramRefused((f"{path}: holds no target that can be corrected, so nothing was written",), refused)
    del literals, new  # 26 MB for 100,000 targets
    changes += marks_of(program, refused) if options.mark else []
    lines_of = [program.source.line(_place(targets.poses[good[i]])) for i in kept]
    lines_of += [program.source.line(readings[i].start) for i in moved]
    rows = [good[i] for i in kept]
    whole = np.tile(np.eye(4), (len(moved), 1, 1))  # joint readings have no tool
    at_end = _stacked(for_each(lambda tool: np.asarray(flange.pose @ tool), _taken(tools, rows)), whole)
    correction = at_tools(how.pair, joined([_rows(done, rows), _rows(joints, moved)]), at_end)
    of_pose = {i: k for k, i in enumerate(rows)}
    of_joints = {readings[i].start: len(rows) + k for k, i in enumerate(moved)}
    corrected = CorrectedTargets(
        tuple(f"line {line}" for line in lines_of),
        np.arange(len(lines_of)) >= len(rows),
        _stacked(_taken(place, rows), believed(how.pair, joints.q_nominal[moved])),
        _stacked(told, joints.commanded[moved]),
        at_end,
        correction,
    )
    text = changed_text(program, changes)
    if len(targets.indices) + len(readings) <= MOST_REREAD:
        wanted = Wanted(
            {goal: of_pose[i] for goal, i in targets.indices.items() if i in of_pose},
            corrected.told[: len(rows)],
            {readings[i]: joints.q[i] for i in moved},
            options.joint_moves is not JointMoves.CORRECT,
            frozenset(one.line for one in refused),
        )
        check_reread(program, parse_program(text, language, surroundings, str(path)), wanted)
    return Corrected(
        text,
        corrected,
        _straight_moves(how.pair, program, targets, of_pose, of_joints, corrected),
        tuple(refused),
        (
            f"The controller's base is {base.called(names.base)}. Its flange is {flange.called(names.end)}.",
            *_joints_kept(len(at_joints) if options.joint_moves is JointMoves.KEEP else 0),
            *configuration_notes(
                correction.q[: len(kept)],
                quarters[rows],
                determined[rows],
                lines_of,
            ),
        ),
    )


def _determined(
    pair: ModelPair, ends: Floats, targets: ProgramTargets, near: Floats, quarters: Floats
) -> NDArray[np.bool_]:
    """Return for which targets (n,) the program determines the arm's configuration: by joints, by the robot's previous
    position, or by quarter turns or joint limits that only one configuration fits.
    """
    n = len(targets.poses)
    determined = np.isfinite(near[:n]).any(axis=1) | np.array([one is not None for one in targets.origins], dtype=bool)
    searched = np.flatnonzero(~determined)
    if searched.size:
        determined[searched] = ~several_fit(pair.chain, pair.nominal, ends[searched], quarters[searched])
    return determined


def _straight_moves(
    pair: ModelPair,
    program: Program,
    targets: ProgramTargets,
    of_pose: Mapping[int, int],
    of_joints: Mapping[int, int],
    corrected: CorrectedTargets,
) -> CorrectedMoves:
    """Simulate the straight moves between corrected targets.

    ``of_pose`` maps a pose's index to its row in ``corrected``, ``of_joints`` the place of joint readings to theirs.
    """
    starts: list[Floats] = []
    ends: list[int] = []
    places: list[tuple[str, str]] = []
    unchecked = len(targets.loose)
    for move in targets.lines:
        if isinstance(move.start, int):
            begin = of_pose.get(move.start)
            q, where = (
                (None, 0) if begin is None else (corrected.correction.q[begin], _place(targets.poses[move.start]))
            )
        else:
            at = of_joints.get(move.start.start)
            q = np.array(readings_of(move.start)) if at is None else corrected.correction.q[at]
            where = move.start.start
        if q is None or move.end not in of_pose or len(q) != corrected.correction.q.shape[1]:
            unchecked += 1
            continue
        starts.append(q)
        ends.append(of_pose[move.end])
        places.append((f"line {program.source.line(move.at)}", f"line {program.source.line(where)}"))
    if not ends or len(ends) > MOST_MOVES:
        return CorrectedMoves(unchecked=unchecked + len(ends))
    told = corrected.correction.commanded[ends]
    found = straight_moves(pair, np.array(starts), told, corrected.tools[ends])
    return CorrectedMoves(tuple(a for a, _ in places), tuple(b for _, b in places), found, unchecked)


def _joints_kept(n: int) -> list[str]:
    return [f"{counted(n, 'move')} to joint values kept as {'it is' if n == 1 else 'they are'}."] * bool(n)


def _last_axis(pair: ModelPair) -> Floats:
    """Return the last joint's axis (3,) in the end frame of the robot as described."""
    q = np.zeros((1, len(pair.chain.joints)))
    pose, turn = believed(pair, q)[0], joint_jacobian(pair.chain, pair.nominal, q)[0, 3:, -1]
    return np.asarray(pose[:3, :3].T @ turn)


def _placed(
    language: ProgramLanguage, names: CalibrationFrames, options: ProgramOptions, axis: Floats
) -> tuple[Frame, Frame]:
    """Return the controller's base and flange in the calibration's frames. Raises ProgramError if they are not
    specified.

    Without its mountings a robot still has the frames of its description. They are the controller's, whatever their
    names, only if it is no URDF.
    """
    other = SAME if names.own and names.brought else None
    base = _given(options.base) or base_of(language, names.base, names.brought) or other
    flange = _given(options.flange) or _described(names) or flange_of(language, names.end, names.brought, axis) or other
    for found, what, frame, argument in ((base, "base", names.base, "work"), (flange, "flange", names.end, "flange")):
        if found is None:
            same = " X,Y,Z,RX,RY,RZ, or as 0,0,0,0,0,0 if the two frames are the same"
            wrong = f"the calibration uses frame {frame[:60]}; the pose of the controller's {what} in this frame is not known; give it as "
            own = (f"{same}, or use the robot's own frames with ", Argument("own_frames")) if names.brought else (same,)
            raise ProgramError(wrong, Argument(argument), *own)
    assert base is not None
    assert flange is not None
    return base, flange


def _described(names: CalibrationFrames) -> Frame | None:
    return None if names.tool0 is None else Frame(names.tool0, "tool0 (as in the URDF)")


def _given(six: Six | None) -> Frame | None:
    return None if six is None else Frame(frame_of(six), "as given")


def _ends(base: Frame, flange: Frame, poses: tuple[Floats, Floats, Floats], targets: ProgramTargets) -> Floats:
    """Return the poses (n, 4, 4) of the calibration's end frame at the targets and then at their revisits."""
    place, frame, tools = poses
    frames = for_each(lambda one: np.asarray(base.pose @ one), frame)
    ends = frames @ place @ for_each(inverted, tools) @ inverted(flange.pose)
    return _taken(ends, [*range(len(targets.poses)), *(one.pose for one in targets.revisits)])


def _corrected_poses(
    how: HowCorrected, ends: Floats, near: Floats, quarters: Floats, targets: ProgramTargets
) -> Correction:
    """Correct the targets and their revisits, whose ends are (n, 4, 4).

    Those with joints nearby start from there, the others from a search from the robot's previous position.
    """
    origins = [*targets.origins, *(one.origin for one in targets.revisits)]
    given: NDArray[np.bool_] = np.asarray(np.isfinite(near).all(axis=1))
    known = given.copy()
    at_known = _corrected(how, _taken(ends, np.flatnonzero(known)), Configuration(q_start=near[known]))
    if (far := np.abs(at_known.q_nominal - near[known]).max(axis=1) > NEAR).any():
        known[np.flatnonzero(known)[far]] = (
            False  # from so far away, descent may end in another configuration than the nearest
        )
        at_known = _rows(at_known, np.flatnonzero(~far).tolist())
    place = np.where(known, np.cumsum(known), np.cumsum(~known)) - 1  # among those of its kind
    begun = Origins(np.full(len(ends), -1), near.copy())
    for i, origin in enumerate(origins):
        if given[i]:
            continue
        if isinstance(origin, Taught) and near.shape[1] == N_READINGS:
            begun.q[i] = readings_of(origin)
        elif isinstance(origin, int) and known[origin]:
            begun.q[i] = at_known.q_nominal[place[origin]]
        elif isinstance(origin, int):
            begun.target[i] = place[origin]
    rest = Origins(begun.target[~known], begun.q[~known])
    by_search = _corrected(how, ends[~known], Configuration(home=how.home, quadrants=quarters[~known], origins=rest))
    found = joined([at_known, by_search])
    order = np.concatenate([np.flatnonzero(known), np.flatnonzero(~known)])
    return _rows(found, np.argsort(order).tolist())


def _corrected_joints(how: HowCorrected, literals: Sequence[Taught]) -> Correction:
    """Correct joint readings: the true robot shall be where a perfect robot would be with them.

    Raises ProgramError for a robot without exactly six joints.
    """
    n_joints = len(how.pair.chain.joints)
    q = np.array([readings_of(literal) for literal in literals]).reshape(-1, 6)
    if literals and n_joints != q.shape[1]:
        raise ProgramError(
            f"the program has {q.shape[1]} joints, the robot {n_joints}; give the robot that the program is for"
        )
    q = q if literals else np.zeros((0, n_joints))
    return _corrected(how, believed(how.pair, q), Configuration(q_start=q))


def _corrected(how: HowCorrected, ends: Floats, configuration: Configuration) -> Correction:
    if not len(ends):
        n_joints = len(how.pair.chain.joints)
        return Correction(
            np.zeros((0, n_joints)), np.zeros((0, n_joints)), ends, np.zeros((0, 2)), np.zeros((0, 2)), ()
        )
    return how.correct(ends, configuration)


def _rows(of: Correction, rows: Sequence[int]) -> Correction:
    """Return a selection of the targets."""
    if _are_all(rows, of.q):
        return of
    k = np.array(rows, dtype=int)
    problems = tuple(of.problem[i] for i in rows)
    return Correction(of.q_nominal[k], of.q[k], of.commanded[k], of.before[k], of.after[k], problems)


def _taken(of: Floats, rows: Sequence[int] | NDArray[np.int_]) -> Floats:
    """Return a selection of rows; of all of them no copy, which takes 13 MB for 100,000 poses."""
    return of if _are_all(rows, of) else of[np.asarray(rows, dtype=int)]


def _are_all(rows: Sequence[int] | NDArray[np.int_], of: Floats) -> bool:
    return len(rows) == len(of) and bool((np.asarray(rows, dtype=int) == np.arange(len(of))).all())


def _stacked(first: Floats, second: Floats) -> Floats:
    """Return the rows of both; the first alone is not copied."""
    return np.concatenate([first, second]) if len(second) else first


def _problems(program: Program, done: Correction, users: Sequence[Sequence[int]]) -> list[Refused]:
    pairs = zip(users, done.problem, strict=True)
    return [refused_at(program, at, problem) for moves, problem in pairs if problem for at in moves]


def _other_configurations(program: Program, targets: ProgramTargets, done: Correction) -> list[Refused]:
    """Return the revisits in which the arm needs a different correction from that of its first visit to the pose.

    Their rows follow those of the poses.
    """
    rows = [one.pose for one in targets.revisits]
    again = done.commanded[len(targets.poses) :]
    off = np.abs(apart(done.commanded[rows], again)).max(axis=1) > SAME_TARGET
    found = []
    for one, row, problem, is_off in zip(targets.revisits, rows, done.problem[len(targets.poses) :], off, strict=True):
        if done.problem[row]:
            continue
        if is_off or problem:
            line = program.source.line(targets.poses[row].at)
            why = f"the arm reaches its target in another configuration than in line {line}, which needs different numbers"
            found += [refused_at(program, at, problem or why) for at in one.moves]
    return found


def _place(target: PoseTarget) -> int:
    """Return the place of a target's numbers."""
    return target.literal.start if target.literal is not None else target.goal.start
