"""Base and tool that a fit places elsewhere than they are described: by how much, and that this alone is no fault."""

from dataclasses import replace

import fault_worlds as worlds
import numpy as np
import pytest
from puma_bench import CHAIN, FREE, SIGMA, TRUTH

from truearm.estimate.displaced_mounts import displaced_mounts
from truearm.estimate.identify import identify
from truearm.model.rotation import rotation

# The true arm as described, so that base and tool are where they are described.
AS_DESCRIBED = replace(
    CHAIN, parameters=tuple(replace(p, nominal=value) for p, value in zip(CHAIN.parameters, TRUTH, strict=True))
)


def moved(points, turn, shift):
    turned = rotation(np.array(turn))
    return {name: replace(p, xyz=tuple((turned @ p.xyz + shift).tolist())) for name, p in points.items()}


def displaced(rig):
    plan = worlds.plan()
    rows = worlds.table(plan, worlds.lengths(plan) + SIGMA * np.random.default_rng(940050).normal(size=len(plan)))
    estimate = identify(AS_DESCRIBED, rig, rows, free=FREE, prefer=FREE)
    assert estimate.chi2_reduced < estimate.chi2_band[1]
    assert estimate.systematic is None
    return {one.frame: one for one in displaced_mounts(AS_DESCRIBED, estimate)}


def test_base_and_tool_that_are_where_they_are_described_are_not_mentioned():
    assert displaced(worlds.RIG) == {}


def test_chucks_that_are_all_wrong_by_one_motion_move_the_base():
    rig = replace(worlds.RIG, chucks=moved(worlds.RIG.chucks, (0.0, 0.0, 0.02), (0.03, 0.0, 0.04)))
    found = displaced(rig)
    assert list(found) == ["base"]
    assert found["base"].distance == pytest.approx(0.05, abs=1e-3)
    assert found["base"].turn == pytest.approx(0.02, abs=1e-3)


def test_spheres_that_are_all_wrong_by_one_motion_move_the_tool():
    rig = replace(worlds.RIG, spheres=moved(worlds.RIG.spheres, (0.0, 0.0, 0.0), (0.003, 0.004, 0.0)))
    found = displaced(rig)
    assert list(found) == ["tool"]
    assert found["tool"].distance == pytest.approx(5e-3, abs=5e-4)


def test_a_fit_that_did_not_converge_says_nothing_about_base_and_tool():
    rows = worlds.clean(worlds.plan(), np.random.default_rng(940051))
    estimate = identify(
        AS_DESCRIBED,
        replace(worlds.RIG, chucks=moved(worlds.RIG.chucks, (0.0, 0.0, 0.0), (0.2, 0.0, 0.0))),
        rows,
        free=FREE,
    )
    assert displaced_mounts(AS_DESCRIBED, estimate)
    assert displaced_mounts(AS_DESCRIBED, replace(estimate, status="max_iterations")) == ()
