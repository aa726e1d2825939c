"""Parameters that are fixed or get a prior by default: frames, and parameters that the data hardly determine."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.host.puma_bench import (
    CHAIN,
    CHUCKS,
    DESIGN,
    FREE,
    RIG,
    SIGMA,
    TRUTH,
    lengths,
    random_poses,
    random_table,
    table,
)

import truearm
from truearm.estimate.defaults import choose_defaults
from truearm.estimate.frame_choice import mounting
from truearm.estimate.identify import identify
from truearm.model.chain import forward
from truearm.results import Defaults

NAMES = np.array(CHAIN.parameter_names)
NOBODY = np.zeros(len(NAMES), dtype=bool)


def chosen(rows, rig=RIG, named=NOBODY, prior=True):
    return choose_defaults(CHAIN, rig, rows, FREE, named, prior)


def one_pairing(n, chuck="c1", sphere="s1", rig=RIG, rng=None):
    pairs = [(chuck, sphere)] * n
    q = random_poses(n, np.random.default_rng(5) if rng is None else rng)
    return table(q, lengths(TRUTH, q, pairs, rig.chucks, rig.spheres), pairs)


def test_mountings_are_what_moves_base_or_tool_as_one_body():
    """Moving one of them and the inverse motion of base or tool is not a change of the arm, whatever the pose."""
    found = mounting(CHAIN, DESIGN)
    q = random_poses(20, np.random.default_rng(0))
    here = forward(CHAIN, DESIGN, q)
    for i in range(len(NAMES)):
        there = forward(CHAIN, DESIGN + 1e-3 * (np.arange(len(NAMES)) == i), q)
        at_base, at_end = there @ np.linalg.inv(here), np.linalg.inv(here) @ there
        assert found.base[i] == (np.ptp(at_base, axis=0).max() < 1e-12), NAMES[i]
        assert found.tool[i] == (np.ptp(at_end, axis=0).max() < 1e-12), NAMES[i]
    assert set(NAMES[found.base]) >= {f"link1.{k}" for k in ("x", "y", "z", "alpha", "beta", "gamma")}
    assert "joint6.offset" in NAMES[found.tool]


def test_known_fixtures_leave_no_choice_and_unknown_ones_are_placed():
    free, sigma, why = chosen(random_table(100, np.random.default_rng(1), SIGMA))
    assert why == Defaults()
    np.testing.assert_array_equal(free, FREE)
    assert np.isinf(sigma).all()
    rig = replace(RIG, chucks={name: replace(chuck, sigma=None) for name, chuck in CHUCKS.items()})
    free, _, why = chosen(random_table(200, np.random.default_rng(3), SIGMA), rig)
    assert len(why.base) == 6
    assert why.tool == ()
    whole, without = (
        identify(CHAIN, rig, random_table(200, np.random.default_rng(3), SIGMA), free=mask) for mask in (FREE, free)
    )
    assert without.null_space == ()
    assert without.chi2_reduced == pytest.approx(whole.chi2_reduced, rel=1e-3)
    named = NAMES == "link1.alpha"
    free, _, why = chosen(one_pairing(120), named=named, prior=False)
    assert free[named].all()
    assert len(why.base) == 3  # others in its place
    assert "link1.alpha" not in why.base
    free, _, _ = chosen(one_pairing(120), named=FREE, prior=False)
    np.testing.assert_array_equal(free, FREE)


def test_rows_left_out_do_not_choose_the_prior():
    """Rows with wrong labels raise the usual misfit, by which the weak prior is scaled; left out, they must not."""
    rows = random_table(200, np.random.default_rng(11), sigma=SIGMA)
    wrong = np.arange(len(rows)) < 60
    spoiled = replace(rows, value=rows.value + np.where(wrong, 0.02, 0.0))
    robot = truearm.load_robot("puma560")
    without, left_out = (
        truearm.identify(robot, table, RIG, options=truearm.IdentifyOptions(joint_laws="none", leave_out=spans))
        for table, spans in ((rows.select(~wrong), ()), (spoiled, ("1:60",)))
    )
    assert left_out.document["prior"] == without.document["prior"]
    assert left_out.document["defaults"] == without.document["defaults"]
    # the same rows, the same start, the same steps: equal to rounding
    assert left_out.estimate.value == pytest.approx(without.estimate.value, rel=1e-9, abs=1e-12)
    assert left_out.estimate.chi2_reduced == pytest.approx(without.estimate.chi2_reduced, rel=1e-9)


def test_joints_without_limits_have_defaults(tmp_path):
    """A URDF's continuous joint has none: its random poses lie within one turn, as those of a joint with wide limits."""
    data = Path(__file__).parents[1] / "data" / "mukca"
    text = (data / "panda.urdf").read_text()
    for joint in (1, 3, 5, 7):
        old = f'"panda_joint{joint}" type="revolute"'
        assert old in text
        text = text.replace(old, f'"panda_joint{joint}" type="continuous"')
    (tmp_path / "endless.urdf").write_text(text)
    endless = truearm.load_robot(tmp_path / "endless.urdf", tip="ball_link")
    limited = truearm.load_robot(data / "panda.urdf", tip="ball_link")
    assert np.isinf([joint.upper for joint in endless.chain.joints]).sum() == 4
    rows, rig = truearm.read_table(data / "panda_3.csv", limited), truearm.read_rig(data / "rig.toml")
    nobody = np.zeros(limited.free.size, dtype=bool)
    free, _, why = choose_defaults(endless.chain, rig, rows, endless.free, nobody, prior=False)
    assert free.sum() == choose_defaults(limited.chain, rig, rows, limited.free, nobody, prior=False)[0].sum()
    assert why.base
    assert why.tool


def test_seats_that_measure_no_length_do_not_shrink_the_robot():
    """Without a known distance a robot of half the size has half the residuals: then its lengths have a prior."""
    data = Path(__file__).parents[1] / "data" / "mukca"
    panda = truearm.load_robot("panda")
    rows = truearm.read_table(data / "panda_3.csv", panda)
    found = truearm.identify(panda, rows, options=truearm.IdentifyOptions(joint_laws="none"))
    assert {"joint3.d", "joint5.d"} <= set(found.document["defaults"]["believed"])
    assert (found.document["usable"], found.document["scale"]) == (True, None)
    sockets = [[found.parameters[f"socket.backcenter.{k}.{axis}"].value for axis in "xyz"] for k in "01"]
    assert np.linalg.norm(np.subtract(*sockets)) == pytest.approx(0.05, rel=0.01)
    assert found.parameters["joint3.d"].sigma is None
