"""Rig files: what is written comes back, what is wrong is told with entry and key."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from truearm.errors import RigError
from truearm.files.rig import format_rig, parse_rig, read_rig, write_rig
from truearm.types import BallBar, Point, Rig, SocketDistance

FULL = """
seat_sigma_mm = 0.05
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
"""


def test_every_entry_is_read_in_si() -> None:
    rig = parse_rig(FULL, "rig.toml")
    assert rig.seat_sigma == pytest.approx(5e-5, rel=1e-15)
    assert rig.chucks["c1"].xyz == pytest.approx((0.1, -0.2005, 0.0), rel=1e-15)
    assert rig.chucks["c1"].sigma == pytest.approx(2e-5, rel=1e-15)
    assert rig.chucks["c2"].sigma is None
    assert rig.spheres["s1"] == Point("s1", (0.0, 0.0, 0.1), 0.0)
    assert rig.bars["b46"].zero == pytest.approx(0.46, rel=1e-15)
    assert (rig.bars["b46"].gain, rig.bars["b46"].gain_sigma) == (1.0, 0.01)
    assert rig.socket_distances[0].sockets == ("0", "1")
    assert rig.socket_distances[0].distance == pytest.approx(0.05, rel=1e-15)


def test_an_empty_rig_is_the_default_rig() -> None:
    assert parse_rig("", "rig.toml") == Rig()


names = st.from_regex(r"[A-Za-z0-9_é-]{1,64}", fullmatch=True)
coordinates = st.tuples(*[st.floats(-100.0, 100.0)] * 3)
sizes = st.floats(1e-9, 100.0)
points = st.builds(Point, names, coordinates, st.none() | st.floats(0.0, 100.0))
bars = st.builds(BallBar, names, sizes, sizes, sizes, sizes, st.floats(0.0, 100.0), st.floats(0.0, 100.0))
distances = st.builds(SocketDistance, st.lists(names, min_size=2, max_size=2, unique=True).map(tuple), sizes, sizes)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(points, max_size=3), st.lists(points, max_size=3), st.lists(bars, max_size=2), st.lists(distances), sizes
)
def test_a_written_rig_comes_back_bit_for_bit(
    chucks: list[Point], spheres: list[Point], bars: list[BallBar], distances: list[SocketDistance], seat_sigma: float
) -> None:
    rig = Rig(
        {p.name: p for p in chucks},
        {p.name: p for p in spheres},
        {b.name: b for b in bars},
        tuple(distances),
        seat_sigma,
    )
    assert parse_rig(format_rig(rig), "rig.toml") == rig


def test_write_and_read(tmp_path: Path) -> None:
    rig = parse_rig(FULL, "rig.toml")
    write_rig(tmp_path / "rig.toml", rig)
    assert read_rig(tmp_path / "rig.toml") == rig


BAR = '[[bar]]\nname="b"\nzero_m=0.4\ntravel_m=0.1\nsigma_m=1e-4\n'
WRONG = {
    "no TOML": ("chuck = [", "is not TOML"),
    "deep": ("a = " + "[" * 100_000, "nested too deeply"),
    "long integer": ("seat_sigma_m = 1" + "0" * 5000, "rig.toml"),
    "long hexadecimal": ("seat_sigma_m = 0x" + "f" * 5000, "seat_sigma must be a finite number"),
    "list of long": ("seat_sigma_m = [0x" + "f" * 5000 + "]", "seat_sigma must be a number"),
    "unknown table": ("[[chucks]]\n", "unknown key 'chucks'"),
    "one table": ('[chuck]\nname = "c"\n', "[[chuck]] entries"),
    "unknown key": (BAR + "scale = 1.0\n", "[[bar]] 1: unknown key 'scale'"),
    "no name": ("[[chuck]]\nxyz_m = [0, 0, 0]\n", "needs a name"),
    "odd name": ('[[chuck]]\nname = "a b"\nxyz_m = [0, 0, 0]\n', "needs a name"),
    "twice": (BAR + BAR, "[[bar]] 2: the name 'b' stands twice"),
    "no length": ('[[bar]]\nname = "b"\n', "needs zero_m (or zero_mm)"),
    "both units": (BAR + "zero_mm = 400\n", "both zero_m and zero_mm"),
    "text": (BAR.replace("0.4", '"0.4"'), "zero must be a number"),
    "truth": (BAR.replace("0.4", "true"), "zero must be a number"),
    "NaN": (BAR.replace("0.4", "nan"), "zero must be a finite number"),
    "mm called m": (BAR.replace("0.4", "400"), "must lie between"),
    "no travel": (BAR.replace("0.1", "0"), "travel must be greater than 0"),
    "negative sigma": ('[[chuck]]\nname = "c"\nxyz_m = [0, 0, 0]\nsigma_m = -1\n', "sigma must lie between 0"),
    "unknown word": ('[[chuck]]\nname = "c"\nxyz_m = [0, 0, 0]\nsigma_m = "unkown"\n', "sigma must be a number"),
    "two coordinates": ('[[sphere]]\nname = "s"\nxyz_m = [0, 0]\n', "three numbers"),
    "one socket": ('[[socket_distance]]\nsockets = ["0"]\n', "two names"),
    "same socket": ('[[socket_distance]]\nsockets = ["0", "0"]\n', "from itself"),
}


@pytest.mark.parametrize(("text", "message"), WRONG.values(), ids=WRONG.keys())
def test_wrong_rigs_are_told_in_one_line(text: str, message: str) -> None:
    with pytest.raises(RigError) as caught:
        parse_rig(text, "rig.toml")
    assert message in str(caught.value)
    assert str(caught.value).startswith("rig.toml")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 250
