"""Correct the programs of a robot: every move to a target, or none of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.correct.controller_frames import SAME, Frame, base_of, flange_of
from truearm.correct.correction import Configuration, Correction, at_tools, correct, joined
from truearm.correct.inverse import Origins, several_fit, solutions, within
from truearm.correct.joint_moves import JointMoves
from truearm.correct.methods import Method
from truearm.correct.model_pair import ModelPair, believed
from truearm.correct.programs.census import Census
from truearm.correct.programs.corrected_text import CONFIGURED, Joints, changed_files, changes_of, marks_of
from truearm.correct.programs.languages import ProgramLanguage, read_programs
from truearm.correct.programs.order import preceding
from truearm.correct.programs.poses import readings_of
from truearm.correct.programs.program import Goal, Move, Place, Program, Surroundings
from truearm.correct.programs.reasons import reason_text, remedy_of
from truearm.correct.programs.reread import difference, target_poses
from truearm.correct.programs.tokens import Source
from truearm.correct.straight_moves import straight_moves
from truearm.errors import Argument
from truearm.findings import Finding, FindingError
from truearm.model.chain import joint_jacobian
from truearm.model.poses import Six, apart, frame_of, inverted
from truearm.text import counted, listed
from truearm.types import Floats
from truearm.units import MM
from truearm.workflows.configuration_notes import configuration_notes
from truearm.workflows.correction_findings import CorrectedMoves, CorrectedTargets, Refused
from truearm.workflows.given_tools import check_mentioned, check_names

N_JOINTS = 6  # of a robot that a pose in a program determines
SAME_TARGET = 1e-6  # m, rad between corrections of one target: below a controller's resolution
NEAR = 0.3  # rad, m from a program's joints to those of the target; if farther, the joints are searched for
MOST_MOVES = 20_000  # straight moves that are simulated: about 0.14 ms each
MOST_GOALS = 100_000  # of all moves
MOST_COMPARED = 20  # targets whose correction is computed in all configurations of the arm
MOST_ORIGINS = 4  # from which a move may come; more count as unknown


class ProgramOptions(NamedTuple):
    """How to correct programs.

    ``joint_moves``: what to do with moves to joint readings, None to refuse programs with any. ``partial``: correct the
    other moves if some cannot be corrected; ``mark`` marks these with a comment. ``strict``: routines in none of the
    files may displace the program and change data. ``base``: the controller's base in the calibration's base frame, and
    ``flange``: its flange in the calibration's end frame, if their names do not show this. ``tool``: the tool in force
    before a URScript sets one. ``tools`` and ``works``: those declared elsewhere, by name in lower case. Poses are
    positions [m] and rotation vectors [rad]. ``unchanged``: names that nothing outside the files changes.
    """

    joint_moves: JointMoves | None = None
    partial: bool = False
    mark: bool = False
    strict: bool = False
    base: Six | None = None
    flange: Six | None = None
    tool: Six | None = None
    tools: Mapping[str, Six] = {}
    works: Mapping[str, Six] = {}
    unchanged: frozenset[str] = frozenset()


class ProgramRefused(FindingError):
    """Programs with moves that cannot be corrected with certainty; ``refused`` names them."""

    def __init__(self, text: Sequence[str], refused: Sequence[Refused]) -> None:
        super().__init__(Finding("uncertain-moves", {"refused": len(refused)}), *text)
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
            self.pair, ends, self.method, self.steps, oriented=oriented, configuration=configuration, margin=self.margin
        )


class Corrected(NamedTuple):
    """Corrected targets and straight moves, with the text of a table or the program files by name.

    ``refused``: what was left unchanged; ``notes``: remarks.
    """

    targets: CorrectedTargets
    moves: CorrectedMoves = CorrectedMoves()
    refused: tuple[Refused, ...] = ()
    notes: tuple[str, ...] = ()
    table: str = ""
    programs: Mapping[str, bytes] = {}


@dataclass(frozen=True, eq=False)
class Visit:
    """A goal of a move that comes from ``origin``, None if that is unknown."""

    program: Program
    move: Move
    goal: Goal
    origin: Goal | None


def correct_program(
    files: Mapping[str, bytes],
    language: ProgramLanguage,
    how: HowCorrected,
    names: CalibrationFrames,
    options: ProgramOptions,
) -> Corrected:
    """Correct the program files of one robot, by name.

    Raises ProgramRefused if a move cannot be corrected, FindingError if the files are no valid program.
    """
    surroundings = _surroundings(files, language, options)
    sources = [Source(name, data) for name, data in files.items()]
    programs = read_programs(language, sources, surroundings)
    moves = [move for program in programs for move in program.moves]
    title = next(iter(files)) if len(files) == 1 else counted(len(files), "program file")
    _check_moves(title, programs, moves, how.pair, options)
    check_mentioned(title, language, programs, options.tools, options.works)
    base, flange = _placed(language, names, options, _last_axis(how.pair))
    work = _Work(programs, how, base.pose, flange.pose, options.joint_moves is JointMoves.CORRECT)
    work.solve()
    refused = _refused(programs)
    if refused and not options.partial:
        raise ProgramRefused(_refusal(title, len(moves), refused), refused)
    if not work.targets.places:
        raise ProgramRefused((f"{title}: no move can be corrected, so nothing was written",), refused)
    written = work.written(language, surroundings, options.mark)
    absent = list(dict.fromkeys(name for program in programs for name in program.absent))
    n_kept = sum(goal.target.literal.form.is_joints for move in moves if move.reason is None for goal in move.goals)
    notes = [f"The controller's base is {base.called(names.base)}. Its flange is {flange.called(names.end)}."]
    if absent and not options.strict:
        notes.append(
            f"None of the files defines {listed(absent)}: taken not to displace the program and not to change its data."
        )
    if n_kept and not work.joints_change:
        notes.append(f"{counted(n_kept, 'move')} to joint values kept as {'it is' if n_kept == 1 else 'they are'}.")
    return Corrected(work.targets, work.moves, tuple(refused), (*notes, *work.notes), programs=written)


def _surroundings(files: Mapping[str, bytes], language: ProgramLanguage, options: ProgramOptions) -> Surroundings:
    """Return what defines the programs from outside. Raises FindingError for tools that the language cannot use."""
    check_names(next(iter(files)), language, options.tool, options.tools, options.works)
    frames = {name.lower(): frame_of(six) for name, six in [*options.tools.items(), *options.works.items()]}
    tool = None if options.tool is None else frame_of(options.tool)
    unchanged = frozenset(name.lower() for name in options.unchanged)
    return Surroundings(tool, frames, unchanged, options.strict)


def _check_moves(
    title: str, programs: Sequence[Program], moves: Sequence[Move], pair: ModelPair, options: ProgramOptions
) -> None:
    """Raise FindingError for programs without moves, for a redundant robot, and for joint moves without an option."""
    if not moves:
        raise FindingError(Finding("no-move"), f"{title}: contains no move; there is nothing to correct")
    n_goals = sum(len(move.goals) for move in moves)
    if n_goals > MOST_GOALS:
        raise FindingError(
            Finding("many-targets"), f"{title}: has {n_goals} targets, the maximum is {MOST_GOALS}; give fewer files"
        )
    n_joints = len(pair.chain.joints)
    if n_joints != N_JOINTS:
        raise FindingError(
            Finding("redundant", {"joints": n_joints}),
            f"{title}: its targets have {N_JOINTS} coordinates, which do not determine the {n_joints} joints of the robot; "
            "correct a table of targets with joints (q1_deg, q2_deg, …)",
        )
    lines = {
        program.where(move.place): None
        for program in programs
        for move in program.moves
        if any(goal.target.literal.form.is_joints for goal in move.goals)
    }
    if lines and options.joint_moves is None:
        raise FindingError(
            Finding("joint-moves", {"lines": len(lines)}),
            f"{next(iter(lines))}: the program moves to joint values, in {counted(len(lines), 'line')}; to keep or to correct these, give ",
            Argument("joint_moves"),
            " keep or correct",
        )


def _refused(programs: Sequence[Program]) -> list[Refused]:
    """Return the moves that are not corrected."""
    return [
        Refused(
            program.files[move.place.file].name,
            program.files[move.place.file].line(move.place.offset),
            _shortened(program.statement(move)),
            move.reason.code,
            reason_text(move.reason),
            remedy_of(move.reason),
        )
        for program in programs
        for move in program.moves
        if move.reason is not None
    ]


def _shortened(statement: str) -> str:
    return statement if len(statement) <= 60 else f"{statement[:57]}..."


def _refusal(title: str, n_moves: int, refused: Sequence[Refused]) -> tuple[str, ...]:
    """Return the message for programs of which nothing was written."""
    n_good = n_moves - len(refused)
    others = "the other one" if len(refused) == 1 else f"the other {len(refused)}"
    if not n_good:
        return (f"{title}: none of {counted(n_moves, 'move')} can be corrected, so nothing was written",)
    counts = f"{title}: {n_good} of {counted(n_moves, 'move')} can be corrected; {others} cannot, so nothing was written; change them as their reasons say, or correct the {n_good} alone with "
    return counts, Argument("partial")


@dataclass(eq=False)
class _Work:
    """The correction of programs: what each goal needs, what was settled, and what is expected of it.

    ``base`` and ``flange`` (4, 4): the controller's frames in those of the calibration. ``rows``: the row in ``done`` of
    each goal's first visit.
    """

    programs: Sequence[Program]
    how: HowCorrected
    base: Floats
    flange: Floats
    joints_change: bool
    censuses: list[Census] = field(default_factory=list)
    visits: list[tuple[Visit, int]] = field(default_factory=list)
    goals: list[Goal] = field(default_factory=list)
    rows: dict[Goal, int] = field(default_factory=dict)
    wanted: dict[Goal, Floats] = field(default_factory=dict)
    joints: dict[Goal, Joints] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    moves: CorrectedMoves = field(default_factory=CorrectedMoves)

    def solve(self) -> None:
        """Correct all goals, and settle which numbers change."""
        self.censuses = [Census(program, self.joints_change) for program in self.programs]
        for census in self.censuses:
            self.refuse_computed_joints(census)
        visits = self.unique_visits()
        goals = self.goals[: len(visits)]
        self.asked = target_poses(goals)
        frames, tools = (_stacked([getattr(goal, name) for goal in goals]) for name in ("frame", "tool"))
        ends = self.base @ frames @ self.asked @ inverted(tools) @ inverted(self.flange)
        near, quarters = _near(goals), _quarters(goals)
        determined = self.determined(visits, ends, near, quarters)
        done = self.corrected_poses(visits, ends, near, quarters)
        told = inverted(frames) @ inverted(self.base) @ done.commanded @ self.flange @ tools
        self.done = joined([done, self.corrected_joints()])
        self.tools = np.concatenate([self.flange @ tools, np.tile(np.eye(4), (len(self.goals) - len(goals), 1, 1))])
        for goal, row in self.rows.items():
            self.joints[goal] = Joints(self.done.q_nominal[row], self.done.q[row])
            if row < len(goals):
                self.wanted[goal] = told[row]
        self.refuse_unsolved(told, determined)
        for census in self.censuses:
            census.settle(self.wanted)
        self.describe(quarters, determined)

    def unique_visits(self) -> list[Visit]:
        """Return the different visits of poses. The rows of joint readings that change follow theirs.

        Visits of one target from one target have one row, however often the program goes there.
        """
        every = [visit for program in self.programs for visit in _visits(program)]
        kinds: dict[Goal | None, object] = {None: None}
        for visit in every:
            kinds.setdefault(visit.goal, _kind(visit.goal))
        rows: dict[object, int] = {}
        unique: list[Visit] = []
        posed = [visit for visit in every if not visit.goal.target.literal.form.is_joints]
        for visit in posed:
            row = rows.setdefault((kinds[visit.goal], kinds.get(visit.origin)), len(unique))
            if row == len(unique):
                unique.append(visit)
            self.visits.append((visit, row))
        self.goals = [visit.goal for visit in unique]
        for visit in every if self.joints_change else ():
            if visit.goal.target.literal.form.is_joints:
                row = rows.setdefault(kinds[visit.goal], len(self.goals))
                if row == len(self.goals):
                    self.goals.append(visit.goal)
                self.visits.append((visit, row))
        for visit, row in self.visits:
            self.rows.setdefault(visit.goal, row)
        return unique

    def refuse_computed_joints(self, census: Census) -> None:
        """Refuse moves to joint readings that should change and are not written as numbers."""
        for move in census.program.moves if self.joints_change else ():
            if any(g.target.literal.form.is_joints and not g.target.literal.spans for g in move.goals):
                census.refuse(move, Finding("joints"))

    def determined(self, posed: Sequence[Visit], ends: Floats, near: Floats, quarters: Floats) -> NDArray[np.bool_]:
        """Return for which visits (n,) the program determines the arm's configuration.

        It does by joints, by the move before, or by quarter turns or joint limits that only one configuration fits.
        """
        determined = np.isfinite(near).any(axis=1) | np.array([v.origin is not None for v in posed], dtype=bool)
        searched = np.flatnonzero(~determined)
        if searched.size:
            pair = self.how.pair
            determined[searched] = ~several_fit(pair.chain, pair.nominal, ends[searched], quarters[searched])
        return determined

    def corrected_poses(self, posed: Sequence[Visit], ends: Floats, near: Floats, quarters: Floats) -> Correction:
        """Correct poses: those with joints nearby from these, the others by a search from where the robot comes from."""
        is_near: NDArray[np.bool_] = np.asarray(np.isfinite(near).all(axis=1))
        at_near = self.corrected(ends[is_near], Configuration(q_start=near[is_near]))
        far = np.abs(at_near.q_nominal - near[is_near]).max(axis=1, initial=0.0) > NEAR
        by_near = np.array(is_near)
        by_near[np.flatnonzero(is_near)[far]] = False  # descent from so far may end in another configuration
        at_near = _selected(at_near, np.flatnonzero(~far))
        place = np.where(by_near, np.cumsum(by_near), np.cumsum(~by_near)) - 1
        origins = Origins(np.full(len(ends), -1), near.copy())
        for row, visit in enumerate(posed):
            origin = visit.origin
            if is_near[row] or origin is None:
                continue
            if origin.target.literal.form.is_joints:
                origins.q[row] = readings_of(origin.target.literal)
            elif (before := self.rows.get(origin)) is not None and before < len(posed):
                if by_near[before]:
                    origins.q[row] = at_near.q_nominal[place[before]]
                else:
                    origins.target[row] = place[before]
        others = Origins(origins.target[~by_near], origins.q[~by_near])
        by_search = self.corrected(
            ends[~by_near], Configuration(home=self.how.home, quadrants=quarters[~by_near], origins=others)
        )
        order = np.concatenate([np.flatnonzero(by_near), np.flatnonzero(~by_near)])
        return _selected(joined([at_near, by_search]), np.argsort(order))

    def corrected_joints(self) -> Correction:
        """Correct joint readings: the true robot shall be where a perfect robot would be with them."""
        literals = [goal.target.literal for goal in self.goals if goal.target.literal.form.is_joints]
        q = np.array([readings_of(literal) for literal in literals]).reshape(-1, N_JOINTS)
        return self.corrected(believed(self.how.pair, q), Configuration(q_start=q))

    def corrected(self, ends: Floats, configuration: Configuration) -> Correction:
        """Correct poses (n, 4, 4) of the end, which may be none."""
        if len(ends):
            return self.how.correct(ends, configuration)
        q, errors = np.zeros((0, N_JOINTS)), np.zeros((0, 2))
        return Correction(q, q, np.zeros((0, 4, 4)), errors, errors, ())

    def refuse_unsolved(self, told: Floats, determined: NDArray[np.bool_]) -> None:
        """Refuse moves with a goal that cannot be corrected, or needs different numbers on different visits."""
        census_of = {id(census.program): census for census in self.censuses}
        for visit, row in self.visits:
            problem, first = self.done.problem[row], self.rows[visit.goal]
            finding = None
            if row < len(determined) and not determined[row] and self.how.home is None:
                finding = Finding("configuration")
            elif problem:
                finding = Finding("solution", {"problem": problem})
            elif row != first and np.abs(apart(told[first][None], told[row][None])).max() > SAME_TARGET:
                finding = Finding("other-configuration")
            elif not _turns_fit(visit, self.done.q_nominal[row], self.done.q[row]):
                finding = Finding("turns")
            if finding is not None:
                census_of[id(visit.program)].refuse(visit.move, finding)

    # what was settled

    def describe(self, quarters: Floats, determined: NDArray[np.bool_]) -> None:
        """Describe the corrected targets and straight moves."""
        places: dict[tuple[int, Place], tuple[str, int]] = {}
        for number, census in enumerate(self.censuses):
            for move, goal in _corrected_goals(census, self.joints_change):
                is_own = move in census.own and goal.argument is not None
                place = (
                    Place(move.place.file, goal.argument[0]) if is_own and goal.argument else goal.target.literal.place
                )
                settled = census.poses.get(place)
                row = self.rows[settled[0] if settled and not is_own else goal]
                places.setdefault((number, place), (self.label(census.program, place), row))
        labels, rows = [label for label, _ in places.values()], np.array([row for _, row in places.values()], dtype=int)
        n_posed = len(determined)
        told = np.array([self.wanted.get(self.goals[row], np.eye(4)) for row in rows]).reshape(-1, 4, 4)
        by_joints = rows >= n_posed
        asked = np.concatenate([self.asked, believed(self.how.pair, self.done.q_nominal[n_posed:])])[rows]
        told[by_joints] = self.done.commanded[rows[by_joints]]
        correction = at_tools(self.how.pair, _selected(self.done, rows), self.tools[rows])
        self.targets = CorrectedTargets(tuple(labels), by_joints, asked, told, self.tools[rows], correction)
        self.moves = self.straight_moves()
        posed = rows[~by_joints]
        numbers = [
            label.removeprefix("line ") for label, is_joint in zip(labels, by_joints, strict=True) if not is_joint
        ]
        open_rows = posed[~determined[posed]]
        if self.how.home is not None and open_rows.size:
            self.notes.append(self.configuration_spread(open_rows[:MOST_COMPARED]))
        self.notes += configuration_notes(self.done.q_nominal[posed], quarters[posed], determined[posed], numbers)

    def configuration_spread(self, rows: NDArray[np.int_]) -> str:
        """Return how far apart [mm] the corrections of targets are in the arm's configurations."""
        pair, spread = self.how.pair, 0.0
        ends = believed(pair, self.done.q_nominal[rows])
        stock = solutions(pair.chain, pair.nominal, ends, oriented=True)
        for end, row, q, is_reached in zip(ends, rows, stock.q, stock.reached, strict=True):
            q_start = q[is_reached & within(pair.chain, q)]
            other = self.corrected(np.broadcast_to(end, (len(q_start), 4, 4)), Configuration(q_start=q_start))
            distances = np.linalg.norm((other.commanded - self.done.commanded[row])[:, :3, 3], axis=1)
            spread = max(spread, float(distances.max(initial=0.0)))
        return f"Only the joints near the first target determine the configuration; in the arm's other ones the corrections would differ by up to {MM.text(spread, '.3f')}."

    def label(self, program: Program, place: Place) -> str:
        """Return "line 12", or "line part.mod:12" among several files."""
        source = program.files[place.file]
        several = len(self.programs) > 1 or len(program.files) > 1
        return f"line {source.name}:{source.line(place.offset)}" if several else f"line {source.line(place.offset)}"

    def straight_moves(self) -> CorrectedMoves:
        """Simulate the straight moves between corrected targets."""
        starts: list[Floats] = []
        rows: list[int] = []
        labels: list[tuple[str, str]] = []
        unchecked = 0
        for visit, row in self.visits:
            if not visit.move.straight or visit.move.reason is not None or row >= len(self.asked):
                continue
            origin = visit.origin
            if origin is None or (origin not in self.rows and not origin.target.literal.form.is_joints):
                unchecked += 1
                continue
            place = origin.target.literal.place
            starts.append(self.done.q[self.rows[origin]] if origin in self.rows else readings_of(origin.target.literal))
            rows.append(row)
            labels.append((self.label(visit.program, visit.move.place), self.label(visit.program, place)))
        if not rows or len(rows) > MOST_MOVES:
            return CorrectedMoves(unchecked=unchecked + len(rows))
        found = straight_moves(self.how.pair, np.array(starts), self.done.commanded[rows], self.tools[rows])
        return CorrectedMoves(tuple(end for end, _ in labels), tuple(start for _, start in labels), found, unchecked)

    def written(self, language: ProgramLanguage, surroundings: Surroundings, mark: bool) -> dict[str, bytes]:
        """Return the corrected files, read again and compared. Raises FindingError for a fault in them."""
        files: dict[str, bytes] = {}
        for census in self.censuses:
            changes = changes_of(census, self.wanted, self.joints, self.joints_change)
            changes += marks_of(census.program) if mark else []
            names = [source.name for source in census.program.files]
            files |= zip(names, changed_files(census.program, changes), strict=True)
        again = read_programs(language, [Source(name, data) for name, data in files.items()], surroundings)
        faults = ["the corrected files are other programs"] * (len(again) != len(self.programs))
        for census, program in zip(self.censuses, again, strict=False):
            faults.append(difference(census.program, program, self.wanted, self.joints, self.joints_change))
        if any(faults):
            fault = next(filter(None, faults))
            raise FindingError(
                Finding("reread"),
                f"{fault}, so nothing was written; this is a fault in truearm: report it with this program",
            )
        return files


def _visits(program: Program) -> Iterator[Visit]:
    """Yield the goals of all moves with the goals from where the robot may come."""
    before = preceding(program.steps, lambda move: True, MOST_ORIGINS)
    for move in program.moves:
        origins: list[Goal | None] = list(_ends(before.get(move, ())))
        for goal in move.goals:
            is_fixed = goal.near or goal.quarters or goal.target.literal.form.is_joints
            chosen = origins[:1] if is_fixed else origins
            for origin in chosen:
                yield Visit(program, move, goal, origin)
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
    return sorted(ends, key=lambda goal: goal is None)[: MOST_ORIGINS + 1] or [None]


def _kind(goal: Goal) -> object:
    """Return what two goals with equal corrections have in common."""
    target = goal.target
    frames = (pose.tobytes() for pose in (target.left, target.right, goal.tool, goal.frame))
    return id(target.literal), *frames, goal.near, goal.quarters


def _corrected_goals(census: Census, joints_change: bool) -> Iterator[tuple[Move, Goal]]:
    """Yield the goals whose numbers change, with their moves."""
    for move in census.program.moves:
        for goal in move.goals if move.reason is None else ():
            if joints_change or not goal.target.literal.form.is_joints:
                yield move, goal


def _turns_fit(visit: Visit, before: Floats, after: Floats) -> bool:
    """Return whether the configuration data that no search uses agree: the signs of KRL's T, the turns of Fanuc's axes."""
    if visit.goal.turns is not None and visit.move.name.endswith("ptp"):
        signs = [bool(visit.goal.turns >> axis & 1) for axis in range(N_JOINTS)]
        return all((q < 0.0) == sign or abs(q) < 1e-3 for q, sign in zip(before, signs, strict=True))
    if visit.program.language == "ls":
        turned = np.floor((before + np.pi) / (2.0 * np.pi)) != np.floor((after + np.pi) / (2.0 * np.pi))
        return not turned[list(CONFIGURED)].any()
    return True


def _near(goals: Sequence[Goal]) -> Floats:
    """Return joint readings (n, 6) [rad] near those of goals, NaN if the program gives none."""
    return np.array([goal.near or (np.nan,) * N_JOINTS for goal in goals]).reshape(-1, N_JOINTS)


def _quarters(goals: Sequence[Goal]) -> Floats:
    """Return the quarter turns (n, 6) of axes 1, 4 and 6 that goals ask for, NaN elsewhere."""
    quarters = np.full((len(goals), N_JOINTS), np.nan)
    quarters[:, CONFIGURED] = np.array([goal.quarters or (np.nan,) * 3 for goal in goals]).reshape(-1, 3)
    return quarters


def _stacked(poses: Sequence[Floats]) -> Floats:
    return np.array(poses).reshape(-1, 4, 4)


def _selected(done: Correction, rows: Sequence[int] | NDArray[np.int_]) -> Correction:
    """Return a selection of corrected targets."""
    index = np.asarray(rows, dtype=int)
    arrays = (done.q_nominal, done.q, done.commanded, done.before, done.after)
    q_nominal, q, commanded, before, after = (array[index] for array in arrays)
    problems = tuple(done.problem[row] for row in index.tolist())
    return Correction(q_nominal, q, commanded, before, after, problems)


def _last_axis(pair: ModelPair) -> Floats:
    """Return the last joint's axis (3,) in the end frame of the robot as described."""
    q = np.zeros((1, len(pair.chain.joints)))
    pose, turn = believed(pair, q)[0], joint_jacobian(pair.chain, pair.nominal, q)[0, 3:, -1]
    return np.asarray(pose[:3, :3].T @ turn)


def _placed(
    language: ProgramLanguage, names: CalibrationFrames, options: ProgramOptions, axis: Floats
) -> tuple[Frame, Frame]:
    """Return the controller's base and flange in the calibration's frames. Raises FindingError if they are not
    specified.

    Without its mountings a robot still has the frames of its description. They are the controller's, whatever their
    names, only if it is no URDF.
    """
    other = SAME if names.own and names.brought else None
    base = _given(options.base) or base_of(language, names.base, names.brought) or other
    flange = _given(options.flange) or _described(names) or flange_of(language, names.end, names.brought, axis) or other
    for frame, what, name, argument in ((base, "base", names.base, "work"), (flange, "flange", names.end, "flange")):
        if frame is None:
            same = " X,Y,Z,RX,RY,RZ, or as 0,0,0,0,0,0 if the two frames are the same"
            wrong = f"the calibration uses frame {name[:60]}; the pose of the controller's {what} in this frame is not known; give it as "
            own = (f"{same}, or use the robot's own frames with ", Argument("own_frames")) if names.brought else (same,)
            raise FindingError(Finding("frame", {"frame": name}), wrong, Argument(argument), *own)
    assert base is not None
    assert flange is not None
    return base, flange


def _described(names: CalibrationFrames) -> Frame | None:
    return None if names.tool0 is None else Frame(names.tool0, "tool0 (as in the URDF)")


def _given(six: Six | None) -> Frame | None:
    return None if six is None else Frame(frame_of(six), "as given")
