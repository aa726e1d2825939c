"""Which statements may come immediately before another, by following the text through branches, loops and routines.

This answers two questions: from which targets the robot comes to a target, and which frames are in force at a move.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from truearm.correct.programs.program import Step

MOST_ORIGINS = 4  # moves that may be the last one before a move; more count as unknown
MOST_SETTINGS = 100  # of a tool or base that may be the last one before a move
UNKNOWN: frozenset[None] = frozenset([None])
LOOPS = (Step.LOOP, Step.REPEAT)
T = TypeVar("T")
Source = int | frozenset[T | None]  # what may be the last before another step, or that


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
    """A routine, choice or loop: its first step with what comes before it, and the last steps of its finished branches.

    ``is_skipped``: whether some way leads past all of its branches.
    """

    step: Step
    number: int
    incoming: list[Source[T]]
    is_skipped: bool
    ends: list[Source[T]] = field(default_factory=list)


def preceding(
    steps: Sequence[Step | T],
    counts: Callable[[T], bool],
    limit: int,
    linked: Callable[[T], Sequence[T]] = lambda entry: (),
) -> dict[T, frozenset[T | None]]:
    """Return, for every entry of ``steps``, which entries that count may be the last before it.

    None among them: it is unknown, as where a routine begins, or after a call. More than ``limit`` are unknown too.
    ``linked``: what came before these entries is what comes before all after this one, such as the ends of a routine that it calls.
    """
    places: dict[T, list[int]] = defaultdict(list)
    for index, step in enumerate(steps):
        if not isinstance(step, Step):
            places[step].append(index)

    nowhere: list[Source[T]] = [UNKNOWN]

    def sources_of(index: int, entry: T) -> list[Source[T]]:
        if links := linked(entry):
            return [source for link in links for source in places.get(link) or nowhere]
        return [frozenset([entry]) if counts(entry) else index]

    sources = _sources(steps, sources_of)
    followers: dict[int, list[int]] = defaultdict(list)
    for index, origins in enumerate(sources):
        for origin in origins:
            if isinstance(origin, int):
                followers[origin].append(index)
    last: list[frozenset[T | None]] = [frozenset()] * len(steps)
    waiting = deque(range(len(steps)))
    while waiting:
        index = waiting.popleft()
        first, *further = [last[source] if isinstance(source, int) else source for source in sources[index]]
        union = first.union(*further)
        if len(union) > limit:
            sources[index], union = [UNKNOWN], UNKNOWN
        if union != last[index]:
            last[index] = union
            waiting += followers[index]
    unions = {entry: last[first].union(*(last[i] for i in further)) for entry, (first, *further) in places.items()}
    return {entry: union if len(union) <= limit else UNKNOWN for entry, union in unions.items()}


def _sources(steps: Sequence[Step | T], sources_of: Callable[[int, T], list[Source[T]]]) -> list[list[Source[T]]]:
    """Return what each step may follow; ``sources_of``: what comes before a step that follows an entry."""
    sources: list[list[Source[T]]] = []
    blocks: list[_Block[T]] = []
    last: list[Source[T]] = [UNKNOWN]
    for index, step in enumerate(steps):
        sources.append(last)
        if not isinstance(step, Step):
            last = sources_of(index, step)
            continue
        last = [UNKNOWN] if step in (Step.ROUTINE, Step.CALL) else [index]
        if step in (Step.ROUTINE, Step.IF, *LOOPS):
            sources[index] = [*sources[index]]
            blocks.append(_Block(step, index, sources[index], step is not Step.REPEAT))
        elif step in (Step.BRANCH, Step.ELSE) and blocks:
            block = blocks[-1]
            block.ends.append(index)
            block.is_skipped &= step is Step.BRANCH or block.step is not Step.IF
            last = block.incoming if block.step is Step.ROUTINE else [block.number]
        elif step is Step.LEAVE:
            for block in [block for block in blocks if block.step in LOOPS][-1:]:
                block.ends.append(index)
        elif step is Step.END and blocks:
            block = blocks.pop()
            sources[index] = [*sources[index], *block.ends]
            last = [index, block.number] if block.is_skipped else [index]
            if block.step in LOOPS:
                block.incoming.append(index)
            elif block.step is Step.ROUTINE:
                last = block.incoming
    return sources
