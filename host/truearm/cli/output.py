"""Printing that several commands share."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from truearm.findings import Finding, option
from truearm.strict_json import strict_json


def print_lines(lines: Iterable[str | Finding]) -> None:
    """Print lines, or findings with their severity, on standard output."""
    for line in lines:
        print(line if isinstance(line, str) else f"{line.severity}: {line.text(option)}", flush=True)


def print_json(document: Any) -> None:
    """Print a document as JSON on standard output; a number that is not finite is null."""
    print(strict_json(document))
