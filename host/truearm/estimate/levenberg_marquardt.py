"""Levenberg–Marquardt (Goswami, Quaid, Peshkin 1993, (4)–(10)), on the square-root information.

docs/explanation/estimation.md has the step, docs/decisions/0019-damping.md the rule of λ with a comparison. Columns are
scaled to length 1, so λ has no unit; ``plain`` takes the paper's own λI, in units of s_max². Only significant singular
values (``information.seen``) count: x does not move along null directions.

λ is divided by 1000 after a step that was predicted to 10 % and not rejected before. After other good steps it follows
Nielsen's rule (1999), after a rejected one it is multiplied by 4. A rejected step may only have left a curved valley:
up to CORRECTORS full steps from its end return to it (a watchdog: Chamberlain and others 1982).

The iteration ends when the predicted reduction is negligible, or lost in the rounding of χ². Weights that depend on x
are those of x while x + Δ is judged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from truearm.estimate.information import Information, Spectrum, seen, spectrum
from truearm.estimate.parameter_update import Step, added
from truearm.text import counted
from truearm.types import Floats

DAMPING_START = 1e-4
DAMPING_MIN = 1e-14
DAMPING_MAX = 1e10
REFUSED = 4.0  # Rosenbrock's valley needs a quarter of the linearisations that it needs with 10, with the rule above
STRAIGHT = 1e-3
CORRECTORS = 3  # of Damping
RELATIVE_END = 1e-6
ABSOLUTE_END = 1e-10
STEP_END = 1e-14
ROUNDING_END = 1e-3  # σ; far below the precision of any estimate, above what the rounding of χ² can hide


class Ends(NamedTuple):
    """Where an iteration may end before the minimum, with the status "max_iterations": a start needs no more.

    It ends where the next step is predicted to reduce χ² by less than the part ``predicted``, or where its last
    ``steps`` together reduced it by less than ``worth``.
    """

    worth: float = 1e-4
    steps: int = 3
    predicted: float = 1e-8  # an RMS in all its printed digits

    def reached(self, chi2: Sequence[float], reduction: float) -> bool:
        """Return whether further steps are of no use, from χ² at the start and after each step, and the next reduction."""
        least = (1.0 - self.worth) * chi2[-1 - self.steps] if len(chi2) > self.steps else np.inf
        return reduction < self.predicted * chi2[-1] or chi2[-1] > least


class Damping(NamedTuple):
    """How steps are damped: by λ, ``start`` at first (0: full Gauss–Newton steps), of scaled columns or, ``plain``, λI.

    ``correctors`` is how many full steps a step that does not reduce χ² gets to return to a curved valley. Without them
    a fit that only tells right from wrong inputs costs less; in such a valley it may end before the minimum.
    """

    start: float = DAMPING_START
    plain: bool = False
    correctors: int = CORRECTORS

    def from_full_steps(self) -> Damping:
        """Return a damping that begins with full steps, of scaled columns."""
        return self._replace(start=0.0, plain=False)


class Minimum(NamedTuple):
    """The end point of the iteration; ``status`` is "converged", "max_iterations" or "stalled"."""

    x: Floats  # (k,)
    status: str
    message: str
    iterations: int
    information: Information


def minimise(
    linearise: Callable[[Floats], Information],
    x: Floats,
    max_iterations: int,
    on_step: Callable[[int, Information], None] | None = None,
    *,
    damping: Damping = Damping(),  # noqa: B008 (frozen)
    cost: Callable[[Floats, Floats], float] | None = None,
    move: Step = added,
    ends: Ends | None = None,
) -> Minimum:
    """Minimise χ² = fᵀf from x (k,).

    ``linearise`` returns root, Qᵀf and χ² at an x; ``on_step`` is called after each step. ``cost(there,
    here)`` is χ² at ``there`` with what J takes as constant, such as weights, as at ``here``; needed only if it depends
    on x. ``move(x, Δ)`` is the point that a step leads to. ``ends`` may end the iteration before it converges. An iteration is an accepted step. Failure to converge is a status, not an exception.
    """
    lam, plain, correctors = damping
    here = linearise(x)
    so_far = [here.chi2]
    for iteration in range(max_iterations + 1):
        if not _finite(here):
            return Minimum(x, "stalled", "residuals or derivatives are not finite numbers", iteration, here)
        parts = spectrum(here.root)
        promised = promise(parts, here.rhs)
        if promised @ promised <= max(RELATIVE_END**2 * here.chi2, ABSOLUTE_END**2 * here.n_residuals):
            return Minimum(
                x, "converged", "the linearised problem predicts no further reduction of the residuals", iteration, here
            )
        if ends is not None and ends.reached(so_far, float(promised @ promised)):
            return Minimum(x, "max_iterations", "further iterations are of no use", iteration, here)
        delta, _ = step(parts, promised, 0.0)
        if np.linalg.norm(parts.scale * delta) <= STEP_END * np.linalg.norm(parts.scale * x):
            return Minimum(x, "converged", "the step is below rounding", iteration, here)
        if iteration == max_iterations:
            break
        if plain:
            parts = _unscaled(here.root)
            promised = promise(parts, here.rhs)
        unit = parts.singular[0] ** 2 if plain else 1.0
        refused, rounding = False, promised @ promised <= ROUNDING_END**2
        while True:
            delta, predicted = step(parts, promised, lam * unit)
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                goal = move(x, delta)
                there = linearise(goal)
                chi2 = there.chi2 if cost is None else cost(goal, x)
                for _ in range(0 if rounding else correctors):  # χ² may be NaN after a diverging step
                    if chi2 < here.chi2 or not _finite(there):
                        break
                    back = spectrum(there.root)
                    goal = move(goal, step(back, promise(back, there.rhs), 0.0)[0])
                    there = linearise(goal)
                    chi2 = there.chi2 if cost is None else cost(goal, x)
            if chi2 < here.chi2:
                break
            refused = True
            lam = after_refusal(lam)
            if lam > DAMPING_MAX:
                if rounding:
                    return Minimum(x, "converged", "the predicted reduction is below rounding", iteration, here)
                return Minimum(x, "stalled", "no step reduces the residuals", iteration, here)
        gain = (here.chi2 - chi2) / predicted
        lam = after_step(lam, gain, refused)
        x, here = goal, there
        if on_step is not None:
            on_step(iteration + 1, here)
        so_far.append(here.chi2)
    return Minimum(x, "max_iterations", _too_few(max_iterations), max_iterations, here)


def _finite(here: Information) -> bool:
    return bool(np.isfinite(here.chi2) and np.isfinite(here.root).all() and np.isfinite(here.rhs).all())


def _too_few(iterations: int) -> str:
    return f"{counted(iterations, 'iteration was', 'iterations were')} not enough"


def after_refusal(damping: float) -> float:
    """Return λ after a step that did not reduce χ²."""
    return max(damping * REFUSED, DAMPING_MIN if damping else DAMPING_START)


def after_step(damping: float, gain: float, refused: bool) -> float:
    """Return λ after a step that achieved the part ``gain`` of the predicted reduction; ``refused``: a smaller λ failed."""
    gain = min(gain, 1.0)  # if almost no gain was predicted, a larger ratio means only that the model was correct
    damping *= STRAIGHT if gain > 0.9 and not refused else max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
    return max(damping, DAMPING_MIN) if damping else 0.0


def _unscaled(root: Floats) -> Spectrum:
    """Return the decomposition of the unscaled root, for damping by λI."""
    u, singular, vt = np.linalg.svd(root)
    return Spectrum(u, singular, vt, np.ones(root.shape[1]))


def promise(parts: Spectrum, rhs: Floats) -> Floats:
    """Return Uᵀz on the identifiable directions, zero elsewhere; its square is the remaining reduction of χ²."""
    return np.where(seen(parts), parts.u.T @ rhs, 0.0)


def step(parts: Spectrum, promised: Floats, damping: float) -> tuple[Floats, float]:
    """Return Δ (k,) for a damping λ, and the reduction of χ² that the linearised problem predicts."""
    some = promised != 0.0
    filtered = np.zeros_like(promised)
    filtered[some] = parts.singular[some] / (parts.singular[some] ** 2 + damping) * promised[some]
    left = promised - parts.singular * filtered
    predicted = float(promised @ promised - left @ left)
    return (parts.vt.T @ filtered) / parts.scale, max(predicted, np.finfo(float).tiny)
