"""What reading and following a program may cost: its size bounds the time and the memory."""

from __future__ import annotations

from truearm.errors import ProgramError
from truearm.files.programs.syntax import Source
from truearm.files.programs.tree_walks import places_in

WORK, WORK_EACH = 500_000, 0.25  # units for any program, and for each byte of it
# what something costs, in units
TOKEN = 1  # of the text
MOVE, GOAL = 5, 5  # and each of its possible goals
CALL = 20  # of a routine
GEOMETRY = 10  # a function of poses
ELEMENT = 1  # an operator, an element or a list
# how many of them cost a unit
SEVERAL = 8  # possibilities
LETTERS = 100  # of texts


class Work:
    """What may still be spent on a program, in units of about a microsecond: tokens read, and parts followed."""

    def __init__(self, source: Source) -> None:
        self.source, self.left = source, WORK + WORK_EACH * len(source.text)
        self.statement: object = None  # that is followed now

    def spend(self, units: int) -> None:
        """Take off units; raises ProgramError where too few are left."""
        self.left -= units
        if self.left < 0:
            raise self.spent(next(places_in(self.statement), None))

    def spent(self, at: int | None) -> ProgramError:
        """Return the error that nothing is left, at a place if it is known."""
        why = "the program is too complex to trace; split the file"
        return ProgramError(f"{self.source.name}: {why}") if at is None else self.source.wrong(at, why)
