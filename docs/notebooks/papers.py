"""What the notebooks of both papers share: least squares as the papers write it, ranks, and a table of criteria."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

WEAK = 8.0  # an interval with a larger ratio of its ends can hardly fail, which the table says


def experiments(whole: int, quick: int) -> int:
    """Return how many experiments to run: ``quick`` if TRUEARM_QUICK is set, as in ``make test``."""
    return quick if "TRUEARM_QUICK" in os.environ else whole


@dataclass(frozen=True)
class Number:
    """A number of the paper beside the one computed here, with a criterion that can fail.

    ``here`` is a value, or one for each of several random experiments; its median is shown. The paper's number agrees
    if it is within ``tolerance`` of the value, or a likely further experiment: within three standard deviations of
    their mean, of logarithms where all are positive. ``theory`` is an interval for
    ``here``. Where the paper's number cannot agree, ``differs`` says why; the criterion is then that it does not.
    ``assumed`` names an input that the paper does not state and that was chosen here.
    """

    what: str
    unit: str
    paper: float | None
    here: float | np.ndarray
    theory: tuple[float, float] | None = None
    tolerance: float = 0.0
    differs: str = ""
    assumed: str = ""

    @property
    def value(self) -> float:
        return float(np.median(self.here))

    @property
    def likely(self) -> tuple[float, float]:
        """Return the interval in which the paper's number agrees."""
        if np.ndim(self.here) == 0:
            return self.value - self.tolerance, self.value + self.tolerance
        positive = np.min(self.here) > 0.0
        values = np.log(self.here) if positive else np.asarray(self.here)
        interval = values.mean() + 3.0 * values.std() * np.array([-1.0, 1.0])
        low, high = np.exp(interval) if positive else interval
        return float(low), float(high)

    @property
    def failure(self) -> str:
        """Return which criterion fails, "" if none does."""
        if self.paper is None and self.theory is None:
            return "no criterion"
        if self.theory is not None and not self.theory[0] <= self.value <= self.theory[1]:
            return f"{self.value:.4g}, theory {self.theory[0]:.4g} to {self.theory[1]:.4g}"
        low, high = self.likely
        if self.paper is not None and (low <= self.paper <= high) == bool(self.differs):
            return "agrees, though it should differ" if self.differs else f"{low:.4g} to {high:.4g} here"
        return ""


def compare(numbers: Iterable[Number]) -> None:
    """Print numbers as a table. Raises AssertionError if a criterion fails."""
    numbers = list(numbers)
    print(f"{'':62}{'paper':>9}{'here':>10}  theory, or where the paper's agrees")
    for number in numbers:
        paper = "" if number.paper is None else f"{number.paper:.4g}"
        low, high = number.theory or number.likely
        print(f"{number.what:62}{paper:>9}{number.value:10.3g}  {f'{low:.3g} to {high:.3g}':20} {number.unit}".rstrip())
        if number.differs:
            print(f"    differs: {number.differs}")
        if number.assumed:
            print(f"    assumed: {number.assumed}")
        if number.theory is None and low > 0.0 and high > WEAK * low:
            print(f"    weak: sets of lines differ so much that a factor of {high / low:.0f} is allowed")
    failed = [f"{number.what}: {number.failure}" for number in numbers if number.failure]
    assert not failed, "\n".join(failed)


def standard_errors(expected: float, one: float, count: float) -> tuple[float, float]:
    """Return the interval of three standard errors of a mean of ``count`` values with standard deviation ``one``."""
    return expected - 3.0 * one / np.sqrt(count), expected + 3.0 * one / np.sqrt(count)


def rank(jacobian: np.ndarray) -> tuple[int, float]:
    """Return the rank with columns scaled to length 1, and the smallest kept over the largest dropped singular value."""
    length = np.linalg.norm(jacobian, axis=0)
    singular = np.linalg.svd(jacobian / np.where(length > 1e-12 * length.max(), length, np.inf), compute_uv=False)
    kept = int((singular > 1e-9 * singular[0]).sum())
    return kept, float(singular[kept - 1] / max(singular[kept:].max(initial=0.0), 1e-300))


Evaluate = Callable[
    [np.ndarray], tuple[np.ndarray, np.ndarray]
]  # x (p,) to whitened residuals (n,), their −∂/∂x (n, p)


def gauss_newton(evaluate: Evaluate, x: np.ndarray, steps: int = 50) -> tuple[np.ndarray, int]:
    """Return x after steps of Δ = (JᵀJ)⁻¹ Jᵀ f, (6) of Goswami 1993, and their number (``steps``: not converged)."""
    for step in range(1, steps + 1):
        residual, jac = evaluate(x)
        delta = np.linalg.solve(jac.T @ jac, jac.T @ residual)
        x = x + delta
        if not np.isfinite(x).all() or np.linalg.norm(jac @ delta) < 1e-6 * (1.0 + np.linalg.norm(residual)):
            return x, step
    return x, steps


def levenberg_marquardt(evaluate: Evaluate, x: np.ndarray, steps: int = 50) -> tuple[np.ndarray, int]:
    """Return the minimum of the squares near x, and the number of steps: (10) of Goswami 1993, λI for scaled columns."""
    residual, jac = evaluate(x)
    damping = 1e-3
    for step in range(1, steps + 1):
        length = np.linalg.norm(jac, axis=0)
        scaled = jac / np.where(length > 0.0, length, 1.0)
        square, gradient = scaled.T @ scaled, scaled.T @ residual
        while True:
            delta = np.linalg.solve(square + damping * np.eye(x.size), gradient)
            there = x + delta / np.where(length > 0.0, length, 1.0)
            residual_there, jac_there = evaluate(there)
            if residual_there @ residual_there <= residual @ residual or damping > 1e9:
                break
            damping *= 10.0
        done = np.linalg.norm(scaled @ delta) < 1e-6 * (1.0 + np.linalg.norm(residual))
        x, residual, jac, damping = there, residual_there, jac_there, max(damping / 10.0, 1e-12)
        if done:
            return x, step
    return x, steps
