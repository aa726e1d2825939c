"""Which statements may come immediately before another, by following the text through branches and loops.

This answers two questions: from which targets the robot comes to a target, and which tool is in force at a move.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar, assert_never

from truearm.correct.programs.program import Step

T = TypeVar("T")
MOST_PASSES = 5  # over the text, until the ends of all loops are known


@dataclass(eq=False)
class _Block(Generic[T]):
    """A routine, choice or loop: its first step, what comes before it, and what its finished branches end with."""

    step: Step
    number: int
    before: frozenset[T | None]
    ends: set[T | None] = field(default_factory=set)


def preceding(steps: Sequence[Step | T], counts: Callable[[T], bool], most: int) -> dict[T, frozenset[T | None]]:
    """Return, for every entry of ``steps``, which entries that count may be the last before it.

    None among them: it is unknown, as where a routine begins, or after a call. More than ``most`` are unknown too.
    """
    loop_ends: dict[int, frozenset[T | None]] = {}
    last: dict[T, frozenset[T | None]] = {}
    for _ in range(MOST_PASSES):
        ends_before = dict(loop_ends)
        last = _Walk(counts, most, loop_ends).follow(steps)
        if loop_ends == ends_before:
            return last
    return dict.fromkeys(last, frozenset([None]))


@dataclass(eq=False)
class _Walk(Generic[T]):
    """One pass over the steps; ``loop_ends``: what each loop ends with, by the number of its first step, updated."""

    counts: Callable[[T], bool]
    most: int
    loop_ends: dict[int, frozenset[T | None]]
    blocks: list[_Block[T]] = field(default_factory=list)
    last: frozenset[T | None] = frozenset([None])

    def follow(self, steps: Sequence[Step | T]) -> dict[T, frozenset[T | None]]:
        """Return the last entries that count before each entry."""
        last_before: dict[T, frozenset[T | None]] = {}
        for number, step in enumerate(steps):
            if isinstance(step, Step):
                self.enter(step, number)
                continue
            last_before[step] = self.united(last_before.get(step, frozenset()), self.last)
            if self.counts(step):
                self.last = frozenset([step])
        return last_before

    def enter(self, step: Step, number: int) -> None:
        """Follow one step of the structure."""
        match step:
            case Step.ROUTINE:
                self.blocks.append(_Block(step, number, self.last))
                self.last = frozenset([None])
            case Step.IF:
                self.blocks.append(_Block(step, number, self.last))
            case Step.LOOP:
                self.last = self.united(self.last, self.loop_ends.setdefault(number, frozenset()))
                self.blocks.append(_Block(step, number, self.last))
            case Step.BRANCH:
                if self.blocks:
                    self.blocks[-1].ends |= self.last
                    self.last = self.blocks[-1].before
            case Step.LEAVE:
                loop = next((block for block in reversed(self.blocks) if block.step is Step.LOOP), None)
                if loop is not None:
                    loop.ends |= self.last
            case Step.END:
                if self.blocks:
                    self.leave(self.blocks.pop())
            case Step.CALL:
                self.last = frozenset([None])
            case _:
                assert_never(step)

    def leave(self, block: _Block[T]) -> None:
        """Go on after a routine, choice or loop."""
        if block.step is Step.ROUTINE:
            self.last = block.before
            return
        ends = self.united(self.last, frozenset(block.ends))
        if block.step is Step.LOOP:
            self.loop_ends[block.number] = ends
        self.last = self.united(ends, block.before)

    def united(self, first: frozenset[T | None], second: frozenset[T | None]) -> frozenset[T | None]:
        """Return all of both; unknown if they are too many."""
        union = first | second
        return union if len(union) <= self.most else frozenset([None])
