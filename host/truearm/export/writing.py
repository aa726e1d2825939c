"""Prepare a calibrated robot for a format: refit it for what the format cannot hold, and compute the remaining error.

Formats need the robot with every joint about or along the z axis of its own frame:

    T(q) = B · S_0 · Z_1(θ_1) · S_1 · … · Z_j(θ_j) · S_j · E

B and E are the mountings (``model.robot_mounting``), S_i rigid constants, Z_i a rotation about z or a motion along it,
and θ the true joint angles by the joint law.

Statements about a file are computed from the input of its writer. Its links and its joint law predict poses, and these
are compared with those of the identified robot. A format that declares a term of the law but writes no such term is
rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.additions import blamed, instance
from truearm.errors import RobotError
from truearm.export.formats import FORMATS, Format
from truearm.model import joint_law
from truearm.model.chain import Chain, forward, point_forward, point_jacobians
from truearm.model.chain_structure import GEOMETRY, Joint, Parameter, far_frames
from truearm.model.joint_law import JointLaw
from truearm.model.joint_terms.term import Term
from truearm.model.robot_mounting import NONE, mountings, own_law, own_links
from truearm.model.transforms import apart, elementary
from truearm.types import Floats, rms
from truearm.units import MM, UNITS

# transforms that turn z into the axis of a motion
_TO_AXIS = {"x": elementary("ry", 0.5 * np.pi), "y": elementary("rx", -0.5 * np.pi), "z": np.eye(4)}
EXACT = 1e-9  # m, and of a rotation matrix: a file with such predictions holds everything
NAMED = 8  # parameters that a message names
LEVER = 0.1  # m
MARKS = LEVER * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
SINGULAR = 1e-7  # relative to the largest singular value: below this, a direction moves the end less than rounding
MAX_STEPS = 30
STEP_END = 1e-9  # in the units above: 1 pm, 5 prad


class LinkFrames(NamedTuple):
    """A robot of j joints."""

    name: str
    joints: tuple[Joint, ...]
    links: Floats  # (j + 1, 4, 4) S
    law: JointLaw
    params: Floats  # (p,) of the law, without offsets that are mountings
    base: Floats  # (4, 4) B
    tool: Floats  # (4, 4) E
    base_frame: str
    end_frame: str

    @property
    def offsets(self) -> Floats:
        """Offsets (j,) [rad or m]."""
        return self.law.offset.of(self.params)

    @property
    def gains(self) -> Floats:
        """Gains (j,)."""
        return self.law.gain.of(self.params)

    @property
    def further_terms(self) -> tuple[Term, ...]:
        """The terms of the law other than offset and gain; ``params[term.parameters]`` are for ``term.joints``."""
        return tuple(term for term in self.law.terms if term not in (self.law.offset, self.law.gain))

    @property
    def first(self) -> Floats:
        """The transform before the first joint, including the mounting."""
        return np.asarray(self.base @ self.links[0])

    @property
    def last(self) -> Floats:
        """The transform after the last joint, including the mounting."""
        return np.asarray(self.links[-1] @ self.tool)


def link_frames(chain: Chain, nominal: Floats, calibrated: Floats, with_mountings: bool = True) -> LinkFrames:
    """Return the robot with calibrated parameters (p,); its mountings are relative to the nominal parameters (p,).

    With ``with_mountings`` False they are left out: B and E are then identities.
    """
    links = own_links(chain, nominal, calibrated)
    axes = [np.eye(4), *(_TO_AXIS[motion[1]] for motion in chain.motions), np.eye(4)]
    turned = np.stack(
        [axis.T @ link @ next_axis for link, (axis, next_axis) in zip(links, pairwise(axes), strict=True)]
    )
    mounted = mountings(chain, nominal, calibrated) if with_mountings else NONE
    return LinkFrames(
        name=chain.name,
        joints=chain.joints,
        links=turned,
        law=chain.law,
        params=own_law(chain, nominal, calibrated),
        base=mounted.base,
        tool=mounted.tool,
        base_frame=chain.base_frame,
        end_frame=chain.end_frame,
    )


def predicted(robot: LinkFrames, q: Floats) -> Floats:
    """Return T(q), (n, 4, 4), at joint readings q (n, j)."""
    links = np.stack([robot.first, *robot.links[1:-1], robot.last])
    motions = ["tz" if joint.kind == "prismatic" else "rz" for joint in robot.joints]
    return far_frames(links, motions, robot.law.angles(robot.params, q))[-1]


def joint_motion(joint: Joint, amount: float) -> Floats:
    """Return Z (4, 4)."""
    return elementary("tz" if joint.kind == "prismatic" else "rz", amount)


def check_gains(robot: LinkFrames, format_name: str) -> None:
    """Raise RobotError for a gain other than 1, which ``format_name`` cannot store."""
    for joint, gain in zip(robot.joints, robot.gains, strict=True):
        if gain != 1.0:
            raise RobotError(f"joint {joint.name} has gain {gain:g}, but {format_name} has no gains; refit with gain 1")


@dataclass(frozen=True)
class RobotToWrite:
    """The input of a format's writer: a robot whose joint law contains only what the format holds.

    ``nominal`` and ``params`` are parameters (p,). ``mountings`` False: both ends as nominal. ``comment``: text for the
    head of the file. ``urdf``: the robot's original text, None if that is not a URDF. ``drawing``: parameters (p,) of
    the drawing, None if that is the nominal robot.
    """

    chain: Chain
    nominal: Floats
    params: Floats
    mountings: bool = True
    comment: str = ""
    urdf: str | None = None
    drawing: Floats | None = None

    @cached_property
    def robot(self) -> LinkFrames:
        """The calibrated robot."""
        return link_frames(self.chain, self.nominal, self.params, self.mountings)

    @cached_property
    def described(self) -> LinkFrames:
        """The nominal robot, for choices that follow its manufacturer, such as the directions of axes."""
        return link_frames(self.chain, self.nominal, self.nominal)


Writer = Callable[[RobotToWrite], str]


def writer(name: str) -> Writer:
    """Return the function that writes a format, loading its module. Raises KeyError for an unknown name."""
    module, _, function = FORMATS[name].writer.partition(":")
    with blamed(f"format {name}"):
        write: Writer = getattr(import_module(module, __package__), function)
    return write


class FormatFit(NamedTuple):
    """The parameters that a format holds, and their error relative to the identified ones over n poses."""

    params: Floats  # (p,)
    missing: tuple[str, ...]  # identified parameters that the format cannot hold; a curve or a sag as one
    refitted: bool
    dropped: Floats  # (n,) m, position error if these were simply left out
    left: Floats  # (n,) m, position error of what is written
    dropped_turn: Floats  # (n,) rad, and the error of the orientation
    left_turn: Floats  # (n,) rad
    exact: bool  # the file holds everything that was identified


def written(name: str, robot: RobotToWrite) -> str:
    """Return the text of the format called ``name``. Raises RobotError for a robot that it cannot hold."""
    text = writer(name)(robot)
    with blamed(f"format {name}"):
        instance(str)(text)
    for term in robot.chain.law.moving:
        neutral = np.array(robot.params)
        neutral[term.parameters] = term.neutral
        if not np.array_equal(neutral, robot.params) and writer(name)(replace(robot, params=neutral)) == text:
            raise RobotError(f"{name} declares that it holds {term.name} of a joint, but its file says nothing of it")
    return text


def held(chain: Chain, form: Format) -> NDArray[np.bool_]:
    """Return a mask (p,) of the parameters that a format can hold. Raises ValueError if it declares an unknown term."""
    unknown = set(form.holds) - {term.name for term in joint_law.terms()}
    if unknown:
        raise ValueError(f"a format holds {', '.join(sorted(unknown))}, which no term of the joint law is called")
    return np.array([p.term == GEOMETRY or p.term in form.holds for p in chain.parameters])


def fit_to(
    name: str, chain: Chain, nominal: Floats, identified: Floats, adjustable: NDArray[np.bool_], q: Floats
) -> FormatFit:
    """Fit the parameters that a format holds and are ``adjustable`` (p,) to the identified robot over poses q (n, j).

    Parameters that are not adjustable stay nominal. Raises RobotError without poses, and if no values of the others
    make the file better than the nominal robot.
    """
    if not len(q):
        raise RobotError("there are no poses to compare the file with; give at least one")
    form = FORMATS[name]
    has_place = held(chain, form)
    neutral = {term.name: term.neutral for term in joint_law.terms()}
    without = np.where(has_place, nominal, [neutral.get(p.term, np.nan) for p in chain.parameters])
    start = np.where(adjustable & has_place, identified, without)
    lost = [p for p, is_lost in zip(chain.parameters, ~has_place & (identified != without), strict=True) if is_lost]
    missing = tuple(dict.fromkeys(_called(p) for p in lost))
    refitted = not np.array_equal(start, identified)
    params = refit(chain, identified, start, adjustable & has_place, q) if refitted else identified
    identified_poses = forward(chain, identified, q)
    poses, simply = predicted(link_frames(chain, nominal, params), q), forward(chain, start, q)
    if missing and adjustable.all():
        _check_worth(name, chain, nominal, identified, poses, lost, q)
    return FormatFit(
        params=params,
        missing=missing,
        refitted=refitted,
        dropped=_distance(simply, identified_poses),
        left=_distance(poses, identified_poses),
        dropped_turn=_turn(simply, identified_poses),
        left_turn=_turn(poses, identified_poses),
        exact=bool(np.abs(poses - identified_poses).max(initial=0.0) <= EXACT),
    )


def _called(parameter: Parameter) -> str:
    """Return a parameter's name; for a coefficient, the name of its joint's curve or sag, "joint2.sag"."""
    learned = {term.name for term in joint_law.terms() if term.learned}
    return parameter.name.rpartition(".")[0] if parameter.term in learned else parameter.name


def named(names: tuple[str, ...]) -> str:
    """Return parameter names as a message lists them."""
    return ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")


def _check_worth(
    name: str, chain: Chain, nominal: Floats, identified: Floats, poses: Floats, lost: Sequence[Parameter], q: Floats
) -> None:
    """Raise RobotError unless a file's poses (n, 4, 4) are closer to the identified robot's than the nominal ones.

    Without a gain of −1, for example, no links are useful.
    """
    identified_poses, mounted = forward(chain, identified, q), mountings(chain, nominal, identified)
    as_described = mounted.base @ forward(chain, nominal, q) @ mounted.tool
    if _marks_apart(poses, identified_poses) <= _marks_apart(as_described, identified_poses):
        return
    cost, nominal_cost = (
        MM.text(rms(_distance(written_poses, identified_poses)), ".3f") for written_poses in (poses, as_described)
    )
    terms, missing = {p.term for p in lost}, tuple(dict.fromkeys(map(_called, lost)))
    alternatives = [format_name for format_name, form in FORMATS.items() if terms <= set(form.holds)]
    raise RobotError(
        f"{name} has no place for {named(missing)}; without {'it' if len(missing) == 1 else 'them'}, the file would be no better "
        f"than the nominal robot ({cost} RMS, nominal {nominal_cost}): {'use ' + ' or '.join(alternatives) if alternatives else 'no format holds this robot'}"
    )


def _marks_apart(a: Floats, b: Floats) -> float:
    """Return the sum of squares that ``refit`` minimises."""
    return float(np.sum(((a - b) @ np.concatenate([MARKS.T, np.ones((1, len(MARKS)))])) ** 2))


def _distance(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.linalg.norm((a - b)[:, :3, 3], axis=1))


def _turn(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.linalg.norm(apart(a, b)[:, 3:], axis=1))


def refit(chain: Chain, identified: Floats, start: Floats, adjustable: NDArray[np.bool_], q: Floats) -> Floats:
    """Return parameters (p,), the adjustable ones (p,) fitted from ``start`` (p,) to the robot over poses q (n, j).

    Renders (1991, III-F) identifies only what the controller lets its user adjust. Here the identified robot provides
    the data: the values of the adjustable parameters are those that bring the end closest to the identified robot's.
    Where parameters are interchangeable, the smallest change is taken. This is least squares over four marks on the
    end, LEVER apart, so that rotations of the end count as well. Parameters count in units of a drawing's tolerances.
    """
    params = np.array(start, dtype=float)
    unit = np.array([UNITS[p.unit].weak_sigma for p in chain.parameters])[adjustable]
    identified_marks = _marks(chain, identified, q)
    for _ in range(MAX_STEPS):
        error = (identified_marks - _marks(chain, params, q)).ravel()
        columns = [point_jacobians(chain, params, q, mark)[1][..., adjustable] for mark in MARKS]
        jac = np.stack(columns, axis=1).reshape(error.size, -1) * unit
        step = np.linalg.lstsq(jac, error, rcond=SINGULAR)[0]
        params[adjustable] += unit * step
        if np.abs(step).max(initial=0.0) < STEP_END:
            break
    return params


def _marks(chain: Chain, params: Floats, q: Floats) -> Floats:
    return np.stack([point_forward(chain, params, q, mark) for mark in MARKS], axis=1)
