"""A new term of the joint law, a torsional spring of one joint, in one new file and one line of the registry.

The true arm is computed here from the numbers of the robot file, with nothing of truearm's.
"""

import csv
import json
import math
import re
import tomllib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.recipes.recipes import ROOT, Copy
from tests.recipes.tracked import RIG, tracked

SPRING = math.radians(0.12)
N = 400
PUMA = (ROOT / "host/truearm/model/robots/puma560.toml").read_text(encoding="utf-8")
SPRUNG = PUMA.replace("[joint2]\n", "[joint2]\nspring_deg = { design = 0.0, optimised = 0.0 }\n")
COMMAND = ("--model", "sprung.toml", "--rig", "rig.toml")


def numbers(values):
    """Links (7, 6) as x, y, z [m], α, β, γ [rad], offsets (6,) [rad] and gains (6,) of the file's ``values``."""
    data = tomllib.loads(PUMA)
    links = [data[f"link{i}"] for i in range(1, 8)]
    lengths = np.array([[link[f"{key}_cm"][values] / 100.0 for key in "xyz"] for link in links])
    turns = np.radians([[link[f"{key}_deg"][values] for key in ("alpha", "beta", "gamma")] for link in links])
    joints = [data[f"joint{i}"] for i in range(1, 7)]
    offsets = np.radians([joint["offset_deg"][values] for joint in joints])
    return np.hstack([lengths, turns]), offsets, np.array([joint["gain"][values] for joint in joints])


def turned(axis, angle):
    """(n, 4, 4) turns by angles (n,) about x, y or z; complex ones too."""
    out = np.zeros((len(angle), 4, 4), angle.dtype)
    out[:, range(4), range(4)] = 1.0
    i, k = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    out[:, i, i] = out[:, k, k] = np.cos(angle)
    out[:, k, i] = np.sin(angle)
    out[:, i, k] = -np.sin(angle)
    return out


def end(links, angles):
    """(n, 4, 4) the end at true joint angles (n, 6)."""
    here = np.broadcast_to(np.eye(4), (len(angles), 4, 4))
    for i, (x, y, z, alpha, beta, gamma) in enumerate(links):
        link = np.eye(4)
        link[:3, 3] = x, y, z
        for axis, angle in (("z", alpha), ("y", beta), ("x", gamma)):
            link = link @ turned(axis, np.array([angle]))[0]
        here = here @ link
        if i < 6:
            here = here @ turned("z", angles[:, i])
    return here


def true_end(q):
    """The arm with a spring in joint 2: the optimised values, and the torque of a weight by the design's height of the end."""
    links, offsets, gains = numbers("design")
    raised = (offsets + gains * q).astype(complex)
    raised[:, 1] += 1e-30j
    torque = -end(links, raised)[:, 2, 3].imag / 1e-30
    links, offsets, gains = numbers("optimised")
    angles = offsets + gains * q
    angles[:, 1] += SPRING * torque
    return end(links, angles)


def some_targets():
    """20 poses in one configuration of the arm, away from singularities and limits."""
    low, high = np.radians([(-120, 120), (-120, -20), (120, 170), (-60, 120), (30, 80), (-150, 150)]).T
    links, offsets, gains = numbers("design")
    q = np.random.default_rng(7).uniform(low, high, (20, 6))
    return q, end(links, offsets + gains * q)


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The package with the term, tables of a tracker with and without noise, and targets."""
    copy = Copy(tmp_path_factory.mktemp("term"))
    copy.apply("A term of the joint law")
    assert copy.changes() == {
        "host/truearm/model/joint_law.py": "+1 -0",
        "host/truearm/model/joint_terms/spring.py": "new file",
    }
    rng = np.random.default_rng(3)
    q = rng.uniform(-2.0, 2.0, (N, 6))
    ends = true_end(q)
    (copy.folder / "exact.csv").write_text(tracked(q, ends, np.zeros((N, 3))))
    (copy.folder / "noisy.csv").write_text(tracked(q, ends, rng.normal(size=(N, 3))))
    (copy.folder / "rig.toml").write_text(RIG)
    (copy.folder / "sprung.toml").write_text(SPRUNG)
    q, ends = some_targets()
    names = ["x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad", *(f"q{i}_rad" for i in range(1, 7))]
    rows = np.hstack([ends[:, :3, 3], Rotation.from_matrix(ends[:, :3, :3]).as_rotvec(), q]).tolist()
    (copy.folder / "targets.csv").write_text("\n".join([",".join(names), *(",".join(map(repr, row)) for row in rows)]))
    return copy


@pytest.fixture(scope="module")
def said(copy):
    """Return what the commands print, by name."""
    correct = ("correct", "exact.json", "targets.csv", "--model", "sprung.toml", "--out", "corrected.csv")
    commands = {
        "noisy": ("identify", "noisy.csv", *COMMAND, "--details", "--out", "noisy.json"),
        "exact": ("identify", "exact.csv", *COMMAND, "--out", "exact.json"),
        "correct": (*correct, "--margin", "0.01"),
    }
    found = dict(zip(commands, copy.run_each(*commands.values()), strict=True))
    assert [found[name].err for name in ("noisy", "exact", "correct")] == [""] * 3
    return found


def test_it_is_identified_with_its_standard_deviation(copy, said):
    (line,) = (line for line in said["noisy"].out.splitlines() if "joint2.spring" in line)
    assert re.search(r"0\.1[12]\d*", line), line
    result = json.loads((copy.folder / "noisy.json").read_text())
    (spring,) = (p for p in result["parameters"] if p["name"] == "joint2.spring")
    assert spring["unit"] == "rad"
    assert abs(spring["value"] - SPRING) < 5 * spring["sigma"] < 0.05 * SPRING
    assert result["chi2_reduced"] == pytest.approx(1.0, abs=5 * math.sqrt(2 / (3 * N - 60)))


def test_corrected_targets_are_where_the_true_arm_goes(copy, said):
    with (copy.folder / "corrected.csv").open() as file:
        rows = list(csv.DictReader(file))
    q, wanted = some_targets()
    told = np.radians([[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows])
    before, after = (np.abs(true_end(joints) - wanted).max() for joints in (q, told))
    assert before > 5e-3
    assert after < 1e-9
