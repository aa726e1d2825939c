"""Correct the programs of a robot: every move to a target, or none of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.correct.configurations import Origins, several_fit, solutions, within
from truearm.correct.correction import (
    Configuration,
    Correction,
    ModelPair,
    at_tools,
    believed,
    correct,
    joined,
    straight_moves,
)
from truearm.correct.methods import JointMoves, Method
from truearm.correct.programs import corrected_text
from truearm.correct.programs.census import Census
from truearm.correct.programs.corrected_text import difference, target_poses
from truearm.correct.programs.languages import SAME, Frame, ProgramLanguage, base_of, flange_of, read_programs
from truearm.correct.programs.order import MOST_ORIGINS, preceding
from truearm.correct.programs.program import Goal, Move, Place, Program, Surroundings
from truearm.correct.programs.reading import readings_of
from truearm.correct.programs.tokens import Source
from truearm.errors import Argument, InputError
from truearm.findings import Finding, Reason
from truearm.model.chain import joint_jacobian
from truearm.model.inverse import inverse
from truearm.model.transforms import Six, apart, frame_of, inverted
from truearm.progress import uncollected
from truearm.text import counted
from truearm.types import Floats
from truearm.workflows.correction_findings import (
    Corrected,
    CorrectedMoves,
    CorrectedTargets,
    OtherConfigurations,
    configuration_notes,
)
from truearm.workflows.requests import ProgramOptions

N_JOINTS = 6  # of a robot that a pose in a program determines
SAME_TARGET = 1e-6  # m, rad between corrections of one target: below a controller's resolution
NEAR = 0.3  # rad, m from a program's joints to those of the target; if farther, the joints are searched for
MOST_MOVES = 20_000  # straight moves that are simulated: about 0.14 ms each
MOST_COMPARED = 20  # targets that are corrected in all configurations of the arm


class CalibrationFrames(NamedTuple):
    """The frames of a calibration.

    ``brought``: defined by a robot that is not a URDF. ``own_frames``: targets are in the robot's own frames.
    ``tool0``: the pose (4, 4) in the end frame of the link of this name, if a URDF has it there.
    """

    base: str
    end: str
    brought: bool
    own_frames: bool
    tool0: Floats | None = None


class HowCorrected(NamedTuple):
    """The robot, and how its targets are corrected."""

    pair: ModelPair
    method: Method | str
    steps: int
    home: Floats | None
    margin: float
    simulated: bool = False  # the calibration

    def correct(self, ends: Floats, configuration: Configuration, oriented: bool = True) -> Correction:
        """Return the correction of poses (n, 4, 4) of the end."""
        return correct(
            self.pair, ends, self.method, self.steps, oriented=oriented, configuration=configuration, margin=self.margin
        )


class Visit(NamedTuple):
    """A goal of a move of a program, by its number, that comes from ``origin``, None if that is unknown."""

    program: int
    move: Move
    goal: Goal
    origin: Goal | None


@dataclass(frozen=True, eq=False)
class Solution:
    """The correction of n visits, the first ``n_poses`` of poses, the others of joint readings.

    ``rows``: the first visit of each goal. ``requested`` and ``commanded`` (n, 4, 4): the tools' poses in the goals'
    frames; for joint readings, those of the end in the base. ``tools`` (n, 4, 4): in the end frame. ``quarters``
    (n, 6): quarter turns that a goal asks for, NaN if it asks for none. ``determined`` (n,): the program determines the
    configuration. ``motors``: the joints of the chain that a program's six joints are.
    """

    visits: Sequence[Visit]
    n_poses: int
    rows: Mapping[Goal, int]
    correction: Correction
    requested: Floats
    commanded: Floats
    tools: Floats
    quarters: Floats
    determined: NDArray[np.bool_]
    motors: Sequence[int]

    @property
    def wanted(self) -> dict[Goal, Floats]:
        """The pose (4, 4) to command of each goal that is a pose."""
        return {goal: self.commanded[row] for goal, row in self.rows.items() if row < self.n_poses}

    @property
    def joints(self) -> dict[Goal, corrected_text.Joints]:
        """The joint readings of each goal before and after the correction."""
        q_nominal, q = (q[:, self.motors] for q in (self.correction.q_nominal, self.correction.q))
        return {goal: corrected_text.Joints(q_nominal[row], q[row]) for goal, row in self.rows.items()}


@uncollected()
def correct_program(
    files: Mapping[str, bytes],
    language: ProgramLanguage,
    method: HowCorrected,
    names: CalibrationFrames,
    options: ProgramOptions,
) -> Corrected:
    """Correct the program files of one robot, by name.

    Raises InputError if a move cannot be corrected, with these as ``refused``, or if the files are no valid program.
    """
    programs = read_programs(language, [Source(name, data) for name, data in files.items()], _surroundings(options))
    title = next(iter(files)) if len(files) == 1 else counted(len(files), "program file")
    _check_moves(title, programs, method.pair, options)
    if options.mark and language not in corrected_text.COMMENTS:
        raise InputError("no-effect", place=Argument("mark"), reason="such a program has no comments beside moves")
    frames = _controller_frames(language, names, options, method.pair)
    joints_change = options.joint_moves is JointMoves.CORRECT
    censuses = [Census(program, joints_change) for program in programs]
    visits = [visit for visit in _visits(programs) if joints_change or not visit.goal.is_joints]
    solution = _solution(sorted(visits, key=lambda visit: visit.goal.is_joints), method, frames)
    _settle(censuses, solution, method)
    refused = _refused(programs)
    places = _corrected_rows(censuses, solution, joints_change)
    n_moves = sum(len(program.moves) for program in programs)
    if not places and not refused:
        raise InputError("no-move", place=title, kept=True)
    if not places or (refused and not options.partial):
        good = n_moves - len(refused) if places else 0
        raise InputError("uncertain-moves", place=title, good=good, n=n_moves, refused=refused)
    _check_frames(programs, options)
    written = _written(censuses, solution, language, options, method.simulated)
    labels, rows = [_label(programs, *place) for place in places], np.array(list(places.values()))
    posed, tools = rows < solution.n_poses, solution.tools[rows]
    correction = at_tools(method.pair, _selected(solution.correction, rows), tools)
    lines = [label.removeprefix("line ") for label, is_pose in zip(labels, posed, strict=True) if is_pose]
    columns = (solution.correction.q_nominal[:, solution.motors], solution.quarters, solution.determined)
    q, quarters, determined = (column[rows[posed]] for column in columns)
    return Corrected(
        CorrectedTargets(tuple(labels), ~posed, solution.requested[rows], solution.commanded[rows], tools, correction),
        _straight_moves(method.pair, programs, solution),
        _other_configurations(method, rows, solution),
        tuple(refused),
        (*_notes(programs, names, frames, options), *configuration_notes(q, quarters, determined, lines)),
        written,
    )


def _surroundings(options: ProgramOptions) -> Surroundings:
    """Return what defines the programs from outside."""
    works = {name: six for name, six in options.works.items() if name}  # without the controller's base
    for name in works.keys() & options.tools.keys():
        raise InputError("given-twice", place=name, what="a tool or work object")
    frames = {name.lower(): frame_of(six) for name, six in [*options.tools.items(), *works.items()]}
    return Surroundings(frames, frozenset(name.lower() for name in options.unchanged), options.strict)


def _check_frames(programs: Sequence[Program], options: ProgramOptions) -> None:
    """Raise InputError for tools and work objects that no move needs, and names of --unchanged that no file has."""
    needed_names = {name for program in programs for name in program.needed_frames}
    for argument, names in (("tool", options.tools), ("work", options.works.keys() - {""})):
        for name in names:
            if name.lower() not in needed_names:
                reason = f"no move needs {name[:40] or 'a tool without a name'} from outside of the files"
                raise InputError("no-effect", place=Argument(argument), reason=reason)
    texts = [source.text.lower() for program in programs for source in program.files]
    for name in sorted(name for name in options.unchanged if not name.startswith("eax_")):
        if not any(name.lower() in text for text in texts):
            raise InputError("no-effect", place=Argument("unchanged"), reason=f"no file contains {name[:40]}")


def _check_moves(title: str, programs: Sequence[Program], pair: ModelPair, options: ProgramOptions) -> None:
    """Raise InputError for programs without moves, for a redundant robot, and for joint moves without an option."""
    moves = [(program, move) for program in programs for move in program.moves]
    if not moves:
        raise InputError("no-move", place=title)
    if len(pair.chain.motors) != N_JOINTS:
        raise InputError("redundant", place=title, joints=len(pair.chain.motors))
    to_joints = ((program, move) for program, move in moves if any(goal.is_joints for goal in move.goals))
    lines = list(dict.fromkeys(program.where(move.place) for program, move in to_joints))
    if lines and options.joint_moves is None:
        raise InputError("joint-moves", place=lines[0], lines=len(lines))


def _refused(programs: Sequence[Program]) -> list[dict[str, Any]]:
    """Return the moves that are not corrected, and why, as JSON."""
    refused = []
    for program in programs:
        for move, reason in ((move, move.reason) for move in program.moves):
            if reason is not None:
                source, statement = program.files[move.place.file], program.statement(move)
                shown = statement if len(statement) <= 60 else f"{statement[:57]}..."
                place = {"file": source.name, "line": source.line(move.place.offset), "statement": shown}
                refused.append({**place, "reason": reason.name, "text": reason.text(), "values": dict(reason.values)})
    return refused


# what is corrected


def _visits(programs: Sequence[Program]) -> Iterator[Visit]:
    """Yield the goals of all moves with the goals from where the robot may come."""
    for number, program in enumerate(programs):
        origins_by_move = program.origins or preceding(program.steps, lambda move: True, MOST_ORIGINS)
        for move in program.moves:
            origins: list[Goal | None] = list(_ends(origins_by_move.get(move, ())))
            for goal in move.goals:
                is_fixed = goal.near or goal.quarters or goal.is_joints
                yield from (Visit(number, move, goal, origin) for origin in (origins[:1] if is_fixed else origins))
                if goal.argument is not None:
                    origins = [goal]  # the end of a circle follows the point on it


def _ends(moves: Iterable[Move | None]) -> list[Goal | None]:
    """Return the goals at which moves may end, known ones first; None: unknown."""
    ends: dict[Goal | None, None] = {}
    for move in moves:
        goals = move.goals if move is not None else []
        is_single = all(goal.argument is not None for goal in goals)
        chosen = goals[-1:] if is_single else goals
        ends.update(dict.fromkeys(chosen if 0 < len(chosen) <= MOST_ORIGINS else [None]))
    certain_goals = [goal for goal in ends if goal is not None]
    is_uncertain = None in ends or not 0 < len(certain_goals) <= MOST_ORIGINS
    return [*certain_goals[:MOST_ORIGINS], *[None] * is_uncertain]


def _near(goal: Goal | None) -> Sequence[float] | Floats:
    """Return joint readings (6,) [rad] at or near a goal, NaN if the program gives none."""
    if goal is not None and goal.is_joints:
        return readings_of(goal.target.literal)
    return (goal and goal.near) or (np.nan,) * N_JOINTS


def _rows_of(values: Sequence[Sequence[float] | Floats], *shape: int) -> Floats:
    return np.array(values, dtype=float).reshape(-1, *shape)


def _solution(visits: Sequence[Visit], method: HowCorrected, frames: tuple[Frame, Frame]) -> Solution:
    """Correct all visits: poses nearest to where the robot comes from, joint readings near themselves."""
    goals, pair, chain = [visit.goal for visit in visits], method.pair, method.pair.chain
    rows: dict[Goal, int] = {}
    for row, goal in enumerate(goals):
        rows.setdefault(goal, row)
    n = sum(not goal.is_joints for goal in goals)
    hints = chain.completed(_rows_of([_near(goal) for goal in goals], N_JOINTS))
    base, tools = np.tile(np.eye(4), (2, len(goals), 1, 1))
    base[:n] = frames[0].pose @ _rows_of([goal.frame for goal in goals[:n]], 4, 4)
    tools[:n] = frames[1].pose @ _rows_of([goal.tool for goal in goals[:n]], 4, 4)
    requested = np.concatenate([target_poses(goals[:n]), believed(pair, hints[n:])])
    ends = base @ requested @ inverted(tools)
    quarters = np.full((len(goals), N_JOINTS), np.nan)
    quarters[:, corrected_text.CONFIGURED] = _rows_of([goal.quarters or (np.nan,) * 3 for goal in goals], 3)
    quadrants = np.full(hints.shape, np.nan)
    quadrants[:, chain.motors] = quarters
    direct: NDArray[np.bool_] = np.asarray(np.isfinite(hints).all(axis=1))
    q = inverse(chain, pair.nominal, ends[direct], hints[direct])
    direct[direct] = np.abs(q - hints[direct]).max(axis=1, initial=0.0) < NEAR
    corrections = [method.correct(ends[direct], Configuration(q_start=hints[direct]))]
    if not direct.all():
        number = np.where(direct, -1, np.cumsum(~direct) - 1)  # of a search
        origins = [visit.origin for visit, is_direct in zip(visits, direct, strict=True) if not is_direct]
        origin_rows = np.array([-1 if origin not in rows else number[rows[origin]] for origin in origins])
        q_origin = chain.completed(_rows_of([_near(origin) for origin in origins], N_JOINTS))
        q_origin = np.where(np.isnan(hints[~direct]), q_origin, hints[~direct])
        searching = Configuration(
            home=method.home, quadrants=quadrants[~direct], origins=Origins(origin_rows, q_origin)
        )
        corrections.append(method.correct(ends[~direct], searching))
    correction = _selected(joined(corrections), np.argsort(np.argsort(~direct, kind="stable")))
    commanded = inverted(base) @ correction.commanded @ tools
    determined = np.isfinite(hints).any(axis=1) | np.array([visit.origin is not None for visit in visits], dtype=bool)
    searched = np.flatnonzero(~determined)
    determined[searched] = ~several_fit(chain, pair.nominal, ends[searched], quadrants[searched])
    return Solution(visits, n, rows, correction, requested, commanded, tools, quarters, determined, chain.motors)


def _settle(censuses: Sequence[Census], solution: Solution, method: HowCorrected) -> None:
    """Refuse moves to goals that cannot be corrected, and settle which numbers change."""
    for row, visit in enumerate(solution.visits):
        reason = _reason(row, visit, censuses[visit.program].program.language, solution, method.home is not None)
        if reason is not None:
            censuses[visit.program].refuse(visit.move, reason)
    for census in censuses:
        census.settle(solution.wanted)


def _reason(row: int, visit: Visit, language: str, solution: Solution, has_home: bool) -> Reason | None:
    """Return why a goal cannot be corrected: it has no correction, or another one than on its first visit."""
    first, problem = solution.rows[visit.goal], solution.correction.problem[row]
    if visit.goal.is_joints and not visit.goal.target.literal.spans:
        return Reason("joints")
    if not solution.determined[row] and not has_home:
        return Reason("configuration")
    if problem:
        return Reason("solution", {"problem": problem})
    first_command, command = (solution.commanded[k][None] for k in (first, row))
    if row != first and np.abs(apart(first_command, command)).max() > SAME_TARGET:
        return Reason("other-configuration")
    q_nominal, q = (q[row, solution.motors] for q in (solution.correction.q_nominal, solution.correction.q))
    return None if _turns_fit(visit, language, q_nominal, q) else Reason("turns")


def _turns_fit(visit: Visit, language: str, q_nominal: Floats, q: Floats) -> bool:
    """Return whether the configuration data that no search uses agree: signs of KRL's T, turns of Fanuc's axes."""
    if visit.goal.turns is not None and visit.move.name.endswith("ptp"):
        signs = [bool(visit.goal.turns >> axis & 1) for axis in range(N_JOINTS)]
        return all((q < 0.0) == sign or abs(q) < 1e-3 for q, sign in zip(q_nominal, signs, strict=True))
    if language == "ls":
        turned = np.floor((q_nominal + np.pi) / (2.0 * np.pi)) != np.floor((q + np.pi) / (2.0 * np.pi))
        return not turned[list(corrected_text.CONFIGURED)].any()
    return True


# what was corrected


def _corrected_rows(censuses: Sequence[Census], solution: Solution, joints: bool) -> dict[tuple[int, Place], int]:
    """Return the row of each place of a program whose numbers change, in the order of the text."""
    due = [
        (number, corrected_text.due_numbers(census, solution.wanted, joints)) for number, census in enumerate(censuses)
    ]
    rows = {(number, place): solution.rows[goal] for number, places in due for place, (goal, *_) in places.items()}
    return dict(sorted(rows.items()))


def _label(programs: Sequence[Program], number: int, place: Place) -> str:
    """Return "line 12", or "line part.mod:12" among several files."""
    source = programs[number].files[place.file]
    name = f"{source.name}:" if len(programs) > 1 or len(programs[number].files) > 1 else ""
    return f"line {name}{source.line(place.offset)}"


def _straight_moves(pair: ModelPair, programs: Sequence[Program], solution: Solution) -> CorrectedMoves:
    """Simulate the straight moves between corrected targets, from origins at which the joint readings are known."""
    visits = enumerate(solution.visits[: solution.n_poses])
    straight = [(row, visit) for row, visit in visits if visit.move.straight and visit.move.reason is None]
    # What was refused stands as it was, so the arm drives there as before the correction.
    q = {goal: np.where(np.isnan(ends.after), ends.before, ends.after) for goal, ends in solution.joints.items()}
    lost = {goal for goal, readings in q.items() if np.isnan(readings).any()}
    moves = [(row, visit, visit.origin) for row, visit in straight if visit.origin and visit.origin not in lost]
    if not moves or len(moves) > MOST_MOVES:
        return CorrectedMoves(unchecked=len(straight))
    rows = [row for row, *_ in moves]
    starts = np.array([q[origin] if origin in q else readings_of(origin.target.literal) for *_, origin in moves])
    simulated = straight_moves(
        pair, pair.chain.completed(starts), solution.correction.commanded[rows], solution.tools[rows]
    )
    ends = tuple(_label(programs, visit.program, visit.move.place) for _, visit, _ in moves)
    begins = tuple(_label(programs, visit.program, origin.target.literal.place) for _, visit, origin in moves)
    return CorrectedMoves(ends, begins, simulated, len(straight) - len(moves))


def _other_configurations(
    method: HowCorrected, rows: NDArray[np.int_], solution: Solution
) -> OtherConfigurations | None:
    """Correct the first targets whose configuration only ``home`` determines in all configurations of the arm."""
    pair = method.pair
    compared = rows[~solution.determined[rows]][:MOST_COMPARED]
    if method.home is None or not compared.size:
        return None
    ends = believed(pair, solution.correction.q_nominal[compared])
    stock = solutions(pair.chain, pair.nominal, ends, oriented=True)
    target, k = np.nonzero(within(pair.chain, stock))
    done = method.correct(ends[target], Configuration(q_start=stock[target, k]))
    shift = (done.commanded - solution.correction.commanded[compared[target]])[:, :3, 3]
    return OtherConfigurations(len(compared), np.linalg.norm(shift, axis=1), done.q, solution.tools[compared[target]])


def _notes(
    programs: Sequence[Program], names: CalibrationFrames, frames: tuple[Frame, Frame], options: ProgramOptions
) -> Iterator[Finding]:
    """Yield remarks about frames, routines outside of the files, and moves that are kept."""
    base, flange = frames
    yield Finding("controller-frames", {"base": base.called(names.base), "flange": flange.called(names.end)})
    absent = list(dict.fromkeys(name for program in programs for name in program.absent))
    if absent and not options.strict:
        yield Finding("routines-absent", {"names": absent})
    moves = [move for program in programs for move in program.moves if move.reason is None]
    n_readings = sum(goal.is_joints for move in moves for goal in move.goals)
    if n_readings and options.joint_moves is not JointMoves.CORRECT:
        yield Finding("joint-moves-kept", {"n": n_readings})
    if texts := [program.where(place) for program in programs for place in program.texts]:
        yield Finding("moves-in-texts", {"n": len(texts), "place": texts[0]})


def _written(
    censuses: Sequence[Census], solution: Solution, language: ProgramLanguage, options: ProgramOptions, simulated: bool
) -> dict[str, bytes]:
    """Return the corrected files, read again and compared. Raises InputError for a fault in them."""
    files: dict[str, bytes] = {}
    change = solution.wanted, solution.joints, options.joint_moves is JointMoves.CORRECT
    for census in censuses:
        changes = corrected_text.changes_of(census, *change) + (
            corrected_text.marks_of(census.program) if options.mark else []
        )
        changes += corrected_text.remarks_of(census.program, changes, Finding("simulated").text()) if simulated else []
        names = [source.name for source in census.program.files]
        files |= zip(names, corrected_text.changed_files(census.program, changes), strict=True)
    again = read_programs(language, [Source(name, data) for name, data in files.items()], _surroundings(options))
    faults = ["the corrected files are other programs"] * (len(again) != len(censuses))
    faults += [difference(census.program, program, *change) for census, program in zip(censuses, again, strict=False)]
    for fault in filter(None, faults):
        raise InputError("reread", reason=fault)
    return files


def _selected(done: Correction, rows: NDArray[np.int_]) -> Correction:
    """Return a selection of corrected targets."""
    columns = {name: getattr(done, name)[rows] for name in ("q_nominal", "q", "commanded", "before", "after")}
    return Correction(**columns, problem=tuple(done.problem[row] for row in rows.tolist()))


# frames


def _controller_frames(
    language: ProgramLanguage, names: CalibrationFrames, options: ProgramOptions, pair: ModelPair
) -> tuple[Frame, Frame]:
    """Return the controller's base and flange in the frames of the calibration.

    Raises InputError if they are not specified.

    Without its mountings a robot still has the frames of its description. They are the controller's, whatever their
    names, only if it is no URDF.
    """
    q = np.zeros((1, len(pair.chain.joints)))
    axis = believed(pair, q)[0, :3, :3].T @ joint_jacobian(pair.chain, pair.nominal, q)[0, 3:, -1]  # in the end frame
    robot_frame = SAME if names.own_frames and names.brought else None
    tool0 = None if names.tool0 is None else Frame(names.tool0, "tool0 (as in the URDF)")
    base = _given(options.works.get("")) or base_of(language, names.base) or robot_frame
    flange = _given(options.flange) or tool0 or flange_of(language, names.end, names.brought, axis) or robot_frame
    if base is not None and flange is not None:
        return base, flange
    noun, name, argument = ("base", names.base, "work") if base is None else ("flange", names.end, "flange")
    raise InputError("frame", frame=name[:60], what=noun, argument=Argument(argument), may_use_own=names.brought)


def _given(six: Six | None) -> Frame | None:
    return None if six is None else Frame(frame_of(six), "as given")
