"""A new format to export in two places: its module and its line in the registry."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.recipes.recipes import Copy
from tests.recipes.tracked import RIG, tracked
from truearm.files.result_file import read_result
from truearm.model.chain import forward
from truearm.model.robot import builtin_robot

CHAIN = builtin_robot("ur5e").chain


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    copy = Copy(tmp_path_factory.mktemp("format"))
    copy.apply("A format to export")
    rng = np.random.default_rng(0)
    errors = 2e-3 * rng.normal(size=len(CHAIN.parameters)) * [p.term != "gain" for p in CHAIN.parameters]
    q = rng.uniform(-2, 2, (200, 6))
    ends = forward(CHAIN, CHAIN.params_nominal + errors, q)
    (copy.folder / "t.csv").write_text(tracked(q, ends, rng.normal(size=(200, 3))))
    (copy.folder / "rig.toml").write_text(RIG)
    copy.run("identify", "t.csv", "--robot", "ur5e", "--rig", "rig.toml", "--out", "r.json")
    return copy


def test_help_names_it(copy):
    assert "screws: axes of the joints at readings 0 (.json)." in " ".join(copy.run("export", "--help").split())


def test_it_predicts_the_identified_robot(copy):
    said = copy.run("export", "r.json", "--format", "screws", "--out", "screws.json")
    assert "the file holds all that was identified" in said
    document = json.loads((copy.folder / "screws.json").read_text())
    stored = read_result(copy.folder / "r.json")
    for q in np.random.default_rng(2).uniform(-2, 2, (20, 6)):
        expected = forward(CHAIN, stored.value[stored.of_robot], q)
        np.testing.assert_allclose(exponentials(document, q), expected, atol=1e-12)


def exponentials(document, q):
    """T(q) of the file, by hand."""
    out = np.eye(4)
    for joint, angle in zip(document["joints"], q, strict=True):
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(angle * np.array(joint["axis"])).as_matrix()
        turn[:3, 3] = joint["point"] - turn[:3, :3] @ joint["point"]
        out = out @ turn
    return out @ np.array(document["home"])
