"""Robot files (TOML): a chain with named sets of parameter values, and which parameters are held fixed by default.

::

    name = "ulb"
    convention = "dh"                  # or modified_dh, sheth_uicker, elementary
    source = "where the numbers are from"
    nominal = "design"                 # the set the chain starts from
    base_frame = "base"
    end_frame = "flange"
    [joint1]
    kind = "revolute"
    lower_deg = -180.0
    upper_deg = 180.0
    offset_deg = { design = 0.0, held = true }
    gain = { design = 1.0, held = true }
    d_mm = { design = 0.0, held = true }
    a_mm = { design = 0.0 }
    alpha_deg = { design = -90.0 }
    …

``robot_tables`` reads the tables. docs/reference/robot-format.md describes every key.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from truearm.arguments import floats
from truearm.errors import RobotError
from truearm.model.chain import Chain, forward
from truearm.model.chain_structure import Joint
from truearm.model.robot_tables import MAX_JOINTS, MAX_NAME, Description, chain_from_slots, read_tables, robot_number
from truearm.schema import Direction, Key, List, SchemaError, Table, Text, Whole, at, load_toml, raising
from truearm.text import counted
from truearm.types import Displayed, Floats
from truearm.units import DEG

# ------------------------------------------------------------------------------------------------------ what plans need
#
#     [branch]                           # joint bounds without a singularity inside
#     lower_deg = [-150.0, -170.0, …]
#     upper_deg = [150.0, -10.0, …]
#     clearance_mm = 220.0               # from the base's z axis; left out: 250
#     height_mm = 80.0                   # above z = 0; left out: 80
#     [[capsule]]                        # all within a radius of a segment that moves with a joint
#     joint = 2                          # 0: fixed to the base
#     start_mm = [0.0, 0.0, 135.0]
#     end_mm = [-425.0, 0.0, 135.0]
#     radius_mm = 95.0

MAX_CAPSULES = 100
CLEARANCE, HEIGHT = 0.25, 0.08  # m


@dataclass(frozen=True)
class Branch:
    """One configuration branch as joint bounds (j,) [rad].

    An arm reaches a pose in several configurations (elbow up or down, wrist flipped or not), separated by
    singularities. A plan stays in one branch: the joints can then move straight from any pose to any other with the bar
    mounted.

    ``clearance`` [m] is the minimum distance of the end from the base's z axis, and ``height`` [m] that from the table,
    z = 0.
    """

    lower: Floats
    upper: Floats
    clearance: float = CLEARANCE
    height: float = HEIGHT


class Capsules(NamedTuple):
    """The volume of an arm's links: everything within a radius of m segments.

    ``joint`` is the joint that each segment moves with (0: none, it is fixed). ``ends`` (m, 2, 3) [m] are given in that
    joint's frame after its motion (0: the base frame). ``radius`` is (m,) [m].
    """

    joint: tuple[int, ...]
    ends: Floats
    radius: Floats


def _branch(lower: tuple[float, ...], upper: tuple[float, ...], **clearances: float) -> Branch:
    return Branch(np.array(lower), np.array(upper), **clearances)


_ANGLES, _LENGTH, _POINT = List(robot_number("rad")), robot_number("m"), List(robot_number("m"), 3)
BRANCH = Table(
    (
        Key("lower", _ANGLES),
        Key("upper", _ANGLES),
        Key("clearance", _LENGTH, optional=True),
        Key("height", _LENGTH, optional=True),
    ),
    _branch,
)
CAPSULE: Table[dict[str, Any]] = Table(
    (
        Key("joint", Whole(0, MAX_JOINTS)),
        Key("start", _POINT),
        Key("end", _POINT),
        Key("radius", replace(_LENGTH, positive=True)),
    ),
    dict,
)


def check_branch(branch: Branch, joints: Sequence[Joint]) -> None:
    """Raise SchemaError if the branch is invalid for an arm with these joints."""
    if any(joint.kind != "revolute" for joint in joints):
        raise SchemaError("only an arm with revolute joints can have one")
    for key, bounds in (("lower", branch.lower), ("upper", branch.upper)):
        if len(bounds) != len(joints):
            raise SchemaError(f"needs bounds of {len(joints)} joints, {key} has {len(bounds)}")
    for joint, lower, upper in zip(joints, branch.lower.tolist(), branch.upper.tolist(), strict=True):
        if not joint.lower <= lower < upper <= joint.upper:
            limits = f"{DEG.of(joint.lower):.6g} to {DEG.text(joint.upper, '.6g')}"
            raise SchemaError(f"the bounds of {joint.name} must lie within its limits, {limits}, lower below upper")


def capsules_of(entries: Sequence[Mapping[str, Any]], n_joints: int) -> Capsules:
    """Return the capsules of a robot file's ``[[capsule]]`` tables. Raises SchemaError."""
    joint = tuple(entry["joint"] for entry in entries)
    for i, index in enumerate(joint, start=1):
        if index > n_joints:
            raise SchemaError(
                f"capsule: item {i}: joint: must be a whole number from 0 (fixed) to {n_joints}, is {index}"
            )
    ends = np.array([(entry["start"], entry["end"]) for entry in entries])
    return Capsules(joint, ends, np.array([entry["radius"] for entry in entries]))


# ------------------------------------------------------------------------------------------------------------ the robot

CONTROLLER = "controller"  # the set of values that a controller computes with (workflows.controller_model)
MAX_TEXT = 1_000_000  # characters; the PUMA's file has 3,000
MAX_SOURCE = 2_000  # characters
LINE = Text(MAX_NAME, one_line=True)
HEAD = (
    *(Key(name, LINE) for name in ("name", "convention", "nominal", "base_frame", "end_frame")),
    Key("source", Text(MAX_SOURCE, one_line=True), optional=True),
    Key("branch", BRANCH, optional=True),
    Key("gravity", Direction(), optional=True),
    Key("checksums", List(Whole(0, 2**32 - 1), 6), optional=True),
    Key("capsule", List(CAPSULE, most=MAX_CAPSULES), optional=True),
)


@dataclass(frozen=True, eq=False, repr=False)
class Robot(Displayed):
    """A chain, named parameter sets (p,), and ``free`` (p,): False for the parameters that are fixed in the file.

    ``source`` is the origin of the numbers, "" if unknown. ``branch`` is required for plans. Without ``capsules``,
    links count as capsules of 50 mm radius there. Both are None if the file has none. ``file`` is the file that the
    robot was read from (a URDF has the suffix .urdf or .xml), "" for a built-in robot. ``checksums`` of a Universal
    Robots controller's joints identify the factory calibration that the nominal values are. ``identified`` (p,) are the
    parameters of a calibration's robot, None of one that is only described.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> [joint.kind for joint in robot.chain.joints] == 6 * ["revolute"]
    True
    """

    chain: Chain
    parameter_sets: Mapping[str, Floats]
    free: NDArray[np.bool_]
    source: str = ""
    branch: Branch | None = None
    capsules: Capsules | None = None
    file: str = ""
    gravity: tuple[float, float, float] | None = None  # its direction in the base frame; None: not in the file
    checksums: tuple[int, ...] = ()
    identified: Floats | None = None

    def __str__(self) -> str:
        return self._headline()

    def _headline(self) -> str:
        chain = self.chain
        return (
            f"{chain.name}: {counted(len(chain.joints), 'joint')}, {chain.base_frame} to {chain.end_frame}, "
            f"{counted(len(chain.parameters), 'parameter')}, {int(self.free.sum())} free"
            f"{'' if self.identified is None else ', calibrated'}"
        )

    def _columns(self) -> Mapping[str, Any]:
        parameters = self.chain.parameters
        names, units = zip(*((parameter.name, parameter.unit) for parameter in parameters), strict=True)
        return {"name": names, "unit": units, "nominal": self.chain.params_nominal, "free": self.free}

    def forward(self, q: ArrayLike) -> Floats:
        """Return the poses (n, 4, 4) of the end in the base frame at joint readings q (n, j), or one.

        They are those of the nominal robot, but of the identified one, with its joint laws, if it is a calibration's
        ``robot``. Raises TypeError, InputError.

        Examples
        --------
        >>> import truearm
        >>> truearm.load_robot("puma560").forward([[0.0] * 6]).shape
        (1, 4, 4)
        """
        params = self.chain.params_nominal if self.identified is None else self.identified
        ends = forward(self.chain, params, floats("q", q, None, len(self.chain.joints), or_one=True))
        return ends[0] if np.ndim(q) == 1 else ends

    @property
    def drawing(self) -> Floats | None:
        """Return the drawing's parameters (p,) of a robot whose nominal values are its controller's, else None."""
        names = [name for name in self.parameter_sets if name != CONTROLLER]
        return self.parameter_sets[names[0]] if names and CONTROLLER in self.parameter_sets else None

    @property
    def is_urdf(self) -> bool:
        """Return whether it was read from a URDF.

        This does not say which parameters are fixed: all but the gains are free.
        """
        return self.file.lower().endswith((".urdf", ".xml"))


def parse_robot(text: str) -> Robot:
    """Return the robot described by a TOML text.

    Raises RobotError, naming table and key, for anything missing, unknown or implausible.
    """
    if len(text) > MAX_TEXT:
        raise RobotError(f"robot file has {len(text)} characters, the limit is {MAX_TEXT}; is this the right file?")
    try:
        doc = load_toml(text)
    except (ValueError, RecursionError) as error:  # tomllib propagates int()'s digit limit and impossible dates
        raise RobotError(f"robot file is not valid TOML: {error}; correct this place") from error
    with raising(RobotError, "robot file"):
        head, description = read_tables(doc, HEAD)
        sets = _set_names(description, head["nominal"])
        chain = _chain(head, description)
        branch = head.get("branch")
        if branch is not None:
            with at("branch"):
                check_branch(branch, chain.joints)
        capsules = capsules_of(head["capsule"], len(chain.joints)) if "capsule" in head else None
    amounts = [description.amounts[name] for name in chain.parameter_names]
    values = {name: np.array([amount.values[name] for amount in amounts]) for name in sets}
    free = np.array([not amount.held for amount in amounts], dtype=bool)
    gravity = _unit_vector(head["gravity"]) if "gravity" in head else None
    text, checksums = head.get("source", ""), head.get("checksums", ())
    return Robot(chain, values, free, text, branch, capsules, gravity=gravity, checksums=checksums)


def _unit_vector(direction: tuple[float, float, float]) -> tuple[float, float, float]:
    length = math.hypot(*direction)
    x, y, z = (component / length for component in direction)
    return x, y, z


def _set_names(description: Description, nominal: str) -> list[str]:
    """Return the sets in which every parameter has a value.

    Raises SchemaError naming the first parameter without one.
    """
    sets = {name: amount.values.keys() for name, amount in description.amounts.items() if amount.constant is None}
    if not sets:
        raise SchemaError("no parameter can be identified; write parameters as tables, { design = 0.0 }")
    set_names = sorted({nominal}.union(*sets.values()))
    for set_name in (nominal, *set_names):
        for name, values in sets.items():
            if set_name not in values:
                raise SchemaError(
                    f"{name}: has no value {set_name!r}; every parameter needs the same sets of values ({', '.join(set_names)})"
                )
    return set_names


def _chain(head: Mapping[str, str], description: Description) -> Chain:
    nominal: dict[str, float] = {}
    fixed = set()
    for name, amount in description.amounts.items():
        if amount.constant is None:
            nominal[name] = amount.values[head["nominal"]]
        else:
            nominal[name] = amount.constant
            fixed.add(name)
    frames = head["base_frame"], head["end_frame"]
    return chain_from_slots(head["name"], description.joints, description.slots, nominal, fixed, *frames)
