"""Levenberg–Marquardt (Goswami, Quaid, Peshkin 1993, (4)–(10)), on the square-root information.

docs/explanation/estimation.md has the step, docs/decisions/0019-damping.md the rule of λ with a comparison. Columns are
scaled to length 1, so λ has no unit. Only significant singular values (``information.seen``) count: x does not move
along null directions.

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
FAST_DECAY = 1e-3  # of λ after a step that was predicted well
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
        """Return whether further steps are of no use, from χ² at the start and after each, and the next reduction."""
        limit = (1.0 - self.worth) * chi2[-1 - self.steps] if len(chi2) > self.steps else np.inf
        return reduction < self.predicted * chi2[-1] or chi2[-1] > limit


class Damping(NamedTuple):
    """How steps are damped: by λ, ``start`` at first (0: full Gauss–Newton steps).

    ``correctors`` is how many full steps a step that does not reduce χ² gets to return to a curved valley. Without them
    a fit that only tells right from wrong inputs costs less; in such a valley it may end before the minimum.
    """

    start: float = DAMPING_START
    correctors: int = CORRECTORS


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

    ``linearise`` returns root, Qᵀf and χ² at an x; ``on_step`` is called after each step. ``cost(trial, current)`` is
    χ² at ``trial`` with what J takes as constant, such as weights, as at ``current``; needed only if it depends on x.
    ``move(x, Δ)`` is the point that a step leads to. ``ends`` may end the iteration before it converges. An iteration
    is an accepted step. Failure to converge is a status, not an exception.
    """
    lam, correctors = damping
    current = linearise(x)
    so_far = [current.chi2]
    for iteration in range(max_iterations + 1):
        if not _finite(current):
            return Minimum(x, "stalled", "residuals or derivatives are not finite numbers", iteration, current)
        decomposition = spectrum(current.root)
        promised = promise(decomposition, current.rhs)
        if promised @ promised <= max(RELATIVE_END**2 * current.chi2, ABSOLUTE_END**2 * current.n_residuals):
            text = "the linearised problem predicts no further reduction of the residuals"
            return Minimum(x, "converged", text, iteration, current)
        if ends is not None and ends.reached(so_far, float(promised @ promised)):
            return Minimum(x, "max_iterations", "further iterations are of no use", iteration, current)
        delta, _ = damped_step(decomposition, promised, 0.0)
        if np.linalg.norm(decomposition.scale * delta) <= STEP_END * np.linalg.norm(decomposition.scale * x):
            return Minimum(x, "converged", "the step is below rounding", iteration, current)
        if iteration == max_iterations:
            break
        refused, rounding = False, promised @ promised <= ROUNDING_END**2
        while True:
            delta, predicted = damped_step(decomposition, promised, lam)
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                goal = x
                for _ in range(1 if rounding else 1 + correctors):  # χ² may be NaN after a diverging step
                    goal = move(goal, delta)
                    trial = linearise(goal)
                    chi2 = trial.chi2 if cost is None else cost(goal, x)
                    if chi2 < current.chi2 or not _finite(trial):
                        break
                    back = spectrum(trial.root)
                    delta, _ = damped_step(back, promise(back, trial.rhs), 0.0)
            if chi2 < current.chi2:
                break
            refused = True
            lam = lam * REFUSED if lam else DAMPING_START
            if lam > DAMPING_MAX:
                if rounding:
                    return Minimum(x, "converged", "the predicted reduction is below rounding", iteration, current)
                return Minimum(x, "stalled", "no step reduces the residuals", iteration, current)
        gain = (current.chi2 - chi2) / predicted
        lam = after_step(lam, gain, refused)
        x, current = goal, trial
        if on_step is not None:
            on_step(iteration + 1, current)
        so_far.append(current.chi2)
    text = f"{counted(max_iterations, 'iteration was', 'iterations were')} not enough"
    return Minimum(x, "max_iterations", text, max_iterations, current)


def _finite(information: Information) -> bool:
    return bool(
        np.isfinite(information.chi2) and np.isfinite(information.root).all() and np.isfinite(information.rhs).all()
    )


def after_step(damping: float, gain: float, refused: bool) -> float:
    """Return λ after a step that achieved the part ``gain`` of the predicted reduction.

    ``refused``: a smaller λ failed.
    """
    gain = min(gain, 1.0)  # if almost no gain was predicted, a larger ratio means only that the model was correct
    damping *= FAST_DECAY if gain > 0.9 and not refused else max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
    return max(damping, DAMPING_MIN) if damping else 0.0


def promise(decomposition: Spectrum, rhs: Floats) -> Floats:
    """Return Uᵀz on the identifiable directions, zero elsewhere; its square is the remaining reduction of χ²."""
    return np.where(seen(decomposition), decomposition.u.T @ rhs, 0.0)


def damped_step(decomposition: Spectrum, promised: Floats, damping: float) -> tuple[Floats, float]:
    """Return Δ (k,) for a damping λ, and the reduction of χ² that the linearised problem predicts."""
    singular = decomposition.singular
    filtered = singular / np.where(promised != 0.0, singular**2 + damping, 1.0) * promised  # 0 along null directions
    unreduced = promised - singular * filtered
    predicted = float(promised @ promised - unreduced @ unreduced)
    return (decomposition.vt.T @ filtered) / decomposition.scale, max(predicted, np.finfo(float).tiny)
