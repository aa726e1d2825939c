"""``truearm identify`` as a whole on 36,000 positions: three targets at each of 12,000 poses of a UR5e whose joints have error curves.

.venv/bin/python bench/workers/run_command.py none|auto POSES
"""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from measure import tell

from truearm.cli.main import main
from truearm.model.chain import point_forward
from truearm.model.robot_file import builtin_robot

TARGETS = {"a": (0.05, 0.03, 0.1), "b": (-0.06, 0.04, 0.1), "c": (0.0, -0.07, 0.12)}
SCATTER = {"m": 5e-4, "rad": 2e-3, "1": 1e-4}
SIGMA = 5e-5  # m
CURVE = 1e-4 * np.array([4.0, 4.0, 3.0, 3.0, 3.0, 3.0])  # rad, of 17 and of 2 cycles a turn


def write(folder: Path, poses: int) -> None:
    """Write poses.csv and rig.toml."""
    robot, rng = builtin_robot("ur5e"), np.random.default_rng(16)
    chain = robot.chain
    sigma = np.array([SCATTER[p.unit] for p in chain.parameters])
    truth = chain.params_nominal + np.where(robot.free, sigma * rng.normal(size=sigma.size), 0.0)
    q = rng.uniform(-np.pi, np.pi, (poses, 6))
    turned = q + CURVE * (np.sin(17.0 * q + rng.uniform(0.0, 2.0 * np.pi, 6)) + np.sin(2.0 * q))
    names = [f"q{i}_deg" for i in range(1, 7)]
    with (folder / "poses.csv").open("w") as file:
        print("kind", *names, "x_mm", "y_mm", "z_mm", "tracker", "target", sep=",", file=file)
        for name, xyz in TARGETS.items():
            points = point_forward(chain, truth, turned, np.array(xyz)) + SIGMA * rng.normal(size=(poses, 3))
            for angles, point in zip(np.degrees(q), 1e3 * points, strict=True):
                numbers = [*(f"{v:.6f}" for v in angles), *(f"{v:.5f}" for v in point)]
                print("position", *numbers, "t", name, sep=",", file=file)
    with (folder / "rig.toml").open("w") as file:
        file.write(f'[[tracker]]\nname = "t"\nsigma_m = {[SIGMA] * 3}\n')
        for name, xyz in TARGETS.items():
            file.write(f'[[target]]\nname = "{name}"\nxyz_m = {list(xyz)}\n')


def run(laws: str, poses: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder), poses)
        started = time.process_time()
        files = [f"{folder}/poses.csv", "--model", "ur5e", "--rig", f"{folder}/rig.toml"]
        with contextlib.redirect_stdout(io.StringIO()):
            code = main(["identify", *files, "--joint-laws", laws])
    tell(seconds=time.process_time() - started, status=f"exit {code}")


if __name__ == "__main__":
    run(sys.argv[1], int(sys.argv[2]))
