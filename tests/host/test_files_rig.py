"""Rig files are read back as written; errors name entry and key."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from truearm.errors import RigError
from truearm.kinds.rig_file import format_rig, parse_rig
from truearm.types import BallBar, Device, Plane, Point, Rig, SocketDistance

FULL = """
seat_sigma_mm = 0.05
line_sigma_mm = [0.06, 0.1, 0.07]
line_placement = "two_point"
line_travel_mm = 15
time_offset_sigma_ms = 5
joint_sigma_deg = [0.01, 0.02]
[[target]]
name = "ball"
xyz_mm = [0, 0, 120]
[[line]]
name = "left"
sigma_mm = [0.06, 0.1, 0.06]
[[line]]
name = "right"
covariance_m2 = [[1e-8, 1e-9, 0], [1e-9, 2e-8, 0], [0, 0, 1e-8]]
position_sigma_mm = 100
turn_sigma_deg = 5
[[tracker]]
name = "t"
sigma_m = [1e-5, 1e-5, 2e-5]
xyz_mm = [1000, 0, 500]
rotation_deg = [0, 0, 90]
position_sigma_m = 0
turn_sigma_rad = 0
rotation_sigma_rad = 1e-4
[[plane]]
name = "table"
xyz_m = [0.5, 0, 0]
normal = [0, 0, 1]
sigma_mm = 0.02
tilt_sigma_deg = 1
[[chuck]]
name = "c1"
xyz_mm = [100, -200.5, 0]
sigma_mm = 0.02
[[chuck]]
name = "c2"
xyz_m = [0.5, 0.0, 0.0]
sigma_m = "unknown"
[[sphere]]
name = "s1"
xyz_m = [0.0, 0.0, 0.1]
[[bar]]
name = "b46"
zero_mm = 460.0
travel_mm = 75.0
sigma_mm = 0.084
zero_sigma_m = 0.001
gain_sigma = 0.01
[[socket_distance]]
sockets = ["0", "1"]
distance_mm = 50.0
sigma_mm = 0.1
[[socket]]
place = "front"
name = "0"
xyz_mm = [400, 0, 50]
sigma_mm = 0.02
[[socket]]
name = "0"
xyz_m = [0.5, 0, 0]
"""


def test_every_entry_is_read_in_si():
    rig = parse_rig(FULL, "rig.toml")
    assert rig.seat_sigma == pytest.approx(5e-5, rel=1e-15)
    assert rig.chucks["c1"].xyz == pytest.approx((0.1, -0.2005, 0.0), rel=1e-15)
    assert rig.chucks["c1"].sigma == pytest.approx(2e-5, rel=1e-15)
    assert rig.chucks["c2"].sigma is None
    assert rig.spheres["s1"] == Point("s1", (0.0, 0.0, 0.1), 0.0)
    assert rig.bars["b46"].zero == pytest.approx(0.46, rel=1e-15)
    assert (rig.bars["b46"].gain, rig.bars["b46"].gain_sigma) == (1.0, 0.01)
    assert rig.socket_distances[0].sockets == ("0", "1")
    assert rig.sockets["", "0"] == Point("0", (0.5, 0.0, 0.0), 0.0)
    assert rig.sockets["front", "0"].xyz == pytest.approx((0.4, 0.0, 0.05), rel=1e-15)
    assert rig.sockets["front", "0"].sigma == pytest.approx(2e-5, rel=1e-15)
    assert rig.socket_distances[0].distance == pytest.approx(0.05, rel=1e-15)
    rig = parse_rig(FULL, "rig.toml")
    assert rig.targets["ball"].xyz == pytest.approx((0.0, 0.0, 0.12), rel=1e-15)
    assert rig.line_sigma == pytest.approx((6e-5, 1e-4, 7e-5), rel=1e-15)
    assert rig.line_travel == pytest.approx(0.015, rel=1e-15)
    assert parse_rig("", "rig.toml").line_travel is None
    assert (rig.line_placement, rig.time_offset, rig.time_offset_sigma) == ("two_point", 0.0, 0.005)
    assert np.diag(np.array(rig.joint_cov)) == pytest.approx(np.radians([0.01, 0.02]) ** 2, rel=1e-15)
    left, right, tracker = rig.lines["left"], rig.lines["right"], rig.trackers["t"]
    assert np.array(left.sensor_cov) == pytest.approx(np.diag([3.6e-9, 1e-8, 3.6e-9]), rel=1e-12)
    assert (left.xyz, left.sigma, left.turn_sigma, left.rotation_sigma) == (None, None, None, None)
    assert right.sensor_cov[0] == (1e-8, 1e-9, 0.0)
    assert (right.sigma, right.turn_sigma) == pytest.approx((0.1, math.radians(5)), rel=1e-15)
    assert tracker.rotation == pytest.approx((0.0, 0.0, math.pi / 2), rel=1e-15)
    assert (tracker.xyz, tracker.sigma, tracker.turn_sigma, tracker.rotation_sigma) == ((1.0, 0.0, 0.5), 0.0, 0.0, 1e-4)
    flat = rig.planes["table"]
    assert (flat.normal, flat.offset_sigma, flat.tilt_sigma) == ((0.0, 0.0, 1.0), None, math.radians(1))


def test_the_rig_of_the_document_and_an_empty_one():
    text = (Path(__file__).parents[2] / "docs" / "reference" / "table-format.md").read_text(encoding="utf-8")
    rig = parse_rig(re.findall(r"```toml\n(.*?)```", text, re.DOTALL)[0], "table-format.md")
    for name in (
        "chucks",
        "spheres",
        "bars",
        "socket_distances",
        "sockets",
        "targets",
        "lines",
        "trackers",
        "planes",
        "joint_cov",
    ):
        assert getattr(rig, name), f"{name} is missing in the example"
    assert parse_rig("", "rig.toml") == Rig()


names = st.from_regex(r"[A-Za-z0-9_é-]{1,64}", fullmatch=True)
coordinates = st.tuples(*[st.floats(-100.0, 100.0)] * 3)
sizes = st.floats(1e-9, 100.0)
spreads = st.just(0.0) | st.floats(1e-9, 1.0)  # known exactly, or no smaller than any sensor's
points = st.builds(Point, names, coordinates, st.none() | spreads)
bars = st.builds(BallBar, names, sizes, sizes, sizes, sizes, spreads, spreads).filter(lambda b: b.zero > 0.5 * b.travel)
distances = st.builds(SocketDistance, st.lists(names, min_size=2, max_size=2, unique=True).map(tuple), sizes, sizes)


turns = st.tuples(*[st.floats(-6.0, 6.0)] * 3)
sigmas = st.none() | spreads
variances = st.floats(1e-12, 1e-4)
covariances = st.builds(lambda a, b, c: ((a, 0.0, 0.0), (0.0, b, 0.0), (0.0, 0.0, c)), *[variances] * 3)
placed = st.builds(Device, names, covariances, coordinates, turns, sigmas, sigmas, st.none() | st.floats(1e-9, 1.0))
unplaced = st.builds(
    Device, names, covariances, rotation=turns, sigma=st.none() | sizes, turn_sigma=st.none() | st.floats(1e-9, 1.0)
)
devices = placed | unplaced
planes = st.builds(Plane, names, coordinates, coordinates.filter(any), sizes, sigmas, sigmas)


def by_name(things: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    return st.lists(things, max_size=2).map(lambda some: {thing.name: thing for thing in some})


rigs = st.builds(
    Rig,
    *(by_name(points), by_name(points), by_name(bars), st.lists(distances, max_size=2).map(tuple), sizes),
    targets=by_name(points),
    lines=by_name(devices),
    line_sigma=st.tuples(*[st.floats(1e-9, 1.0)] * 3),
    line_placement=st.sampled_from(["least_squares", "two_point"]),
    line_travel=st.none() | st.floats(1e-6, 10.0),
    trackers=by_name(devices),
    planes=by_name(planes),
    time_offset=st.floats(-1.0, 1.0),
    time_offset_sigma=sigmas,
    joint_cov=st.just(()) | covariances,
    sockets=st.dictionaries(st.tuples(st.just("") | names, names), points, max_size=3).map(
        lambda found: {key: replace(point, name=key[1]) for key, point in found.items()}
    ),
)


@settings(max_examples=25, deadline=None)
@given(rigs)
def test_a_written_rig_comes_back_bit_for_bit(rig: Rig) -> None:
    assert parse_rig(format_rig(rig), "rig.toml") == rig


BAR = '[[bar]]\nname="b"\nzero_m=0.4\ntravel_m=0.1\nsigma_m=1e-4\n'
LINE = '[[line]]\nname="l"\nsigma_mm=[0.1, 0.1, 0.1]\n'
SOCKET = '[[socket]]\nplace = "p"\nname = "0"\nxyz_m = [0, 0, 0]\n'
WRONG = {
    "a bar in metres": (BAR.replace("zero_m=0.4", "zero_mm = 0.37"), "[[bar]] 1: zero"),
    "a bar shorter than its travel": (BAR.replace("zero_m=0.4", "zero_mm = 50"), "50 mm: no length"),
    "line known nowhere": (LINE + "position_sigma_m = 0\n", "[[line]] 1: an exactly known pose (sigma 0) needs xyz_m"),
    "exact sensor": (LINE.replace("[0.1,", "[0.0,"), "sigma_mm: item 1: 0 mm"),
    "sigma twice": (LINE + "covariance_m2 = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n", "both covariance_m2 and sigma_mm"),
    "singular sensor": ('[[line]]\nname="l"\ncovariance_m2 = [[1, 1, 0], [1, 1, 0], [0, 0, 1]]\n', "covariance"),
    "joints twice": ("joint_cov_si = [[1.0]]\njoint_sigma_rad = [1.0]\n", "both joint_cov_si and joint_sigma_rad"),
    "flat normal": ('[[plane]]\nname="p"\nxyz_m=[0,0,0]\nnormal=[0,0,0]\nsigma_m=1e-5\n', "normal: must"),
    "socket twice": (SOCKET + SOCKET, "[[socket]] 2: 'p/0'"),
    "same socket": ('[[socket_distance]]\nsockets = ["0", "0"]\ndistance_m = 1\nsigma_m = 1\n', "'0'"),
}


@pytest.mark.parametrize(("text", "message"), WRONG.values(), ids=WRONG.keys())
def test_wrong_rigs_are_told_in_one_line(text: str, message: str) -> None:
    with pytest.raises(RigError) as caught:
        parse_rig(text, "rig.toml")
    assert message in str(caught.value)
    assert str(caught.value).startswith("rig.toml")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 250
