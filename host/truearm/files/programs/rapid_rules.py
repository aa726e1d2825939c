"""Rules of RAPID that a controller checks when it loads a module, and that decide where a program goes.

A module that assigns to a constant or to the counter of a FOR loop is not loaded. LOCAL data and routines are known
only in their own module.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence

from truearm.files.programs.rapid import Module
from truearm.files.programs.rapid_words import SEARCHES
from truearm.files.programs.syntax import Assign, Block, Call, Expression, Loop, Name, Routine
from truearm.files.programs.tree_walks import calls_in, root_of, statements_in
from truearm.files.programs.work import Work

PREDEFINED = frozenset({"tool0", "wobj0"})
_SEPARATE = "remove LOCAL, or put each module in its own file"
_COUNTING = frozenset({"add", "clear", "decr", "incr"})  # instructions that assign to their first argument


def check_rules(work: Work, modules: Sequence[Module]) -> None:
    """Raise ProgramError with the line of the first assignment to a constant or counter, or use of a LOCAL name."""
    routines = {routine.name: routine for module in modules for routine in module.routines}
    constants = {datum.name for module in modules for datum in module.data if datum.kind == "const"}
    wrong = [
        (at, f"{name} is {what}, which nothing may change, so no controller loads this module; {remedy}")
        for routine in routines.values()
        for at, name, what, remedy in _changed(routine, constants, routines)
    ]
    owners: dict[str, str] = {}  # of LOCAL names
    for module in modules:
        owners |= {name: min(module.name, owners.get(name, module.name)) for name in module.hidden}
    wrong += [
        (at, f"{name} is LOCAL to module {owners[name]}, so module {module.name} does not know it; {_SEPARATE}")
        for module in modules
        if owners
        for name, at in _seen(module, owners)
    ]
    if wrong:
        at, why = min(wrong)
        raise work.source.wrong(at, why)


def _blocks(routine: Routine) -> tuple[Block, ...]:
    return (routine.body, *routine.handlers)


def _own(routine: Routine) -> set[str]:
    """Return the names that a routine declares, except counters."""
    declared = (one for block in _blocks(routine) for one in statements_in(block))
    own = {root_of(one.target) for one in declared if isinstance(one, Assign) and one.scope == "local"}
    return own | {one.name for one in routine.parameters}


def _changed(
    routine: Routine, constants: set[str], routines: Mapping[str, Routine]
) -> Iterator[tuple[int, str, str, str]]:
    """Yield what a routine changes though it may not: place, name, what it is, and what to do."""
    statements = [one for block in _blocks(routine) for one in statements_in(block)]
    found = _assigned(_blocks(routine), routines)
    changed = {name for name, _ in found}
    counters = {one.counter for one in statements if isinstance(one, Loop)}
    yield from ((at, name, "predefined", "use a name of your own") for name, at in found if name in PREDEFINED)
    if not (changed.isdisjoint(constants) and changed.isdisjoint(routine.constants)):
        hidden = _own(routine) | counters
        for name, at in found:
            if name in routine.constants or (name in constants and name not in hidden):
                yield at, name, "a constant", "declare it as PERS or VAR"
    for loop in statements if not changed.isdisjoint(counters) else ():
        if isinstance(loop, Loop) and loop.counter:
            of_loop = [at for name, at in _assigned((loop.body,), routines) if name == loop.counter]
            yield from ((at, loop.counter, "the counter of a FOR loop", "use WHILE instead") for at in of_loop)


def _assigned(blocks: Sequence[Block], routines: Mapping[str, Routine]) -> list[tuple[str, int]]:
    """Return the names to which blocks assign, or that they pass to what assigns to them, with the places."""
    found = [
        (root_of(one.target), one.target.start)
        for block in blocks
        for one in statements_in(block)
        if isinstance(one, Assign) and one.scope != "local"
    ]
    return found + [(root_of(one), call.start) for call in calls_in(tuple(blocks)) for one in _given(call, routines)]


def _given(call: Call, routines: Mapping[str, Routine]) -> Sequence[Expression]:
    """Return the arguments of a call that have to be variables, because it assigns to them."""
    if (routine := routines.get(call.function)) is not None:
        required = [one for one in routine.parameters if not one.optional]
        optional = {one.name for one in routine.parameters if one.optional and one.shared}
        return [
            *(value for one, value in zip(required, call.arguments, strict=False) if one.shared),
            *(value for name, value in call.named if name in optional),
        ]
    if call.function in SEARCHES:
        return call.arguments[1:2]
    return call.arguments[:1] if call.function in _COUNTING else ()


def _seen(module: Module, hidden: Container[str]) -> Iterator[tuple[str, int]]:
    """Yield which LOCAL names of other modules a module uses, with the places; its own hide them."""
    declared = {datum.name for datum in module.data} | {routine.name for routine in module.routines}
    for datum in module.data:
        yield from _named(datum.value, hidden, declared)
    for routine in module.routines:
        loops = (one for block in _blocks(routine) for one in statements_in(block) if isinstance(one, Loop))
        own = _own(routine).union(loop.counter for loop in loops)
        for name, at in _named(_blocks(routine), hidden, declared):
            if name not in own:
                yield name, at


def _named(node: object, names: Container[str], but: Container[str]) -> Iterator[tuple[str, int]]:
    """Yield which of the names, but some, a part of a program uses, with the places."""
    waiting = [node]
    while waiting:
        here = waiting.pop()
        if isinstance(here, Name):
            if here.name in names and here.name not in but:
                yield here.name, here.start
        elif isinstance(here, tuple):
            if isinstance(here, Call) and here.function in names and here.function not in but:
                yield here.function, here.start
            waiting += here
