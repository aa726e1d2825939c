"""Joint laws on real arms: what docs/real-arms.md shows, as far as it is cheap. ``make benchmark`` runs all of it."""

import lzma
from pathlib import Path

import numpy as np
import pytest
from ur10_bench import RIG, ROBOT, tracked

from truearm.files.observation_table import parse_table, read_table
from truearm.files.rig_file import read_rig
from truearm.files.robot_file import load_robot
from truearm.types import ObservationTable
from truearm.workflows.identify import IdentifyOptions, Selection, default_free, identified

DATA = Path(__file__).parents[1] / "data"


def held_out_means(robot, rig, table, held):
    """Mean held-out errors [mm] of geometry and with laws."""
    selection = Selection(default_free(robot), held, ("held",))
    found = identified(robot, rig, table, selection, IdentifyOptions(joint_laws="auto"))
    steps = found.estimate.joint_laws.steps
    last = found.estimate.held_out.figures["m"].mean
    return 1e3 * steps[0].held_out.figures["m"].mean, 1e3 * last


def test_ur5_by_its_authors_poses():
    """1000 poses of a grid fitted; 0.155 mm was published for the 20 that judge."""
    folder = DATA / "ur5_tsinghua"
    robot = load_robot(str(folder / "ur5.toml"), None, None)
    texts = {name: lzma.decompress((folder / f"{name}.csv.xz").read_bytes()).decode() for name in ("grid", "random")}
    grid, judges = (parse_table(text, name, robot.chain.joint_units) for name, text in texts.items())
    table = ObservationTable.joined([grid, judges])
    geometry, laws = held_out_means(robot, RIG, table, np.arange(len(table)) >= len(grid))
    assert geometry < 0.105
    assert laws < 0.066


@pytest.mark.soak
def test_ur10_by_a_random_fifth():
    table = tracked("c", "position")
    held = np.zeros(len(table), dtype=bool)
    held[np.random.default_rng(0).permutation(len(table))[: len(table) // 5]] = True
    geometry, laws = held_out_means(ROBOT, RIG, table, held)
    assert 0.40 < geometry < 0.46
    assert laws < 0.095


@pytest.mark.soak
@pytest.mark.parametrize("held", ["front", "back"])
def test_panda_from_one_side_to_the_other(held):
    folder = DATA / "mukca"
    robot = load_robot(str(folder / "panda.urdf"), None, "ball_link")
    table = read_table(folder / "panda_3.csv", robot.chain.joint_units)
    rows = np.array([str(place).startswith(held) for place in table.place])
    geometry, laws = held_out_means(robot, read_rig(folder / "rig.toml"), table, rows)
    assert laws < 0.20 < geometry
