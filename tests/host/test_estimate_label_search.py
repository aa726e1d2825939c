"""Wrong labels: rows labelled with another chuck or sphere than the measured one are named, and no others."""

from dataclasses import replace

import numpy as np
import pytest
from puma_bench import (
    BARS,
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

from truearm.estimate import label_search as relabel
from truearm.estimate import wrong_inputs
from truearm.estimate.identify import SolverOptions
from truearm.estimate.identify import identify as estimated
from truearm.estimate.wrong_inputs import diagnosed
from truearm.kinds.table import ObservationTable
from truearm.types import Rig


@pytest.fixture(autouse=True)
def readings_are_right(monkeypatch):
    """Try no other units, robots or joints before the labels, which takes nine tenths of the time.

    test_wrong_inputs.py and test_cli_identify.py try them all before wrong labels.
    """
    monkeypatch.setattr(wrong_inputs, "_every_reading", lambda *_: ())


def identify(chain, rig, table, **how):
    """Return the estimate, and the findings about wrong inputs."""
    return diagnosed(estimated(chain, rig, table, **how), chain, rig, table, FREE)


@pytest.fixture(scope="module")
def shells():
    return shell_table(400, 0.46, np.random.default_rng(0), SIGMA)


def relabelled(t, **columns):
    changed = {}
    for name, moves in columns.items():
        column = getattr(t, name).astype(object)
        for rows, label in moves:
            column[rows] = label
        changed[name] = column.astype(str)
    return replace(t, **changed)


def of(t, chuck, sphere):
    return (t.chuck == chuck) & (t.sphere == sphere)


@pytest.mark.parametrize(
    ("column", "was", "called"),
    [("chuck", ("c0", "s1"), "c2"), ("sphere", ("c1", "s1"), "s2"), ("sphere", ("c2", "s0"), "s1")],
)
def test_one_shell_with_a_wrong_label_is_named(shells, column, was, called):
    rows = of(shells, *was)
    wrong = relabelled(shells, **{column: [(rows, called)]})
    e = identify(CHAIN, RIG, wrong, free=FREE)
    assert e.rms_after["m"] > 5e-3
    (found,) = e.relabellings
    assert list(found.rows) == np.flatnonzero(rows).tolist()
    assert found.fits == was
    assert found.was == ((called, was[1]) if column == "chuck" else (was[0], called))
    assert found.rms_after < 2 * SIGMA
    assert found.rms_before > 5e-3


def test_two_shells_exchanged_are_named(shells):
    one, other = of(shells, "c0", "s1"), of(shells, "c0", "s2")
    wrong = relabelled(shells, sphere=[(one, "s2"), (other, "s1")])
    found = identify(CHAIN, RIG, wrong, free=FREE).relabellings
    assert {(r.was, r.fits) for r in found} == {(("c0", "s2"), ("c0", "s1")), (("c0", "s1"), ("c0", "s2"))}
    assert sorted(i for r in found for i in r.rows) == np.flatnonzero(one | other).tolist()


def test_two_chucks_exchanged_everywhere_are_named(shells):
    wrong = relabelled(shells, chuck=[(shells.chuck == "c0", "c2"), (shells.chuck == "c2", "c0")])
    found = identify(CHAIN, RIG, wrong, free=FREE).relabellings
    assert len(found) == 6
    assert {r.was[0] + r.fits[0] for r in found} == {"c0c2", "c2c0"}


def test_held_out_rows_are_not_relabelled_and_noise_is_no_label(shells):
    rows = of(shells, "c0", "s1")
    wrong = relabelled(shells, chuck=[(rows, "c2")])
    assert identify(CHAIN, RIG, wrong, free=FREE, hold_out=rows).relabellings == ()
    loud = replace(shells, value=shells.value + 5e-4 * np.random.default_rng(5).normal(size=400))
    assert identify(CHAIN, RIG, loud, free=FREE).relabellings == ()


def test_when_nothing_fits_nothing_is_named(shells):
    """Lengths of another world: the residuals are large, but no label explains them. With two chucks, for fewer fits."""
    mine = shells.select(shells.chuck != "c2")
    wild = replace(mine, value=np.random.default_rng(6).uniform(0.3, 0.8, len(mine)))
    rig = Rig({name: CHUCKS[name] for name in ("c0", "c1")}, SPHERES, BARS)
    e = identify(CHAIN, rig, wild, free=FREE, options=SolverOptions(max_iterations=5))
    assert e.rms_after["m"] > 1e-2
    assert (e.relabellings, e.relabelling_search) == ((), "done")


def joined(*tables):
    return ObservationTable.joined(tables)


def on(day, t):
    return replace(t, rig=np.full(len(t), day))


def test_a_wrong_label_among_several_rigs_is_named_in_its_own(shells):
    """On Tuesday the chucks stood elsewhere, under the names of Monday's, and one shell got a wrong one."""
    moved = points("c", [(x + 0.2, y - 0.1, z + 0.05) for x, y, z in (p.xyz for p in CHUCKS.values())])
    rng = np.random.default_rng(7)
    pairs = [(c, s) for c in CHUCKS for s in SPHERES for _ in range(30)]
    q = random_poses(len(pairs), rng)
    length = lengths(TRUTH, q, pairs, moved) + SIGMA * rng.normal(size=len(q))
    tuesday = table(q, length, pairs)
    rigs = {"mon": RIG, "tue": Rig(moved, SPHERES, BARS)}
    rows = np.concatenate([np.zeros(len(shells), bool), of(tuesday, "c1", "s2")])
    right = joined(on("mon", shells), on("tue", tuesday))
    wrong = relabelled(right, chuck=[(rows, "c0")])
    e = identify(CHAIN, rigs, wrong, free=FREE)
    (found,) = e.relabellings
    assert list(found.rows) == np.flatnonzero(rows).tolist()
    assert (found.was, found.fits) == (("c0", "s2"), ("c1", "s2"))
    assert e.relabelling_search == "done"
    clean = identify(CHAIN, rigs, right, free=FREE)
    assert (clean.relabellings, clean.relabelling_search) == ((), "not needed")


def test_chucks_exchanged_on_one_day_only_are_named(shells):
    later = shell_table(180, 0.5, np.random.default_rng(8), SIGMA)
    swapped = relabelled(later, chuck=[(later.chuck == "c0", "c2"), (later.chuck == "c2", "c0")])
    e = identify(CHAIN, {"mon": RIG, "tue": RIG}, joined(on("mon", shells), on("tue", swapped)), free=FREE)
    assert {(r.was[0], r.fits[0]) for r in e.relabellings} == {("c0", "c2"), ("c2", "c0")}
    assert sorted(i for r in e.relabellings for i in r.rows) == (400 + np.flatnonzero(later.chuck != "c1")).tolist()


def test_one_of_twenty_seven_shells_is_named():
    """Three radii about each of three chucks, with three spheres."""
    rng = np.random.default_rng(9)
    shells = [replace(shell_table(135, r, rng, SIGMA), shell=np.full(135, f"r{r}")) for r in (0.42, 0.46, 0.50)]
    t = joined(*shells)
    rows = of(t, "c0", "s1") & (t.shell == "r0.46")
    (found,) = identify(CHAIN, RIG, relabelled(t, chuck=[(rows, "c2")]), free=FREE).relabellings
    assert list(found.rows) == np.flatnonzero(rows).tolist()
    assert found.fits == ("c0", "s1")


def test_a_search_that_is_not_made_is_told(shells, monkeypatch):
    """Eight pairings by name, in nine runs."""
    wrong = relabelled(shells, chuck=[(of(shells, "c0", "s1"), "c2")])
    monkeypatch.setattr(relabel, "MAX_GROUPS", 7)
    e = identify(CHAIN, RIG, wrong, free=FREE)
    assert e.rms_after["m"] > 5e-3
    assert (e.relabellings, e.relabelling_search) == ((), "too many groups")
    monkeypatch.setattr(relabel, "MAX_GROUPS", 9)
    assert len(identify(CHAIN, RIG, wrong, free=FREE).relabellings) == 1


def test_rows_whose_shells_are_too_many_are_grouped_by_pairing(shells, monkeypatch):
    """A shell of its own for every row says nothing; two chucks exchanged everywhere are found anyway."""
    monkeypatch.setattr(relabel, "MAX_GROUPS", 12)
    each = replace(shells, shell=np.array([f"pose {i}" for i in range(len(shells))]))
    wrong = relabelled(each, chuck=[(each.chuck == "c0", "c2"), (each.chuck == "c2", "c0")])
    assert len(identify(CHAIN, RIG, wrong, free=FREE).relabellings) == 6


def test_a_name_left_empty_is_the_only_one_there_is(shells):
    """A rig of one chuck, which rows need not name: a wrong sphere is named, the empty name is not a wrong label."""
    one = Rig({"c0": CHUCKS["c0"]}, SPHERES, BARS)
    mine = shells.select(shells.chuck == "c0")
    mine = replace(mine, chuck=np.full(len(mine), ""))
    rows = np.zeros(len(mine), bool)
    rows[:40] = True
    assert set(mine.sphere[rows]) == {"s0"}
    found = identify(CHAIN, one, relabelled(mine, sphere=[(rows, "s2")]), free=FREE).relabellings
    assert sorted(i for r in found for i in r.rows) == list(range(40))
    assert all(r.fits == ("c0", "s0") and r.was == ("c0", "s2") for r in found)
