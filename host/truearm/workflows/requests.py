"""What commands take: their options in SI units, declared once. ``truearm.cli.command`` makes options of the fields.

``--help`` reads this, so it imports nothing slow.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from truearm import option_defaults
from truearm.bounds import CELL, DURATION, ITERATIONS, REPEATABILITY, SEED, OneOf, Within
from truearm.correct.methods import JointMoves, Method
from truearm.estimate.solvers import SOLVERS, LawMode, Loss, Prior
from truearm.export.formats import FORMATS
from truearm.model.robot_file import NO_ROBOT, RobotChoice

if TYPE_CHECKING:
    from truearm.model.robot import Branch
    from truearm.model.transforms import Six
    from truearm.types import Payload

PUMA = RobotChoice("puma560")
NO_FRAME: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
FAST_RATE_HZ = 500.0  # of what simulate records in virtual time


@dataclass(frozen=True)
class FitOptions:
    """How to identify, as the command line describes it; ``truearm.IdentifyOptions`` has it for Python.

    Options
    -------
    apply : mean|NAME[@FIRST[:LAST]]
        Put a fault into the result that the output names: mean, the mean of its possible causes, or one of them, such
        as bar.bar46.zero, chuck.c2@183 (from row 183 on, counted from 1 over all inputs), joint2@91:270,
        bar.bar46.zero.drift or .thermal_drift, joint1.backlash or .settling (repeatable).
    leave_out : ROWS
        Rows to leave out completely: 120:140, counted from 1 over all inputs, or a row as messages name it, such as
        'poses.csv row 100' (repeatable).

    Expert options
    --------------
    fit_only : GROUP
        Fit only these rows, such as place=front (repeatable). All others are held out.
    free : PATTERN
        Identify only parameters that match, such as 'joint*.offset' (repeatable); '*': also those that the robot file
        fixes.
    also_free : PATTERN
        Identify these too, in addition to those that the robot file frees: '*.gain,link3.y' (repeatable).
    freeze : PATTERN
        Hold parameters that match at their nominal values (repeatable).
    prior
        Prior about the nominal values. weak: sigma of {weak}. wide: {wide}. where-needed: like weak, but for weakly
        identifiable parameters only. Default for a URDF: weak. Default for other robots: where-needed; wide with
        --solver map, none with renders-1991. The solver ls uses no prior.
    solver
        {solvers}.
    loss
        huber and cauchy tolerate outliers; for the solvers {lossy}.
    joint_laws
        Joint laws to fit: curve (error curves), sag, or auto (both, if geometry and declared noise do not explain the
        residuals). A law is kept only if the rows give evidence for it. none: geometry alone.
    max_iterations : N
        Stop after N iterations, converged or not.
    """

    free: tuple[str, ...] = ()
    also_free: tuple[str, ...] = ()
    freeze: tuple[str, ...] = ()
    prior: Annotated[str | None, OneOf(tuple(Prior))] = None
    solver: Annotated[str, OneOf(SOLVERS)] = option_defaults.SOLVER
    loss: Annotated[str, OneOf(tuple(Loss))] = option_defaults.LOSS
    max_iterations: Annotated[int, ITERATIONS] = option_defaults.MAX_ITERATIONS
    seed: Annotated[int, SEED] = option_defaults.SEED
    apply: tuple[str, ...] = ()
    leave_out: tuple[str, ...] = ()
    fit_only: tuple[str, ...] = ()
    joint_laws: Annotated[str, OneOf(tuple(LawMode))] = option_defaults.JOINT_LAWS


@dataclass(frozen=True)
class PlanFiles:
    """Inputs of a plan, and the files to write.

    ``result``: an earlier result.json, with a model that replaces the design. ``measured``: sessions and tables that
    count as already measured. ``branch``: None for the robot file's. Programs are written for the controllers
    identified by their suffixes. ``output_line`` and ``input_line`` of the controller connect robot and box.
    """

    robot: RobotChoice
    rig: Path
    result: Path | None = None
    measured: tuple[Path, ...] = ()
    branch: Branch | None = None
    out: Path | None = None
    rig_out: Path | None = None
    program_out: tuple[Path, ...] = ()
    output_line: Annotated[int, Within(0)] = 0
    input_line: Annotated[int | None, Within(0)] = None
    force: bool = False

    @property
    def outputs(self) -> list[Path]:
        """Every file to write."""
        return [path for path in (self.out, self.rig_out, *self.program_out) if path is not None]


@dataclass(frozen=True)
class FirstRig:
    """A project's first rig: its chucks and spheres, its bars' lengths [m], what measures them (None: not asked)."""

    chucks: Annotated[int, Within(1, 9)] = 3  # more than a table or a flange has room for
    spheres: Annotated[int, Within(1, 9)] = 3
    lengths: tuple[float, ...] = ()
    measured_with: Annotated[str | None, OneOf((option_defaults.NOTHING, *option_defaults.INSTRUMENTS))] = None


@dataclass(frozen=True)
class SocketSeats:
    """Seats in printed sockets to plan [m]: the ball's diameter, its centre on the end, the table's z in the base."""

    ball: Annotated[float, Within(0.004, 0.1)] = 0.02
    ball_xyz: tuple[float, float, float] = (0.0, 0.0, 0.1)
    table: Annotated[float, Within(-5.0, 5.0)] = 0.0
    places: Annotated[int, Within(2, 20)] = 6
    seats: Annotated[int, Within(4, 100)] = 12  # at each place


@dataclass(frozen=True)
class TruthOptions:
    """How the true robot differs from its design.

    ``tolerance``: standard deviations of lengths [m] and angles [rad]; None: the simulator's, or those measured
    according to the robot file. ``gear_error``: amplitude [rad] of a sine for each of the ``gear_periods`` [rad].
    ``masses`` [kg] of the links, one per joint; None for joints that do not sag. ``stiffness_nm_rad`` of each joint.
    ``repeatability`` [m] of the bars, None for the rig's. ``worn``: backlash, slow settling, swinging links, noisy
    readings. ``truth_seed``: random seed of the truth; None: that of everything else.
    """

    worn: bool = False
    tolerance: tuple[float, float] | None = None
    repeatability: Annotated[float | None, REPEATABILITY] = None
    gear_error: Annotated[float, Within(0.0)] = 0.0
    gear_periods: tuple[float, ...] = (math.pi, 0.5 * math.pi)
    masses: tuple[float, ...] | None = None
    stiffness_nm_rad: Annotated[float, Within(1.0)] = 5e4
    truth_seed: Annotated[int | None, SEED] = None


@dataclass(frozen=True)
class SimulateOptions:
    """What to simulate, and where it listens.

    ``branch``: where poses are drawn, by default the robot file's. ``truth`` is written to ``truth_out``. ``plan`` and
    ``rig`` are files that replace ``poses`` with each bar, or ``lines``. A ``fault`` is written SECONDS:KIND. A port of
    0 means any free one. ``warming`` [K]: how much the laboratory warms up; bar and sensor then have thermometers.
    ``rate`` [Hz]: of what is recorded in virtual time, None for the usual one.
    """

    out: Path = Path("out/simulated")
    robot: RobotChoice = PUMA
    branch: Branch | None = None
    truth: TruthOptions = TruthOptions()
    truth_out: Path | None = None
    force: bool = False
    rate: float | None = None
    port: Annotated[int, Within(0, 65535)] = 7007
    protocol: Annotated[str, OneOf(("lines", "rtde"))] = "lines"
    robot_port: Annotated[int | None, Within(0, 65535)] = None
    pty: bool = False
    poses: Annotated[int, Within(9, 5000)] = 72
    lines: Annotated[int, Within(0, 50)] = 0
    plan: Path | None = None
    rig: Path | None = None
    robot_delay: Annotated[float, Within(0.0, 1.0)] = 0.0  # s
    trigger: Annotated[int | None, Within(0, 15)] = None
    warming: Annotated[float | None, Within(-20.0, 20.0)] = None
    seed: Annotated[int, Within(0)] = 1
    level: Annotated[str, OneOf(("vm", "chip"))] = "vm"  # what the simulated box runs in
    fault: tuple[str, ...] = ()


@dataclass(frozen=True)
class RecordOptions:
    """What to record from which ``box`` (None: the one that is plugged in) and from the robot at ``address``.

    ``resume``: the session to continue, in place of ``out``. ``duration`` [s]: None for no end. ``patience`` [s]: how
    long to wait for a box or robot that was lost. ``project_model``: the robot of the project, or the path of its file.
    """

    box: str | None = None
    out: Path | None = None
    resume: Path | None = None
    address: str | None = None
    plan: Path | None = None
    rig: Path | None = None
    mounted: str | None = None
    rate: float | None = None
    duration: Annotated[float | None, DURATION] = None
    patience: Annotated[float, Within(0.0)] = 600.0
    plain: bool = False
    unchecked: bool = False
    force: bool = False
    project_model: str = ""


@dataclass(frozen=True)
class CharacterizeFiles:
    """Input and output files of ``truearm characterize``; ``rig`` and ``plan`` replace those in the session."""

    session: Path
    robot: RobotChoice
    rig: Path | None = None
    plan: Path | None = None
    out: Path | None = None
    allow_damaged: bool = False
    force: bool = False


@dataclass(frozen=True)
class ExportSession:
    """What to export of a session.

    ``out``: a new or empty folder. ``rig`` replaces the recorded one. ``robot`` shows which joints are prismatic.
    """

    session: Path
    out: Path
    format: Annotated[str, OneOf(("csv", "npz", "parquet"))] = "csv"
    rig: Path | None = None
    robot: RobotChoice = NO_ROBOT
    allow_damaged: bool = False


@dataclass(frozen=True)
class UsedResult:
    """A result that a command uses for a robot with a payload.

    Says whether one that is not usable will do, and whether files are replaced.
    """

    result: Path
    _: KW_ONLY
    robot: RobotChoice = NO_ROBOT
    payload: Payload | None = None
    allow_unusable: bool = False
    force: bool = False


@dataclass(frozen=True)
class ExportFiles(UsedResult):
    """A result, and the file to write of its robot: the ``format``, and patterns of what may change (``adjust``).

    ``over``: a table or a plan of poses to refit over. ``curves_out``: the joints' error curves.
    """

    format: Annotated[str, OneOf(FORMATS)]
    out: Path
    own_frames: bool = False
    adjust: tuple[str, ...] = ()
    over: Path | None = None
    curves_out: Path | None = None


@dataclass(frozen=True)
class MapFiles(UsedResult):
    """Input and output files of ``truearm map``."""

    out: Path | None = None
    picture_out: Path | None = None
    report: Path | None = None


@dataclass(frozen=True)
class Section:
    """The section of the workspace to map.

    ``joints``: the two that span it, counted from 1. ``at``: position of the joints (j,) [rad, m]; None for the middle
    of the fitted readings, and then only cells within these. The elbow is as there. ``cell`` [m]: size of a cell.
    ``own_frames``: leave out how base and tool were mounted. ``task``: width and height [m] of a task for which to find
    the best place, ``within`` u0, u1, v0, v1 [m] or anywhere.
    """

    joints: tuple[int, int] = (2, 3)
    at: tuple[float, ...] | None = None
    cell: Annotated[float, CELL] = 0.025
    own_frames: bool = False
    task: tuple[float, float] | None = None
    within: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class CorrectFiles(UsedResult):
    """Input and output files of ``truearm correct``."""

    targets: Path
    out: Path
    report: Path | None = None


@dataclass(frozen=True)
class ProgramOptions:
    """How to correct programs.

    ``joint_moves``: what to do with moves to joint readings, None to refuse programs with any. ``partial``: correct the
    other moves if some cannot be corrected; ``mark`` marks these with a comment. ``strict``: routines in none of the
    files may displace the program and change data. ``flange``: the controller's flange in the calibration's end frame,
    if their names do not show this. ``tools`` and ``works``: tools and work objects that are declared elsewhere, by
    name; the tool "" is in force before a URScript sets one, the work object "" is the controller's base in the
    calibration's base frame. Poses are positions [m] and rotation vectors [rad]. ``unchanged``: names that nothing
    outside the files changes.
    """

    joint_moves: JointMoves | None = None
    partial: bool = False
    mark: bool = False
    strict: bool = False
    flange: Six | None = None
    tools: Mapping[str, Six] = field(default_factory=dict)
    works: Mapping[str, Six] = field(default_factory=dict)
    unchanged: tuple[str, ...] = ()


@dataclass(frozen=True)
class CorrectOptions:
    """How to correct.

    ``own_frames``: targets are in the robot's own base and flange frames. ``margin``: targets with a smaller singular
    value are refused. ``home``: joints (j,) [rad, m] near those of the first target. ``program``: how to correct a
    program, which contains its own frames; of a table, the tool and the work object "" are those of its targets.
    ``document``: compute what is expected of each target, as a report does too.
    """

    method: Method = Method.NEWTON
    steps: Annotated[int, Within(1, 50)] = 1
    own_frames: bool = False
    margin: Annotated[float, Within(0.0001, 1.0)] = option_defaults.MARGIN
    home: tuple[float, ...] | None = None
    program: ProgramOptions = ProgramOptions()
    document: bool = False

    @property
    def frames(self) -> tuple[Six, Six]:
        """Return the frame of a table's targets, and the pose of the tool."""
        return self.program.works.get("", NO_FRAME), self.program.tools.get("", NO_FRAME)


@dataclass(frozen=True)
class FleetOptions:
    """What is done for each arm, by how many ``workers`` (None: one per core), or by those of a ``dask`` scheduler.

    ``reports``: whether each result gets a report with a certificate. ``out``: the table of all arms.
    """

    hold_out: tuple[str, ...] = ()
    reports: bool = False
    workers: Annotated[int | None, Within(1, 10_000)] = None
    dask: str | None = None
    out: Path | None = None
