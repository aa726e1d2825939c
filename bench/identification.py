"""Measure how fast a robot is identified, compared with other programs on the same data: time, memory, error, growth, lower bound.

    .venv/bin/python bench/identification.py            # everything, some minutes
    .venv/bin/python bench/identification.py --quick    # 100 and 800 poses

Writes out/bench/identification.csv, .md and .svg. Every run is a process of its own with one thread; time is the CPU
time of the fit, the least of some runs, taken in turn so that a busy machine hits all alike. The peers are installed
into build/bench-venv (``make bench`` does it); one that is missing is said to be missing. docs/explanation/benchmarks.md discusses it.
"""

from __future__ import annotations

import csv
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from truearm import load_robot
from truearm.model.chain import forward
from truearm.report import svg

ROOT = Path(__file__).parents[1]
OUT = ROOT / "out" / "bench"
WORKERS = ROOT / "bench" / "workers"
VENVS = {"pybotics": ROOT / "build/bench-venv/pybotics", "figaroh": ROOT / "build/bench-venv/figaroh"}
SMALL, LARGE, HUGE = (100, 800, 8_000), 80_000, 1_000_000
MANY = 12_000
OFF = 1.5  # ratio to the published time that is reported
LIMIT_S = 1800  # wall clock of one run
ENV = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
FIELDS = ("problem", "program", "poses", "seconds", "us_a_pose", "peak_mb", "held_out_mm", "iterations", "status")
COLOURS = ("#0072b2", "#56b4e9", "#d55e00", "#e69f00", "#009e73", "#cc79a7")


class Case(NamedTuple):
    """One program on one problem: its name, its file in bench/workers, its arguments and the sizes."""

    problem: str
    program: str
    worker: str
    what: str
    sizes: tuple[int, ...]


CASES = (
    Case("position", "truearm lm", "run_truearm", "lm", (*SMALL, LARGE, HUGE)),
    Case("position", "truearm identify", "run_truearm", "identify", (*SMALL, LARGE, HUGE)),
    Case("position", "pybotics", "run_pybotics", "fit", SMALL),
    Case("position", "figaroh", "run_figaroh", "fit", SMALL),
    Case("ball_bar", "truearm lm", "run_truearm", "lm", (*SMALL, LARGE, HUGE)),
    Case("ball_bar", "truearm identify", "run_truearm", "identify", (*SMALL, LARGE)),
    Case("ball_bar", "scipy lm", "run_scipy", "lm", (*SMALL, LARGE)),
    Case("ball_bar", "scipy trf", "run_scipy", "trf", SMALL),
)


def main(quick: bool) -> None:
    OUT.mkdir(parents=True, exist_ok=True)
    rows = [row for n in (*SMALL, LARGE, HUGE) if not quick or n <= 800 for row in compared(n)]
    at = 800 if quick else LARGE
    floor = run(".venv", "run_floor", "-", "ball_bar", problem_file("ball_bar", at), 9)
    recursive = run(".venv", "run_recursive", "update", "rows", 3000, 5)
    processes = commands()
    shown = [
        "| command | CPU s | peak MiB |",
        "|---|--:|--:|",
        *(f"| `{c}` | {s:.2f} | {m:.0f} |" for c, s, m in processes),
    ]
    wrong = off_the_page({**{_name(row): row["seconds"] for row in rows}, **{(f"`{c}`",): s for c, s, _ in processes}})
    text = "\n".join([table(rows), *ratios(rows), *single(at, floor, recursive), "", *shown, "", *wrong])
    (OUT / "identification.md").write_text(text + "\n")
    with (OUT / "identification.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        writer.writeheader()
        writer.writerows(rows)
    (OUT / "identification.svg").write_text(picture(rows))
    print(text)


def compared(n: int) -> list[dict]:
    """Run all programs at n poses in turn, several rounds; return the shortest round of each."""
    best: dict[Case, dict] = {}
    rounds, runs = (2, 2) if n <= 800 else (1, 1)  # the same for all
    for _ in range(rounds):
        for case in (case for case in CASES if n in case.sizes):
            venv = str(VENVS.get(case.program.split()[0], ROOT / ".venv"))
            found = run(venv, case.worker, case.what, case.problem, problem_file(case.problem, n), runs)
            if case not in best or found["seconds"] < best[case]["seconds"]:
                best[case] = found
    return [row_of(case, n, found) for case, found in best.items()]


def row_of(case: Case, n: int, found: dict) -> dict:
    row = {"problem": case.problem, "program": case.program, "poses": n, "us_a_pose": 1e6 * found["seconds"] / n}
    done = f"{found['seconds']:.4g} s" if math.isfinite(found["seconds"]) else found["status"]
    print(f"{case.problem} {case.program} {n}: {done}", file=sys.stderr, flush=True)
    return row | {name: found.get(name) for name in FIELDS if name not in row}


def run(venv: str, worker: str, *arguments: object) -> dict:
    """Return what a worker reports; seconds are inf if its venv is missing, it fails or it takes too long."""
    python = ROOT / venv / "bin" / "python"
    if not python.exists():
        return {"seconds": float("inf"), "status": "not installed"}
    command = [str(python), f"{WORKERS / worker}.py", *map(str, arguments)]
    try:
        done = subprocess.run(command, env=ENV, capture_output=True, text=True, timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        return {"seconds": float("inf"), "status": f"stopped after {LIMIT_S} s"}
    told = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    if done.returncode or not told:
        print(done.stderr[-2000:], file=sys.stderr)
        return {"seconds": float("inf"), "status": f"failed: {done.stderr.strip().splitlines()[-1:]}"}
    return json.loads(told[-1].removeprefix("RESULT "))


def problem_file(kind: str, n: int) -> Path:
    path = OUT / f"{kind}-{n}.npz"
    if not path.exists():
        command = [sys.executable, str(WORKERS / "data.py"), kind, str(n), str(path)]
        subprocess.run(command, env=ENV, check=True)
    return path


def table(rows: list[dict]) -> str:
    lines = ["| problem | program | poses | CPU s | µs a pose | peak MB | held out mm | iterations or calls |"]
    lines.append("|---|---|--:|--:|--:|--:|--:|--:|")
    for r in rows:
        figures = [
            f"{r[k]:.4g}" if r[k] is not None else r["status"]
            for k in ("seconds", "us_a_pose", "peak_mb", "held_out_mm")
        ]
        lines.append(
            f"| {r['problem']} | {r['program']} | {r['poses']:,} | {' | '.join(figures)} | {r['iterations']} |"
        )
    return "\n".join(lines)


def ratios(rows: list[dict]) -> list[str]:
    """Return the times of the other programs divided by that of ``truearm lm``, and the growth of truearm's time and memory with n."""
    lines = ["", "| problem | poses | against | times as long | held out, theirs/ours |", "|---|--:|---|--:|--:|"]
    ours = {(r["problem"], r["poses"]): r for r in rows if r["program"] == "truearm lm"}
    for r in rows:
        mine = ours[r["problem"], r["poses"]]
        if not r["program"].startswith("truearm") and np.isfinite(r["seconds"]):
            error = r["held_out_mm"] / mine["held_out_mm"]
            slower = r["seconds"] / mine["seconds"]
            lines.append(f"| {r['problem']} | {r['poses']:,} | {r['program']} | {slower:.1f} | {error:.3f} |")
    lines.append("")
    for kind in ("position", "ball_bar"):
        n, s = np.array([(r["poses"], r["seconds"]) for (k, _), r in ours.items() if k == kind and r["poses"] >= 800]).T
        if len(n) > 1:
            power = np.polyfit(np.log(n), np.log(s), 1)[0]
            lines.append(f"- {kind}, truearm lm from 800 poses on: time grows as n^{power:.2f}")
    return lines


def single(n: int, floor: dict, recursive: dict) -> list[str]:
    of_floor = floor["seconds"] / floor["floor"]
    return [
        f"- one linearisation of {n:,} × 54: {1e3 * floor['seconds']:.1f} ms; dsyrk floor {1e3 * floor['floor']:.1f} ms;"
        f" ratio {of_floor:.1f}; residuals and derivatives alone {1e3 * floor['evaluation']:.1f} ms",
        f"- recursive, 54 + 6 unknowns: {recursive['iterations'] / recursive['seconds']:,.0f} updates/s",
    ]


PANDA = (  # of the README
    "identify tests/data/mukca/panda_3.csv --model tests/data/mukca/panda.urdf --tip ball_link"
    " --rig tests/data/mukca/rig.toml --hold-out place=frontcenter --hold-out place=frontleft --hold-out place=frontright"
)
PROJECT = (
    "init cell --model ur5e --minutes 30",
    "plan ballbar --minutes 60 --out long.csv",
    "simulate --fast --out rehearsal",
    "identify rehearsal/session.mcap --out result.json",
    "map result.json --cell-mm 5 --out map.csv",
    "correct result.json path.csv --home 0,-69,92,-109,-92,0 --out corrected.csv",
)
PATH = 100_000  # poses of path.csv, without joints


def commands() -> list[tuple[str, float, float]]:
    """Return commands with the CPU seconds [s] and the peak memory [MiB] of complete processes, with the interpreter's start."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_inputs(str(folder / "poses.csv"), str(folder / "rig.toml"))
        poses = "identify poses.csv --model puma560 --rig rig.toml"
        short = (("--help", folder), (poses, folder), (PANDA, ROOT))
        done = [min((measured(*command) for _ in range(10)), key=lambda row: row[1]) for command in short]
        for command in PROJECT:
            if "path.csv" in command:
                write_path(folder / "cell" / "path.csv")
            done.append(measured(command, folder if command.startswith("init") else folder / "cell"))
    for laws in ("none", "auto"):
        found = run(".venv", "run_command", laws, MANY)
        command = f"truearm identify --joint-laws {laws}, 3 positions at each of {MANY:,} poses"
        done.append((command, found["seconds"], found.get("peak_mb", math.nan)))
    return done


def measured(words: str, folder: Path) -> tuple[str, float, float]:
    """Run a command in a folder; seconds are inf if it fails."""
    command = [str(ROOT / ".venv/bin/truearm"), *words.split()]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command, env=ENV, cwd=folder, **quiet)
    _, status, used = os.wait4(process.pid, 0)
    seconds = used.ru_utime + used.ru_stime if status == 0 else math.inf
    print(f"truearm {words}: {seconds:.2f} s", file=sys.stderr, flush=True)
    return f"truearm {words}", seconds, used.ru_maxrss / 1024


def write_path(file: Path) -> None:
    """Write poses along a smooth path of a UR5e, as a program of many short moves has them."""
    chain = load_robot("ur5e").chain
    turn = np.linspace(0.0, 2.0 * np.pi, PATH)[:, None]
    q = np.array([0.0, -1.2, 1.6, -1.9, -1.6, 0.0]) + 0.3 * np.sin(turn * np.arange(1, 7))
    pose = forward(chain, chain.params_nominal, q)
    turned = np.degrees(Rotation.from_matrix(pose[:, :3, :3]).as_rotvec())
    rows = np.column_stack([np.arange(PATH), 1e3 * pose[:, :3, 3], turned])
    np.savetxt(file, rows, "%.6f", ",", header="name,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg", comments="")


def _name(row: dict) -> tuple[str, ...]:
    return row["problem"], row["program"], f"{row['poses']:,}"


def off_the_page(seconds: dict[tuple[str, ...], float]) -> list[str]:
    """Return where a time differs from that of docs/explanation/benchmarks.md by more than OFF, or is not there."""
    text = (ROOT / "docs/explanation/benchmarks.md").read_text(encoding="utf-8")
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    written = {tuple(row[:3]): row[3] for row in cells if len(row) == 8 and row[2][:1].isdigit()}
    written |= {(row[0],): row[1] for row in cells if len(row) == 3 and row[0].startswith("`truearm")}
    lines = []
    for name, value in seconds.items():
        ratio = value / float(written.get(name, "nan"))
        if name not in written or not 1.0 / OFF <= ratio <= OFF:
            lines.append(f"- off the page: {' '.join(name)}: {ratio:.2f} times the written time")
    return lines


def write_inputs(table_csv: str, rig_toml: str) -> None:
    """Write the ball-bar problem of 800 poses as the files that an operator has."""
    sys.path.insert(0, str(WORKERS))
    from data import CHUCKS, SIGMA, SPHERES

    data = np.load(problem_file("ball_bar", 800))
    with open(table_csv, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["kind", *(f"q{i}_deg" for i in range(1, 7)), "length_mm", "bar", "chuck", "sphere"])
        for q, length, chuck, sphere in zip(np.degrees(data["q"]), 1e3 * data["y"], *data["pair"], strict=True):
            writer.writerow(["ball_bar", *q, length, "bar", f"c{chuck}", f"s{sphere}"])
    with open(rig_toml, "w") as file:
        for kind, points in (("chuck", CHUCKS), ("sphere", SPHERES)):
            for i, xyz in enumerate(points):
                file.write(f'[[{kind}]]\nname = "{kind[0]}{i}"\nxyz_m = {list(xyz)}\n')
        file.write(f'[[bar]]\nname = "bar"\nzero_m = 5.5\ntravel_m = 10.0\nsigma_m = {SIGMA["ball_bar"]}\n')


def picture(rows: list[dict]) -> str:
    """Return drawings of CPU time over poses, one per problem, one below the other."""
    drawings = []
    for k, kind in enumerate(("position", "ball_bar")):
        mine = [r for r in rows if r["problem"] == kind and np.isfinite(r["seconds"])]
        x = svg.log_axis(f"poses ({kind} problem)", [r["poses"] for r in mine])
        plot = svg.Plot(x, svg.log_axis("CPU time, s", [r["seconds"] for r in mine]), width=640.0)
        names = list(dict.fromkeys(r["program"] for r in mine))
        for i, name in enumerate(names):
            n, s = np.array([(r["poses"], r["seconds"]) for r in mine if r["program"] == name]).T
            plot.line(n, s, f"c{i} line", name)
            plot.scatter(n, s, f"c{i}", [f"{name}, {a:,.0f} poses: {b:.3g} s" for a, b in zip(n, s)])
        parts = [svg.axes(plot), *plot.marks, svg.legend(plot)]
        drawings.append(f'<g transform="translate(0 {k * plot.height:g})">{"".join(parts)}</g>')
    style = "text{font:12px sans-serif}.mid{text-anchor:middle}.end{text-anchor:end}path,polyline{fill:none}"
    style += ".grid{stroke:#ddd}.axis{stroke:#333}" + "".join(
        f".c{i}.line{{stroke:{c};stroke-width:2}}.c{i}{{fill:{c}}}polyline.c{i},path.c{i}{{fill:none}}"
        for i, c in enumerate(COLOURS)
    )
    whole = svg.drawing(
        640.0, 600.0, [f"<style>{style}</style>", *drawings], "CPU time of a fit over the number of poses"
    )
    return whole.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1)


if __name__ == "__main__":
    main("--quick" in sys.argv[1:])
