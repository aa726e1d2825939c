"""Noise files: their contents, what they replace, and what is refused."""

import json

import numpy as np
import pytest
from puma_bench import DESIGN, random_table
from puma_bench import RIG as PUMA_RIG
from tests.refusals import ended, refused

from truearm.cli.main import main
from truearm.disk import KINDS
from truearm.errors import RigError
from truearm.kinds.rig_file import NoiseFile, check_against_rigs, format_noise, parse_noise, with_noise, write_rig
from truearm.kinds.table_file import write_table
from truearm.types import BallBar, Point, Rig

RIG = Rig(
    chucks={"c": Point("c", (0.45, 0.15, 0.08))},
    spheres={"s": Point("s", (0.1, 0.0, 0.04))},
    bars={name: BallBar(name, zero, 1.0, 4.0, 84e-6) for name, zero in (("b46", 2.05), ("b61", 2.06))},
)
COV = ((4e-8, 0.0), (0.0, 9e-8))


@pytest.mark.parametrize("prismatic", [False, True])
def test_a_file_reads_back(prismatic):
    noise = NoiseFile(COV, {"b46": 9.1e-5}, "noise.toml", (3e-4, -1e-5), (2e-5, 0.0))
    text = format_noise(noise, ["joint1: 0.2 mrad"], prismatic)
    assert ("joint_cov_si" in text) == prismatic
    read = parse_noise(text, "noise.toml")
    assert np.allclose(read.joint_cov, COV, rtol=1e-14, atol=0.0)
    assert read.bar_sigma == noise.bar_sigma
    assert (read.backlash, read.backlash_sigma) == (noise.backlash, noise.backlash_sigma)
    assert KINDS["noise"].fits(text.encode())


def test_it_stands_in_for_the_rigs_figures():
    rig = with_noise(RIG, NoiseFile(COV, {"b46": 9.1e-5}))
    assert (rig.joint_cov, rig.bars["b46"].sigma, rig.bars["b61"].sigma) == (COV, 9.1e-5, 84e-6)
    assert with_noise(rig, NoiseFile()).joint_cov == COV
    worn = with_noise(RIG, NoiseFile(COV, backlash=(3e-4, 0.0), backlash_sigma=(2e-5, 0.0)))
    assert (worn.backlash, worn.backlash_sigma) == ((3e-4, 0.0), (2e-5, 0.0))
    assert with_noise(RIG, None) is RIG
    with refused("not-in-rig", what="bar", name="b99", names=["b46", "b61"]):
        check_against_rigs(NoiseFile(bar_sigma={"b99": 1e-4}, name="noise.toml"), {"a": RIG})


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[[bar]]\nname = "a"\nsigma_mm = 0', "greater than 0"),
        ("backlash_si = [1e-4]", "needs joint_sigma_rad"),
        ("joint_sigma_rad = [1e-4]\nbacklash_si = [1e-4]", "backlash_sigma_si: needs"),
        ("joint_sigma_rad = [1e-4]\nbacklash_si = 3\nbacklash_sigma_si = [0]", "backlash_si: needs"),
        ("joint_sigma_rad = [1e-4]\nbacklash_si = [1e-4]\nbacklash_sigma_si = [-1]", "between"),
        ("joint_sigma_rad = [1e-4]\nbacklash_si = [3e-4]\nbacklash_sigma_si = [0]", "below half its backlash"),
    ],
)
def test_what_is_wrong_is_refused_in_one_line(text, says):
    with pytest.raises(RigError, match=says) as refused:
        parse_noise(text, "noise.toml")
    assert "\n" not in str(refused.value)


@pytest.fixture
def files(tmp_path):
    """A rig and a table of lengths of a perfect PUMA 560 with 84 µm of noise."""
    table = random_table(120, np.random.default_rng(3), 84e-6, DESIGN)
    write_rig(tmp_path / "rig.toml", PUMA_RIG)
    write_table(tmp_path / "poses.csv", table, ("rad",) * 6)
    return tmp_path


def identified(files, capsys, *more):
    arguments = ["identify", files / "poses.csv", "--model", "puma560", "--rig", files / "rig.toml"]
    arguments += ["--free", "joint*.offset"]
    code = main([str(word) for word in (*arguments, "--json", *more)])
    said = capsys.readouterr()
    return code, json.loads(said.out) if code == 0 else said.err


def test_identify_weighs_by_it_and_says_that_it_was_read(files, capsys):
    (files / "noise.toml").write_text(format_noise(NoiseFile((), {"short": 168e-6}), [], False))
    _, declared = identified(files, capsys)
    code, found = identified(files, capsys, "--noise", files / "noise.toml")
    assert code == 0
    assert found["chi2_reduced"] == pytest.approx(declared["chi2_reduced"] / 4.0, rel=1e-3)
    assert [one["name"] for one in found["inputs"] if one["role"] == "noise"] == ["noise.toml"]


def test_identify_refuses_noise_of_other_bars_and_robots(files, capsys):
    noise = files / "noise.toml"
    noise.write_text('[[bar]]\nname = "b99"\nsigma_mm = 0.1\n')
    code, said = identified(files, capsys, "--noise", noise)
    assert code == 2
    ended(said, "not-in-rig", place=noise, name="b99")
    noise.write_text("joint_sigma_rad = [1e-4, 1e-4]\n")
    code, said = identified(files, capsys, "--noise", noise)
    assert (code, said.count("\n")) == (2, 1)
    assert "give joint_sigma_rad" in said
    code, said = identified(files, capsys, "--noise", files / "none.toml")
    assert (code, said.count("\n")) == (2, 1)
