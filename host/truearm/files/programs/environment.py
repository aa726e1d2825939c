"""A program's variables with their possibilities, in layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from truearm.errors import ProgramError
from truearm.files.programs.syntax import Source
from truearm.files.programs.values import Value, Values, joined

Key = tuple[int, str]  # the scope, 0 for the program's own, and the name


WORK, WORK_EACH = 1_500_000, 0.5  # parts of a program that are followed at most, and more for each byte of it
SEVERAL = 8  # possibilities, or layers, that cost as much as one part of an expression


class Work:
    """What may still be spent on a program, in units of about two microseconds: its size bounds the time and the memory."""

    def __init__(self, source: Source) -> None:
        self.source, self.left = source, WORK + WORK_EACH * len(source.text)

    def spend(self, units: int) -> None:
        """Take off units; raises ProgramError where too few are left."""
        self.left -= units
        if self.left < 0:
            raise ProgramError(f"{self.source.name}: its routines and loops are too complex to follow; split it")


class Environment:
    """Variables with their possibilities, in layers: each branch writes to its own, which is then removed and joined."""

    def __init__(self, work: Work) -> None:
        self.work = work
        self.layers: list[dict[Key, Values]] = [{}]
        self.records: list[dict[Key, dict[Value, None]]] = []  # all values of names since each began

    def get(self, key: Key) -> Values | None:
        if len(self.layers) > SEVERAL:
            self.work.spend(len(self.layers) // SEVERAL)
        for layer in reversed(self.layers):
            if key in layer:
                return layer[key]
        return None

    def set(self, key: Key, values: Values) -> None:
        self.work.spend((1 + len(self.records)) * (1 + len(values) // SEVERAL))
        for record in self.records:
            seen = record.get(key)
            if seen is None:
                seen = record[key] = dict.fromkeys(self.get(key) or ())
            seen.update(dict.fromkeys(values))
        self.layers[-1][key] = values

    def since(self, depth: int) -> dict[Key, Values]:
        """Return what was written to the layers from ``depth`` on."""
        out: dict[Key, Values] = {}
        for layer in self.layers[depth:]:
            out |= layer
        return out

    def join(self, ways: Sequence[Mapping[Key, Values]]) -> None:
        """Continue where several paths meet, each with its own assignments."""
        for key in dict.fromkeys(key for way in ways for key in way):
            before = self.get(key)
            values: Values | None = None
            for way in ways:
                values = joined(values, way.get(key, before))
            self.set(key, values or ())
