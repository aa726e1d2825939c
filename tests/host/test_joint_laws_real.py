"""Joint laws on real arms: a cheap part of docs/explanation/real-arms.md. ``make benchmark`` runs all of it."""

import lzma
from pathlib import Path

import numpy as np
import pytest
from scipy.cluster.vq import kmeans2
from ur10_bench import RIG

from truearm.estimate.prediction import point_covariance, predicted_point_error
from truearm.kinds.position import nearest_rotation
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import parse_table
from truearm.model.chain import forward
from truearm.model.robot_file import load_robot
from truearm.workflows.identify import identified
from truearm.workflows.inputs import Observed

ROOT = Path(__file__).parents[2]
DATA = ROOT / "tests" / "data"
LARGEST = 0.36  # mm, of UR10 C


def held_out_means(robot, rig, table, held):
    """Mean held-out errors [mm] of geometry and with laws."""
    found = identified(robot, Observed(rig, table), held)
    steps = found.estimate.joint_laws.steps
    last = found.estimate.held_out.figures["m"].mean
    return 1e3 * steps[0].held_out.figures["m"].mean, 1e3 * last


def test_ur5_by_its_authors_poses():
    """A third of the grid's 1000 poses fitted, all in make soak; 0.155 mm was published for the 20 that judge."""
    folder = DATA / "ur5_tsinghua"
    robot = load_robot(str(folder / "ur5.toml"), None, None)
    texts = {name: lzma.decompress((folder / f"{name}.csv.xz").read_bytes()).decode() for name in ("grid", "random")}
    grid, judges = (parse_table(text, name, robot.chain.joint_units) for name, text in texts.items())
    grid = grid.select(np.arange(0, len(grid), 3))
    table = ObservationTable.joined([grid, judges])
    geometry, laws = held_out_means(robot, RIG, table, np.arange(len(table)) >= len(grid))
    assert geometry < 0.105
    assert laws < 0.066


def test_a_reflector_remounted_by_a_third_of_a_millimetre_is_named(real_arms):
    """After row 40 of 120 of the UR10: curves follow a part of it, and noise that neighbours share explains the rest."""
    robot, table = real_arms.ur10("c")
    table = table.select(np.sort(np.random.default_rng(3).permutation(len(table))[:400])[:120])
    points = real_arms.base_points(robot, table)
    device = nearest_rotation((points - points.mean(0)).T @ (table.xyz - table.xyz.mean(0)), np.eye(3))
    axes = forward(robot.chain, robot.chain.params_nominal, table.q)[:, :3, :3]
    moved = (axes @ [2.4e-4, -1.5e-4, 9e-5]) @ device * (np.arange(120)[:, None] >= 40)
    found = identified(robot, Observed(RIG, table.replace(xyz=table.xyz + moved))).estimate
    assert [(fault.rivals[0].name, fault.rivals[0].rows) for fault in found.faults] == [
        ("target.reflector.step", (40, 120))
    ]


@pytest.mark.soak
@pytest.mark.parametrize("cluster", [0, 6])
def test_clusters_at_the_edge_are_covered_by_what_is_stated_there(real_arms, cluster):
    """Twice the RMS over all poses covers 84 and 86 % of these two of 12 clusters: their parameters' part is larger."""
    case = dict(real_arms.cases())["ur10-c-0"]()
    scaled = (case.table.q - case.table.q.mean(axis=0)) / case.table.q.std(axis=0)
    held = kmeans2(scaled, 12, minit="++", seed=0)[1] == cluster
    found = identified(case.robot, Observed(case.rig, case.table), held)
    rows, estimate = case.table.select(held), found.estimate
    parameters = point_covariance(found.chain, case.rig, rows, estimate)
    scatter = predicted_point_error(found.chain, case.rig, rows, estimate).scatter
    stated = np.sqrt((parameters.half**2).sum(axis=1).reshape(-1, 3).sum(axis=1) + scatter**2)
    assert np.mean(estimate.residual["m"][held] < 2.0 * stated) >= 0.90
    assert np.sqrt((stated**2).mean()) > found.predicted.rms


CASES = [
    *("ur10-c-0", "ur10-c-1", "ur10-c-2", "ur10-c-command-with-home", "ur10-c-command-without-home"),
    *("ur10-a-0", "ur10-a-blocks-0", "ur10-a-blocks-1", "ur5", "panda3-front", "panda3-back"),
    *("panda1", "kuka-left", "kuka-front", "bars", "bars-200"),
]


@pytest.mark.soak
@pytest.mark.parametrize("name", CASES)
def test_every_arm_of_the_page_reaches_its_figure(real_arms, name):
    """Mean held-out errors, of random fifths of UR10 C the largest too; laws make none worse.

    The splits by command hold out rows beyond all that is fitted, which the page shows beside them.
    """
    cases = dict(real_arms.cases())
    assert set(cases) == set(CASES)
    out = real_arms.run(cases[name]())
    assert out.laws.mean() <= out.geometry.mean()
    if np.isfinite(out.case.most):
        assert out.laws.mean() <= out.case.most
    if out.case.split.startswith("random fifth") and out.case.name == "UR10 C":
        assert out.laws.max() <= LARGEST
