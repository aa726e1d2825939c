"""The error to expect: the largest of what poses show, what the covariance predicts, and what named errors move."""

import math

import pytest

from truearm.report.result_words import unexplained_words
from truearm.results import MeanError

HELD_OUT = {"m": MeanError(mean=0.9e-4, low=0.7e-4, high=1.1e-4, n=36, held_out=True)}


@pytest.mark.parametrize(
    ("systematic", "tool", "first"),
    [
        (None, None, "The declared noise does not explain the residuals. Expect errors of 0.0900 mm (95 %: "),
        (None, (2e-4, 50), "The declared noise does not explain the residuals. Expect tool errors of 0.2000 mm RMS"),
        (math.nan, (5e-5, 50), "The fit has systematic errors. Expect errors of 0.0900 mm (95 %: "),
        (8e-5, (5e-5, 50), "The fit has systematic errors. Expect errors of 0.0900 mm (95 %: "),
        (1e-4, (2e-4, 50), "The fit has systematic errors. Expect tool errors of 0.2000 mm RMS over 50 poses"),
        (5.5e-3, (2e-4, 50), "The fit has systematic errors. Expect tool errors of at least 5.5000 mm RMS: by so much"),
        (5.5e-3, None, "The fit has systematic errors. Expect tool errors of at least 5.5000 mm RMS: by so much"),
    ],
)
def test_the_largest_comes_first(systematic, tool, first):
    lines = unexplained_words(HELD_OUT, systematic, tool)
    assert lines[0].startswith(first)
    assert "0.0900 mm (95 %: 0.0700 to 0.1100), the mean of 36 poses held out." in " ".join(lines)
