"""Make series_a.csv.xz to series_d.csv.xz from the original files, in the folder where it runs: python convert.py FOLDER

The numbers of the originals, with decimal points; of their columns only the joints, the measured position and the
measured angles.
"""

import csv
import lzma
import sys
from pathlib import Path

ORIGINALS = {
    "series_a": "Series_A/measurements_grid.csv",
    "series_b": "Series_B/measurements_joint_configurations.csv",
    "series_c": "Series_C/measurements_random_poses.csv",
    "series_d": "Series_D/measurements_iso_cubes.csv",
}
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
COLUMNS = (
    *(f"{name}_joint" for name in JOINTS),
    *(f"measurement_{name}" for name in ("x", "y", "z", "rx", "ry", "rz")),
)
HEADER = "kind,tracker,target,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,x_mm,y_mm,z_mm,x_rx_deg,x_ry_deg,x_rz_deg"


def main(folder: Path) -> None:
    for name, original in ORIGINALS.items():
        with (folder / original).open(encoding="utf-8-sig", newline="") as source:
            rows = [
                [row[column].replace(",", ".") for column in COLUMNS] for row in csv.DictReader(source, delimiter=";")
            ]
        seen = [row for row in rows if any(float(value) != 0.0 for value in row[6:9])]
        lines = [HEADER, *(",".join(("position", "tracker", "reflector", *row)) for row in seen)]
        Path(f"{name}.csv.xz").write_bytes(
            lzma.compress(("\n".join(lines) + "\n").encode(), preset=9 | lzma.PRESET_EXTREME)
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
