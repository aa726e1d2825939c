"""The error to expect: the largest of what poses show, what the covariance predicts, and what named errors move."""

import numpy as np
import pytest

import truearm
from truearm.model.chain import forward
from truearm.report.result_findings import joint_zeros, tool_error

SHOWN = {"mean_mm": 0.09, "low_mm": 0.07, "high_mm": 0.11, "n_mm": 36, "by": "held out"}


def error_of(tool=None, without_bad=None, shown=SHOWN):
    """The error of the tool to expect [mm]."""
    document = {
        "status": "converged",
        "usable": True,
        "unexplained": shown,
        "predicted_error": None if tool is None else {"rms_mm": tool[0], "n": tool[1]},
        "faults": [],
        "without_bad_rows": None if without_bad is None else {"tool_moves_mm": without_bad},
    }
    (finding,) = tool_error(document)
    return finding


@pytest.mark.parametrize(
    ("tool", "code"),
    [(None, "tool-error-shown"), ((0.2, 50), "tool-error-by-sigmas"), ((0.05, 50), "tool-error-shown")],
)
def test_the_largest_is_the_one_to_expect(tool, code):
    finding = error_of(tool)
    assert finding.code == code
    assert (finding.values["error"], finding.values["n"], finding.values["by"]) == ({"mm": 0.09}, 36, "held out")
    assert "0.090 mm (95 %: 0.0700 to 0.1100)" in finding.text()


def test_words_of_held_out_poses_and_bad_rows():
    assert error_of(shown={**SHOWN, "by": "cross-validation"}).values["by"] == "left out in turn"
    finding = error_of(tool=(0.2, 50), without_bad=0.05)
    assert (finding.code, finding.values["moves"]) == ("tool-error-bad-rows", {"mm": 0.05})


def seen_by_a_tracker(turned=(0.0,) * 6, mirrored=1.0):
    """An IRB 120 as described, whose controller counts joints from other zeros, or whose tracker has left-handed axes."""
    robot, rng = truearm.load_robot("irb120"), np.random.default_rng(5)
    q = rng.uniform(-1.05, 1.05, (120, 6))
    xyz = forward(robot.chain, robot.chain.params_nominal, q)[:, :3, 3] + 2e-5 * rng.normal(size=(120, 3))
    covariance = ((4e-10, 0.0, 0.0), (0.0, 4e-10, 0.0), (0.0, 0.0, 4e-10))
    rig = truearm.Rig(trackers={"t": truearm.Device("t", covariance)})
    rows = truearm.ObservationTable(
        q=q + turned, kind=["position"] * 120, xyz=xyz * [1.0, 1.0, mirrored], tracker=["t"] * 120
    )
    return truearm.identify(robot, rows, rig, options=truearm.IdentifyOptions(joint_laws="none")).document


def test_other_zeros_and_left_handed_axes_are_named():
    # The first and the last joint's zeros are those of base and tool, which may be anywhere.
    assert joint_zeros(seen_by_a_tracker()) == []
    assert joint_zeros(seen_by_a_tracker((1.5, 0.0, 2.0 * np.pi, 0.0, 0.0, 1.5))) == []
    (said,) = joint_zeros(seen_by_a_tracker((0.0, np.pi / 2.0, 0.0, 0.0, 0.0, 0.0)))
    assert (said.code, said.values["joints"]) == ("joint-zeros", ["joint2.offset by -90.0 deg"])
    # A robot with its lengths and zeros reversed is the mirrored one; no residual is left.
    document = seen_by_a_tracker(mirrored=-1.0)
    assert not document["usable"] or joint_zeros(document)
