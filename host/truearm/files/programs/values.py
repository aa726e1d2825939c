"""The possible values of a program's expressions at run time: numbers, poses, lists, and values known only at run time.

A variable may have one of several values where the program branches, so a value is a tuple of *possibilities*, each
once. A pose stores the literals of which it is made: a product of them, of their inverses and of fixed matrices. A
target reached through names, features and offsets therefore leads back to the numbers that a person taught.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, product
from typing import NamedTuple

from truearm.files.programs.rotations import NO_TURN, Nine, of_quaternion, of_vector, rows_of
from truearm.files.programs.syntax import Form, Number, Taught, Text, Truth
from truearm.units import MM

MOST = 1_000  # possibilities of a function of several arguments
MOST_NUMBERS = 64  # possible results of an operator: a number with more, such as a count, is unknown
MOST_FACTORS = 100  # of a product of poses
MAX_NESTED = 50  # lists and records within each other
MOST_LISTS = 16  # versions of a list or record, before the possibilities of its items are joined
UNIT_QUATERNION = 1e-3  # tolerance of the norm of a quaternion about 1, if it was written with few digits


Origin = frozenset[Taught]  # the literals from whose numbers a value is computed
NO_ORIGIN: Origin = frozenset()
EVERY = Taught(Form.POSE, "", -1)  # represents all literals, where a value is computed from more than MOST_ORIGINS
MOST_ORIGINS = 100
_ALL: Origin = frozenset({EVERY})


class Unknown(NamedTuple):
    """A value known only at run time, and why; ``at``: place in the text, ``remedy``: the argument to resolve it."""

    why: str
    at: int
    remedy: str = ""
    origin: Origin = NO_ORIGIN


_NOT_SOUGHT = Unknown("", 0)


class _Kept:
    """What may be large: its hash and what is asked of its items are computed once."""

    items: tuple[Values, ...]
    _hash: int | None = None
    _depth: int | None = None
    _unknown: Unknown | None = _NOT_SOUGHT
    _origin: Origin | None = None
    _numbers_origin: Origin | None = None

    def __hash__(self) -> int:
        if self._hash is None:
            self._hash = super().__hash__()
        return self._hash

    @property
    def depth(self) -> int:
        """Return how many lists and records are within each other."""
        if self._depth is None:
            self._depth = _depth(self.items)
        return self._depth

    @property
    def unknown(self) -> Unknown | None:
        """Return the first unknown value in it, at any depth of lists."""
        if self._unknown is _NOT_SOUGHT:
            self._unknown = None
            for one in chain.from_iterable(self.items):
                found = one if isinstance(one, Unknown) else one.unknown if isinstance(one, Listed) else None
                if found is not None:
                    self._unknown = found
                    break
        return self._unknown

    @property
    def origin(self) -> Origin:
        """Return the literals in it, and those from whose numbers its items are computed."""
        if self._origin is None:
            self._origin = origin_of(chain.from_iterable(self.items))
        return self._origin

    @property
    def numbers_origin(self) -> Origin:
        """Return the literals from whose numbers its items are computed."""
        if self._numbers_origin is None:
            self._numbers_origin = numbers_origin([*chain.from_iterable(self.items)])
        return self._numbers_origin


class _Listed(NamedTuple):
    items: tuple[Values, ...]
    pose: bool = False


class Listed(_Kept, _Listed):
    """A list or record, each item with its possibilities; ``pose`` where it is a p[…]."""


class _Fields(NamedTuple):
    names: tuple[str, ...]
    items: tuple[Values, ...]


class Fields(_Kept, _Fields):
    """A record with named fields."""


def _depth(items: Iterable[Values]) -> int:
    return 1 + max((one.depth for values in items for one in values if isinstance(one, Listed | Fields)), default=0)


class Fixed(NamedTuple):
    """A rigid motion that is not a literal: the rows of its (4, 4) matrix."""

    rows: tuple[float, ...]


class Factor(NamedTuple):
    """A factor of a product of poses."""

    pose: Taught | Fixed
    inverse: bool = False


class Pose(NamedTuple):
    """A product of poses. ``like``: its robtarget for configuration and external axes; ``free``: any configuration.

    ``origin``: the literals from whose numbers fixed factors are computed.
    """

    factors: tuple[Factor, ...]
    like: Taught | None = None
    free: bool = False
    origin: Origin = NO_ORIGIN


class Solved(NamedTuple):
    """The joints at which a tool has a pose, nearest to ``near``."""

    pose: Pose
    near: Taught | tuple[float, ...] | None
    tool: Pose


class Goal(NamedTuple):
    """The goal of a move: a pose of the tool in a frame, or joint readings.

    ``own_tool``: the tool is not the one in force, as of joints that were computed for a pose.
    """

    target: Pose | Taught
    tool: Pose
    frame: Pose
    near: Taught | tuple[float, ...] | None  # joint readings [rad] that select the configuration
    start: int  # of the argument that contains it
    end: int  # -1 if nothing can replace it
    own_tool: bool = False


class Begin(NamedTuple):
    """Where the robot is when a routine begins, for each of its calls another place; ``scope``: of its names."""

    routine: str
    scope: int


Value = Number | Text | Truth | Taught | Listed | Fields | Pose | Solved | Goal | Unknown | Begin
Values = tuple[Value, ...]

NOWHERE = Pose(())  # the identity


def joined(a: Values | None, b: Values | None) -> Values:
    """Return the possibilities of both, in order; None if there is no value yet."""
    if a is None or a is b:
        return b or ()
    if not b or a == b:
        return a
    return distinct(a + b)


def all_of(found: Sequence[Values]) -> Values:
    """Return the possibilities of several values, in order."""
    if all(one is found[0] or one == found[0] for one in found):
        return found[0] if found else ()
    return distinct(chain.from_iterable(found))


def distinct(values: Iterable[Value]) -> Values:
    """Return each value once, in order.

    If one is unknown, the first reason is kept and numbers are dropped: an unknown number may be any, and several would multiply with each operator.
    """
    if isinstance(values, tuple) and len(values) < 2:
        return values
    found = dict.fromkeys(values)
    if len(found) > 1 and (reason := next((one for one in found if isinstance(one, Unknown)), None)) is not None:
        origin = origin_of(one for one in found if isinstance(one, Unknown | Number))
        kept = (one for one in found if one is reason or not isinstance(one, Unknown | Number))
        return tuple(computed(reason, origin) if one is reason else one for one in kept)
    return tuple(found)


def united(origins: Iterable[Origin]) -> Origin:
    """Return the literals of several origins."""
    found = NO_ORIGIN
    for one in origins:
        if one and one is not found:
            found = found | one if found else one
            if len(found) > MOST_ORIGINS or EVERY in found:
                return _ALL
    return found


def origin_of(values: Iterable[Value]) -> Origin:
    """Return the literals that values contain, and those from whose numbers they are computed."""
    return united(map(_origin_of, values))


def _origin_of(value: Value) -> Origin:
    if isinstance(value, Number | Unknown | Listed | Fields):
        return value.origin
    if isinstance(value, Taught):
        return frozenset({value})
    if isinstance(value, Solved | Pose):
        pose = value.pose if isinstance(value, Solved) else value
        return united((pose.origin, frozenset(literals_in(pose))))
    return NO_ORIGIN


_WITH_NUMBERS = (Number, Unknown, Listed, Fields)


def numbers_origin(values: Sequence[Value]) -> Origin:
    """Return the literals from whose numbers values are computed, but not those that they contain."""
    computed_from = [one for one in values if isinstance(one, _WITH_NUMBERS)]
    if not computed_from:
        return NO_ORIGIN
    return united(one.origin if isinstance(one, Number | Unknown) else one.numbers_origin for one in computed_from)


def computed(value: Value, origin: Origin) -> Value:
    """Return a value as computed also from the numbers of these literals."""
    if isinstance(value, Number | Unknown | Pose) and not origin <= value.origin:
        return value._replace(origin=united((value.origin, origin)))
    if isinstance(value, Listed) and origin:
        return value._replace(items=tuple(tuple(computed(one, origin) for one in item) for item in value.items))
    if isinstance(value, Solved) and origin:
        return value._replace(pose=value.pose._replace(origin=united((value.pose.origin, origin))))
    return value


def merged(values: Values) -> Values:
    """Return lists and records of one shape as one, with the possibilities of all of them item by item, and the others as they are.

    What is lost is which items belong together.
    """
    shapes: dict[object, list[Listed | Fields]] = {}
    others: list[Value] = []
    for one in values:
        if isinstance(one, Listed | Fields):
            shape = (one.pose, len(one.items)) if isinstance(one, Listed) else one.names
            shapes.setdefault(shape, []).append(one)
        else:
            others.append(one)
    for same in shapes.values():
        columns = zip(*(one.items for one in same), strict=True)
        items = tuple(distinct(chain.from_iterable(column)) for column in columns)
        others.append(same[0]._replace(items=tuple(merged(one) if len(one) > MOST_LISTS else one for one in items)))
    return tuple(others)


def combined(at: int, function: Callable[..., Value], arguments: Sequence[Values]) -> Values:
    """Return the results of a function of single values for every combination of possibilities."""
    if len(arguments) == 1:
        return tuple(_traced(function(one), at) for one in arguments[0])
    choices = math.prod(map(len, arguments))
    if choices == 1:
        return (_traced(function(*(one[0] for one in arguments)), at),)
    if choices > most_choices(arguments):
        return (Unknown("it has too many possible values to trace", at),)
    return distinct(_traced(function(*choice), at) for choice in product(*arguments))


def _traced(value: Value, at: int) -> Value:
    """Return a value, unless it is a product of too many poses: each further product would copy all of them."""
    if isinstance(value, Pose) and len(value.factors) > MOST_FACTORS:
        return Unknown(f"it is a product of more than {MOST_FACTORS} poses", at)
    return value


def counts(before: Values | None, after: Values | None) -> bool:
    """Return whether only numbers were added to the possibilities, as from turn to turn of a loop that counts."""
    new = set(after or ()).difference(before or ())
    return bool(new) and all(isinstance(one, Number) for one in new)


def most_choices(arguments: Sequence[Values]) -> int:
    """Return how many choices of possibilities ``combined`` follows at most."""
    return max(MOST, *map(len, arguments))


def first_unknown(values: Sequence[Value]) -> Unknown | None:
    """Return the first of the values known only at run time."""
    return next((value for value in values if isinstance(value, Unknown)), None)


def numbers_of(value: Value) -> tuple[float, ...] | None:
    """Return the plain numbers of a list or literal; None for anything else, or for several possibilities."""
    if isinstance(value, Taught):
        return value.values
    if not isinstance(value, Listed):
        return None
    found = [item[0].value for item in value.items if len(item) == 1 and isinstance(item[0], Number)]
    return tuple(found) if len(found) == len(value.items) else None


def fixed(xyz: Sequence[float], turn: Nine) -> Pose:
    """Return a pose [m] that is not in the text."""
    return Pose((Factor(Fixed(rows_of(xyz, turn))),))


def fixed_six(six: Sequence[float]) -> Pose:
    """Return the pose at x, y, z [m] with a rotation vector [rad]."""
    x, y, z = six[3:]
    return fixed(six[:3], of_vector(x, y, z))


def fixed_mm(xyz: Sequence[float], quaternion: Sequence[float]) -> Pose | None:
    """Return the pose at x, y, z [mm] with a quaternion, scalar first; None for anything else, or without unit norm."""
    if (len(xyz), len(quaternion)) != (3, 4) or not all(map(math.isfinite, xyz)):
        return None
    if not abs(math.hypot(*quaternion) - 1.0) <= UNIT_QUATERNION:
        return None
    w, x, y, z = quaternion
    return fixed([MM.to_si(value) for value in xyz], of_quaternion(w, x, y, z))


def shifted(xyz: Sequence[float]) -> Pose:
    """Return a translation [m]."""
    return fixed(xyz, NO_TURN)


def turned(turn: Nine) -> Pose:
    """Return a rotation about the origin."""
    return fixed((0.0, 0.0, 0.0), turn)


def times(*poses: Pose) -> Pose:
    """Return the product of poses; it has the configuration of the first that has one."""
    like = next((pose.like for pose in poses if pose.like is not None), None)
    origin = united(pose.origin for pose in poses)
    return Pose(tuple(factor for pose in poses for factor in pose.factors), like, origin=origin)


def inverse(pose: Pose) -> Pose:
    """Return the inverse of a pose."""
    factors = tuple(Factor(factor.pose, not factor.inverse) for factor in reversed(pose.factors))
    return Pose(factors, origin=pose.origin)


def taught_pose(taught: Taught) -> Pose:
    """Return a literal as a pose."""
    return Pose((Factor(taught),), taught if taught.form is Form.ROBTARGET else None)


def plain_literal(pose: Pose) -> Taught | None:
    """Return the literal of a pose that is nothing else, otherwise None."""
    factor = pose.factors[0] if len(pose.factors) == 1 else None
    return factor.pose if factor is not None and isinstance(factor.pose, Taught) and not factor.inverse else None


def literals_in(pose: Pose) -> Iterator[Taught]:
    """Yield the literals of a product."""
    return (factor.pose for factor in pose.factors if isinstance(factor.pose, Taught))
