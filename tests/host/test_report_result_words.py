"""The error to expect: the largest of what poses show, what the covariance predicts, and what named errors move."""

import math

import numpy as np
import pytest

import truearm
from truearm.model.chain import forward
from truearm.report.result_words import displacement_sentences, unexplained_words, zero_sentences
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
        (
            5.5e-3,
            (2e-4, 50),
            "The fit has systematic errors. Expect tool errors of at least 5.5000 mm RMS: the tool moves by that much",
        ),
        (
            5.5e-3,
            None,
            "The fit has systematic errors. Expect tool errors of at least 5.5000 mm RMS: the tool moves by that much",
        ),
    ],
)
def test_the_largest_comes_first(systematic, tool, first):
    lines = unexplained_words(HELD_OUT, systematic, tool)
    assert lines[0].startswith(first)
    assert "0.0900 mm (95 %: 0.0700 to 0.1100), the mean of 36 poses held out." in " ".join(lines)


@pytest.mark.parametrize(
    ("n", "said"),
    [
        (1, "the mean of 1 pose (predicted from the other poses)."),
        (2, "the mean of 2 poses (each predicted from the other poses)."),
    ],
)
def test_poses_left_out_in_turn_are_said_to_be_predicted_from_the_others(n, said):
    (line,) = unexplained_words({"m": MeanError(mean=1e-4, low=0.9e-4, high=1.1e-4, n=n, held_out=False)}, None, None)
    assert said in line


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        (
            ("base",),
            "The fit places the base 12 mm from where it is described. This is normal if nobody measured its place: ",
        ),
        (
            ("base", "tool"),
            "and the tool 12 mm from where it is described. This is normal if nobody measured their places: ",
        ),
    ],
)
def test_a_base_or_tool_elsewhere_may_be_wrong_positions_in_the_rig(frames, said):
    displaced = [{"frame": frame, "distance_mm": 12.0, "turn_deg": 0.1} for frame in frames]
    (line,) = displacement_sentences({"displaced": displaced})
    assert said in line
    assert line.endswith("check the positions in the rig.")


def test_bad_rows_in_the_fit_come_first_whatever_the_rows_show():
    lines = unexplained_words(HELD_OUT, None, (2e-4, 50), without_bad=5e-5)
    assert lines[0] == (
        "Bad rows are in the fit. Expect tool errors of 0.0500 mm RMS: the tool moves by that much if they are left out."
    )
    assert lines[1].startswith(
        "The error that the rows show includes that of the bad rows themselves: 0.0900 mm (95 %: "
    )


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


def test_a_joint_that_counts_from_another_zero_is_named():
    """The first and the last joint's zeros are those of base and tool, which may be anywhere."""
    assert zero_sentences(seen_by_a_tracker()) == []
    assert zero_sentences(seen_by_a_tracker((1.5, 0.0, 2.0 * np.pi, 0.0, 0.0, 1.5))) == []
    (said,) = zero_sentences(seen_by_a_tracker((0.0, np.pi / 2.0, 0.0, 0.0, 0.0, 0.0)))
    assert said.startswith("Zeros of joints differ from the description: joint2.offset by -90.0 deg. ")


def test_left_handed_axes_that_a_mirrored_arm_explains_are_not_silent():
    """A robot with its lengths and zeros reversed is the mirrored one; no residual is left."""
    document = seen_by_a_tracker(mirrored=-1.0)
    assert not document["usable"] or "check the signs and axes" in zero_sentences(document)[0]
