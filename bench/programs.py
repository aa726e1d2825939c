"""Measure the cost of correcting large programs and tables: CPU seconds on one core and peak memory, with and without given joints.

    .venv/bin/python bench/programs.py             # 100,000 targets: a table, a URScript with qnear; a RAPID module read alone
    .venv/bin/python bench/programs.py --quick     # 10,000

Each runs in a process of its own. The robot is the tests' PUMA 560, identified from 600 noisy lengths. RAPID's configurations are searched for,
which costs more than a millisecond a target; of such a module only what is done to its text is measured here.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "host"))
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from scipy.spatial.transform import Rotation
from tests.host import correct_bench
from tests.host.puma_bench import CHAIN, DESIGN

from truearm.model.chain import forward

FRAMES = ("--work", "0,0,0,0,0,0", "--flange", "0,0,0,0,0,0")
READ_ALONE = Path(__file__).parent / "workers" / "read_rapid.py"


def main(n: int) -> None:
    q = correct_bench.good_poses(100)
    q = np.repeat(q, n // 100, axis=0) + np.random.default_rng(0).uniform(-0.01, 0.01, (n, 6))
    pose = forward(CHAIN, DESIGN, q)
    print(f"{'file':24}{'targets':>9}{'MB':>7}{'CPU s':>8}{'peak MB':>9}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        correct_bench.write(folder / "result.json", correct_bench.identified())
        for file, text in (("targets.csv", table(pose, q)), ("program.script", script(pose, q))):
            (folder / file).write_text(text)
            out = folder / f"out{Path(file).suffix}"
            frames = () if file.endswith("csv") else FRAMES
            command = ("-m", "truearm", "correct", folder / "result.json", folder / file, "--out", out, *frames)
            show(file, n, len(text), command)
        (folder / "program.mod").write_text(text := module(pose, q))
        show("program.mod, text alone", n, len(text), (READ_ALONE, folder / "program.mod", folder / "out.mod"))


def show(what: str, n: int, size: int, command: tuple[object, ...]) -> None:
    """Run a command and print what it cost."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    watched = [sys.executable, "-c", _WATCHED, *map(str, command)]
    peak_kb = int(subprocess.run(watched, check=True, capture_output=True, text=True).stdout.split()[-1])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print(f"{what:24}{n:>9}{size / 1e6:>7.1f}{cpu:>8.1f}{peak_kb / 1e3:>9.0f}")


_WATCHED = """
import resource, subprocess, sys
subprocess.run([sys.executable, *sys.argv[1:]], check=True, stdout=subprocess.DEVNULL)
print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
"""


def table(pose: np.ndarray, q: np.ndarray) -> str:
    turn = Rotation.from_matrix(pose[:, :3, :3]).as_rotvec()
    rows = np.concatenate([1e3 * pose[:, :3, 3], np.rad2deg(turn), np.rad2deg(q)], axis=1)
    titles = ["x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg", *(f"q{i}_deg" for i in range(1, 7))]
    return "\n".join([",".join(titles), *(",".join(f"{v:.6f}" for v in row) for row in rows), ""])


def script(pose: np.ndarray, q: np.ndarray) -> str:
    six = np.concatenate([pose[:, :3, 3], Rotation.from_matrix(pose[:, :3, :3]).as_rotvec()], axis=1)
    moves = (
        f"  movej(get_inverse_kin(p[{', '.join(f'{v:.6f}' for v in a)}], qnear=[{', '.join(f'{v:.4f}' for v in b)}]), a=1.2, v=0.25)"
        for a, b in zip(six, q, strict=True)
    )
    return "\n".join(["def work():", "  set_tcp(p[0,0,0,0,0,0])", *moves, "end", ""])


def module(pose: np.ndarray, q: np.ndarray) -> str:
    turn = Rotation.from_matrix(pose[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    quarter = np.floor(q / (0.5 * np.pi)).astype(int)
    data = (
        f"  CONST robtarget p{k}:=[[{','.join(f'{v:.4f}' for v in 1e3 * pose[k, :3, 3])}],[{','.join(f'{v:.8f}' for v in turn[k])}],"
        f"[{quarter[k, 0]},{quarter[k, 3]},{quarter[k, 5]},0],[9E9,9E9,9E9,9E9,9E9,9E9]];"
        for k in range(len(pose))
    )
    moves = (f"    MoveJ p{k},v100,fine,tool0;" for k in range(len(pose)))
    return "\r\n".join(["MODULE Work", *data, "PROC main()", *moves, "ENDPROC", "ENDMODULE", ""])


if __name__ == "__main__":
    main(10_000 if "--quick" in sys.argv[1:] else 100_000)
