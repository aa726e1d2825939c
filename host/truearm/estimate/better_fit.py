"""Whether another interpretation of the inputs explains the observations better than the given one, beyond chance.

An interpretation explains the observations if it reduces χ² by HUNDREDFOLD (the RMS tenfold), leaves residuals within
the tolerances of a drawing and the robot within LARGEST_SHIFT tolerances of manual mounting, and if this is beyond
chance. If all interpretations were as wrong as the given one, their mean squares would differ as F(ν, ν) does, so a
reduction by r has the probability P(F < r), times the number of interpretations tried (Bonferroni). That is at most
LEVEL for each type of interpretation; at LEVEL/5 per type, false alarms have the probability LEVEL in total. If the
given interpretation is correct, another would have to be a hundred times better than the truth.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.estimate.label_test import log_chance
from truearm.estimate.trial_fit import Trial
from truearm.results import Explanation, WrongInput
from truearm.types import thinned
from truearm.units import UNITS

HUNDREDFOLD = 0.01  # of χ²
FAMILY = 1e-3  # false alarms of all types of wrong input together
LEVEL = FAMILY / len(WrongInput)
LARGEST_SHIFT = 5.0  # tolerances of manual mounting: the paper's PUMA differs by 1.3
MOST_ROWS = 200  # of a trial fit


class Found(NamedTuple):
    """An explanation with its fit."""

    explanation: Explanation
    fit: Trial
    score: float  # twice the negative logarithm of the evidence


def explains(before: Trial, after: Trial, count: int, least: float = HUNDREDFOLD) -> bool:
    """Return whether a fit is far better, beyond chance, no longer absurd, and close to the described robot.

    An interpretation that shrinks everything explains nothing, and neither does one that requires the robot to shrink.
    """
    ratio = after.reduced / before.reduced
    return (
        fits(after)
        and after.shifted < LARGEST_SHIFT
        and ratio < least
        and log_chance(ratio, after.freedom) + math.log(count) < math.log(LEVEL)
    )


def fits(trial: Trial) -> bool:
    """Return whether the residuals of a trial are within the tolerances of a drawing."""
    return all(rms <= UNITS[unit].weak_sigma for unit, rms in trial.rms.items())


def found_in(
    what: WrongInput, text: str, n: int, before: Trial, after: Trial, count: int, apply: str = "", of: int = 0
) -> Found:
    """Return an explanation of ``n`` of ``of`` rows, by default all; ``count`` interpretations were tried."""
    ratio = after.reduced / before.reduced
    chance = math.exp(min(log_chance(ratio, after.freedom) + math.log(count), 0.0))
    score = (n / of if of else 1.0) * math.log(max(ratio, 1e-300))
    return Found(Explanation(what, text, apply, n, before.rms, after.rms, chance), after, score)


def some_rows(rows: NDArray[np.bool_], most: int = MOST_ROWS) -> NDArray[np.intp]:
    """Return the numbers of an evenly spaced selection of masked ``rows`` (n,)."""
    return np.flatnonzero(rows)[thinned(int(rows.sum()), most)]
