"""A calibrated robot as URDF or MuJoCo's MJCF: an existing URDF with only its joint origins changed, or a new text.

*In place.* The robot was identified from a URDF, and that text is changed: ``xyz`` and ``rpy`` of the origins on the
path from base to tip. Every other character stays, including comments and spaces. A URDF has no joint offsets: an
offset is a motion along the joint's own axis, and goes into the joint's origin. The mountings go to the ends: that of
the base into the first joint of the path, that of the tool into the last one if that is fixed. Between the ends only
the robot itself has changed.

*New.* For any other chain, a URDF of links without shape: base frame, mounting, joints, flange, mounting, end frame. An
MJCF has bodies with a joint each; masses and shapes are yours to add.

``model.urdf`` has already parsed the text; it rejects document type declarations.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import reduce
from html import unescape
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from truearm.errors import RobotError
from truearm.export.writing import LinkFrames, RobotToWrite, check_gains, joint_motion
from truearm.model.chain import Chain
from truearm.model.transforms import Element, elementary, inverted, position_and_rotation, six_of
from truearm.types import Floats

_ATTRIBUTE = re.compile(r"""\s+([^\s=]+)\s*=\s*("[^"]*"|'[^']*')""")
_TAG = re.compile(
    r"""<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>|<(?P<end>/?)(?P<name>[^\s/>]++)(?:[^"'>]++|"[^"]*+"|'[^']*+')*+>""",
    re.DOTALL,
)  # a comment has no name


class _PathJoint(NamedTuple):
    """A joint of the path and its elements: six of the origin, then alignments and the motion."""

    name: str
    origin: tuple[Element, ...]
    motion: tuple[Element, ...]  # empty for a fixed joint


def write(source: RobotToWrite) -> str:
    """Return the robot's URDF with other origins, or a new one. Raises RobotError for what neither can express."""
    if source.urdf is None:
        return new_urdf(source.robot, source.comment)
    chain, nominal = source.chain, source.nominal
    drawn = joint_origins(chain, nominal, nominal)
    return edited(source.urdf, drawn, joint_origins(chain, nominal, source.params, source.mountings))


def joint_origins(chain: Chain, nominal: Floats, calibrated: Floats, with_mountings: bool = True) -> dict[str, Floats]:
    """Return the origin (4, 4) of every joint on the path of a chain from ``chain_from_urdf``; gains must be 1.

    With ``with_mountings`` False, both ends are unchanged.
    """
    path = _path(chain)
    moving = [i for i, joint in enumerate(path) if joint.motion]
    origins_n = [_product(joint.origin, nominal) for joint in path]
    origins_i = [_product(joint.origin, calibrated) for joint in path]
    offset_n, offset_i = chain.law.offset.of(nominal), chain.law.offset.of(calibrated)
    offsets = [_moved(joint, offset_i) @ inverted(_moved(joint, offset_n)) for joint in path]
    first, last = moving[0], moving[-1]
    has_tail = last + 1 < len(path)
    out = [a @ b for a, b in zip(origins_i, offsets, strict=True)]
    if has_tail:  # a rotation of the last joint is indistinguishable from one of the tool
        out[last] = origins_i[last] if last != first else out[last]
        tail_i = (offsets[last] if last != first else np.eye(4)) @ _chained(origins_i[last + 1 :])
        tool = inverted(_chained(origins_n[last + 1 :])) @ tail_i
        out[last + 1 :] = origins_n[last + 1 :]
        out[-1] = out[-1] @ tool if with_mountings else out[-1]
    base = _chained(out[: first + 1]) @ inverted(_chained(origins_n[: first + 1]))
    out[: first + 1] = origins_n[: first + 1]
    out[0] = base @ out[0] if with_mountings else out[0]
    return {joint.name: origin for joint, origin in zip(path, out, strict=True)}


def _path(chain: Chain) -> list[_PathJoint]:
    """Return the joints of the path by the names of their parameters, ``<joint>.x`` and so on."""
    path: list[_PathJoint] = []
    index, elements = 0, chain.elements
    while index < len(elements):
        origin = elements[index : index + 6]
        names = [chain.parameter_names[e.parameter].rpartition(".") for e in origin if e.parameter is not None]
        if [name[2] for name in names] != ["x", "y", "z", "yaw", "pitch", "roll"]:
            raise RobotError(f"robot {chain.name} was not read from a URDF; a new URDF can be written for it")
        index += 6
        end = index
        while end < len(elements) and elements[end].parameter is None:
            end += 1
        path.append(_PathJoint(names[0][0], origin, elements[index:end]))
        index = end
    return path


def _product(elements: tuple[Element, ...], params: Floats) -> Floats:
    """Return the product of elements that are not joints."""
    amounts = [e.value if e.parameter is None else params[e.parameter] for e in elements]
    return _chained([elementary(e.motion, amount) for e, amount in zip(elements, amounts, strict=True)])


def _moved(joint: _PathJoint, offset: Floats) -> Floats:
    """Return a joint's motion by the offsets (j,), between its alignments."""
    amounts = [e.value if e.joint is None else offset[e.joint] for e in joint.motion]
    return _chained([elementary(e.motion, amount) for e, amount in zip(joint.motion, amounts, strict=True)])


def _chained(motions: list[Floats]) -> Floats:
    return reduce(np.matmul, motions, np.eye(4))


def edited(text: str, drawn: Mapping[str, Floats], origins: Mapping[str, Floats]) -> str:
    """Return the URDF text with other origins of the named joints. Raises RobotError for a joint missing in the text.

    An origin that is the ``drawn`` one to 1e-15 is not rewritten.
    """
    origins = {name: origin for name, origin in origins.items() if np.abs(origin - drawn[name]).max() > 1e-15}
    spans = _origin_spans(text)
    missing = sorted(set(origins) - set(spans))
    if missing:
        raise RobotError(f"URDF has no joint {missing[0]!r}; give the URDF that the result was identified with")
    for name, (start, end) in sorted(spans.items(), key=lambda item: item[1], reverse=True):
        if name in origins:
            text = text[:start] + _with_origin(text[start:end], origins[name]) + text[end:]
    return text


def _origin_spans(text: str) -> dict[str, tuple[int, int]]:
    """Return where the <origin …> tag of each joint of the robot is; an empty span where one can be inserted."""
    elements: list[str] = []
    spans: dict[str, tuple[int, int]] = {}
    joint = ""
    for tag in _TAG.finditer(text):
        if tag["end"]:
            elements.pop()
        if tag["end"] != "":
            continue  # an end tag, or a comment
        elements.append(tag["name"])
        if elements == ["robot", "joint"]:
            attributes = {name: unescape(value[1:-1]) for name, value in _ATTRIBUTE.findall(tag[0])}
            joint = attributes.get("name", "")
            spans[joint] = tag.end(), tag.end()
        elif elements == ["robot", "joint", "origin"] and spans[joint][0] == spans[joint][1]:
            spans[joint] = tag.span()
        if tag[0].endswith("/>"):
            elements.pop()
    return spans


def _with_origin(tag: str, origin: Floats) -> str:
    """Return an <origin …> tag with other numbers; "" becomes a new tag."""
    x, y, z, yaw, pitch, roll = six_of(origin)
    tag = tag or "<origin/>"
    for key, values in (("rpy", (roll, pitch, yaw)), ("xyz", (x, y, z))):
        match = next((attribute for attribute in _ATTRIBUTE.finditer(tag) if attribute[1] == key), None)
        start, end = match.span() if match else (len("<origin"), len("<origin"))
        tag = f"{tag[:start]} {key}={_numbers(values)}{tag[end:]}"
    return tag


def _numbers(values: tuple[float, ...]) -> str:
    """Return three numbers in quotes, each in the shortest form that is read back exactly."""
    return '"' + " ".join(repr(float(value) + 0.0) for value in values) + '"'


def new_urdf(robot: LinkFrames, comment: str = "") -> str:
    """Return a URDF of a chain of any convention. Raises RobotError for gains, which a URDF cannot hold."""
    check_gains(robot, "a URDF")
    names = link_names(robot)
    lines = ['<?xml version="1.0"?>', f"<robot name={quoteattr(robot.name)}>"]
    if comment:
        lines.append(f"  <!-- {comment.replace('--', '- -')} -->")
    lines += [f"  <link name={quoteattr(name)}/>" for name in names]
    joint_names = {joint.name for joint in robot.joints}
    ends = [_other_than(joint_names, name) for name in ("base_mounting", "flange", "tool_mounting")]
    lines += _joint(ends[0], "fixed", names[0], names[1], robot.base)
    for i, (joint, origin) in enumerate(zip(robot.joints, robot.links[:-1], strict=True)):
        kind, limit = joint.kind, ""
        if np.isfinite([joint.lower, joint.upper]).all():
            limit = f'    <limit lower="{joint.lower!r}" upper="{joint.upper!r}" effort="0" velocity="0"/>\n'
        elif joint.kind == "revolute":
            kind = "continuous"
        else:
            raise RobotError(
                f"joint {joint.name} is prismatic without limits, which a URDF cannot express; add its lower_mm and upper_mm to the robot file"
            )
        moving = f'    <axis xyz="0 0 1"/>\n{limit}'
        pose = origin @ joint_motion(joint, float(robot.offsets[i]))
        lines += _joint(joint.name, kind, names[i + 1], names[i + 2], pose, moving)
    lines += _joint(ends[1], "fixed", names[-3], names[-2], robot.links[-1])
    lines += _joint(ends[2], "fixed", names[-2], names[-1], robot.tool)
    return "\n".join([*lines, "</robot>", ""])


def link_names(robot: LinkFrames) -> list[str]:
    """Return base frame, robot base, a link after each joint, flange and end frame; all different."""
    inner = ["robot_base", *(f"link{i + 1}" for i in range(len(robot.joints))), "robot_flange"]
    first = _other_than(set(inner), robot.base_frame)
    return [first, *inner, _other_than({first, *inner}, robot.end_frame)]


def _other_than(names: set[str], name: str) -> str:
    while name in names:
        name += "_"
    return name


def _joint(name: str, kind: str, parent: str, child: str, origin: Floats, content: str = "") -> list[str]:
    x, y, z, yaw, pitch, roll = six_of(origin)
    return [
        f"  <joint name={quoteattr(name)} type={quoteattr(kind)}>",
        f"    <origin xyz={_numbers((x, y, z))} rpy={_numbers((roll, pitch, yaw))}/>",
        f"    <parent link={quoteattr(parent)}/>",
        f"    <child link={quoteattr(child)}/>",
        *([content.rstrip("\n")] if content else []),
        "  </joint>",
    ]


def write_mjcf(source: RobotToWrite) -> str:
    """Return an MJCF. Raises RobotError for gains, which it cannot hold."""
    robot = source.robot
    check_gains(robot, "an MJCF")
    names = link_names(robot)
    motions = [joint_motion(joint, float(x)) for joint, x in zip(robot.joints, robot.offsets, strict=True)]
    origins = [np.eye(4), robot.base, *map(np.matmul, robot.links, [*motions, np.eye(4)]), robot.tool]
    lines = [f"<mujoco model={quoteattr(robot.name)}>"]
    if source.comment:
        lines.append(f"  <!-- {source.comment.replace('--', '- -')} -->")
    lines += ['  <compiler angle="radian" boundmass="0.01" boundinertia="1e-5"/>', "  <worldbody>"]
    for depth, (name, origin) in enumerate(zip(names, origins, strict=True)):
        lines.append(f"{'  ' * (depth + 2)}<body name={quoteattr(name)}{_place(origin)}>")
        if 2 <= depth < 2 + len(robot.joints):
            joint = robot.joints[depth - 2]
            kind = "slide" if joint.kind == "prismatic" else "hinge"
            limited = np.isfinite([joint.lower, joint.upper]).all()
            limit = f' limited="true" range="{joint.lower!r} {joint.upper!r}"' if limited else ""
            lines.append(f'{"  " * (depth + 3)}<joint name={quoteattr(joint.name)} type="{kind}" axis="0 0 1"{limit}/>')
    lines += [f"{'  ' * (depth + 2)}</body>" for depth in reversed(range(len(names)))]
    return "\n".join([*lines, "  </worldbody>", "</mujoco>", ""])


def _place(pose: Floats) -> str:
    """Return the attributes of a body's place."""
    x, y, z, *vector = position_and_rotation(pose[None])[0].tolist()
    angle = float(np.linalg.norm(vector))
    quaternion = [np.cos(0.5 * angle), *(0.5 * np.sinc(0.5 * angle / np.pi) * np.array(vector))]
    numbers = (" ".join(repr(float(value) + 0.0) for value in values) for values in ((x, y, z), quaternion))
    return "".join(f' {key}="{text}"' for key, text in zip(("pos", "quat"), numbers, strict=True))
