"""The bounds of numbers and names, shared by the arguments of Python and the options of commands.

``--help`` reads this, so it imports nothing slow.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

from truearm.errors import Argument, InputError
from truearm.units import UNITS

SHOWN = 40  # characters of a wrong value
LONGEST = 200  # bytes of the name of a file or folder; file systems allow 255 bytes


@dataclass(frozen=True)
class Within:
    """A rule: a finite number from ``least`` to ``most``, or several of them."""

    least: float = -math.inf
    most: float = math.inf

    def check(self, name: str, value: Any) -> None:
        """Raise InputError if a value breaks the rule."""
        are_several = isinstance(value, Iterable)
        if not all(
            abs(number) < math.inf and self.least <= number <= self.most
            for number in (value if are_several else (value,))
        ):
            low, high = (f"{end:g}" if math.isfinite(end) else "" for end in (self.least, self.most))
            limits = f" from {low} to {high}" if low and high else f" of {low} or more" if low else ""
            finite = "" if limits else "finite "
            noun = f"{finite}numbers" if are_several else f"a {finite}number"
            raise InputError(Argument(name), f": must be {noun}{limits}, is {str(value)[:SHOWN]}")


@dataclass(frozen=True)
class FileName:
    """A rule: a path that a file can have."""

    def check(self, name: str, value: str | os.PathLike[str]) -> None:
        """Raise InputError if a value breaks the rule."""
        path = os.fspath(value)
        if not path or "\0" in path:
            raise InputError(Argument(name), f": {path[:SHOWN]!r} is not the name of a file")
        if max(len(os.fsencode(component)) for component in re.split(r"[/\\]", path)) > LONGEST:
            raise InputError(Argument(name), f": {path[:SHOWN]!r}… is too long for the name of a file")


@dataclass(frozen=True)
class OneOf:
    """A rule: one of several names."""

    names: Collection[str]

    def check(self, name: str, value: Any) -> None:
        """Raise InputError if a value breaks the rule."""
        if value not in self.names:
            raise InputError("wrong-value", place=Argument(name), value=value[:SHOWN], names=list(self.names))


PATH = FileName()
SEED = Within(0)
ITERATIONS = Within(1, 10_000)
LINE_POINTS = Within(5)
POSES = Within(1)
MINUTES = Within(1.0, 100_000.0)
CANDIDATES = Within(9, 100_000)
REPEATABILITY = Within(1e-8, UNITS["m"].largest)  # m, of a bar; a rig has none that is exact
TRAVEL = Within(0.0, UNITS["m"].largest)  # m, kept free or varied by a plan
DWELL = Within(1.5, 600.0)  # s; a shorter one gives no observation (session/dwells.py)
VISITS = Within(1, 10)
CHECK_POSES = Within(0, 100)
CELL = Within(1e-3, 1.0)  # m, of an error map
DURATION = Within(1e-3)  # s, of a recording
