"""The command line as called by the tests."""

import subprocess
import sys
from collections.abc import Callable
from typing import NamedTuple

from truearm.findings import Finding


class _Output(NamedTuple):
    code: int
    out: str
    err: str


class Outcome(_Output):
    finding: Finding | None = None  # with which the command ended


Run = Callable[..., Outcome]  # the fixture `run`: the real main() with arguments


def process(*arguments: object) -> Outcome:
    """Run the command as the shell starts it."""
    command = [sys.executable, "-m", "truearm", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    return Outcome(done.returncode, done.stdout, done.stderr)


def told(outcome: Outcome, message: str) -> None:
    """Check for exit code 2, nothing on stdout, and one line on stderr that contains the message."""
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err.startswith("truearm: ")
    assert outcome.err.count("\n") == 1
    assert outcome.err.endswith("\n")
    assert message in outcome.err
    assert "Traceback" not in outcome.err
