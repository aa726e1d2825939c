"""Convert the original layout of the MUKCa data to truearm's tables: python convert.py ORIGINAL [TARGET].

ORIGINAL contains data/<robot>/<place>/hole_<socket>.csv: one row per pose, joint readings in rad, no header. TARGET
(this folder by default) gets <robot>.csv with every number unchanged.
"""

import csv
import sys
from pathlib import Path


def rows_of(robot: Path):
    for file in sorted(robot.glob("*/hole_?.csv")):
        with file.open(newline="") as text:
            for cells in csv.reader(text):
                yield ["seat", file.parent.name, file.stem.removeprefix("hole_"), *(repr(float(c)) for c in cells)]


def main(original: Path, target: Path) -> None:
    for robot in sorted(p for p in (original / "data").iterdir() if p.is_dir()):
        rows = list(rows_of(robot))
        joints = [f"q{i}_rad" for i in range(1, len(rows[0]) - 2)]
        with (target / f"{robot.name}.csv").open("w", newline="") as text:
            csv.writer(text, lineterminator="\n").writerows([["kind", "place", "socket", *joints], *rows])
        print(f"{robot.name}: {len(rows)} rows, {len(joints)} joints")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else Path(__file__).parent)
