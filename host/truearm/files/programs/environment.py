"""A program's variables with their possibilities, in layers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from truearm.files.programs.values import Begin, Unknown, Value, Values, all_of
from truearm.files.programs.work import SEVERAL, Work

Key = tuple[int, str]  # the scope, 0 for the program's own, and the name
GLOBAL = 0
HERE: Key = (GLOBAL, "where the robot is")  # variable names contain no spaces
TOOL = "tool in force"


class Trace:
    """What a routine reads of what was before it, every value that it gives to a name, and its moves from where it begins.

    ``depth``: its first layer; ``scope``: of its own names, those of routines within it are later; ``records``: those
    begun before it; ``swept``: names of which it would change a caller's own variable. It is not ``repeatable`` if what it
    does depends on more than what it reads.
    """

    def __init__(self, depth: int, scope: int, records: int) -> None:
        self.depth, self.scope, self.records = depth, scope, records
        self.read: dict[Key, Values | None] = {}
        self.written: dict[Key, dict[Value, None]] = {}
        self.swept: set[str] = set()
        self.legs: dict[tuple[int, Values, Values], None] = {}
        self.repeatable = True

    def reads(self, key: Key, values: Values | None, layer: int) -> None:
        """Note what is read, unless it is the routine's own."""
        if layer < self.depth and key not in self.read and key[0] < self.scope:
            self.read[key] = values

    def writes(self, key: Key, values: Iterable[Value]) -> None:
        """Note what is written, unless it is the routine's own."""
        if key[0] < self.scope:
            _add(self.written.setdefault(key, {}), values)


_NONE = (None, -1)
_SEVERAL: Values = (Unknown("it may be at too many places to be distinguished", 0),)
MOST_PLACES = 64  # where the robot may be: maximum number that are distinguished


class Environment:
    """Variables with their possibilities, in layers: each branch writes to its own, which is then removed and joined."""

    def __init__(self, work: Work) -> None:
        self.work = work
        self.records: list[dict[Key, dict[Value, None]]] = []  # all values of names since each began
        self.traces: list[Trace] = []
        self._layers: list[dict[Key, Values]] = [{}]
        self._now: dict[Key, tuple[Values | None, int]] = {}  # the values of every name, and their layer
        self._before: list[dict[Key, tuple[Values | None, int]]] = [{}]  # what each layer hides

    @property
    def depth(self) -> int:
        """Return the number of layers."""
        return len(self._layers)

    def begin(self, values: Mapping[Key, Values]) -> None:
        """Begin a layer with these values."""
        self._layers.append({})
        self._before.append({})
        for key, each in values.items():
            self._write(key, each)

    def begin_any_time(self, record: Mapping[Key, Mapping[Value, None]]) -> None:
        """Begin a layer where each name may have every value of a record."""
        self.begin({key: few(tuple(seen)) if key == HERE else tuple(seen) for key, seen in record.items()})

    def end(self) -> dict[Key, Values]:
        """Remove the last layer and return its values."""
        self._now.update(self._before.pop())
        return self._layers.pop()

    def _write(self, key: Key, values: Values) -> None:
        layer = self._layers[-1]
        if key not in layer:
            self._before[-1][key] = self._now.get(key, _NONE)
        layer[key] = values
        self._now[key] = values, len(self._layers) - 1

    def get(self, key: Key) -> Values | None:
        """Return the possible values of a name; None if it has none."""
        values, layer = self._now.get(key, _NONE)
        if self.traces and layer < (trace := self.traces[-1]).depth and key not in trace.read:
            trace.reads(key, values, layer)
        return values

    def find(self, key: Key) -> tuple[Values | None, int]:
        """Return the possible values of a name and their layer, which no trace notes."""
        return self._now.get(key, _NONE)

    def set(self, key: Key, values: Values) -> None:
        """Give values to a name."""
        self.work.spend((1 + len(self.records)) * (1 + len(values) // SEVERAL))
        known = values
        if key == HERE:
            values = few(values)
            known = places_known(values)
        self.trace(key, known)
        self.record(key, known)
        self._write(key, values)

    def trace(self, key: Key, values: Iterable[Value]) -> None:
        """Note values of a name in the trace."""
        if self.traces:
            trace = self.traces[-1]
            trace.writes(key, values)
            if len(self.records) > trace.records:
                self.get(key)  # a record that it began has the value before

    def record(self, key: Key, values: Iterable[Value]) -> None:
        """Add values of a name to the records."""
        for record in self.records:
            seen = record.get(key)
            if seen is None:
                seen = record[key] = dict.fromkeys(places_known(self.find(key)[0] or ()))
            _add(seen, values)

    def since(self, depth: int) -> dict[Key, Values]:
        """Return what was written to the layers from ``depth`` on."""
        out: dict[Key, Values] = {}
        for layer in self._layers[depth:]:
            out |= layer
        return out

    def join(self, ways: Sequence[Mapping[Key, Values]]) -> None:
        """Continue where several paths meet, each with its own assignments."""
        for key in dict.fromkeys(key for way in ways for key in way):
            before = self.get(key)
            found = [values for way in ways if (values := way.get(key, before))]
            self.work.spend(sum(map(len, found)) if len(found) > 1 else 0)
            self.set(key, all_of(found))


def _add(seen: dict[Value, None], values: Iterable[Value]) -> None:
    """Add values, of which a dict already knows the hashes."""
    if isinstance(values, dict):
        seen.update(values)
    else:
        for one in values:
            seen[one] = None


def few(places: Values) -> Values:
    """Return the places where the robot may be, or if they are too many, that it may be anywhere."""
    return places if len(places) <= MOST_PLACES else _SEVERAL


def places_known(values: Values) -> Values:
    """Return values without the place where a routine begins: records have those from which it is called."""
    return tuple(one for one in values if not isinstance(one, Begin)) if begins(values) else values


def begins(places: Values) -> bool:
    """Return whether one of these places is where a routine begins."""
    return Begin in map(type, places)
