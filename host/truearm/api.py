"""The functions of ``import truearm``: the commands' work, on data in memory.

Each function checks its arguments and then runs the same code as the command of that name. A wrong argument raises
TypeError or InputError with a one-line message that names the argument. Lengths are in metres, angles in radians and
times in seconds.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from truearm.arguments import checked, converted, floats
from truearm.bounds import CELL, LINE_POINTS, MINUTES, PATH, POSES, OneOf
from truearm.correct.correction import Correction
from truearm.correct.error_map import ErrorMap
from truearm.correct.methods import Method
from truearm.disk import missing_file, write_atomic
from truearm.errors import Argument, InputError, SessionError, TableError
from truearm.estimate import result_file
from truearm.export.formats import FORMATS
from truearm.kinds import rig_file
from truearm.kinds import table_file as observation_table
from truearm.kinds.table import ObservationTable
from truearm.model import robot_file
from truearm.model.robot import Robot
from truearm.model.robot_file import builtin_names
from truearm.plan.ball_bar_plan import BallBarPlan
from truearm.plan.options import Budget
from truearm.text import counted
from truearm.types import Displayed, Floats, Rig, Rigs
from truearm.units import UNITS
from truearm.workflows import correct, export, plan
from truearm.workflows import identify as identification
from truearm.workflows import map as maps
from truearm.workflows.calibration import Calibration, Identification, calibration_of, read_calibration
from truearm.workflows.identify import DEFAULTS, IdentifyOptions, Progress
from truearm.workflows.inputs import Observed, Sources, completed_rigs, read_sources
from truearm.workflows.plan import BallBarOptions
from truearm.workflows.recorded_session import channel_samples, is_session, joint_readings, session_parts
from truearm.workflows.requests import CorrectOptions, Section
from truearm.workflows.validate import Validation, validated

PathLike = Annotated[str | os.PathLike[str], PATH]
HoldOut = str | float | Sequence[str] | NDArray[np.bool_]
RIGID = 1e-6  # tolerated deviation from orthonormality of a rotation matrix written with few digits
RobotArgument = Annotated[Robot, "load_robot"]
TableArgument = Annotated[ObservationTable, "read_table"]
ResultArgument = Annotated[Calibration, "identify", "read_result"]
RigArgument = Annotated[Rig, "read_rig"] | PathLike
RigsArgument = Annotated[Rigs, "read_rig"] | PathLike
Joints = Sequence[float] | NDArray[np.float64]


@checked
def load_robot(robot: PathLike, base: str | None = None, tip: str | None = None) -> Robot:
    """Load a built-in robot, a robot file or a URDF.

    Parameters
    ----------
    robot : str or path
        Name of a built-in robot (see ``builtin_robots``), or path to a robot file (.toml) or a URDF (.urdf).
    base, tip : str, optional
        First and last link of the chain in a URDF. Default: the root link and the only leaf link.

    Returns
    -------
    Robot
        The kinematic chain, its parameter sets, and which parameters are free by default.

    Raises
    ------
    RobotError
        If the robot does not exist, or the file is invalid.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> print(robot)
    puma560: 6 joints, chuck_fixture to sphere_fixture, 54 parameters, 36 free
    """
    return robot_file.load_robot(str(robot), base, tip)


def builtin_robots() -> tuple[str, ...]:
    """Return the names of the built-in robots.

    Examples
    --------
    >>> import truearm
    >>> "puma560" in truearm.builtin_robots()
    True
    """
    return builtin_names()


@checked
def read_table(path: PathLike, robot: RobotArgument) -> ObservationTable:
    """Read a table of observations (docs/reference/table-format.md).

    Parameters
    ----------
    path : str or path
        CSV file with one row per observation.
    robot : Robot
        The measured robot. Its joints must match the joint columns of the table.

    Returns
    -------
    ObservationTable
        The observations, in SI units, in the order of their times if all have one.

    Raises
    ------
    TableError
        If the table is invalid; the message names file, row and column.

    Examples
    --------
    >>> import truearm
    >>> table = truearm.read_table("poses.csv", truearm.load_robot("puma560"))
    >>> len(table), table.q.shape
    (90, (90, 6))
    """
    return observation_table.read_table(Path(path), robot.chain.joint_units, robot.chain.mimics)


@checked
def write_table(path: PathLike, table: TableArgument, robot: RobotArgument) -> None:
    """Write observations to a table that ``read_table`` can read. An existing file is replaced.

    Parameters
    ----------
    path : str or path
        CSV file to write.
    table : ObservationTable
        The observations.
    robot : Robot
        The measured robot. It determines which joint columns are angles and which are lengths.

    Raises
    ------
    TableError
        If ``read_table`` would reject a row. In this case nothing is written.
    TruearmError
        If the file cannot be written: InputError for a wrong name or folder, another one if the disk is full or fails.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table = truearm.read_table("poses.csv", robot)
    >>> truearm.write_table("inner.csv", table.select(table.shell == "inner"), robot)
    """
    rows = _table("table", table, robot)
    observation_table.write_table(Path(path), rows, robot.chain.joint_units)


@checked
def read_rig(path: PathLike) -> Rig:
    """Read a rig file: chucks, spheres, bars, sockets and devices (docs/how-to/rig.md).

    Parameters
    ----------
    path : str or path
        Rig file (.toml).

    Returns
    -------
    Rig
        The rig around the robot, in metres and radians.

    Raises
    ------
    RigError
        If the file is invalid; the message names file and key.

    Examples
    --------
    >>> import truearm
    >>> rig = truearm.read_rig("rig.toml")
    >>> sorted(rig.chucks)
    ['c0', 'c1', 'c2']
    """
    return rig_file.read_rig(Path(path))


@dataclass(frozen=True, eq=False, repr=False)
class SessionObservations(Displayed):
    """The observations of a session, the rig they were measured with, and what was lost from a damaged file.

    ``rig`` is a single rig, or a mapping of rigs by name if the parts of the session were recorded with different rigs.

    Examples
    --------
    >>> import truearm
    >>> truearm.read_session("session.mcap").lost
    ()
    """

    table: ObservationTable
    rig: Rigs
    lost: tuple[str, ...] = ()
    parts: tuple[Path, ...] = ()
    allow_damaged: bool = False

    def samples(self, channel: str) -> tuple[Floats, Floats]:
        """Return the times (n,) and the values (n,) of all samples of a channel of the box, such as "lvdt".

        Times are in seconds, like ``table.time``, NaN where unknown. A value is a length [m] or in the channel's
        calibrated unit, or without a calibration what the converter measured [V]. The file is read again. Raises
        TypeError, InputError.

        Examples
        --------
        >>> import truearm
        >>> time, extension = truearm.read_session("session.mcap").samples("lvdt")
        >>> time.shape == extension.shape
        True
        """
        return channel_samples(self.parts, converted("channel", channel, str), self.allow_damaged)

    def joints(self) -> tuple[Floats, Floats]:
        """Return the times (n,) [s] and the joint readings (n, j) [rad, m] of the robot. The file is read again.

        Examples
        --------
        >>> import truearm
        >>> time, q = truearm.read_session("session.mcap").joints()
        >>> q.shape == (len(time), 6)
        True
        """
        return joint_readings(self.parts, self.allow_damaged)

    def _headline(self) -> str:
        return f"{counted(len(self.table), 'observation')}, {counted(len(self.lost), 'loss', 'losses')}"

    def _columns(self) -> Mapping[str, Any]:
        return self.table._columns()


@checked
def read_session(
    path: PathLike,
    *,
    rig: RigsArgument | None = None,
    noise: PathLike | None = None,
    allow_damaged: bool = False,
    line_points: Annotated[int, LINE_POINTS] | None = None,
) -> SessionObservations:
    """Build observations from a recorded session: synchronise the clocks, then detect dwells and lines.

    Parameters
    ----------
    path : str or path
        Session file (.mcap). The other parts of the session are read as well.
    rig : Rig, str, path or mapping of str to Rig, optional
        Rig, or rig file, to use instead of the recorded rig; with a mapping, the one under the session's name.
    noise : str or path, optional
        Noise file written by ``truearm characterize``, to use instead of the noise in the rig.
    allow_damaged : bool
        Use the intact part of a damaged file.
    line_points : int, optional
        Maximum number of points of each pass along a line. Default: as many as the noise can distinguish.

    Returns
    -------
    SessionObservations
        Pass its ``table`` and ``rig`` to ``identify``.

    Raises
    ------
    SessionError
        If the file is not a session, or is damaged.
    RigError
        If no rig was recorded or given.
    InputError
        If ``line_points`` is given for a session without passes along a line.

    Examples
    --------
    >>> import truearm
    >>> session = truearm.read_session("session.mcap")
    >>> set(session.table.kind.tolist())
    {'ball_bar'}
    """
    file = Path(path)
    if not file.exists():
        raise missing_file(file)
    if not is_session(file):
        raise SessionError("not-a-session", place=file)
    parts, rigs = tuple(session_parts(file)), {} if rig is None else _read_rigs(rig)
    sources = Sources(
        inputs=parts,
        rigs=rigs if isinstance(rigs, Mapping) else {"": rigs},
        noise=None if noise is None else Path(noise),
        allow_damaged=allow_damaged,
        line_points=line_points,
    )
    observed = read_sources(sources, None)
    lost = tuple(finding.text() for finding in observed.findings)
    return SessionObservations(observed.table, observed.rigs, lost, parts, allow_damaged)


@checked
def identify(
    robot: RobotArgument,
    table: TableArgument,
    rig: RigsArgument | None = None,
    *,
    hold_out: HoldOut = (),
    options: IdentifyOptions | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Identify a robot's parameters from observations.

    Parameters
    ----------
    robot : Robot
        The nominal robot.
    table : ObservationTable
        The observations.
    rig : Rig, str, path or mapping of str to Rig, optional
        The rig, or rig file, that the rows refer to, or rigs by the names in the table's column ``rig``. Default: an
        empty rig.
    hold_out : str, float, sequence of str or array of bool
        Rows to use for validation only: groups such as ``"bar=bar61"``, a fraction such as 0.2, or a mask (n,).
    options : IdentifyOptions, optional
        Free parameters, prior, solver and loss.
    progress : callable, optional
        Called after each step with the iteration and the RMS residual.

    Returns
    -------
    Identification
        A ``Calibration`` with the complete ``estimate``, the table and the rig. Printing it lists the free parameters
        and their standard deviations.

    Raises
    ------
    InputError
        If the arguments are inconsistent.
    ProblemError
        If the observations and the robot do not define a solvable problem.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table, rig = truearm.read_table("poses.csv", robot), truearm.read_rig("rig.toml")
    >>> result = truearm.identify(robot, table, rig, hold_out="shell=outer")
    >>> result.estimate.status, result.estimate.rank
    ('converged', 36)
    >>> length = result.parameters["link2.x"]
    >>> length.unit, length.seen
    ('m', True)
    """
    _check_nominal(robot)
    rows = _table("table", table, robot)
    rigs = _rigs(rig, rows)
    if isinstance(hold_out, np.ndarray):
        held: Sequence[str] | NDArray[np.bool_] = _mask(hold_out, rows)
    else:
        held = _texts(hold_out) if isinstance(hold_out, str | Sequence) else (str(float(hold_out)),)
    return identification.identified(robot, Observed(rigs, rows), held, options or DEFAULTS, progress=progress)


@checked
def validate(
    result: ResultArgument, table: TableArgument, rig: RigsArgument | None = None, keep_rig: bool = False
) -> Validation:
    """Validate a calibration on observations that it was not identified from.

    Parameters
    ----------
    result : Calibration
        Return value of ``identify`` or ``read_result``.
    table : ObservationTable
        Observations that were not used in the fit.
    rig : Rig, str, path or mapping of str to Rig, optional
        As for ``identify``.
    keep_rig : bool
        Keep the identified values of the rig (trackers, targets, chucks, bars) and estimate only the rest of the rig.

    Returns
    -------
    Validation
        ``before`` and ``after`` are the errors without and with the calibration [m, rad], also given by ``regions``.
        ``expected`` is the expected error and ``verdict`` the conclusion in words. Printing it shows everything, in
        mm and deg.

    Raises
    ------
    InputError
        If the arguments are inconsistent, if no row can be used for validation, or if nothing of the rig can be kept.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table, rig = truearm.read_table("poses.csv", robot), truearm.read_rig("rig.toml")
    >>> result = truearm.identify(robot, table, rig)
    >>> print(truearm.validate(result, truearm.read_table("friday.csv", robot), rig).verdict[:22])
    The calibration holds:
    """
    rows = _table("table", table, result.robot)
    return validated(result, Observed(_rigs(rig, rows), rows), keep_rig)


@checked
def read_result(
    path: PathLike, robot: RobotArgument | PathLike | None = None, base: str | None = None, tip: str | None = None
) -> Calibration:
    """Read a result.json (docs/reference/result-format.md) and the robot that it belongs to.

    Parameters
    ----------
    path : str or path
        File written by ``write_result`` or ``truearm identify --out``.
    robot : Robot, str or path, optional
        The nominal robot that was identified, as for ``identify``. Default: the built-in robot named in the file.
    base, tip : str, optional
        First and last link of the chain in a URDF. Default: as identified.

    Returns
    -------
    Calibration
        The robot with its identified parameters and their covariance.

    Raises
    ------
    InputError
        If the file is not a result, or belongs to another robot.

    Examples
    --------
    >>> import truearm
    >>> truearm.read_result("result.json").parameters["link2.x"].unit
    'm'
    """
    if isinstance(robot, Robot):
        if base or tip:
            raise InputError(
                "no-effect", place=Argument("base" if base else "tip"), reason="robot is one that was loaded"
            )
        _check_nominal(robot)
        return calibration_of(result_file.read_result(Path(path)), robot, robot.chain.name, str(path))
    name = None if robot is None else str(robot)
    return read_calibration(Path(path), robot_file.RobotChoice(name, base, tip))


@checked
def write_result(path: PathLike, result: ResultArgument) -> None:
    """Write a calibration to a result.json atomically. An existing file is replaced.

    Parameters
    ----------
    path : str or path
        File to write.
    result : Calibration
        Return value of ``identify`` or ``read_result``.

    Raises
    ------
    TruearmError
        If the file cannot be written: InputError for a wrong name or folder, another one if the disk is full or fails.

    Examples
    --------
    >>> import truearm
    >>> truearm.write_result("copy.json", truearm.read_result("result.json"))
    """
    result_file.write_result(Path(path), result.stored)


@checked
def plan_ball_bar(
    robot: RobotArgument,
    rig: RigArgument,
    *,
    poses: Annotated[int, POSES] | None = None,
    minutes: Annotated[float, MINUTES] | None = None,
    result: ResultArgument | None = None,
    options: BallBarOptions | None = None,
) -> BallBarPlan:
    """Plan the poses of a ball-bar measurement.

    Parameters
    ----------
    robot : Robot
        A robot with six or more revolute joints, whose file has a ``[branch]`` table.
    rig : Rig, str or path
        Chucks, spheres and bars.
    poses, minutes : int, float
        The budget: a number of poses, or minutes of the operator's time. Give exactly one of them.
    result : Calibration, optional
        Plan with this calibrated model instead of the nominal one.
    options : BallBarOptions, optional
        Criterion, region, travel reserve and random seed.

    Returns
    -------
    BallBarPlan
        ``route`` lists the poses in the order in which they are visited (``route.visits`` is the plan). ``forecast``
        holds the predicted standard deviation of each parameter.

    Raises
    ------
    InputError
        If none or both of the budgets are given, or the travel of the bar is too short.
    PlanError
        If truearm cannot plan for this robot or with these options.

    Examples
    --------
    >>> import truearm
    >>> robot, rig = truearm.load_robot("puma560"), truearm.read_rig("bench.toml")
    >>> options = truearm.BallBarOptions(candidates=60)
    >>> planned = truearm.plan_ball_bar(robot, rig, poses=8, options=options)
    >>> len(planned.route.plan)
    8
    """
    if result is not None and result.chain.parameter_names != robot.chain.parameter_names:
        raise InputError("other-robot", place="result", robot=result.chain.name)
    knowledge = plan.knowledge_of(robot, rig if isinstance(rig, Rig) else read_rig(rig), result)
    return plan.planned_ball_bar(knowledge, Budget(poses, minutes), options or BallBarOptions(), result is not None)


@checked
def correct_poses(
    result: ResultArgument,
    poses: ArrayLike,
    *,
    method: Annotated[str, OneOf(tuple(Method))] = "newton",
    own_frames: bool = False,
    home: Joints | None = None,
    partial: bool = False,
    names: Iterable[str] | None = None,
) -> Correction:
    """Correct poses so that the real robot reaches them although its controller uses the nominal model.

    Parameters
    ----------
    result : Calibration
        Return value of ``identify`` or ``read_result``.
    poses : array (n, 4, 4) or (4, 4)
        Target poses of the end frame in the base frame: rotation matrix and position [m].
    method : str
        "newton", "false-target", "joints" or "offsets". The first is the full inverse; the others are those of Renders
        1991.
    own_frames : bool
        The poses are given in the robot's own base and flange frames: do not correct the mounting of base and tool.
    home : sequence of float, optional
        Joint readings (j,) near those of the first pose [rad, m]. They select the configuration of the arm, and are
        needed if joint limits allow several: each needs another correction.
    partial : bool
        Correct the other poses if some cannot be corrected: for these, ``commanded`` and ``q`` are NaN.
    names : iterable of str, optional
        The names of the poses, for the column ``name`` of ``to_pandas``. Default: none.

    Returns
    -------
    Correction
        ``commanded`` (n, 4, 4) holds the poses to command and ``q`` (n, j) the joint readings to move to. ``before``
        and ``after`` (n, 2) are the errors in m and rad. ``status`` is "corrected" or the reason why not, for each
        pose.

    Raises
    ------
    TargetError
        If a pose is out of reach or close to a singularity and ``partial`` is False, or if nothing determines the
        configuration of the arm.

    Examples
    --------
    >>> import numpy as np
    >>> import truearm
    >>> result = truearm.read_result("result.json")
    >>> pose = np.array([[0, 0, 1, 0.5], [0, 1, 0, 0.1], [-1, 0, 0, 0.2], [0, 0, 0, 1]])
    >>> corrected = truearm.correct_poses(result, pose, home=np.radians([0, 0, 180, 0, -90, 0]))
    >>> corrected.commanded.shape, bool(corrected.after[0, 0] < 1e-8)
    ((1, 4, 4), True)
    """
    targets = floats("poses", poses, None, 4, 4, or_one=True)
    _check_rigid("poses", targets)
    options = CorrectOptions(Method(method), own_frames=own_frames, home=_joints("home", home))
    named = tuple(names or ())
    if len(named) not in (0, len(targets)):
        raise InputError(Argument("names"), f": must be {counted(len(targets), 'name')}, one per pose, or none")
    return replace(correct.corrected_poses(result, targets, options, partial), name=named)


@checked
def export_robot(
    result: ResultArgument,
    format: Annotated[str, OneOf(FORMATS)],
    path: PathLike | None = None,
    *,
    own_frames: bool = False,
    adjust: str | Sequence[str] = (),
    over: NDArray[np.float64] | Sequence[Joints] | None = None,
) -> export.ExportedRobot:
    """Export a calibrated robot to another program's format.

    Parameters
    ----------
    result : Calibration
        Return value of ``identify`` or ``read_result``.
    format : str
        "urdf", "mjcf", "ur", "calibration-conf", "dh", "dh-hayati", "mdh", "evaluator-c", "evaluator-python",
        "sheth-uicker" or a format that was added, as for ``truearm export --format``.
    path : str or path, optional
        File to write; an existing file is replaced. Default: return the text without writing a file.
    own_frames : bool
        Exclude the mounting of base and tool.
    adjust : sequence of str
        Patterns of the parameters that may change, such as ``"joint*.offset"``. Default: all.
    over : array (n, j), optional
        Joint vectors [rad, m] over which a refit minimises the error. Default: 600 random ones within the joint limits,
        or within the fitted readings if the result has joint laws.

    Returns
    -------
    ExportedRobot
        ``text`` is the text of the file. ``missing`` lists the identified parameters that the format cannot represent.
        ``rms`` and ``largest`` are the resulting position error [m] relative to the identified robot. Printing it
        shows them in mm.

    Raises
    ------
    InputError
        If the format does not exist, if it can represent none of the parameters that may change, or if the export would
        be no closer to the identified robot than the nominal robot is (RobotError). In these cases nothing is written.

    Examples
    --------
    >>> import truearm
    >>> written = truearm.export_robot(truearm.read_result("result.json"), "urdf", "calibrated.urdf")
    >>> written.text.startswith("<?xml"), written.missing[0]
    (True, 'joint1.gain')
    >>> 0.0 < written.rms < written.largest  # m: what is lost with the gains, which a URDF does not have
    True
    """
    poses = None if over is None else floats("over", over, None, len(result.joint_units))
    exported = export.exported(result, format, poses, own_frames, _texts(adjust))
    if path is not None:
        write_atomic(Path(path), exported.text)
    return exported


@checked
def error_map(
    result: ResultArgument,
    joints: tuple[int, int] = (2, 3),
    *,
    at: Joints | None = None,
    cell: Annotated[float, CELL] = 0.025,
    own_frames: bool = False,
) -> ErrorMap:
    """Map the position error of the uncalibrated robot over a section of its workspace (Renders 1991, eq. 31).

    Parameters
    ----------
    result : Calibration
        Return value of ``identify`` or ``read_result``.
    joints : pair of int
        The two joints that span the section, counted from 1. Their axes must be parallel.
    at : sequence of float, optional
        Joint readings (j,) [rad, m] at which the other joints are held; the two have the configuration of the elbow
        there. Default: the middle of the fitted readings; the map then ends where these end.
    cell : float
        Size of a cell [m].
    own_frames : bool
        Exclude the mounting of base and tool.

    Returns
    -------
    ErrorMap
        ``error`` and ``sigma`` [m] of each cell; NaN where the arm cannot reach. ``sigma`` is relative to base and tool
        if the observations do not determine their poses.

    Raises
    ------
    InputError
        If the robot does not have these joints, or the section cannot be mapped with them.

    Examples
    --------
    >>> import truearm
    >>> found = truearm.error_map(truearm.read_result("result.json"), cell=0.1)
    >>> found.error.shape == (found.v.size, found.u.size)
    True
    """
    a, b = joints
    return maps.mapped(result, Section((a, b), _joints("at", at), cell, own_frames))


def _joints(name: str, readings: Joints | None) -> tuple[float, ...] | None:
    """Return the checked joint readings (j,)."""
    return None if readings is None else tuple(floats(name, readings, None).tolist())


def _check_rigid(name: str, poses: NDArray[np.float64]) -> None:
    """Raise InputError unless all ``poses`` (n, 4, 4) are rigid transforms."""
    if np.abs(poses[:, :3, 3]).max() > UNITS["m"].largest:
        raise InputError(f"{name}: a position is farther than {UNITS['m'].largest:g} m; positions are in m")
    turn = poses[:, :3, :3]
    off = np.abs(turn @ turn.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = (off > RIGID) | (np.linalg.det(turn) < 0.0) | (poses[:, 3] != [0.0, 0.0, 0.0, 1.0]).any(axis=1)
    if bad.any():
        raise InputError(
            f"{name}: number {int(np.argmax(bad))} is not a rotation and a translation over a last row 0, 0, 0, 1"
        )


def _table(name: str, value: ObservationTable, robot: Robot) -> ObservationTable:
    joints = len(robot.chain.joints)
    value = value.completed(robot.chain.mimics, joints) if value.q.shape[1] == len(robot.chain.motors) else value
    if value.q.shape[1] != joints:
        raise InputError("other-robot", place=name, joints=value.q.shape[1], expected=joints)
    if not len(value):
        raise InputError("no-rows", place=name)
    try:
        observation_table.check_values(value, robot.chain.joint_units)
    except TableError as exc:
        raise TableError(Argument(name), f": {exc}") from None
    return value


def _read_rigs(rig: RigsArgument) -> Rigs:
    """Return the rig, or the rigs by name; a file is read."""
    return rig if isinstance(rig, Rig | Mapping) else read_rig(rig)


def _rigs(rig: RigsArgument | None, table: ObservationTable) -> Rigs:
    """Return the rig, or the rigs by name, checked against the rows that refer to them."""
    try:
        return completed_rigs(Rig() if rig is None else _read_rigs(rig), table)
    except TableError as exc:
        raise exc if rig is not None else InputError(Argument("rig"), f": is needed: {exc}") from None


def _mask(hold_out: NDArray[np.bool_], table: ObservationTable) -> NDArray[np.bool_]:
    if hold_out.dtype != np.bool_:
        raise TypeError(f"hold_out: must be an array of bool, is an array of {hold_out.dtype}")
    if hold_out.shape != (len(table),):
        raise InputError(f"hold_out: must be one bool per row, {len(table)} in all; its shape is {hold_out.shape}")
    if hold_out.all():
        raise InputError("nothing-left", what="observations", place="hold_out")
    return hold_out


def _check_nominal(robot: Robot) -> None:
    if robot.identified is not None:
        raise InputError(Argument("robot"), ": is that of a calibration; give the nominal one, of load_robot")


def _texts(value: str | Sequence[str]) -> tuple[str, ...]:
    return (value,) if isinstance(value, str) else tuple(value)
