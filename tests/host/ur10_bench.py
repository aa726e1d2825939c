"""A real UR10 in front of a laser tracker (tests/data/ipa_ur10), as positions and as poses."""

import lzma
from functools import cache
from pathlib import Path

import numpy as np

from truearm.kinds.table import ObservationTable
from truearm.model.robot_file import load_robot
from truearm.model.transforms import rotation, rotation_vector
from truearm.types import Device, Point, Rig

FOLDER = Path(__file__).parents[1] / "data" / "ipa_ur10"
ROBOT = load_robot(str(FOLDER / "ur10.toml"), None, None)
POSITION_SIGMA = 5e-5  # m, of a tracker
ROTATION_SIGMA = np.radians(0.01)
RIG = Rig(
    targets={"reflector": Point("reflector", (0.0, 0.0, 0.109), None)},
    trackers={
        "tracker": Device("tracker", tuple(map(tuple, POSITION_SIGMA**2 * np.eye(3))), rotation_sigma=ROTATION_SIGMA)
    },
)


@cache
def columns(series: str) -> np.ndarray:
    """Return q in rad, the target in mm, its orientation in deg (n, 12)."""
    text = lzma.decompress((FOLDER / f"series_{series}.csv.xz").read_bytes()).decode().splitlines()
    return np.loadtxt(text, delimiter=",", skiprows=1, usecols=range(3, 15))


def tracked(series: str, kind: str, every: int = 1) -> ObservationTable:
    """Return a series as rows of kind "position" or "pose"; every n-th of them."""
    data = columns(series)[::every]
    n = len(data)
    about = [rotation(np.radians(data[:, [9 + k]]) * np.eye(3)[k]) for k in range(3)]
    turn = rotation_vector(about[0] @ about[1] @ about[2])
    return ObservationTable(
        q=data[:, :6],
        kind=np.full(n, kind),
        xyz=1e-3 * data[:, 6:9],
        rotation=turn if kind == "pose" else np.full((n, 3), np.nan),
        tracker=np.full(n, "tracker"),
        target=np.full(n, "reflector"),
        source=np.array([f"series_{series} row {i}" for i in range(n)]),
    )
