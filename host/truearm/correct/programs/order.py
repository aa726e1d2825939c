"""Which statements may come immediately before another, by following the text through branches and loops.

This answers two questions: from which targets the robot comes to a target, and which tool is in force at a move.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar, assert_never

from truearm.correct.programs.program import Step

MOST_ORIGINS = 4  # moves that may be the last one before a move; more count as unknown
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
    """A routine, choice or loop: its first step, what comes before it, and what its finished branches end with.

    ``is_skipped``: whether some way leads past all of its branches.
    """

    step: Step
    number: int
    incoming: frozenset[T | None]
    ends: frozenset[T | None] = frozenset()
    is_skipped: bool = True


def preceding(steps: Sequence[Step | T], counts: Callable[[T], bool], limit: int) -> dict[T, frozenset[T | None]]:
    """Return, for every entry of ``steps``, which entries that count may be the last before it.

    None among them: it is unknown, as where a routine begins, or after a call. More than ``limit`` are unknown too.
    """
    loop_ends: dict[int, frozenset[T | None]] = {}
    _followed(steps, counts, limit, loop_ends)
    # What a loop ends with comes from its body, which this pass has followed, or from before it.
    return _followed(steps, counts, limit, loop_ends)


def _followed(
    steps: Sequence[Step | T], counts: Callable[[T], bool], limit: int, loop_ends: dict[int, frozenset[T | None]]
) -> dict[T, frozenset[T | None]]:
    """Return the last entries that count before each entry, and note with what each loop ends, by its first step."""
    unknown: frozenset[T | None] = frozenset([None])
    last, blocks = unknown, list[_Block[T]]()
    last_before: dict[T, frozenset[T | None]] = {}

    def united(*alternatives: frozenset[T | None]) -> frozenset[T | None]:
        union = frozenset[T | None]().union(*alternatives)
        return union if len(union) <= limit else unknown

    for number, step in enumerate(steps):
        if not isinstance(step, Step):
            last_before[step] = united(last_before.get(step, frozenset()), last)
            last = frozenset([step]) if counts(step) else last
            continue
        match step:
            case Step.ROUTINE | Step.IF | Step.LOOP | Step.REPEAT:
                last = united(last, loop_ends.get(number, frozenset()))
                blocks.append(_Block(step, number, last, is_skipped=step is not Step.REPEAT))
                last = unknown if step is Step.ROUTINE else last
            case Step.BRANCH | Step.ELSE:
                for block in blocks[-1:]:
                    block.ends, last = block.ends | last, block.incoming
                    block.is_skipped &= step is not Step.ELSE or block.step is not Step.IF
            case Step.LEAVE:
                for block in [block for block in blocks if block.step in (Step.LOOP, Step.REPEAT)][-1:]:
                    block.ends |= last
            case Step.END:
                for block in [blocks.pop()] if blocks else ():
                    ends = united(last, block.ends)
                    if block.step in (Step.LOOP, Step.REPEAT):
                        loop_ends[block.number] = ends
                    if block.step is Step.ROUTINE:
                        last = block.incoming
                    else:
                        last = united(ends, block.incoming) if block.is_skipped else ends
            case Step.CALL:
                last = unknown
            case _:
                assert_never(step)
    return last_before
