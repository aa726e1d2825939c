"""Settling of a signal, judged by its own noise: the effect of noise alone, of an oscillation and of creep."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter
from scipy.stats import binom

from truearm.session.dwells import FALSE_ALARM, block_means, block_variance, rests_within, rings, settled_from

HZ, BLOCK = 1000.0, 25
T = np.arange(1800) / HZ


def noise_of(rng, phi):
    kicks = rng.standard_normal(T.size + 500) * np.sqrt(1.0 - phi**2)
    return lfilter([1.0], [1.0, -phi], kicks)[500:]


def found(signal, floor=0.0, variance=1.0 / BLOCK):
    """White noise of variance 1 by default."""
    return settled_from(block_means(signal, BLOCK), variance, floor)


def test_noise_of_known_variance_is_rarely_cut():
    """5000 stops at rest: no more of them lose anything than the bound says (Bonferroni bounds from above; 99.9 %)."""
    rng = np.random.default_rng(1)
    cut = sum(settled_from(rng.standard_normal(72), 1.0, 0.0).first > 0 for _ in range(5000))
    assert cut <= binom.ppf(0.999, 5000, FALSE_ALARM)


@pytest.mark.parametrize("phi", [0.0, 0.9, -0.5])
def test_noise_is_rarely_cut_whatever_its_correlation(phi):
    """With the variance estimated from 36 blocks of the same stop, correlation and all: three in a thousand.

    A variance from 36 numbers is short by a quarter in one stop of ten; at five sigmas that is thirty times as many alarms.
    """
    rng = np.random.default_rng(2)
    cut = 0
    for _ in range(1000):
        signal = noise_of(rng, phi)
        cut += found(signal, variance=block_variance(signal, BLOCK)).first > 0
    assert cut <= binom.ppf(0.999, 1000, 30.0 * FALSE_ALARM)


@pytest.mark.parametrize("amplitude", [3.0, 10.0, 100.0])
def test_a_swing_is_left_out_until_it_drowns_in_the_noise(amplitude):
    rng = np.random.default_rng(3)
    swing = amplitude * np.exp(-T / 0.1) * np.cos(2.0 * np.pi * 6.0 * T)
    for _ in range(20):
        settled = found(noise_of(rng, 0.0) + swing)
        begin = settled.first * BLOCK / HZ
        # What is left is no more than a block may stray by noise, 5.3/√25 sigmas, and its noise on top of that.
        assert np.abs(block_means(swing, BLOCK)[settled.first :]).max() < 5.3 / 5.0 + 3.0 / 5.0
        assert begin < 0.1 * np.log(amplitude) + 0.3


def test_creeps_are_left_out_and_floors_not_waited_for():
    # Three and a half of a block's sigmas to begin with, where one block may stray by 5.3: stretches of many blocks see
    # it.
    rng = np.random.default_rng(4)
    creep = 0.7 * np.exp(-T / 0.3)
    assert found(creep).first == 0 or found(creep).bound > 0.7
    firsts = np.array([found(noise_of(rng, 0.0) + creep).first for _ in range(50)])
    assert np.mean(firsts > 0) > 0.9
    assert firsts.max() < 36
    # To 1 %, by stretches as well as by single blocks, of a level that is itself off by the half's mean, 0.0025.
    creep = np.exp(-T / 0.2)
    assert found(creep, floor=0.01, variance=0.0).first * BLOCK / HZ == pytest.approx(
        0.2 * np.log(1.0 / 0.0125), abs=0.03
    )
    assert found(creep, floor=2.0).first == 0


def test_what_never_rests_and_what_always_does():
    rng = np.random.default_rng(5)
    blocks = len(T) // BLOCK
    swing = found(noise_of(rng, 0.0) + 20.0 * np.cos(2.0 * np.pi * 1.7 * T) * (T < 1.4))
    drift = found(noise_of(rng, 0.0) + 20.0 * T)
    assert swing.first > 0.7 * blocks
    assert drift.first > 0.7 * blocks
    assert (rings(swing), rings(drift)) == (True, False)
    settled = found(np.full(T.size, 0.46), floor=1e-12, variance=0.0)
    assert (settled.first, settled.level) == (0, pytest.approx(0.46))


@given(st.integers(0, 2**32 - 1), st.integers(4, 90), st.floats(0.0, 6.0), st.floats(0.0, 1e3))
def test_signals_within_the_floor_rest_whatever_their_noise(seed, blocks, floor, block_var):
    rng = np.random.default_rng(seed)
    means = 1e3 + rng.standard_normal((3, blocks)) * rng.choice([0.1, 1.0], (3, 1))
    if rests_within(means, floor):
        assert not settled_from(means, block_var, floor).first.any()
