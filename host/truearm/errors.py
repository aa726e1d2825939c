"""Every error that truearm raises on purpose.

::

    TruearmError
    ├── InputError            what the user gave is wrong: one clear line, exit code 2
    │   ├── TableError        a table of observations (CSV)
    │   ├── RigError          a rig file (TOML)
    │   ├── RobotError        a robot file (TOML or URDF)
    │   ├── PlanError         a plan of poses (CSV)
    │   ├── TargetError       a table of targets (CSV), or a target that cannot be corrected
    │   ├── SessionError      a session file (MCAP)
    │   ├── ConfigError       a box's configuration (TOML)
    │   └── ImageError        an image for the box's chip (UF2)
    ├── WriteError            a file cannot be written any more (a full disk)
    ├── ProblemError          the observations and the robot do not define a solvable problem
    ├── IncompleteError       a recording ended before everything requested arrived; the received data are kept
    └── LinkError             the box or the robot stopped answering
        ├── LinkClosed        the other side ended the stream normally
        ├── RefusedError      the box refuses a command
        └── ProtocolError     the box uses a protocol that this version does not support

Data conditions (rank, convergence, gaps, losses) are fields of results, never exceptions.

A text that names an argument of the caller contains it as a separate ``Argument``. Python shows the argument's name, the
command line shows the option instead.
"""

from __future__ import annotations

from collections.abc import Callable

from truearm.exit_codes import ExitCode


class Argument(str):
    """The name of an argument, in the text of an error."""

    __slots__ = ()


class TruearmError(Exception):
    """Base class of all truearm errors; the text is one line that states what is wrong and what to do.

    The text consists of its ``args`` one after the other. An argument of a wrong type raises TypeError instead.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.InputError, truearm.TruearmError)
    True
    """

    exit_code = ExitCode.FAILED

    def __str__(self) -> str:
        return self.text(str)

    def text(self, name: Callable[[Argument], str]) -> str:
        """Return the text with every argument as ``name`` shows it."""
        return "".join(name(part) if isinstance(part, Argument) else str(part) for part in self.args)


class InputError(TruearmError):
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


class TableError(InputError):
    """A table of observations is wrong; the text names file, row and column.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.TableError, truearm.InputError)
    True
    """


class RigError(InputError):
    """A rig file is wrong.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.RigError, truearm.InputError)
    True
    """


class RobotError(InputError):
    """A robot description (TOML or URDF) is wrong or not supported.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.RobotError, truearm.InputError)
    True
    """


class PlanError(InputError):
    """A plan of poses is wrong, or none can be made for the robot, with the options, or from the poses within reach.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.PlanError, truearm.InputError)
    True
    """


class TargetError(InputError):
    """A table of targets is wrong, or a target cannot be corrected; the text names file and row.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.TargetError, truearm.InputError)
    True
    """


class SessionError(InputError):
    """A session file cannot be read.

    Examples
    --------
    >>> import truearm
    >>> issubclass(truearm.SessionError, truearm.InputError)
    True
    """


class ConfigError(InputError):
    """A configuration of a box is wrong."""


class ImageError(InputError):
    """An image for the box's chip is damaged, or for another chip."""


class WriteError(TruearmError):
    """A file cannot be written any more; ``strerror`` is the system's reason."""

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


class IncompleteError(TruearmError):
    """A recording ended before everything requested arrived."""

    exit_code = ExitCode.INCOMPLETE


class LinkError(TruearmError):
    """The box or the robot stopped answering."""


class LinkClosed(LinkError):
    """The other side ended the stream normally, without a reason."""


class RefusedError(LinkError):
    """The box refuses a command; ``code`` is defined in protocol/SPEC.md §4."""

    def __init__(self, code: int, *text: str) -> None:
        super().__init__(*text)
        self.code = code


class ProtocolError(LinkError):
    """The box uses a protocol that this version of truearm does not support."""
