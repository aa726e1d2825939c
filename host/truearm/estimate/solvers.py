"""The solvers and losses by name. Imports nothing slow, so that ``--help`` can list them.

To add a solver, write a module with ``solve(problem, columns, x, options) -> Solution`` (``solution.Solver``) and add a
line for it to ``SOLVERS``. The module is imported when it is first used.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple


class Prior(StrEnum):
    """The robot's prior before any measurement.

    WHERE_NEEDED: the weak one, only for parameters that the data determine less accurately than a drawing
    (``defaults``).
    """

    NONE = "none"
    WHERE_NEEDED = "where-needed"
    WEAK = "weak"
    WIDE = "wide"


class LawMode(StrEnum):
    """Terms of the joint law beyond offset and gain that an identification may add if the evidence supports them."""

    AUTO = "auto"
    NONE = "none"
    CURVE = "curve"
    SAG = "sag"


class SolverEntry(NamedTuple):
    """A solver: its module in this package, and its description in ``--help``.

    ``has_loss``: it supports the robust losses. ``prior``: the robot's default prior; None: it does not support priors.
    ``starts_from_rig``: it starts with the rig fitted to the nominal robot. ``reads_noise``: its sigmas follow the
    residuals, not the declared noise. ``ends_by_recipe``: its status carries no information beyond its message.
    """

    module: str
    summary: str
    has_loss: bool = False
    prior: Prior | None = Prior.WHERE_NEEDED
    starts_from_rig: bool = False
    reads_noise: bool = False
    ends_by_recipe: bool = False


SOLVERS: Mapping[str, SolverEntry] = {
    "lm": SolverEntry("fit", "Levenberg-Marquardt", has_loss=True, starts_from_rig=True),
    "map": SolverEntry("fit", "maximum a posteriori", has_loss=True, prior=Prior.WIDE),
    "recursive": SolverEntry("recursive", "row by row, leaves outliers out"),
    "renders-1991": SolverEntry("renders1991", "the paper's, for comparison", prior=Prior.NONE, ends_by_recipe=True),
    "ls": SolverEntry("least_squares", "least squares without a prior, for comparison", prior=None, reads_noise=True),
}


class Loss(StrEnum):
    """The cost of a residual."""

    LINEAR = "linear"
    HUBER = "huber"
    CAUCHY = "cauchy"


def with_loss() -> tuple[str, ...]:
    """Return the names of the solvers that support the robust losses."""
    return tuple(name for name, entry in SOLVERS.items() if entry.has_loss)
