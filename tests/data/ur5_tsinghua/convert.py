"""Make grid.csv.xz and random.csv.xz, truearm's tables, from the original files: python convert.py FOLDER

Joints stay in degrees. The measured point in m is the target plus its difference, both in mm. ``x_set`` tells the tables apart, to hold
one out. Nothing else is changed.
"""

import csv
import lzma
import sys
from pathlib import Path

ORIGINALS = {"grid": "3D_UR5_uncalibrated_grid_cleaned.csv", "random": "3D_UR5_uncalibrated_random_cleaned.csv"}
HEADER = "kind,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm,target,tracker,x_set"


def main(folder: Path) -> None:
    for name, original in ORIGINALS.items():
        with (folder / original).open(encoding="utf-8-sig", newline="") as source:
            lines = [HEADER]
            for row in csv.DictReader(source):
                joints = [row[f"joint_{k}"] for k in range(1, 7)]
                point = [f"{float(row[f'{k}_t']) + float(row[f'{k}_dif']):.7f}" for k in "xyz"]
                lines.append(",".join(["position", *joints, *point, "reflector", "tracker", name]))
        text = "\n".join(lines) + "\n"
        Path(f"{name}.csv.xz").write_bytes(lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
