"""Real arms: the held-out error of geometry alone and with joint laws, on public data: table and picture of docs/explanation/real-arms.md.

    .venv/bin/python bench/real_arms.py [--only TEXT] [--write]

Every set is fitted with the same settings: ``--joint-laws none``, and what ``identify`` does by default. tests/data says where
the data are from.
"""

from __future__ import annotations

import argparse
import re
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.cluster.vq import kmeans2

from truearm.estimate.fit import fit
from truearm.estimate.information import observe
from truearm.estimate.problem import build_problem, without_knowledge
from truearm.estimate.solution import Options
from truearm.kinds.position import nearest_rotation
from truearm.kinds.rig_file import read_rig
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import concatenate, read_table
from truearm.model.chain import Chain, point_forward
from truearm.model.robot import Robot
from truearm.model.robot_file import load_robot
from truearm.types import BallBar, Device, Floats, Point, Rig
from truearm.workflows.calibration import Identification
from truearm.workflows.identify import IdentifyOptions, identified
from truearm.workflows.inputs import Observed
from truearm.workflows.selection import held_out_rows

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs/explanation/real-arms.md"
DATA = ROOT / "tests" / "data"
SIGMA = 5e-5  # m, declared of a laser tracker
BAR_NOISE = 3e-5  # m
TRAVEL = 0.0375  # m to either side of a bar's middle
BARS = {"b46": 0.46, "b61": 0.61}
PLACED = 0.01  # m: how well the places of the chucks are known beforehand
TRACKER = Rig(
    targets={"reflector": Point("reflector", (0.0, 0.0, 0.109), None)},
    trackers={"tracker": Device("tracker", tuple(map(tuple, SIGMA**2 * np.eye(3))))},
)


@dataclass(frozen=True)
class Case:
    """A data set and its split: the rows in ``held`` (n,) are not fitted. ``points``: tracked rows for judging a robot identified from lengths."""

    name: str
    split: str
    robot: Robot
    rig: Rig
    table: ObservationTable
    held: np.ndarray
    published: str = ""
    most: float = float("nan")  # mm: what it is to reach
    points: ObservationTable | None = None


@dataclass(frozen=True)
class Outcome:
    """Errors of the held-out rows [mm] without and with joint laws, the laws kept, and the seconds of both fits."""

    case: Case
    before: Floats
    geometry: Floats
    laws: Floats
    kept: tuple[str, ...]
    seconds: tuple[float, float]
    found: Identification


def ur10(series: str) -> tuple[Robot, ObservationTable]:
    folder = DATA / "ipa_ur10"
    robot = load_robot(str(folder / "ur10.toml"), None, None)
    return robot, read_table(folder / f"series_{series}.csv.xz", robot.chain.joint_units)


def some(n: int, part: float, seed: int) -> np.ndarray:
    """Return a mask (n,) of a random part of the rows."""
    held = np.zeros(n, dtype=bool)
    held[np.random.default_rng(seed).permutation(n)[: int(part * n)]] = True
    return held


def blocks_of_joint_space(q: Floats, seed: int) -> np.ndarray:
    """Return a mask (n,) of 4 of 22 clusters of the joint readings, each joint scaled to its standard deviation."""
    scaled = q / np.maximum(q.std(axis=0), 1e-3)
    _, block = kmeans2(scaled, 22, seed=seed, minit="++")
    return np.isin(block, np.random.default_rng(seed).permutation(22)[:4])


def base_points(robot: Robot, table: ObservationTable) -> Floats:
    """Return the measured points (n, 3) in the base frame, placed by the nominal robot."""
    nominal = point_forward(robot.chain, robot.chain.params_nominal, table.q, np.array([0.0, 0.0, 0.093]))
    rotation = nearest_rotation((nominal - nominal.mean(0)).T @ (table.xyz - table.xyz.mean(0)), np.eye(3))
    return (table.xyz - table.xyz.mean(0)) @ rotation.T + nominal.mean(0)


def lengths(robot: Robot, table: ObservationTable, seed: int) -> tuple[Rig, ObservationTable]:
    """Return the lengths of two bars between three chucks and the measured points within their travel."""
    rng = np.random.default_rng(seed)
    points = base_points(robot, table)
    chucks = chuck_places(points, rng)
    parts = []
    for c, place in enumerate(chucks):
        distance = np.linalg.norm(points - place, axis=1)
        for bar, middle in BARS.items():
            rows = np.flatnonzero(np.abs(distance - middle) < TRAVEL)
            parts.append(
                ObservationTable(
                    q=table.q[rows],
                    kind="ball_bar",
                    value=distance[rows] + rng.normal(0.0, BAR_NOISE, rows.size),
                    chuck=f"c{c + 1}",
                    sphere="s1",
                    bar=bar,
                    source=table.source[rows],
                )
            )
    guesses = chucks + rng.normal(0.0, PLACED, chucks.shape)
    rig = Rig(
        chucks={f"c{i + 1}": Point(f"c{i + 1}", tuple(guess), None) for i, guess in enumerate(guesses)},
        spheres={"s1": Point("s1", (0.0, 0.0, 0.109), None)},
        bars={name: BallBar(name, middle, 1.0, 2.0 * TRAVEL, BAR_NOISE) for name, middle in BARS.items()},
    )
    return rig, concatenate(parts)


def chuck_places(points: Floats, rng: np.random.Generator) -> Floats:
    """Return chuck positions (3, 3): of 400 random triples at the points' heights, the one with the most rows within the bars' travel."""
    tries = points[rng.integers(len(points), size=(400, 3))] + rng.uniform(-0.3, 0.3, (400, 3, 3))

    def rows(triple: Floats) -> int:
        apart = np.linalg.norm(points[:, None] - triple, axis=2)
        return sum(int((np.abs(apart - middle) < TRAVEL).sum()) for middle in BARS.values())

    return max(tries, key=rows)


def cases() -> Iterator[tuple[str, Callable[[], Case]]]:
    """Return the name of each case and the function that makes it."""
    for seed in (0, 1, 2):

        def random_fifth(series: str, most: float, seed: int = seed) -> Case:
            robot, table = ur10(series)
            held = some(len(table), 0.2, seed)
            return Case(f"UR10 {series.upper()}", f"random fifth, seed {seed}", robot, TRACKER, table, held, "", most)

        yield f"ur10-c-{seed}", lambda random_fifth=random_fifth: random_fifth("c", 0.095)
        if seed == 0:
            yield "ur10-a-0", lambda random_fifth=random_fifth: random_fifth("a", 0.080)

    def by_command(home: bool) -> Case:
        robot, table = ur10("c")
        rows, held = np.arange(len(table)) >= (not home), held_out_rows(table, ["0.2"], 0)
        split = "--hold-out 0.2" if home else "--hold-out 0.2, row 1 left out"
        return Case("UR10 C", split, robot, TRACKER, table.select(rows), held[rows], "", 0.095)

    for home in (True, False):
        yield f"ur10-c-command-{'with' if home else 'without'}-home", lambda home=home: by_command(home)

    def blocks(seed: int) -> Case:
        robot, table = ur10("a")
        held = blocks_of_joint_space(table.q, seed)
        return Case("UR10 A", f"4 of 22 blocks of joint space, seed {seed}", robot, TRACKER, table, held, "", 0.100)

    for seed in (0, 1):
        yield f"ur10-a-blocks-{seed}", lambda seed=seed: blocks(seed)

    def ur5() -> Case:
        folder = DATA / "ur5_tsinghua"
        robot = load_robot(str(folder / "ur5.toml"), None, None)
        grid, random = (read_table(folder / f"{name}.csv.xz", robot.chain.joint_units) for name in ("grid", "random"))
        held = np.arange(len(grid) + len(random)) >= len(grid)
        split = "the author's 20 poses"
        return Case("UR5", split, robot, TRACKER, concatenate([grid, random]), held, "0.155 (neural network)", 0.066)

    yield "ur5", ur5

    yield "panda3-front", lambda: mukca("panda_3", "back → front", ("front",), "", 0.20)
    yield "panda3-back", lambda: mukca("panda_3", "front → back", ("back",), "", 0.20)
    inf = float("nan")
    yield (
        "panda1",
        lambda: mukca("panda_1", "back-high → others", ("front", "right"), "0.347 (authors, outliers removed)", inf),
    )
    yield "kuka-left", lambda: mukca("kuka_14", "front, left_back → raised_left", ("raised",), "", inf)
    yield "kuka-front", lambda: mukca("kuka_14", "front → others", ("left", "raised"), "", inf)

    def bars(n: int, most: float) -> Case:
        robot, table = ur10("c")
        held = some(len(table), 0.2, 0)
        rig, rows = lengths(robot, table.select(~held), seed=0)
        if n:
            rows = rows.select(some(len(rows), n / len(rows), 1))
        split = f"{len(rows)} lengths to 3 chucks; points of a random fifth"
        none = np.zeros(len(rows), dtype=bool)
        return Case("UR10 C by bars", split, robot, rig, rows, none, "", most, table.select(held))

    yield "bars", lambda: bars(0, 0.105)
    yield "bars-200", lambda: bars(200, float("nan"))


def mukca(arm: str, split: str, prefixes: tuple[str, ...], published: str = "", most: float = float("nan")) -> Case:
    """Return a set of seats; the places whose names begin with one of the prefixes are held out."""
    folder = DATA / "mukca"
    urdf = "iiwa14.urdf" if arm.startswith("kuka") else "panda.urdf"
    robot = load_robot(str(folder / urdf), None, "ball_link")
    table = read_table(folder / f"{arm}.csv", robot.chain.joint_units)
    held = np.array([str(place).startswith(prefixes) for place in table.place])
    return Case(f"MUKCa {arm}", split, robot, read_rig(folder / "rig.toml"), table, held, published, most)


def errors(case: Case, chain: Chain, names: tuple[str, ...], value: Floats) -> Floats:
    """Return the errors [mm] of the held-out rows: the robot is fixed, and unknowns that only these rows have are fitted to them."""
    table, rig, known = case.table.select(case.held), case.rig, dict(zip(names, value, strict=True))
    if case.points is not None:  # the base is placed on them; the target is where the sphere was
        at = tuple(known[f"sphere.s1.{k}"] for k in "xyz")
        rig = Rig(targets={"reflector": Point("reflector", at, 0.0)}, trackers=TRACKER.trackers)
        table = case.points
        robot_names = set(chain.parameter_names)
        known = {name: number for name, number in known.items() if name in robot_names}
    problem = without_knowledge(build_problem(chain, rig, table))
    x = np.array([known.get(name, start) for name, start in zip(problem.names, problem.start, strict=True)])
    columns = np.array([name not in known for name in problem.names])
    if columns.any():
        x = fit(problem, columns, x, Options()).x
    return 1e3 * np.abs(observe(problem, x, np.zeros(x.size, dtype=bool)).residual["m"])


def run(case: Case) -> Outcome:
    seconds, results = [], []
    for mode in ("none", "auto"):
        start = time.process_time()
        found = identified(case.robot, Observed(case.rig, case.table), case.held, IdentifyOptions(joint_laws=mode))
        seconds.append(time.process_time() - start)
        results.append(found)
    plain, best = (errors(case, one.chain, one.estimate.parameter_names, one.estimate.value) for one in results)
    nominal = results[0].estimate
    before = errors(
        case,
        results[0].chain,
        nominal.parameter_names,
        np.where(np.arange(nominal.value.size) < nominal.n_robot_parameters, nominal.nominal, nominal.value),
    )
    laws = results[1].estimate.joint_laws
    kept = tuple(f"{law.joint} {law.term}" for law in laws.tried if law.kept) if laws else ()
    return Outcome(case, before, plain, best, kept, (seconds[0], seconds[1]), results[1])


def row(out: Outcome) -> str:
    """Return a row of the page's table."""
    case, fitted = out.case, int((~out.case.held).sum())
    goal = f"{case.most:.3f}" if np.isfinite(case.most) else "-"
    cells = (
        case.name,
        case.split,
        str(fitted),
        str(len(out.geometry)),
        case.published or "-",
        f"{out.before.mean():.3f}",
        f"{out.geometry.mean():.3f} / {out.geometry.max():.2f}",
        f"{out.laws.mean():.3f} / {out.laws.max():.2f}",
        goal,
        ", ".join(out.kept) or "none",
        f"{out.seconds[0]:.1f} / {out.seconds[1]:.1f}",
    )
    return f"| {' | '.join(cells)} |"


def picture(outcomes: Sequence[Outcome]) -> str:
    """Return a bar chart of the mean held-out errors, with geometry alone and with joint laws, as SVG."""
    left, step, width = 450, 34, 420
    most = max(float(out.geometry.mean()) for out in outcomes)
    parts = []
    for i, out in enumerate(outcomes):
        y = 44 + i * step
        parts.append(f'<text x="{left - 8}" y="{y + 14}" text-anchor="end">{out.case.name}, {out.case.split}</text>')
        for k, (colour, error) in enumerate((("#8a8f98", out.geometry), ("#1769aa", out.laws))):
            mean = float(error.mean())
            length = width * min(mean / min(most, 0.6), 1.0)
            parts.append(f'<rect x="{left}" y="{y + 12 * k}" width="{length:.1f}" height="10" fill="{colour}"/>')
            parts.append(f'<text x="{left + length + 5:.1f}" y="{y + 12 * k + 9}" font-size="10">{mean:.3f}</text>')
    height = 60 + step * len(outcomes)
    title = '<text x="12" y="22" font-size="14">Mean held-out error [mm]: geometry (grey), with joint laws (blue). A bar of more than 0.6 mm is cut</text>'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {left + width + 60} {height}" font-family="sans-serif" font-size="12">'
        f'<rect width="100%" height="100%" fill="white"/>{title}{"".join(parts)}</svg>\n'
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="cases whose name contains this")
    parser.add_argument(
        "--write", action="store_true", help="write the table of docs/explanation/real-arms.md and its picture"
    )
    asked = parser.parse_args()
    outcomes, rows = [], []
    for name, make in cases():
        if asked.only in name:
            out = run(make())
            outcomes.append(out)
            rows.append(row(out))
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(f"{name:18} {rows[-1]} {peak:.0f} MB", flush=True)
    if asked.write:
        text, table = PAGE.read_text(encoding="utf-8"), "".join(f"{line}\n" for line in rows)
        PAGE.write_text(re.sub(r"(?<=---\|\n)(\|.*\n)+", lambda _: table, text, count=1), encoding="utf-8")
        (ROOT / "docs/images/real-arms.svg").write_text(picture(outcomes), encoding="utf-8")


if __name__ == "__main__":
    main()
