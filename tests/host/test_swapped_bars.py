"""Rows that name another bar than the one that measured them: a mount, or all rows of two bars."""

from dataclasses import replace

import fault_worlds as worlds
import numpy as np
import pytest
from puma_bench import CHAIN, FREE

from truearm.checks.inputs import checked_inputs
from truearm.estimate.identify import SolverOptions, identify

BAR = worlds.RIG.bars["bar46"]


def alternating(seed, longer):
    """Return a clean session with two bars in turn, mount by mount; its rig, and the first row of each mount and n."""
    plan = worlds.plan()
    rig = replace(worlds.RIG, bars={"bar46": BAR, "other": replace(BAR, name="other", zero=BAR.zero + longer)})
    change = (plan.chuck[1:] != plan.chuck[:-1]) | (plan.sphere[1:] != plan.sphere[:-1])
    mounts = np.concatenate([[0], np.flatnonzero(change) + 1, [len(plan)]])
    turn = np.searchsorted(mounts, np.arange(len(plan)), side="right") % 2
    rows = worlds.clean(plan, np.random.default_rng(seed))
    return replace(rows, bar=np.array(["other", "bar46"])[turn]), rig, mounts


def renamed(rows, rig, mine):
    """Return the rows with the names of the bars exchanged where ``mine``, and the lengths that follow from the readings."""
    name = np.where(mine, np.where(rows.bar == "bar46", "other", "bar46"), rows.bar)
    change = np.array([rig.bars[now].zero - rig.bars[was].zero for now, was in zip(name, rows.bar, strict=True)])
    return replace(rows, bar=name, value=rows.value + change)


def explained(rows, rig):
    estimate = identify(CHAIN, rig, rows, free=FREE, options=SolverOptions(reject=True))
    return checked_inputs(estimate, CHAIN, rig, rows, FREE, FREE, dict).explanations


@pytest.mark.parametrize("longer", [pytest.param(15e-3, marks=pytest.mark.soak), 150e-3])
def test_a_mount_that_was_made_with_another_bar_is_named_and_no_other_row(longer):
    rows, rig, mounts = alternating(940020, longer)
    first, end = mounts[np.argmax(np.diff(mounts)) + np.arange(2)].tolist()
    wrong = renamed(rows, rig, (np.arange(len(rows)) >= first) & (np.arange(len(rows)) < end))
    (one,) = explained(wrong, rig)
    assert (one.code, one.values["leave_out"], one.values["bar"]) == ("wrong-labels", [f"{first + 1}:{end}"], True)
    assert one.values["runs"][0].endswith(f": bar {rows.bar[first]}, not {wrong.bar[first]}")
    assert one.rms["m"] < 1.5 * worlds.SIGMA
    assert one.chance < 1e-3


@pytest.mark.soak
def test_swapped_bars_are_named_and_a_mount_elsewhere_is_none():
    rows, rig, _ = alternating(940021, 15e-3)
    first, *_ = explained(renamed(rows, rig, np.ones(len(rows), dtype=bool)), rig)
    assert (first.code, first.values["bar"]) == ("names-exchanged", True)
    assert first.values["names"] == ["bar bar46 is other", "bar other is bar46"]
    # The chuck of one mount stood 15 mm higher: as far as the bars differ.
    rows, rig, mounts = alternating(940022, 15e-3)
    first, end = mounts[np.argmax(np.diff(mounts)) + np.arange(2)].tolist()
    off = np.zeros((len(rows), 3))
    off[first:end] = (0.0, 0.0, 15e-3)
    length = worlds.lengths(worlds.plan(), off) + rows.value - worlds.lengths(worlds.plan())
    assert not any(one.values.get("bar") for one in explained(replace(rows, value=length), rig))
