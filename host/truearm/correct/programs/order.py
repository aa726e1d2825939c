"""Which statements may come immediately before another, by following the text through branches, loops and routines.

This answers two questions: from which targets the robot comes to a target, and which frames are in force at a move.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar, assert_never

from truearm.correct.programs.program import Step

MOST_ORIGINS = 4  # moves that may be the last one before a move; more count as unknown
MOST_SETTINGS = 100  # of a tool or base that may be the last one before a move
MOST_READINGS = 40  # of a text, and one for each routine; loops nested deeper leave all of it unknown
UNKNOWN: frozenset[None] = frozenset([None])
LOOPS = (Step.LOOP, Step.REPEAT)
T = TypeVar("T")


def closure(start: Iterable[T], following: Callable[[T], Iterable[T]]) -> set[T]:
    """Return the nodes that ``following`` leads to, with those at the start."""
    reached = set(start)
    waiting = list(reached)
    while waiting:
        new = set(following(waiting.pop())) - reached
        reached |= new
        waiting += new
    return reached


@dataclass(eq=False)
class _Block(Generic[T]):
    """A routine, choice or loop: what may come before it, and at the ends of its branches.

    ``is_skipped``: whether some way leads past all of its branches.
    """

    step: Step
    number: int
    incoming: frozenset[T | None]
    is_skipped: bool
    ends: list[frozenset[T | None]] = field(default_factory=list)


def preceding(
    steps: Sequence[Step | T],
    counts: Callable[[T], bool],
    limit: int,
    linked: Callable[[T], Sequence[T]] = lambda entry: (),
) -> dict[T, frozenset[T | None]]:
    """Return, for every entry of ``steps``, which entries that count may be the last before it.

    None among them: it is unknown, as where a routine begins, or after a call. More than ``limit`` are unknown too.
    ``linked``: what came before these entries is what comes before all after this one, such as the ends of a routine
    that it calls.
    """
    places: dict[T, list[int]] = defaultdict(list)
    for index, step in enumerate(steps):
        if not isinstance(step, Step):
            places[step].append(index)
    links = {entry: [index for link in linked(entry) for index in places.get(link, [-1])] for entry in places}
    following = {entry: frozenset[T | None]([entry]) if counts(entry) else None for entry in places}
    # before each entry; at a loop, before its end; the last for all that no step precedes
    last: list[frozenset[T | None]] = [*[frozenset[T | None]()] * len(steps), UNKNOWN]
    crowded: set[int] = set()

    def union(key: int, *states: frozenset[T | None]) -> frozenset[T | None]:
        joined = states[0].union(*states[1:])
        if len(joined) > limit:
            crowded.add(key)
        return UNKNOWN if key in crowded else joined

    for _ in range(MOST_READINGS + steps.count(Step.ROUTINE)):
        previous, blocks = [*last], list[_Block[T]]()
        state: frozenset[T | None] = UNKNOWN
        for index, step in enumerate(steps):
            if not isinstance(step, Step):
                last[index] = state
                state = union(index, *(last[link] for link in links[step])) if links[step] else following[step] or state
                continue
            match step:
                case Step.ROUTINE | Step.IF | Step.LOOP | Step.REPEAT:
                    state = union(index, state, last[index]) if step in LOOPS else state
                    blocks.append(_Block(step, index, state, step is not Step.REPEAT))
                    state = UNKNOWN if step is Step.ROUTINE else state
                case Step.CALL:
                    state = UNKNOWN
                case Step.LEAVE:
                    for block in [block for block in blocks if block.step in LOOPS][-1:]:
                        block.ends.append(state)
                case Step.BRANCH | Step.ELSE:
                    for block in blocks[-1:]:
                        block.ends.append(state)
                        block.is_skipped &= step is Step.BRANCH or block.step is not Step.IF
                        state = block.incoming
                case Step.END:
                    if blocks:
                        block = blocks.pop()
                        state = union(index, state, *block.ends)
                        last[block.number] = state
                        if block.step is Step.ROUTINE:
                            state = block.incoming
                        elif block.is_skipped:
                            state = union(~index, state, block.incoming)
                case _:
                    assert_never(step)
        if last == previous:
            unions = {entry: frozenset[T | None]().union(*(last[i] for i in places[entry])) for entry in places}
            return {entry: joined if len(joined) <= limit else UNKNOWN for entry, joined in unions.items()}
    return dict.fromkeys(places, UNKNOWN)
