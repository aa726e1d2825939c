"""What was mounted, by all evidence: the hidden Markov model compared with sums over all its paths, and the effect of single observations."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from operator_scripts import Visit, lengths, pairing_at, script

from truearm.estimate.mounted_pairings import (
    SURE,
    MountingChances,
    Readings,
    Words,
    mistakes,
    mountings,
    runs,
    state_probabilities,
    transition,
)
from truearm.model.robot_file import builtin_robot
from truearm_sim.world import standard_plan, standard_rig

ROBOT, RIG = builtin_robot("puma560"), standard_rig()
PAIRING = ("bar46", "c1", "s1")


@pytest.fixture(scope="module")
def plan():
    return standard_plan(20, 1, RIG)  # 18 pairings of two or three poses: runs cannot be shorter


def test_probabilities_are_those_of_all_paths():
    """Compared with the sum over all paths, for 3 states and 5 dwells."""
    rng = np.random.default_rng(5)
    n, states = 5, 3
    steps = [rng.dirichlet(np.ones(states), states) for _ in range(n)]
    told, came, stayed = (rng.normal(0.0, 2.0, (n, states)) for _ in range(3))
    weight = np.zeros((n, states))
    for path in product(range(states), repeat=n):
        log = np.log(steps[0].mean(axis=0)[path[0]]) + told[0, path[0]] + came[0, path[0]]
        for i in range(1, n):
            seen = stayed if path[i] == path[i - 1] else came
            log += np.log(steps[i][path[i - 1], path[i]]) + told[i, path[i]] + seen[i, path[i]]
        for i in range(n):
            weight[i, path[i]] += np.exp(log)
    probability, evidence = state_probabilities(steps, told, came, stayed)
    np.testing.assert_allclose(probability, weight / weight.sum(axis=1, keepdims=True), rtol=1e-9)
    np.testing.assert_allclose(evidence, np.log(weight[0].sum()), rtol=1e-9)


@pytest.mark.parametrize(("wanted", "asked"), [([], False), ([1], True), ([1], False), ([0, 2], True)])
def test_transitions_are_probabilities(wanted, asked):
    step = transition(mistakes(list(product(["b1", "b2"], ["c1"], ["s1", "s2"]))), wanted, asked)
    np.testing.assert_allclose(step.sum(axis=1), 1.0)
    assert (step > 0.0).all()  # nothing is impossible for an operator
    if asked:
        assert (step[3, wanted].sum() > 0.85).all()


def test_runs():
    assert runs(np.array([4, 4, 1, 4])) == [slice(0, 2), slice(2, 3), slice(3, 4)]


def shell_rig():
    """Return a rig with only the parts of PAIRING."""
    bar, chuck, sphere = PAIRING
    return replace(
        RIG, bars={bar: RIG.bars[bar]}, chucks={chuck: RIG.chucks[chuck]}, spheres={sphere: RIG.spheres[sphere]}
    )


def readings(extension, q):
    return Readings(q, extension, np.isnan(extension))


def planned(plan, visits):
    return [(pairing_at(plan, visit.planned),) for visit in visits]


def sure(chances):
    """The pairing of each dwell, None where none is as probable as SURE."""
    likeliest = map(chances.likeliest, range(len(chances.probability)))
    return [pairing if p >= SURE else None for pairing, p in likeliest]


def test_an_operator_who_errs(plan):
    """Every label that is sure is right, and nearly all are: 200 operators are in test_relabel (soak)."""
    wrong = usable = read = 0
    for seed in range(6):
        visits = script(seed, plan, RIG)
        extension = lengths(visits, plan, RIG, ROBOT.chain, ROBOT.parameter_sets["optimised"], seed)
        words = Words(planned(plan, visits), [visit.typed for visit in visits])
        found = sure(
            mountings(ROBOT.chain, RIG, readings(extension, plan.q[[v.planned for v in visits]]), words, ROBOT.free)
        )
        of_reading = [(label, v.mounted) for label, v, e in zip(found, visits, extension, strict=True) if e == e]
        read += len(of_reading)
        usable += sum(label is not None for label, _ in of_reading)
        wrong += sum(label is not None and label != mounted for label, mounted in of_reading)
    assert wrong == 0
    assert usable >= 0.95 * read


def test_a_fit_that_predicts_the_dwells_worse_makes_nothing_sure(plan):
    """Operator 104 mounts sphere s3 one dwell late. The fit with the wide prior bends to the wrong label and misses by less than the one
    with the weak prior, but predicts the other runs 10⁸ times worse."""
    visits = script(104, plan, RIG)
    extension = lengths(visits, plan, RIG, ROBOT.chain, ROBOT.parameter_sets["optimised"], 104)
    words = Words(planned(plan, visits), [visit.typed for visit in visits])
    found = mountings(ROBOT.chain, RIG, readings(extension, plan.q[[v.planned for v in visits]]), words, ROBOT.free)
    assert visits[37].mounted == ("bar61", "c3", "s2")
    assert not found.supports(37, ("bar61", "c3", "s3"))
    assert sure(found)[37] in (None, ("bar61", "c3", "s2"))


def test_without_readings_that_tell_words_count(plan):
    # The last dwell of a session, at a pose where two spheres are equally far from the chuck: the old one may have stayed
    # on.
    right, old = PAIRING, ("bar46", "c1", "s2")
    by_words = np.array([[0.95, 0.05, 0.0]])
    assert MountingChances((right, old), by_words, by_words).supports(0, right)
    assert not MountingChances((right, old), np.array([[0.9, 0.1, 0.0]]), by_words).supports(0, right)
    assert not MountingChances((right, old), by_words, by_words).supports(0, ("bar46", "c3", "s3"))
    # No reading can confirm anything; the plan's pairing is the most probable.
    q = plan.q[:6]
    words = Words([(pairing_at(plan, i),) for i in range(6)], [()] * 6)
    found = mountings(ROBOT.chain, RIG, Readings(q, np.full(6, np.nan), np.zeros(6, dtype=bool)), words, ROBOT.free)
    assert [found.pairings[k] for k in found.probability.argmax(axis=1)] == [pairing_at(plan, i) for i in range(6)]
    assert found.probability.max() < SURE
    assert sure(found) == [None] * 6


def test_a_session_without_a_plan_follows_what_was_typed(plan):
    visits = script(1, plan, RIG)
    right = [type(visit)(visit.planned, pairing_at(plan, visit.planned)) for visit in visits]
    extension = lengths(right, plan, RIG, ROBOT.chain, ROBOT.parameter_sets["optimised"], 1)
    typed, last = [], None
    for visit in right:
        typed.append((visit.mounted,) if visit.mounted != last else ())
        last = visit.mounted
    words = Words([()] * len(right), typed)
    found = mountings(ROBOT.chain, RIG, readings(extension, plan.q[[v.planned for v in right]]), words, ROBOT.free)
    of_reading = [(label, v.mounted) for label, v, e in zip(sure(found), right, extension, strict=True) if e == e]
    assert all(label in (None, mounted) for label, mounted in of_reading)
    assert sum(label is not None for label, _ in of_reading) > 0.9 * len(of_reading)


@pytest.mark.parametrize("whole_rig", [True, False])
def test_a_short_session_of_one_pairing_loses_nothing(whole_rig):
    """Nine poses of one shell: nothing but the nominal robot, which is off by 14 mm, speaks of the only run. Right labels stay."""
    (bar, chuck, sphere), small = PAIRING, shell_rig()
    plan = standard_plan(9, 3, small)
    visits = [Visit(row, (bar, chuck, sphere)) for row in range(len(plan))]
    extension = lengths(visits, plan, RIG, ROBOT.chain, ROBOT.parameter_sets["optimised"], 3)
    words = Words(planned(plan, visits), [()] * len(visits))
    found = mountings(ROBOT.chain, RIG if whole_rig else small, readings(extension, plan.q), words, ROBOT.free)
    assert all(found.supports(i, PAIRING) for i in range(len(visits)))


def test_a_short_session_of_another_pairing_is_not_borne_out():
    """Plan and operator say one thing, another hangs there from the first to the last of its nine poses."""
    plan, other = standard_plan(9, 5, shell_rig()), ("bar46", "c1", "s3")
    visits = [Visit(row, other) for row in range(len(plan))]
    extension = lengths(visits, plan, RIG, ROBOT.chain, ROBOT.parameter_sets["optimised"], 5)
    assert np.isfinite(extension).sum() == 4
    words = Words(planned(plan, visits), [(PAIRING,), *[()] * (len(visits) - 1)])
    found = mountings(ROBOT.chain, RIG, readings(extension, plan.q), words, ROBOT.free)
    assert not any(found.supports(i, PAIRING) for i in np.flatnonzero(np.isfinite(extension)))


def test_readings_that_no_robot_gives_doubt_nothing(plan):
    """Predictions that miss everywhere are not witnesses: their uncertainty is as large as they miss."""
    extension = np.random.default_rng(2).uniform(-0.03, 0.03, len(plan))
    words = Words([(pairing_at(plan, row),) for row in range(len(plan))], [()] * len(plan))
    found = mountings(ROBOT.chain, RIG, readings(extension, plan.q), words, ROBOT.free)
    assert np.mean([found.supports(i, pairing_at(plan, i)) for i in range(len(plan))]) > 0.5
