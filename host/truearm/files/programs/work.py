"""What reading and following a program may cost: its size bounds the time and the memory."""

from __future__ import annotations

from truearm.errors import ProgramError
from truearm.files.programs.syntax import Source
from truearm.files.programs.tree_walks import places_in

WORK, WORK_EACH = 430_000, 0.25  # units for any program, and for each byte of it
# what something costs, in units
TOKEN, STATEMENT, DEEPER = 1, 1, 1  # of the text, as it is read: tokens, statements, brackets and blocks
MOVE, GOAL = 4, 3  # and each of its possible goals
CALL, BLOCK = 70, 2  # of a routine; one of the blocks of a choice
GEOMETRY = 14  # a function of poses
ELEMENT = 1  # an operator, an element or a list
CHANGED = 5  # an assignment to an element, for each list or record that contains it
OPENED = 8  # an element of a literal, whose numbers are read for it
# how many of them cost a unit
SEVERAL = 8  # possibilities
LETTERS = 100  # of texts


class Work:
    """What may still be spent on a program, in units of about a microsecond: tokens read, and parts followed."""

    def __init__(self, source: Source) -> None:
        self.source, self.whole = source, WORK + WORK_EACH * len(source.text)
        self.left = self.whole
        self.statement: object = None  # that is followed now
        self.indexed: set[int] = set()  # places of statements with several elements of lists

    def spend(self, units: int) -> None:
        """Take off units; raises ProgramError where too few are left."""
        self.left -= units
        if self.left < 0:
            raise self.spent()

    def spent(self, at: int | None = None) -> ProgramError:
        """Return the error that nothing is left, at a place."""
        return self.wrong("the program is too complex to trace; split the file", at)

    def wrong(self, why: str, at: int | None = None) -> ProgramError:
        """Return an error at a place; without one at the statement that is followed, if there is one."""
        place = next(places_in(self.statement), None) if at is None else at
        return ProgramError(f"{self.source.name}: {why}") if place is None else self.source.wrong(place, why)
