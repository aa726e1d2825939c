"""URDF chains: the path of joints from a base link to a tip link, six constants per joint origin, two per moving joint.

A URDF joint is ``Trans(xyz)·Rz(yaw)·Ry(pitch)·Rx(roll)`` followed by its motion along or about ``axis``. An axis that
is not a coordinate axis is reached by a fixed alignment, ``A·Rz(θ)·A⁻¹`` with ``A = Rz(φ)·Ry(ψ)`` and ``A·e_z = axis``,
whose constants are not parameters. Joint law: θ = offset + gain·q with nominal offset 0 and gain 1.

Parameters, base to tip: ``<joint>.x .y .z .yaw .pitch .roll`` for every joint of the path, including fixed ones, and
``<joint>.offset .gain`` for those that move. Joints off the path are ignored. A mimic joint on the path is one of the
chain's joints, whose reading follows from that of the joint it mimics (``model.chain_structure``).

The text may be untrusted: no document type, no entities, bounded size, finite numbers of a plausible size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import NamedTuple
from xml.etree.ElementTree import Element as Xml
from xml.etree.ElementTree import ParseError

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from truearm.errors import Argument, RobotError
from truearm.model.chain import Chain, joint_frames
from truearm.model.chain_structure import Joint, Mimic, Parameter
from truearm.model.joint_terms.term import Gain, Offset
from truearm.model.robot import Capsules
from truearm.model.transforms import Element, elementary
from truearm.text import listed
from truearm.types import Floats, Mask
from truearm.units import UNITS

MAX_TEXT = 8_000_000  # characters; a large humanoid has about 200,000
MAX_JOINTS = 10_000
MAX_PATH = 64
MAX_ANGLE_RAD = 1e4
ORIGIN = (("x", "tx"), ("y", "ty"), ("z", "tz"), ("yaw", "rz"), ("pitch", "ry"), ("roll", "rx"))
MOVING = ("revolute", "continuous", "prismatic")
TYPES = (*MOVING, "fixed", "floating", "planar")
XACRO = "xacro}"  # ends the namespace of macros: {http://www.ros.org/wiki/xacro}


class _UrdfJoint(NamedTuple):
    name: str
    kind: str
    parent: str
    child: str
    xml: Xml


def chain_from_urdf(text: str, base: str | None = None, tip: str | None = None) -> Chain:
    """Return the chain of a URDF text from link ``base`` (default: the root) to link ``tip`` (default: the only leaf).

    Raises RobotError with a one-line message for text that is not URDF, for loops, unknown links, joints that cannot be
    modelled, and numbers that are not finite or implausible. With several leaves and no tip, the message lists the
    leaves.
    """
    root, path = _root_and_path(text, base, tip)
    return _build(root.get("name") or "robot", path)


def capsules_from_urdf(text: str, chain: Chain) -> Capsules | None:
    """Return capsules that contain the collision shapes of a chain's links; None if there are none, or one is a mesh.

    The chain is that of ``chain_from_urdf`` for this text. Raises RobotError for a shape with invalid numbers.
    """
    root, path = _root_and_path(text, chain.base_frame, chain.end_frame)
    shapes = {node.get("name"): node.findall("collision") for node in root.findall("link")}
    frames = [np.eye(4), *joint_frames(chain, chain.params_nominal, np.zeros(len(chain.joints)))]
    joint, pose = [0], [np.eye(4)]  # of each link on the path: the joint that it moves with, and its pose with all at 0
    for step in path:
        joint.append(joint[-1] + (step.kind != "fixed"))
        pose.append(pose[-1] @ _transform(_origin(f"URDF joint {step.name}", step.xml)))
    capsules = [
        (number, np.linalg.inv(frames[number]) @ frame, _capsule(f"URDF link {link}: collision", node))
        for link, number, frame in zip([path[0].parent, *(step.child for step in path)], joint, pose, strict=True)
        for node in shapes[link]
    ]
    sized = [(number, frame, *capsule) for number, frame, capsule in capsules if capsule is not None]
    if not sized or len(sized) < len(capsules):
        return None
    joints, _, _, radii = zip(*sized, strict=True)
    ends = [ends @ frame[:3, :3].T + frame[:3, 3] for _, frame, ends, _ in sized]
    return Capsules(joints, np.array(ends), np.array(radii))


def _capsule(place: str, node: Xml) -> tuple[Floats, float] | None:
    """Return ends (2, 3) and radius [m] of a capsule around a box, cylinder or sphere, in the link's frame.

    None for a mesh.
    """
    shape = next((child for tag in ("box", "cylinder", "sphere") for child in node.findall(f"geometry/{tag}")), None)
    if shape is None:
        return None

    def size(key: str, count: int = 1) -> list[float]:
        values = _numbers(place, f"{shape.tag} {key}", shape.get(key, ""), count, UNITS["m"].largest)
        if min(values) <= 0.0:
            raise RobotError(f"{place}: {shape.tag} {key} must be greater than 0")
        return values

    if shape.tag == "box":
        half = 0.5 * np.array(size("size", 3))
        axis = int(np.argmax(half))
        reach, radius = half[axis], math.hypot(*np.delete(half, axis))
    else:
        axis, radius = 2, size("radius")[0]
        reach = 0.5 * size("length")[0] if shape.tag == "cylinder" else 0.0
    frame = _transform(_origin(place, node))
    along = reach * frame[:3, axis]
    return np.array([frame[:3, 3] - along, frame[:3, 3] + along]), radius


def _transform(origin: Sequence[float]) -> Floats:
    """Return the pose (4, 4) of an origin's six constants."""
    return reduce(np.matmul, [elementary(motion, value) for (_, motion), value in zip(ORIGIN, origin, strict=True)])


def _root_and_path(text: str, base: str | None, tip: str | None) -> tuple[Xml, list[_UrdfJoint]]:
    root = _parse(text)
    joints = _read_joints(root)
    links = _read_links(root, joints)
    by_child = {j.child: j for j in joints}
    base = base or _only(sorted(links - set(by_child)), "root links", "base")
    for link in (base, tip):
        if link is not None and link not in links:
            raise RobotError(f"URDF has no link {link!r}; it has {listed(sorted(links))}")
    tip = tip or _only(_leaves(base, joints), "end links", "tip")
    return root, _path(base, tip, by_child)


def _parse(text: str) -> Xml:
    if len(text) > MAX_TEXT:
        raise RobotError(
            f"URDF has {len(text)} characters, the limit is {MAX_TEXT}; give a file of one arm, without other robots and scenery"
        )
    try:
        root = fromstring(text, forbid_dtd=True)
    except DefusedXmlException as error:
        raise RobotError("URDF must not contain a document type or entities; remove them") from error
    except (ParseError, ValueError) as error:
        raise RobotError(f"URDF is not valid XML: {error}; correct this place, or export the URDF again") from error
    if root.tag != "robot":
        raise RobotError(f"URDF must start with <robot>, starts with <{root.tag}>")
    macro = next((node.tag.partition(XACRO)[2] for node in root if XACRO in node.tag), None)
    if macro is not None:  # links and joints may be in it
        raise RobotError(f"URDF has <xacro:{macro}>; expand it first, such as with: xacro FILE > robot.urdf")
    return root


def _read_joints(root: Xml) -> list[_UrdfJoint]:
    # Only direct children: <joint> inside <transmission> has another meaning.
    nodes = root.findall("joint")
    if len(nodes) > MAX_JOINTS:
        raise RobotError(
            f"URDF has {len(nodes)} joints, the limit is {MAX_JOINTS}; give a file of one arm, without other robots and scenery"
        )
    out = [_read_joint(node) for node in nodes]
    for role, names in (("joint name", [j.name for j in out]), ("parent of link", [j.child for j in out])):
        twice = sorted({n for n in names if names.count(n) > 1}) if len(set(names)) < len(names) else []
        if twice:
            raise RobotError(f"URDF has more than one {role} {twice[0]!r}; joints must form a tree")
    return out


def _read_joint(node: Xml) -> _UrdfJoint:
    name, kind = node.get("name"), node.get("type")
    if not name:
        raise RobotError("URDF has a joint without a name; give it one")
    if kind not in TYPES:
        raise RobotError(f"URDF joint {name}: type {kind!r} is not known; use one of {', '.join(TYPES)}")
    ends = []
    for tag in ("parent", "child"):
        end = node.find(tag)
        link = None if end is None else end.get("link")
        if not link:
            raise RobotError(f"URDF joint {name} has no <{tag} link=…>")
        ends.append(link)
    return _UrdfJoint(name, kind, ends[0], ends[1], node)


def _read_links(root: Xml, joints: list[_UrdfJoint]) -> set[str]:
    """Return the names of the links. Raises RobotError if there are none, or a joint refers to another link."""
    links = {node.get("name") or "" for node in root.findall("link")}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                raise RobotError(f"URDF joint {joint.name} refers to link {link!r}, which does not exist")
    if not links:
        raise RobotError("URDF has no links; give the file that describes the robot")
    return links


def _leaves(base: str, joints: list[_UrdfJoint]) -> list[str]:
    """Return the links below base (base itself if alone) that are not the parent of any joint."""
    children: dict[str, list[str]] = {}
    for joint in joints:
        children.setdefault(joint.parent, []).append(joint.child)
    below: list[str] = []
    todo = [base]
    while todo and len(below) <= len(joints):
        below.append(todo.pop())
        todo += children.get(below[-1], [])
    return sorted(link for link in below if link not in children)


def _path(base: str, tip: str, by_child: Mapping[str, _UrdfJoint]) -> list[_UrdfJoint]:
    path: list[_UrdfJoint] = []
    link, passed = tip, {tip}
    while link != base:
        if link not in by_child:
            above = _fixed_above(base, by_child)
            advice = f", or base {above!r}, to which {base!r} is fixed" if above != base else ""
            raise RobotError(f"URDF: link {tip!r} is not below link {base!r}; choose a tip below the base{advice}")
        path.append(by_child[link])
        link = path[-1].parent
        if link in passed:
            raise RobotError(f"URDF: the joints above link {tip!r} form a loop")
        passed.add(link)
        if len(path) > MAX_PATH:
            raise RobotError(f"URDF: more than {MAX_PATH} joints between {base!r} and {tip!r}")
    if not path:
        raise RobotError(f"URDF: base and tip are the same link {base!r}; choose two links")
    return path[::-1]


def _fixed_above(link: str, by_child: Mapping[str, _UrdfJoint]) -> str:
    """Return the link from which a link hangs by one fixed joint, such as a UR's base_link; otherwise itself."""
    joint = by_child.get(link)
    return joint.parent if joint is not None and joint.kind == "fixed" else link


def _build(name: str, path: list[_UrdfJoint]) -> Chain:
    base, tip = path[0].parent, path[-1].child
    elements: list[Element] = []
    parameters: list[Parameter] = []
    joints: list[Joint] = []
    for joint in path:
        for (key, motion), value in zip(ORIGIN, _origin(f"URDF joint {joint.name}", joint.xml), strict=True):
            elements.append(Element(motion, parameter=len(parameters)))
            parameters.append(Parameter(f"{joint.name}.{key}", "m" if motion[0] == "t" else "rad", value))
        if joint.kind == "fixed":
            continue
        index = len(joints)
        elements += _moving(joint, index)
        joints.append(_driven_joint(joint) if joint.xml.find("mimic") is None else _mimic_joint(joint, path))
        for term in (Offset, Gain):
            unit = term.unit_of(joints[index].kind)
            parameters.append(Parameter(f"{joint.name}.{term.name}", unit, term.neutral, term.name, index))
    if not joints:
        raise RobotError(f"URDF: no joint moves between {base!r} and {tip!r}; choose links farther apart")
    return Chain(name, tuple(elements), tuple(parameters), tuple(joints), base, tip)


def _origin(place: str, xml: Xml) -> tuple[float, ...]:
    node = xml.find("origin")
    xyz = _numbers(place, "origin xyz", "0 0 0" if node is None else node.get("xyz", "0 0 0"), 3, UNITS["m"].largest)
    roll, pitch, yaw = _numbers(
        place, "origin rpy", "0 0 0" if node is None else node.get("rpy", "0 0 0"), 3, MAX_ANGLE_RAD
    )
    return (*xyz, yaw, pitch, roll)


def _moving(joint: _UrdfJoint, number: int) -> list[Element]:
    """Return the joint's own motion, between alignments if its axis is not a coordinate axis."""
    if joint.kind not in MOVING:
        raise RobotError(
            f"URDF joint {joint.name}: a {joint.kind} joint on the path cannot be modelled; choose base and tip without it between them"
        )
    x, y, z = _axis(joint)
    letter = "t" if joint.kind == "prismatic" else "r"
    for name, unit in (("x", (1.0, 0.0, 0.0)), ("y", (0.0, 1.0, 0.0)), ("z", (0.0, 0.0, 1.0))):
        if (x, y, z) == unit:
            return [Element(letter + name, joint=number)]
    phi, psi = math.atan2(y, x), math.atan2(math.hypot(x, y), z)
    return [
        *(Element("rz", phi), Element("ry", psi)),
        Element(letter + "z", joint=number),
        *(Element("ry", -psi), Element("rz", -phi)),
    ]


def _axis(joint: _UrdfJoint) -> tuple[float, float, float]:
    node = joint.xml.find("axis")
    text = "1 0 0" if node is None else node.get("xyz", "1 0 0")
    x, y, z = _numbers(f"URDF joint {joint.name}", "axis xyz", text, 3, 1e6)
    norm = math.hypot(x, y, z)
    if norm < 1e-6:
        raise RobotError(f"URDF joint {joint.name}: its axis has no length; give one such as 0 0 1")
    return x / norm, y / norm, z / norm


def _driven_joint(joint: _UrdfJoint) -> Joint:
    """Return a joint that follows no other, with its limits.

    A continuous one, and a revolute one without <limit>, has none.
    """
    kind = "prismatic" if joint.kind == "prismatic" else "revolute"
    node = joint.xml.find("limit")
    if joint.kind == "continuous" or (node is None and kind == "revolute"):
        return Joint(joint.name, kind, -math.inf, math.inf)
    if node is None:
        raise RobotError(f"URDF joint {joint.name} is {joint.kind} and needs a <limit>; give it one")
    bound = UNITS["m"].largest if kind == "prismatic" else MAX_ANGLE_RAD
    lower, upper = (
        _numbers(f"URDF joint {joint.name}", f"limit {k}", node.get(k, "0"), 1, bound)[0] for k in ("lower", "upper")
    )
    if lower > upper:
        raise RobotError(f"URDF joint {joint.name}: its lower limit {lower:g} is above its upper limit {upper:g}")
    return Joint(joint.name, kind, lower, upper)


def _mimic_joint(joint: _UrdfJoint, path: list[_UrdfJoint]) -> Joint:
    """Return a joint that follows another of the path, directly or by way of other mimic joints.

    It has no limits of its own.
    """
    moving = [step for step in path if step.kind != "fixed"]
    place, followed, multiplier, offset = f"URDF joint {joint.name}: mimic", joint, 1.0, 0.0
    for _ in moving:
        node = followed.xml.find("mimic")
        if node is None:
            break
        slope, shift = (
            _numbers(place, key, node.get(key, usual), 1, MAX_ANGLE_RAD)[0]
            for key, usual in (("multiplier", "1"), ("offset", "0"))
        )
        multiplier, offset = multiplier * slope, multiplier * shift + offset
        name = node.get("joint")
        of_path = [step for step in moving if step.name == name]
        if not of_path:
            raise RobotError(
                f"{place} joint={name!r} is not a moving joint between base and tip; choose both so that it is"
            )
        followed = of_path[0]
    if followed.xml.find("mimic") is not None:
        raise RobotError(f"{place}: the joints mimic each other; one of them must move on its own")
    kind = "prismatic" if joint.kind == "prismatic" else "revolute"
    return Joint(joint.name, kind, -math.inf, math.inf, Mimic(moving.index(followed), multiplier, offset))


def _numbers(place: str, key: str, text: str, count: int, bound: float) -> list[float]:
    label = f"{place}: {key}={text[:60]!r}"
    try:
        values = [float(word) for word in text.split()]
    except ValueError as error:
        raise RobotError(f"{label} is not numbers (expand xacro files first)") from error
    if "_" in text or not text.isascii():  # float() accepts "0_1" and the digits of other scripts
        raise RobotError(f"{label} is not numbers; write digits with a decimal point")
    if len(values) != count:
        raise RobotError(f"{label} needs {count} number{'s' if count > 1 else ''}")
    if not all(math.isfinite(v) and abs(v) <= bound for v in values):
        raise RobotError(f"{label} is not finite or larger than {bound:g} (URDF is in m and rad)")
    return values


def _only(candidates: list[str], role: str, option: str) -> str:
    if len(candidates) == 1:
        return candidates[0]
    if not candidates:
        raise RobotError(f"URDF has no {role}: its joints form a loop")
    raise RobotError(f"URDF has {len(candidates)} {role}; choose ", Argument(option), f" among {listed(candidates)}")


def free_without_gains(chain: Chain) -> Mask:
    """Return True (p,) for all except joint gains: encoders count complete turns of the joint, so their gain is 1."""
    return np.array([p.term != Gain.name for p in chain.parameters])
