"""Data that cannot determine the robot: every solver reports the rank, the unidentifiable combinations and useful additions."""

from dataclasses import replace

import numpy as np
import pytest
from puma_bench import CHAIN, FREE, RIG, SIGMA, random_table

from truearm.checks.inputs import is_elsewhere
from truearm.estimate.identify import identify
from truearm.model.chain import point_forward
from truearm.types import Point, Rig


def fit(rig, rows, **more):
    return identify(CHAIN, rig, rows, free=FREE, prefer=FREE, **more)


def nearly_in_line(rng, places, sigma):
    """Return 300 lengths from chucks at some places (3, 3), known to ``sigma`` [m], of a robot off by 1 mm and 2 mrad."""
    scatter = {"m": 1e-3, "rad": 2e-3, "1": 1e-4}
    sizes = np.array([scatter[parameter.unit] for parameter in CHAIN.parameters])
    truth = CHAIN.params_nominal + np.where(FREE, sizes * rng.normal(size=FREE.size), 0.0)
    rows = random_table(300, rng)
    names = list(RIG.chucks)
    chucks = np.array(places)[[names.index(name) for name in rows.chuck]]
    spheres = np.array([RIG.spheres[name].xyz for name in rows.sphere])
    length = np.linalg.norm(point_forward(CHAIN, truth, rows.q, spheres) - chucks, axis=1)
    rows = replace(rows, value=length + SIGMA * rng.normal(size=len(rows)))
    guess = np.array(places) + sigma * rng.normal(size=(3, 3))
    known = {name: Point(name, tuple(xyz), sigma) for name, xyz in zip(names, guess, strict=True)}
    return Rig(known, RIG.spheres, RIG.bars), rows


@pytest.mark.parametrize(
    ("places", "sigma"),
    [
        ([(0.0, 0.2, 0.0), (0.1, 0.2, 0.0), (0.2, 0.2, 0.0)], 1e-3),
        ([(0.0, 0.2, 0.0), (0.1, 0.2, 1e-3), (0.2, 0.2, 0.0)], 3e-3),
        ([(0.0, 0.2, 0.0), (0.1, 0.2, 1e-3), (0.2, 0.2, 0.0)], 1e-2),
        ([(0.0, 0.2, 0.0), (0.1, 0.2, 1e-2), (0.2, 0.2, 0.0)], 1e-2),
        ([(0.0, 0.2, 0.0), (0.3, 0.2, 0.0), (0.3, 0.2, 1e-3)], 3e-3),
    ],
)
def test_a_base_that_may_turn_about_nearly_collinear_chucks_is_found_in_few_steps(places, sigma):
    """Only what is known about the chucks' places limits the turn: it is weakly identifiable, and the arm is not."""
    for seed in (71, 72):
        rig, rows = nearly_in_line(np.random.default_rng(seed), places, sigma)
        e = fit(rig, rows)
        assert e.status == "converged"
        assert e.iterations <= 25
        assert e.chi2_band[0] < e.chi2_reduced < e.chi2_band[1]
        weak = {name for direction in e.hardly_seen for name in direction.names}
        assert weak & {"link1.alpha", "link1.beta", "link1.gamma"}  # of the base
        assert not is_elsewhere(e)  # the turn is no reason to search for wrong labels, which takes seconds
