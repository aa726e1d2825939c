"""Denavit–Hartenberg builders: rows multiplied by hand, derivatives, the purpose of β, and what a convention cannot represent."""

import numpy as np
import pytest
from dh_chains import chain_from_dh, chain_from_modified_dh
from rank_bench import random_joints, rank_and_gap, sensitivity

from truearm.model.chain import forward
from truearm.model.chain_structure import Joint

BUILDERS = (chain_from_dh, chain_from_modified_dh)
BOTH = pytest.mark.parametrize("build", BUILDERS)


def joints(kinds):
    return tuple(Joint(f"j{i}", {"R": "revolute", "P": "prismatic"}[k], -1.5, 1.5) for i, k in enumerate(kinds))


def random_rows(n, rng):
    return rng.uniform(-1.0, 1.0, (n, 4))


def distal(theta, d, a, alpha):
    """The matrix of a row as textbooks print it."""
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]])


def proximal(theta, d, a, alpha):
    """Craig's (3.6)."""
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[ct, -st, 0, a], [st * ca, ct * ca, -sa, -sa * d], [st * sa, ct * sa, ca, ca * d], [0, 0, 0, 1]])


def about_y(beta):
    c, s = np.cos(beta), np.sin(beta)
    return np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize(("build", "row_matrix"), [(chain_from_dh, distal), (chain_from_modified_dh, proximal)])
def test_rows_by_the_textbook(build, row_matrix):
    rng = np.random.default_rng(1)
    rows, q = random_rows(3, rng), rng.uniform(-1, 1, 3)
    chain = build("r", joints("RPR"), rows, base=None, tool=None)
    moved = rows.copy()
    moved[[0, 2], 0] += q[[0, 2]]
    moved[1, 1] += q[1]
    expected = row_matrix(*moved[0]) @ row_matrix(*moved[1]) @ row_matrix(*moved[2])
    np.testing.assert_allclose(forward(chain, chain.params_nominal, q), expected, atol=1e-15)


def test_beta_stands_at_the_far_end_of_a_distal_row_and_at_the_near_end_of_a_modified_one():
    rng = np.random.default_rng(2)
    rows, beta = random_rows(2, rng), 0.3
    for build, first in (
        (chain_from_dh, distal(*rows[0]) @ about_y(beta) @ distal(*rows[1])),
        (chain_from_modified_dh, about_y(beta) @ proximal(*rows[0]) @ proximal(*rows[1])),
    ):
        chain = build("r", joints("RR"), rows, twisted=(0,), base=None, tool=None)
        params = np.where(np.array(chain.parameter_names) == "joint1.beta", beta, chain.params_nominal)
        np.testing.assert_allclose(forward(chain, params, np.zeros(2)), first, atol=1e-15)


@BOTH
def test_mountings_offset_and_gain(build):
    six = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    chain = build("r", joints("R"), np.zeros((1, 4)), base=six, tool=six, base_frame="world", end_frame="pen")
    bare = build("r", joints("R"), np.zeros((1, 4)), base=None, tool=None)
    assert (chain.base_frame, chain.end_frame) == ("world", "pen")
    assert chain.parameter_names[:6] == tuple(f"base.{k}" for k in ("x", "y", "z", "alpha", "beta", "gamma"))
    mounting = forward(chain, chain.params_nominal, np.zeros(1))
    params = chain.params_nominal.copy()
    params[[chain.parameter_names.index(n) for n in ("joint1.offset", "joint1.gain")]] = 0.2, 0.9
    based = build("r", joints("R"), np.zeros((1, 4)), base=six, tool=None)
    half = np.linalg.inv(forward(based, based.params_nominal, np.zeros(1)))
    turned = half @ forward(chain, params, np.array([0.5])) @ np.linalg.inv(half @ mounting)
    np.testing.assert_allclose(turned, forward(bare, bare.params_nominal, np.array([0.2 + 0.9 * 0.5])), atol=1e-15)


def seen(chain, params=None, seed=4):
    q = random_joints(chain, 60, np.random.default_rng(seed))
    rank, gap = rank_and_gap(sensitivity(chain, chain.params_nominal if params is None else params, q))
    assert gap > 1e6, "no count without a gap"
    return rank


# θ, d, a, α with axes 2, 3 and 4 parallel, as in a UR; each convention writes the twist in its own row.
UR = np.array([[0, 0.2, 0, 1.5], [0, 0, -0.4, 0], [0, 0, -0.4, 0], [0, 0.1, 0, 1.5], [0, 0.1, 0, -1.5], [0, 0.1, 0, 0]])
UR_MODIFIED = np.column_stack([UR[:, :2], np.roll(UR[:, 2:], 1, axis=0)])


@pytest.mark.parametrize(
    ("build", "rows", "pairs"), [(chain_from_dh, UR, (1, 2)), (chain_from_modified_dh, UR_MODIFIED, (2, 3))]
)
def test_parallel_axes_lose_a_parameter_each_without_beta(build, rows, pairs):
    plain, one, twisted = (build("r", joints("RRRRRR"), rows, twisted=t) for t in ((), pairs[:1], pairs))
    assert [seen(chain) for chain in (plain, one, twisted)] == [34, 35, 36]
    assert len(twisted.parameters) == len(plain.parameters)  # β has taken the place of d
