"""Places of sockets that stand as a whole elsewhere than the rig says: their frame was wrong, not each socket."""

import fault_worlds as worlds
import numpy as np
import pytest
from puma_bench import CHAIN, FREE, LOWER, SPHERES, TRUTH, UPPER, random_poses

from truearm.checks.examination import examined
from truearm.checks.inputs import checked_inputs
from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.problem import build_problem
from truearm.kinds.table import ObservationTable
from truearm.model.chain import point_forward, point_jacobians
from truearm.model.transforms import rotation
from truearm.results import Effect
from truearm.types import Point, Rig

BALL = np.array(SPHERES["s1"].xyz)
PLACES = {"front": (0.5, 0.1, 0.2), "left": (0.1, 0.5, 0.3), "right": (0.2, -0.5, 0.25)}
SOCKETS = {"0": (0.0, 0.0, 0.0), "1": (0.12, 0.0, 0.0), "2": (0.0, 0.1, 0.02)}
SEATS = 10  # of each socket
NOISE = 8e-5  # rad


def seated(goal, rng):
    """Return SEATS poses in which the true arm has its ball at a point of the base frame."""
    found = np.zeros((0, 6))
    while len(found) < SEATS:
        q = random_poses(4 * SEATS, rng)
        for _ in range(40):
            at, _, by_joints = point_jacobians(CHAIN, TRUTH, q, BALL)
            step = np.linalg.pinv(by_joints, rcond=1e-3) @ (goal - at)[:, :, None]
            q = q + np.clip(step[:, :, 0], -0.3, 0.3)
        there = np.linalg.norm(goal - point_forward(CHAIN, TRUTH, q, BALL), axis=1) < 1e-9
        found = np.concatenate([found, q[there & (q > LOWER).all(axis=1) & (q < UPPER).all(axis=1)]])
    return found[:SEATS]


def session(seed, shift=0.0, turn=0.0, sigma=0.0):
    """Return seats, shuffled, and a rig in which the place "left" is off by a motion about its first socket."""
    rng = np.random.default_rng(seed)
    away, turned = shift * worlds.direction(rng), rotation(turn * worlds.direction(rng))
    q, labels, sockets = [], [], {}
    for place, origin in PLACES.items():
        for socket, offset in SOCKETS.items():
            true = np.array(origin) + (turned @ offset + away if place == "left" else offset)
            sockets[place, socket] = Point(f"{place}.{socket}", tuple(np.add(origin, offset).tolist()), sigma)
            q.append(seated(true, rng))
            labels += [(place, socket)] * SEATS
    n = len(labels)
    readings = np.concatenate(q) + NOISE * rng.normal(size=(n, 6))
    order = rng.permutation(n)
    places, names = np.array(labels)[order].T
    rows = ObservationTable(q=readings[order], kind=np.full(n, "seat"), place=places, socket=names)
    return rows, Rig(spheres={"s1": SPHERES["s1"]}, sockets=sockets, seat_sigma=8e-5)


def fitted(rows, rig, *effects):
    return identify(CHAIN, rig, rows, free=FREE, prefer=FREE, options=SolverOptions(effects=effects, reject=True))


def faults(rows, rig, estimate, *effects):
    return examined(CHAIN, rig, rows, estimate, effects).faults


def test_a_place_that_is_millimetres_off_is_named_and_once_applied_nothing_is_left():
    rows, rig = session(940030, shift=0.5e-3)
    (fault,) = faults(rows, rig, fitted(rows, rig))
    assert fault.rivals[0].apply == "place.left"
    assert fault.freedom == 6
    assert fault.sizes[0].value == pytest.approx(0.5e-3, abs=4.0 * fault.sizes[0].sigma)
    effect = Effect("place.left")
    after = fitted(rows, rig, effect)
    assert not faults(rows, rig, after, effect)
    assert after.chi2_reduced < after.chi2_band[1]


@pytest.mark.parametrize(("shift", "turn"), [pytest.param(20e-3, 0.0, marks=pytest.mark.soak), (20e-3, 0.02)])
def test_a_place_that_is_centimetres_off_is_named_as_a_whole(shift, turn):
    rows, rig = session(940031, shift, turn)
    estimate = checked_inputs(fitted(rows, rig), CHAIN, rig, rows, FREE, FREE, dict)
    (first,) = estimate.explanations
    assert (first.code, first.values["apply"]) == ("wrong-constant", "place.left")
    after = fitted(rows, rig, Effect("place.left"))
    assert after.chi2_reduced < after.chi2_band[1]


def test_right_or_undetermined_places_are_not_named():
    rows, rig = session(940032)
    assert not faults(rows, rig, fitted(rows, rig))
    rows, rig = session(940033)
    unknown = {at: Point(point.name, point.xyz, None) for at, point in rig.sockets.items() if at[0] != "left"}
    causes = {cause.name for cause in build_problem(CHAIN, Rig(rig.chucks, rig.spheres, sockets=unknown), rows).causes}
    assert not any(name.startswith("place.") for name in causes)
    assert {"place.front", "place.left", "place.right"} <= {
        cause.name for cause in build_problem(CHAIN, rig, rows).causes
    }
