"""Every error that truearm raises on purpose, and the exit codes of all commands.

::

    TruearmError
    ├── InputError            what the user gave is wrong: exit code 2; a ValueError too
    │   ├── PlugInError       what another package adds is wrong
    │   ├── MissingFileError  a FileNotFoundError too
    │   └── FileError         Table-, Rig-, Robot-, Plan-, Target-, Session-, Config- and ImageError
    ├── WriteError
    ├── ProblemError
    ├── IncompleteError       what was received is kept
    └── LinkError             LinkClosed, RefusedError, ProtocolError

Data conditions (rank, convergence, gaps, losses) are fields of results, never exceptions.

Every error is a finding with a code and values. A cause on which a user acts in a way of its own has an entry in
``truearm.finding_texts``, and is raised by its code: ``TableError("no-rows", place=name)``. All others have a text,
"PLACE: REASON", and the code of their class. A text names an argument of the caller by an ``Argument``: Python shows
the argument's name, the command line the option.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from enum import IntEnum
from typing import Any, Self

from truearm.finding_texts import STATEMENTS
from truearm.findings import Argument as Argument
from truearm.findings import Finding


class ExitCode(IntEnum):
    """How a command ended. ``meaning`` is the text for users.

    Examples
    --------
    >>> from truearm.errors import ExitCode
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


def exit_code_table() -> str:
    """Return the codes with their meanings in one line."""
    return "; ".join(f"{code.value} {code.meaning}" for code in ExitCode) + "."


_JSON = (Argument, int, float, list, tuple, dict, type(None))  # other values become texts
# the place in "PLACE: REASON": one word, or what names a file or an option; other words before a colon are a sentence
_PLACE = re.compile(r"[^\s;]+|--[^;]+|[^;]*(?:\w\.[a-z]|[/\\_])[^;]*")


class TruearmError(Exception):
    """Base class of all truearm errors; the text is one line that states what is wrong and what to do.

    ``finding`` has the error's code and values, ``noticed`` are findings about data that were read before: they may be
    its cause. An argument of a wrong type raises TypeError instead.

    Examples
    --------
    >>> import truearm
    >>> try:
    ...     truearm.read_rig("missing.toml")
    ... except truearm.TruearmError as error:
    ...     print(error.finding.code, error.finding.values["place"])
    missing-file missing.toml
    """

    exit_code = ExitCode.FAILED
    default_code = "invalid-input"  # of an error that is raised with a text
    noticed: tuple[Finding, ...] = ()

    def __init__(self, *text: object, **values: Any) -> None:
        """Take a code and its values, or a text in pieces."""
        super().__init__(*text)
        self.values = {name: value if isinstance(value, _JSON) else str(value) for name, value in values.items()}

    def __str__(self) -> str:
        return self.text(str)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    def text(self, name: Callable[[str], str]) -> str:
        """Return the text with every argument as ``name`` shows it."""
        if self._has_entry:
            return self.finding.text(name)
        return "".join(
            piece.text(name)
            if isinstance(piece, TruearmError)
            else name(piece)
            if isinstance(piece, Argument)
            else str(piece)
            for piece in self.args
        )

    @property
    def finding(self) -> Finding:
        """The code and its values; an error with a text has values ``place`` and ``reason``."""
        if self._has_entry:
            return Finding(self.args[0], self.values)
        text, argument = str(self), next(iter(self.args), "")
        if isinstance(argument, Argument):
            return Finding("invalid-input", {"place": argument, "reason": text[len(argument) :].lstrip(": ")})
        place, colon, reason = text.partition(": ")
        if not colon or not _PLACE.fullmatch(place):
            place, reason = "", text
        code = self.other_code if isinstance(self, FileError) and not place else self.default_code
        return Finding(code, {"place": place, "reason": reason, **self.values})

    @property
    def _has_entry(self) -> bool:
        return type(next(iter(self.args), None)) is str and self.args[0] in STATEMENTS  # an argument may have its name

    def within(self, place: object) -> Self:
        """Return the error with the file, or whatever else encloses its place, in front."""
        if not self._has_entry:
            return type(self)(f"{place}: ", *self.args)
        places = [str(name) for name in (place, self.values.get("place")) if name]
        return type(self)(*self.args, **{**self.values, "place": ": ".join(places)})


@contextmanager
def noting(findings: Iterable[Finding]) -> Iterator[None]:
    """Add findings to an error, as what was noticed before it."""
    try:
        yield
    except TruearmError as exc:
        exc.noticed = (*findings, *exc.noticed)
        raise


class InputError(TruearmError, ValueError):
    """An argument, an option or a file is invalid.

    Examples
    --------
    >>> import truearm
    >>> try:
    ...     truearm.read_rig("missing.toml")
    ... except truearm.InputError as error:
    ...     print("missing.toml" in str(error))
    True
    """

    exit_code = ExitCode.INPUT


class PlugInError(InputError):
    """What another package adds to truearm is wrong; its author has the exception as the cause."""


class MissingFileError(InputError, FileNotFoundError):
    """A file does not exist; ``finding.values["place"]`` is its name.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.MissingFileError, FileNotFoundError)
    True
    """

    def __init__(self, *text: object, **values: Any) -> None:
        super().__init__(*text, **values)
        self.errno, self.filename = errno.ENOENT, self.values.get("place")


class FileError(InputError):
    """The content of a file is wrong; the text begins with the file, the row and the column.

    Without them it is an invalid input of its subject: no plan for a robot, no correction of a target.
    """

    default_code = "malformed-file"
    other_code = "invalid-input"  # of an error of no file


class TableError(FileError):
    """A table of observations is wrong; the text names file, row and column.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.TableError, truearm.InputError)
    True
    """


class RigError(FileError):
    """A rig file is wrong.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.RigError, truearm.InputError)
    True
    """


class RobotError(FileError):
    """A robot description (TOML or URDF) is wrong or not supported.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.RobotError, truearm.InputError)
    True
    """

    other_code = "unsuited-robot"


class PlanError(FileError):
    """A plan of poses is wrong, or none can be made for the robot, with the options, or from the poses within reach.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.PlanError, truearm.InputError)
    True
    """

    other_code = "no-plan"


class TargetError(FileError):
    """A table of targets is wrong, or a target cannot be corrected; the text names file and row.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.TargetError, truearm.InputError)
    True
    """

    other_code = "uncorrectable"


class SessionError(FileError):
    """A session file cannot be read.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.SessionError, truearm.InputError)
    True
    """


class ConfigError(FileError):
    """A configuration of a box is wrong."""


class ImageError(FileError):
    """An image for the box's chip is damaged, or for another chip."""


class WriteError(TruearmError):
    """A file cannot be written any more; ``strerror`` is the system's reason."""

    default_code = "cannot-write"

    def __init__(self, text: str, strerror: str = "") -> None:
        super().__init__(text)
        self.strerror = strerror


class ProblemError(TruearmError):
    """Observations and robot do not define a problem that can be solved (too few rows, unknown names).

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.ProblemError, truearm.TruearmError)
    True
    """

    exit_code = ExitCode.INPUT
    default_code = "unsolvable"


class IncompleteError(TruearmError):
    """A recording ended before everything requested arrived."""

    exit_code = ExitCode.INCOMPLETE
    default_code = "incomplete"


class LinkError(TruearmError):
    """The box or the robot stopped answering."""

    default_code = "link-lost"


class LinkClosed(LinkError):
    """The other side ended the stream normally, without a reason."""


class RefusedError(LinkError):
    """The box refuses a command; ``code`` is defined in protocol/SPEC.md §4."""

    default_code = "refused-by-box"

    def __init__(self, code: int, *text: str) -> None:
        super().__init__(*text)
        self.code = code


class ProtocolError(LinkError):
    """The box uses a protocol that this version of truearm does not support."""

    default_code = "other-protocol"
