"""The command line as called by the tests."""

import subprocess
import sys
from collections.abc import Callable
from typing import NamedTuple

from tests.refusals import check

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
    outcome = Outcome(done.returncode, done.stdout, done.stderr)
    outcome.finding = Finding("process")  # it has no other than its text
    return outcome


def told(outcome: Outcome, *expected: object, **values: object) -> None:
    """Check for exit code 2, nothing on stdout, one line on stderr, and an error as ``check`` describes it."""
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err.startswith("truearm: ")
    assert outcome.err.count("\n") == 1
    assert outcome.err.endswith("\n")
    check(outcome.finding, outcome.err, *expected, **values)
    assert "Traceback" not in outcome.err
