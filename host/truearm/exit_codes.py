"""Exit codes of all commands in one table: ``truearm --help`` prints it, docs/reference/exit-codes.md repeats it."""

from __future__ import annotations

from enum import IntEnum


class ExitCode(IntEnum):
    """How a command ended. ``meaning`` is the text for users.

    Examples
    --------
    >>> from truearm.exit_codes import ExitCode
    >>> int(ExitCode.INPUT), ExitCode.INPUT.meaning
    (2, 'an option, a file or the data in it is wrong')
    """

    meaning: str

    def __new__(cls, value: int, meaning: str) -> ExitCode:
        member = int.__new__(cls, value)
        member._value_, member.meaning = value, meaning
        return member

    DONE = 0, "done"
    FAILED = 1, "the box or the robot is missing or failed, or the disk or the program that reads the output failed"
    INPUT = 2, "an option, a file or the data in it is wrong"
    UNUSABLE = 3, "the fit is not usable (the result is written anyway, marked as not usable)"
    INCOMPLETE = 4, "incomplete: the recording or the correction (what there is was kept)"
    INTERRUPTED = 130, "interrupted"


def table() -> str:
    """Return the codes with their meanings in one line."""
    return "; ".join(f"{code.value} {code.meaning}" for code in ExitCode) + "."
