"""The declared and the unexplained part of the residuals, as two numbers."""

import numpy as np
import pytest
from tests.host.findings_bench import stated
from tests.host.puma_bench import CHAIN, FREE, RIG, ROBOT, SIGMA, random_table

import truearm
from truearm.estimate.identify import identify
from truearm.workflows.calibration_report import write_page

N, RANK = 400, 36


@pytest.mark.parametrize("times", [1.0, 3.0])
def test_the_two_parts_are_what_was_declared_and_what_was_not(times):
    parts = identify(CHAIN, RIG, random_table(N, np.random.default_rng(0), times * SIGMA), free=FREE).parts["m"]
    left = np.sqrt(1.0 - RANK / N)  # of the residuals, as the parameters follow the others
    assert parts.declared == pytest.approx(SIGMA * left, rel=1e-9)
    # Mean squares of 364 degrees of freedom have a standard error of 7.4 %.
    assert parts.unexplained**2 == pytest.approx(
        (times**2 - 1.0) * (SIGMA * left) ** 2, abs=3.0 * 0.074 * (times * SIGMA) ** 2
    )


def test_they_stand_in_result_terminal_and_report(tmp_path):
    found = truearm.identify(ROBOT, random_table(N, np.random.default_rng(1), 3.0 * SIGMA), RIG)
    declared, unexplained = (found.document[f"rms_{name}_mm"] for name in ("declared", "unexplained"))
    assert declared**2 + unexplained**2 == pytest.approx(found.document["rms_after_mm"] ** 2)
    share = stated(found.document)["noise-share"]
    assert (share.values["declared"], share.values["unexplained"]) == ({"mm": declared}, {"mm": unexplained})
    assert share.values["rest"] == "is unexplained"
    write_page(tmp_path / "page.html", found)
    assert share.text() in (tmp_path / "page.html").read_text()
    found = truearm.identify(ROBOT, random_table(N, np.random.default_rng(0), 1.05 * SIGMA), RIG)
    assert found.document["chi2_reduced"] <= found.document["chi2_band"][1]
    assert found.document["rms_unexplained_mm"] > 0.0
    assert stated(found.document)["noise-share"].values["rest"] == "may be chance"
