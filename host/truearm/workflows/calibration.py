"""The result of an identification as later commands use it: a result.json, its robot, and what is undetermined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from truearm.arguments import converted, floats
from truearm.errors import Argument, InputError
from truearm.estimate.frame_choice import mounting
from truearm.estimate.result_file import ParameterEstimate, Result, read_result
from truearm.findings import Finding
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain, point_jacobians
from truearm.model.law_chain import carries, has_payload_law, robot_with_laws
from truearm.model.robot import Robot
from truearm.model.robot_file import NO_ROBOT, RobotChoice, builtin_names, is_urdf, load_robot
from truearm.model.robot_mounting import NONE, Mountings, mountings
from truearm.model.transforms import rotation_vector
from truearm.report.result_findings import result_findings
from truearm.report.result_tables import direction_text, parameter_table
from truearm.results import MOVES, Estimate, NullDirection, PredictedError, weights_of
from truearm.types import CENTRE, MASS, CurveKnots, Displayed, Floats, Law, Payload, Rigs, SagMasses
from truearm.units import DEG, MM, UNITS
from truearm.workflows.requests import UsedResult

NEAR_OBSERVED = 0.05  # rad, m beyond the fitted readings: farther is outside
ROUNDED = 1e-4  # rad, m: a reading at a joint's limit that was written with few digits


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Displayed):
    """A robot and its identified parameters, as stored in a result.json.

    ``nominal`` and ``identified`` are the robot's parameters (p,). ``covariance`` (p, p) is that of the identified
    ones, 0 for fixed ones. ``unseen`` (p, d) holds the null space: the directions that the observations did not
    determine, including those fixed as a choice of frame. The largest weight of each direction is 1. ``parameters``
    maps the name of each parameter, the rig's too, to a ``ParameterEstimate``. ``findings`` are what truearm states
    about it, and ``document`` the content of result.json. ``carrying(mass, centre)`` returns the calibration of the
    robot with a payload [kg, m].

    Examples
    --------
    >>> import truearm
    >>> result = truearm.read_result("result.json")
    >>> result.findings[0].code
    'usable'
    >>> result.covariance.shape
    (54, 54)
    """

    robot: Robot
    stored: Result
    nominal: Floats
    identified: Floats
    covariance: Floats
    unseen: Floats

    def __str__(self) -> str:
        free = (entry for entry in self.document["parameters"] if entry["free"])
        return f"{self._headline()}\n{parameter_table(free)}"

    def _headline(self) -> str:
        """Return the verdict, as the first line of ``truearm identify``, and the robot."""
        first = self.findings[: 1 + self.simulated]
        return f"{' '.join(finding.text() for finding in first)} ({self.chain.name})"

    def _columns(self) -> Mapping[str, Any]:
        names = (name for name in ParameterEstimate.__struct_fields__ if name not in ("law", "seen"))
        return {name: self.stored.column(name) for name in names}

    def forward(self, q: ArrayLike) -> Floats:
        """Return the poses (n, 4, 4) of the identified robot's end, with its joint laws, at readings q (n, j), or one.

        Raises TypeError, InputError.

        Examples
        --------
        >>> import truearm
        >>> truearm.read_result("result.json").forward([0.0] * 6).shape
        (4, 4)
        """
        return self.robot.forward(q)

    @property
    def simulated(self) -> bool:
        """Whether any session that it was identified from is of a simulated box."""
        return self.stored.simulated

    @property
    def parameters(self) -> Mapping[str, ParameterEstimate]:
        """All parameters by name, the robot's first, then the rig's."""
        return {entry.name: entry for entry in self.stored.parameters}

    def carrying(self, mass: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Calibration:
        """Return the calibration of the robot with a payload: its mass [kg], and its centre [m] in the end frame.

        Raises InputError if the result does not know how a payload acts on the robot, or for an implausible payload.

        Examples
        --------
        >>> import truearm
        >>> truearm.read_result("result.json").carrying(0.0).chain.payload.mass
        0.0
        """
        payload = Payload(converted("mass", mass, MASS), converted("centre", centre, CENTRE))
        if payload.mass and not has_payload_law(self.chain):
            raise InputError(
                "the result does not know how a payload acts on the robot: identify with rows under different payloads"
            )
        return replace(self, robot=replace(self.robot, chain=carries(self.chain, payload)))

    def outside(self, q: Floats) -> NDArray[np.bool_] | None:
        """Return (n, j), where a joint is outside the fitted readings, or in a gap of them if it has an error curve.

        A full turn of a revolute joint counts as the same position. Returns None if the result does not contain the
        range of the fitted readings. Raises TypeError or InputError unless q is (n, j).
        """
        q = floats("q", q, None, len(self.chain.joints), finite=False)
        joint_range = self.stored.joint_range
        if joint_range is None:
            return None
        lower, upper = np.array(joint_range.lower) - NEAR_OBSERVED, np.array(joint_range.upper) + NEAR_OBSERVED
        turning = np.array([joint.kind == "revolute" for joint in self.chain.joints])
        past = np.where(turning, np.mod(q - lower, 2.0 * np.pi), q - lower)
        out = np.asarray((past < 0.0) | (past > upper - lower))
        for law in self.stored.laws:
            if isinstance(law, CurveKnots):
                out[:, law.joint] |= ~law.covers(q[:, law.joint])
        return out

    def payload_findings(self, payloads: Sequence[Payload] | None = None) -> list[Finding]:
        """Return for which payload the joints' sag holds, of the robot, or of rows under these ``payloads`` (n).

        A result that does not know how a payload acts predicts all rows under the payload of the calibration.
        """
        masses = masses_of(self.stored.payloads)
        if has_payload_law(self.chain):
            mass = f"{self.chain.payload.mass:g}"
            holder = {"holder": "the robot", "mass": mass} if payloads is None else {"holder": "each row"}
            heaviest = max(payload.mass for payload in payloads or [self.chain.payload])
            is_beyond = heaviest > max((payload.mass for payload in self.stored.payloads), default=0.0) + 1e-3
            beyond = [Finding("payload-beyond", {"mass": f"{heaviest:g}", "masses": masses})] if is_beyond else []
            return [Finding("sag-payload", {**holder, "masses": masses}), *beyond]
        has_sag = any(isinstance(law, SagMasses) for law in self.stored.laws)
        values = {"holder": "the calibration", "masses": masses, "several": False}
        findings = [Finding("sag-payload", values)] if has_sag else []
        unmeasured = [payload for payload in payloads or () if not any(map(payload.is_like, self.stored.payloads))]
        if payloads and masses and unmeasured:
            values = {"n": len(unmeasured), "rows": len(payloads), "payload": masses_of(unmeasured), "masses": masses}
            findings.append(Finding("other-payload", values))
        return findings

    @property
    def chain(self) -> Chain:
        """The robot's kinematic chain."""
        return self.robot.chain

    @property
    def joint_units(self) -> tuple[str, ...]:
        """ "rad" or "m" for each joint."""
        return self.robot.chain.joint_units

    @cached_property
    def document(self) -> Mapping[str, Any]:
        """The content of result.json (docs/reference/result-format.md)."""
        return self.stored.document

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """What screen, report and result.json state: the verdict, warnings, the error of the tool, notes, advice.

        The verdict is the first one, after "simulated" if it is of simulated data.
        """
        return tuple(result_findings(self.document))


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Calibration):
    """A calibration with its observations and the complete estimate.

    ``predicted`` is the predicted error of the measured point (``predicted_error`` of result.json), None if unknown.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table, rig = truearm.read_table("poses.csv", robot), truearm.read_rig("rig.toml")
    >>> result = truearm.identify(robot, table, rig)
    >>> result.estimate.n_observations, result.prior
    (90, 'none')
    """

    rig: Rigs
    table: ObservationTable
    estimate: Estimate
    # The expected error of the tool; None if it is smaller than what residuals hold beyond the declared noise.
    predicted: PredictedError | None

    @property
    def prior(self) -> str:
        """The name of the robot's prior."""
        return str(self.document["prior"])


def read_calibration(result: Path, choice: RobotChoice = NO_ROBOT) -> Calibration:
    """Read a result and its robot; by default the built-in robot named in the result.

    Raises InputError if the two do not belong together.
    """
    stored = read_result(result)
    frames = stored.robot
    name, base, tip = choice
    if name is None:
        if frames.name not in builtin_names():
            raise InputError("other-robot", place=result, robot=frames.name[:60])
        name = frames.name
    base, tip = frames_of(name, base, tip, stored)
    called = name if choice.robot else f"{name} (built-in, because no other was given)"
    return calibration_of(stored, load_robot(name, base, tip), called, str(result))


def read_usable(files: UsedResult) -> Calibration:
    """Read a result and its robot for a command that corrects a robot by it.

    Raises InputError if the fit is not usable, unless that is allowed; see also ``read_calibration``.
    """
    calibration = read_calibration(files.result, files.robot)
    because = calibration.stored.unusable_because
    if because and not files.allow_unusable:
        raise InputError("unusable-result", place=files.result, reason=because)
    return calibration if files.payload is None else calibration.carrying(*files.payload)


def frames_of(robot: str, base: str | None, tip: str | None, stored: Result) -> tuple[str | None, str | None]:
    """Return the first and the last link of a URDF: those given, or else those of the result."""
    return (base or stored.robot.base_frame, tip or stored.robot.end_frame) if is_urdf(robot) else (base, tip)


def calibration_of(stored: Result, robot: Robot, called: str, result: str) -> Calibration:
    """Return the calibration of a robot from a result; ``called`` and ``result`` name the two in messages.

    Raises InputError.
    """
    robot = robot_with_laws(robot, _laws_of(stored, robot, result))
    chain, robot_rows = robot.chain, stored.column("of") == "robot"
    names = tuple(stored.column("name")[robot_rows].tolist())
    if names != chain.parameter_names or stored.robot.joint_units != chain.joint_units:
        first, last = stored.robot.base_frame, stored.robot.end_frame
        other_links = robot.is_urdf and (first, last) != (chain.base_frame, chain.end_frame)
        links = ", with ", Argument("base"), f" {first[:60]} and ", Argument("tip"), f" {last[:60]}"
        raise InputError(
            f"{result}: its parameters differ from those of robot {called}; give the robot it was identified with as ",
            Argument("robot"),
            *(links if other_links else ()),
        )
    nominal, identified = (stored.column(name)[robot_rows] for name in ("nominal", "value"))
    if not np.allclose(nominal, chain.params_nominal, rtol=0.0, atol=1e-9):
        index = int(np.argmax(np.abs(nominal - chain.params_nominal)))
        raise InputError(
            "other-robot", place=result, difference=f"another value of {names[index]} than robot {called} has"
        )
    if not np.isfinite(identified).all() or not np.abs(identified).max() < 1e4:
        raise InputError(f"{result}: a parameter's value is missing or implausible; identify again")
    robot = replace(robot, identified=identified)
    return Calibration(robot, stored, nominal, identified, covariance_of(stored, names), unseen_of(stored, names))


def _laws_of(stored: Result, robot: Robot, result: str) -> tuple[Law, ...]:
    """Return the result's joint laws.

    Raises InputError if they refer to joints or frames that the robot does not have.
    """
    joints = len(robot.chain.joints)
    for law in stored.laws:
        frames = law.frames if isinstance(law, SagMasses) else ()
        if not (law.joint < joints and all(law.joint < frame <= joints for frame in frames)):
            raise InputError(f"{result}: a joint law belongs to a joint that the robot does not have; identify again")
    return stored.laws


def chosen_mountings(calibration: Calibration, own_frames: bool) -> Mountings:
    """Return the mountings to remove: the calibration's, or none."""
    return mountings(calibration.chain, calibration.nominal, calibration.identified) if own_frames else NONE


def six_text(pose: Floats) -> str:
    """Format a pose (4, 4) in mm and deg, with the six numbers in the form that frames are given in."""
    place = ", ".join(f"{round(MM.of(v), 3) + 0.0:.3f}" for v in pose[:3, 3].tolist())
    turn = ", ".join(f"{round(DEG.of(v), 4) + 0.0:.4f}" for v in rotation_vector(pose[:3, :3]).tolist())
    return f"x, y, z {place} mm; rotation vector {turn} deg"


def mounting_values(chain: Chain, nominal: Floats, identified: Floats) -> dict[str, str]:
    """Return the mountings in words, with the names of the frames between which they lie."""
    placed = mountings(chain, nominal, identified)
    poses = {"base": six_text(placed.base), "end": six_text(placed.tool)}
    return {**poses, "base_frame": chain.base_frame, "end_frame": chain.end_frame}


def check_joints(argument: str, readings: Sequence[float] | None, chain: Chain) -> Floats | None:
    """Return the readings (j,) [rad, m] of an argument, completed and checked; None if it was not given.

    Raises InputError.
    """
    if readings is None:
        return None
    q = np.array(readings, dtype=float)
    if q.shape not in ((len(chain.joints),), (len(chain.motors),)) or not np.isfinite(q).all():
        raise InputError(Argument(argument), f": must be {len(chain.joints)} finite numbers, one per joint")
    q, largest = chain.completed(q), largest_readings(chain)
    lower, upper = chain.limits
    check_within(argument, q[None], chain, np.maximum(lower, -largest), np.minimum(upper, largest))
    return q


def largest_readings(chain: Chain) -> Floats:
    """Return the largest plausible reading (j,) of each joint, whatever its limits [rad, m]."""
    return np.array([UNITS[unit].largest for unit in chain.joint_units])


def check_within(argument: str, q: Floats, chain: Chain, lower: Floats, upper: Floats) -> None:
    """Raise InputError for the first of the joint readings (n, j) that is outside lower and upper (j,)."""
    bad = np.argwhere((q < lower - ROUNDED) | (q > upper + ROUNDED))
    for i, j in bad[:1].tolist():
        scale = UNITS[chain.joint_units[j]].scale
        place = f"number {i}, joint {j + 1}" if len(q) > 1 else f"joint {j + 1}"
        raise InputError(
            Argument(argument),
            f": {place} is {scale.text(q[i, j])}, outside its limits of {scale.of(lower[j]):g} to {scale.text(upper[j])}",
        )


def masses_of(payloads: Sequence[Payload]) -> list[str]:
    """Return the different masses [kg] of payloads, such as "0", "2.5"."""
    return [f"{mass:g}" for mass in sorted({payload.mass for payload in payloads})]


def covariance_of(stored: Result, names: Sequence[str]) -> Floats:
    """Return the covariance (k, k) of some parameters, 0 for fixed ones."""
    index = {name: i for i, name in enumerate(names)}
    covariance = np.zeros((len(names), len(names)))
    rows = [i for i, name in enumerate(stored.covariance.names) if name in index]
    to = [index[stored.covariance.names[i]] for i in rows]
    covariance[np.ix_(to, to)] = np.nan_to_num(stored.covariance.matrix[np.ix_(rows, rows)])
    return covariance


def unseen_of(stored: Result, names: Sequence[str]) -> Floats:
    """Return (k, d), the part of the null space for some parameters, including directions fixed as a choice of frame.

    Other fixtures may see either.
    """
    return weights_of((*stored.null_space, *stored.defaults.frames), names)


TERMS = 3  # parameters of a combination
# In names of the rig's numbers, such as "sphere.s1.x", and in words.
ITEMS = {
    "chuck": "chucks",
    "socket": "sockets",
    "tracker": "trackers",
    "line": "line devices",
    "plane": "planes",
    "sphere": "spheres on the end",
    "target": "targets on the end",
}


def undetermined(calibration: Calibration, q: Floats, own_frames: bool) -> list[Finding]:
    """Return what the observations did not determine of the end's position at joints q (n, j); empty if nothing.

    The pose of the base is left out with ``own_frames``: it moves all targets with the robot.
    """
    chain = calibration.chain
    jac = point_jacobians(chain, calibration.identified, q, np.zeros(3))[1]

    def moving(directions: Sequence[NullDirection]) -> list[NullDirection]:
        return [
            direction
            for direction in directions
            if np.abs(jac @ weights_of([direction], chain.parameter_names)).max(initial=0.0) > MOVES
        ]

    findings = []
    places, defaults = mounting(chain, calibration.nominal), calibration.stored.defaults
    names = list(chain.parameter_names)
    base, tool = (
        {name for name, is_placing in zip(names, mask, strict=True) if is_placing}
        for mask in (places.base, places.tool)
    )
    held = moving(defaults.frames)
    for key, noun, default in (("base", "pose of the base", base), ("tool", "mounting of the tool", tool)):
        placing = set(getattr(defaults, key) or default)
        directions = [direction for direction in held if placing.intersection(direction.names)]
        if directions and not (own_frames and key == "base"):
            held_names = [name for name in names if name in placing]
            values = {"what": noun, "base": key == "base", **_held(held_names, directions)}
            findings.append(Finding("mounting-held", values))
            if key == "base":
                findings.append(Finding("own-frames-next"))
    null = moving(calibration.stored.null_space)
    if own_frames:  # a turn of the base together with the rig moves no target relative to the robot
        null = [direction for direction in null if set(names).intersection(direction.names) - base]
    if null:
        terms = [direction_text(direction.weights, direction.names, TERMS) for direction in null]
        findings.append(Finding("null-space-moves-end", {"terms": terms}))
    return findings


def unseen_within(calibration: Calibration) -> tuple[Floats, tuple[str, ...]]:
    """Return the directions (p, d) that the observations did not determine, and which of base and tool are not.

    Directions that only place base or tool are not among them: errors are then relative to base or tool.
    """
    unseen, places = calibration.unseen, mounting(calibration.chain, calibration.nominal)
    within = (unseen[~places.either] != 0.0).any(axis=0)
    placed = (unseen[:, ~within] != 0.0).any(axis=1)
    return unseen[:, within], tuple(name for name in ("base", "tool") if placed[getattr(places, name)].any())


def _held(names: Sequence[str], directions: Sequence[NullDirection]) -> dict[str, object]:
    """Return the names of a choice of frame; items of the rig, such as "sphere.s1.x", tell why there was one."""
    item_words = {word for direction in directions for name in direction.names for word in name.split(".")[:-1]}
    items = [words for item, words in ITEMS.items() if item in item_words]
    moved = {name for direction in directions for name in direction.names}
    return {"names": [name for name in names if name in moved], "items": " and ".join(items)}
