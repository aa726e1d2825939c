"""Wrong labels: rows labelled with another chuck or sphere than the measured one are named, and no others."""

import re
from dataclasses import replace

import fault_worlds as worlds
import numpy as np
import pytest
from puma_bench import (
    CHAIN,
    CHUCKS,
    FREE,
    RIG,
    SIGMA,
    SPHERES,
    TRUTH,
    lengths,
    points,
    random_poses,
    shell_table,
    table,
)

from truearm.checks.inputs import checked_inputs
from truearm.checks.labels import APART, PRICE, best_labels, relabelled, robust_likelihood
from truearm.checks.trial import LEVEL, Alternative
from truearm.estimate.identify import SolverOptions, identify
from truearm.kinds.table import ObservationTable
from truearm.types import Rig


@pytest.fixture(scope="module")
def shells():
    return shell_table(400, 0.46, np.random.default_rng(0), SIGMA)


def labels(t, rig=RIG, rows=None):
    """Return the given rows, by default all, with other labels as they fit."""
    return relabelled(Alternative(CHAIN, rig, t, FREE, np.arange(len(t)) if rows is None else rows))


def with_names(t, **columns):
    changed = {}
    for name, moves in columns.items():
        column = getattr(t, name).astype(object)
        for rows, label in moves:
            column[rows] = label
        changed[name] = column.astype(str)
    return replace(t, **changed)


def of(t, chuck, sphere):
    return (t.chuck == chuck) & (t.sphere == sphere)


def restored(t, right, rig=RIG):
    result, _ = labels(t, rig)
    return all((getattr(result.table, column) == getattr(right, column)).all() for column in ("chuck", "sphere"))


@pytest.mark.parametrize("d", [1, 3, 6])
def test_right_labels_gain_nothing_on_average(d):
    """E exp(gain) is at most 1 under normal noise of d numbers a row, wherever another label has them: formula (14)."""
    noise = np.random.default_rng(d).normal(size=(100_000, d))
    square = (noise**2).sum(axis=1)
    scale = 1.4826 * float(np.sqrt(np.median(square)))
    own = robust_likelihood(square, scale)
    for away in np.linspace(0.5, 12.0, 24):
        other = robust_likelihood(((noise - away * np.eye(d)[0]) ** 2).sum(axis=1), scale)
        assert np.exp(other - own).mean() < 1.0
    assert np.exp(robust_likelihood(np.array(APART**2), 1.0) - own).mean() == pytest.approx(0.035, abs=0.01)


def test_runs_are_relabelled_if_chance_hardly_gives_them():
    # Two labels and none, 100 rows: log(300 / LEVEL) = 12.6 nats.
    score = np.zeros((3, 100))
    score[2] = -50.0
    for gain, runs in ((0.99, []), (1.01, [(40, 44, 1)])):
        score[1] = -1.0
        score[1, 40:44] = PRICE + gain * np.log(300 / LEVEL) / 4
        labels, changed = best_labels(score)
        assert [run[:3] for run in changed] == runs
        assert np.flatnonzero(labels).tolist() == [row for first, last, _ in runs for row in range(first, last)]
    # A run that is relabelled as a whole, and then in part given back, is two.
    score = np.zeros((3, 60))
    score[2], score[1], score[1, 20:22] = -100.0, -9.0, -12.0
    score[1, 5:20] = score[1, 22:40] = 5.0
    labels, runs = best_labels(score)
    assert [run[:3] for run in runs] == [(5, 20, 1), (22, 40, 1)]
    assert np.flatnonzero(labels).tolist() == [*range(5, 20), *range(22, 40)]
    assert [run[3] for run in runs] == pytest.approx([15 * (5.0 - PRICE), 18 * (5.0 - PRICE)])


CASES = {
    "a chuck": {"chuck": [(("c0", "s1"), "c2")]},
    "a sphere": {"sphere": [(("c1", "s1"), "s2")]},
    "another sphere": {"sphere": [(("c2", "s0"), "s1")]},
    "two spheres exchanged": {"sphere": [(("c0", "s1"), "s2"), (("c0", "s2"), "s1")]},
}


@pytest.mark.parametrize("case", ["a chuck", *(pytest.param(one, marks=pytest.mark.soak) for one in list(CASES)[1:])])
def test_shells_with_a_wrong_label_come_back(shells, case):
    changes = {column: [(of(shells, *pair), name) for pair, name in moves] for column, moves in CASES[case].items()}
    wrong = with_names(shells, **changes)
    assert restored(wrong, shells)


@pytest.mark.soak
def test_held_out_rows_are_not_relabelled_and_noise_is_no_label(shells):
    rows = of(shells, "c0", "s1")
    wrong = with_names(shells, chuck=[(rows, "c2")])
    assert labels(wrong, rows=np.flatnonzero(~rows))[1] == ()
    loud = replace(shells, value=shells.value + 5e-4 * np.random.default_rng(5).normal(size=400))
    assert labels(loud)[1] == ()


def on(day, t):
    return replace(t, rig=np.full(len(t), day))


@pytest.mark.soak
def test_a_wrong_label_among_several_rigs_is_named_in_its_own(shells):
    """On Tuesday the chucks stood elsewhere, under the names of Monday's, and one shell got a wrong one."""
    moved = points("c", [(x + 0.2, y - 0.1, z + 0.05) for x, y, z in (p.xyz for p in CHUCKS.values())])
    rng = np.random.default_rng(7)
    pairs = [(c, s) for c in CHUCKS for s in SPHERES for _ in range(30)]
    q = random_poses(len(pairs), rng)
    tuesday = table(q, lengths(TRUTH, q, pairs, moved) + SIGMA * rng.normal(size=len(q)), pairs)
    rigs = {"mon": RIG, "tue": Rig(moved, SPHERES, RIG.bars)}
    right = ObservationTable.joined([on("mon", shells), on("tue", tuesday)])
    wrong = with_names(right, chuck=[(np.concatenate([np.zeros(400, bool), of(tuesday, "c1", "s2")]), "c0")])
    assert restored(wrong, right, rigs)
    assert labels(right, rigs)[1] == ()


@pytest.mark.soak
def test_chucks_exchanged_on_one_day_only_are_named(shells):
    later = shell_table(180, 0.5, np.random.default_rng(8), SIGMA)
    swapped = with_names(later, chuck=[(later.chuck == "c0", "c2"), (later.chuck == "c2", "c0")])
    right, wrong = (ObservationTable.joined([on("mon", shells), on("tue", other)]) for other in (later, swapped))
    assert restored(wrong, right, {"mon": RIG, "tue": RIG})


def test_a_name_left_empty_is_the_only_one_there_is(shells):
    """A rig of one chuck, which rows need not name: a wrong sphere is named, the empty name is not a wrong label."""
    one = Rig({"c0": CHUCKS["c0"]}, SPHERES, RIG.bars)
    right = shells.select(shells.chuck == "c0")
    right = replace(right, chuck=np.full(len(right), ""))
    wrong = with_names(right, sphere=[(np.arange(len(right)) < 40, "s2")])
    assert set(right.sphere[:40]) == {"s0"}
    assert restored(wrong, right, one)


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
    assert re.search(rf": bar {rows.bar[first]}, \w+ {wrong.bar[first]}$", one.values["runs"][0])
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
