"""One row of the simulated checks."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One check: what was measured, and whether it is as wanted."""

    what: str
    measured: str
    wanted: str
    passed: bool


def near(what: str, measured: float, wanted: float, tolerance: float) -> Row:
    """Return a row that passes within a relative tolerance."""
    ok = abs(measured / wanted - 1) <= tolerance
    return Row(what, f"{measured:.6g}", f"{wanted:.6g} ± {tolerance:.1%}", ok)


def at_most(what: str, measured: float, limit: float) -> Row:
    """Return a row for a relative error that passes up to a limit."""
    return Row(what, f"{measured:.4%}", f"{limit:.2%}", measured <= limit)
