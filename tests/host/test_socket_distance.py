"""One measured distance of two sockets has one error, at however many places the block was used."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.host.findings_bench import listed
from tests.refusals import refused

import truearm
from truearm.cli.main import main
from truearm.estimate.prior import weak_prior
from truearm.kinds.rig_file import parse_rig, write_rig
from truearm.kinds.socket_distance import other_lengths
from truearm.kinds.table import ObservationTable
from truearm.model.chain import point_forward, point_jacobians
from truearm.plan.forecast import planned_table
from truearm.plan.socket_places import SocketBlock, plans_of_sites
from truearm.report.result_findings import result_findings
from truearm.types import rms
from truearm.workflows.socket_project import RIG

BALL = (0.0, 0.0, 0.1)
BLOCK = SocketBlock(0.01)
ROBOT = truearm.load_robot("ur5e")
RIG_OF_BLOCK = parse_rig(RIG.format(name="ur5e", ball="0, 0, 100", distance=1e3 * BLOCK.distance), "rig.toml")
SIGMA = RIG_OF_BLOCK.socket_distances[0].sigma
SEEDS = 24


@pytest.fixture(scope="module", params=[3, 6])
def seats(request):
    """Seats of a plan as rows, and the balls' centres (n, 3) from the middle of their places (n, 3)."""
    sites = next(plans_of_sites(ROBOT, BALL, BLOCK, 0.0, request.param, 12))
    rows, arms, middles = [], [], []
    for place, site in enumerate(sites):
        for socket, (q, side) in enumerate(zip(site.q, (-0.5, 0.5), strict=True)):
            rows.append(planned_table(q, "seat", place=f"p{place}", socket=str(socket)))
            arms.append(np.tile(side * BLOCK.distance * site.direction, (len(q), 1)))
            middles.append(np.tile(site.place + BLOCK.centre_height * np.eye(3)[2], (len(q), 1)))
    return ObservationTable.joined(rows), np.concatenate(arms), np.concatenate(middles)


def measured(seats, seed):
    """Return the parameters of a true arm, the true distance [m], and the seats that the arm reads."""
    table, arms, middles = seats
    rng, chain = np.random.default_rng(seed), ROBOT.chain
    truth = chain.params_nominal + ROBOT.free * weak_prior(chain) * rng.normal(size=len(chain.parameters))
    distance = BLOCK.distance + SIGMA * rng.normal()  # of the only block
    socket = middles + arms * distance / BLOCK.distance + RIG_OF_BLOCK.seat_sigma * rng.normal(size=arms.shape)
    q = table.q
    for _ in range(6):
        p, _, jacobian = point_jacobians(chain, truth, q, np.array(BALL))
        q = q + (np.linalg.pinv(jacobian) @ (socket - p)[..., None])[..., 0]
    return truth, distance, table.replace(q=q)


def test_the_stated_error_holds_for_one_distance_at_all_places(seats):
    stated, true, off = [], [], []
    for seed in range(SEEDS):
        truth, distance, table = measured(seats, seed)
        options = truearm.IdentifyOptions(joint_laws="none")
        result = truearm.identify(ROBOT, table, RIG_OF_BLOCK, options=options)
        estimate = result.estimate
        values = dict(zip(estimate.parameter_names, estimate.value.tolist(), strict=True))
        index = estimate.parameter_names.index("socket_distance.0.1")
        off.append((estimate.value[index] - distance) / np.sqrt(estimate.covariance[index, index]))
        ball = np.array([values[f"sphere.ball.{axis}"] for axis in "xyz"])
        identified = point_forward(ROBOT.chain, estimate.value[: len(ROBOT.chain.parameters)], table.q, ball)
        actual = point_forward(ROBOT.chain, truth, table.q, np.array(BALL))
        _, distances = Rotation.align_vectors(actual - actual.mean(axis=0), identified - identified.mean(axis=0))
        true.append(distances / np.sqrt(len(actual)))
        stated.append(1e-3 * result.document["predicted_error"]["rms_mm"])
    ratio = np.array(true) / stated
    assert (ratio < 2.0).sum() >= SEEDS - 2
    assert rms(np.array(true)) == pytest.approx(rms(np.array(stated)), rel=0.3)
    assert 0.6 < rms(np.array(off)) < 1.4  # 99.8 % of 24 normal deviates


def test_the_distance_is_known_as_well_as_it_was_measured(seats):
    """Places do not average the error of one measurement; only the drawing of the arm adds to it."""
    table, *_ = seats
    estimate = truearm.identify(ROBOT, table, RIG_OF_BLOCK, options=truearm.IdentifyOptions(joint_laws="none")).estimate
    index = estimate.parameter_names.index("socket_distance.0.1")
    assert 0.5 * SIGMA < np.sqrt(estimate.covariance[index, index]) < SIGMA


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_a_distance_in_another_unit_is_named(seats, tmp_path, capsys, factor):
    table, *_ = seats
    (distance,) = RIG_OF_BLOCK.socket_distances
    wrong = replace(distance, distance=factor * distance.distance)
    write_rig(tmp_path / "rig.toml", replace(RIG_OF_BLOCK, socket_distances=(wrong,)))
    truearm.write_table(tmp_path / "seats.csv", table, ROBOT)
    arguments = ["--model", ROBOT.chain.name, "--rig", str(tmp_path / "rig.toml"), "--joint-laws", "none"]
    assert main(["identify", str(tmp_path / "seats.csv"), *arguments]) in (2, 3)
    (finding,) = other_lengths(table, replace(RIG_OF_BLOCK, socket_distances=(wrong,)), ROBOT.chain)
    lengths = {"declared": {"mm": pytest.approx(50 * factor)}, "nominal": {"mm": pytest.approx(50, abs=0.5)}}
    assert (finding.code, finding.values) == ("other-distance", {"sockets": ["0", "1"], **lengths})
    assert " ".join(finding.text().split()) in " ".join("".join(capsys.readouterr()).split())


def test_a_block_in_two_rigs_is_said_to_count_twice(seats, tmp_path, capsys):
    table, *_ = seats
    write_rig(tmp_path / "rig.toml", RIG_OF_BLOCK)
    days = np.where(np.arange(len(table)) % 2, "monday", "tuesday")
    truearm.write_table(tmp_path / "seats.csv", table.replace(rig=days), ROBOT)
    rigs = [f"--rig={day}={tmp_path / 'rig.toml'}" for day in ("monday", "tuesday")]
    assert main(["identify", str(tmp_path / "seats.csv"), "--model", ROBOT.chain.name, "--json", *rigs]) in (0, 3)
    result = json.loads(capsys.readouterr().out)
    assert listed(result)["repeated-distance"] == {"rigs": ["monday", "tuesday"], "sockets": ["0", "1"]}
    assert "repeated-distance" in [finding.code for finding in result_findings(result)]


@pytest.mark.parametrize("order", [1, -1])
def test_a_distance_that_is_declared_twice_is_refused(seats, order):
    (distance,) = RIG_OF_BLOCK.socket_distances
    again = replace(distance, sockets=distance.sockets[::order], distance=0.051)
    with refused("given-twice", place="rig", what="sockets 0.1"):
        truearm.identify(ROBOT, seats[0], replace(RIG_OF_BLOCK, socket_distances=(distance, again)))
