"""A program's variables with their possibilities, in layers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from truearm.files.programs.values import Value, Values, joined

Key = tuple[int, str]  # the scope, 0 for the program's own, and the name


class Environment:
    """Variables with their possibilities, in layers: each branch writes to its own, which is then removed and joined."""

    def __init__(self) -> None:
        self.layers: list[dict[Key, Values]] = [{}]
        self.records: list[dict[Key, dict[Value, None]]] = []  # all values of names since each began

    def get(self, key: Key) -> Values | None:
        for layer in reversed(self.layers):
            if key in layer:
                return layer[key]
        return None

    def set(self, key: Key, values: Values) -> None:
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
