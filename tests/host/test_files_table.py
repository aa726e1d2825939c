"""Tables are read back as written; errors name row and column."""

import lzma
import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.refusals import refused

import truearm
from truearm.errors import TableError
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import check_against_rig, concatenate, format_table, parse_table, read_table
from truearm.types import BallBar, Device, Plane, Point, Rig, SocketDistance

GOOD = "kind,q1_rad,q2_deg,length_mm,sigma_mm,bar,chuck,sphere,shell\nball_bar,0.5,90,460.25,0.1,b46,c1,s1,low\n"
LINE = "kind,q1_rad,qd1_deg_s,line,x_mm,y_mm,z_mm\nline,0.5,10,left,0.1,250.5,-2\n"
SEAT = "kind,q1_rad,place,socket\nseat,0.5,front,0\n"


def test_units_are_converted_to_si() -> None:
    table = parse_table(GOOD, "t.csv", ("rad", "rad"))
    np.testing.assert_allclose(table.q, [[0.5, math.pi / 2]], rtol=1e-15)
    np.testing.assert_allclose([table.value[0], table.sigma[0]], [0.46025, 1e-4], rtol=1e-15)
    assert (table.bar[0], table.shell[0], table.place[0], table.source[0]) == ("b46", "low", "", "t.csv row 2")


def test_rows_without_a_length_and_prismatic_joints():
    table = parse_table("kind,q1_mm,place,socket\nseat,250,front,0\n", "t.csv", ("m",))
    assert table.q[0, 0] == pytest.approx(0.25, rel=1e-15)
    assert math.isnan(table.value[0])
    assert math.isnan(table.sigma[0])
    table = parse_table(LINE + "line,0.5,,left,0.1,250.5,-2\n", "t.csv", ("rad",))
    np.testing.assert_allclose(table.xyz, [[1e-4, 0.2505, -2e-3]] * 2, rtol=1e-15)
    np.testing.assert_allclose(table.q_rate, [[math.radians(10.0)], [math.nan]], rtol=1e-15)
    assert table.line.tolist() == ["left", "left"]
    assert np.isnan(table.rotation).all()


POSE = "kind,q1_rad,tracker,x_mm,y_mm,z_mm,{}\npose,0.5,t,1,2,3,{}\n"
TURN = (0.3, -1.2, 2.0)  # rad


def test_quaternions_and_matrices_are_rotation_vectors() -> None:
    rot = Rotation.from_rotvec(TURN)
    x, y, z, w = rot.as_quat()
    matrix = rot.as_matrix()
    titles = [f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)]
    for names, values in (
        (("qw", "qx", "qy", "qz"), (w, x, y, z)),
        (("qx", "qy", "qz", "qw"), (-x, -y, -z, -w)),
        (titles, matrix.ravel()),
        (titles[::-1], matrix.ravel()[::-1]),
        (("m30", *(f"m{k // 3}{k % 3}" for k in range(9)), "m33"), (0, *matrix.ravel(), 1)),
    ):
        table = parse_table(POSE.format(",".join(names), ",".join(map(str, values))), "t.csv", ("rad",))
        np.testing.assert_allclose(table.rotation, [TURN], atol=1e-14)
        np.testing.assert_allclose(table.xyz, [[1e-3, 2e-3, 3e-3]], rtol=1e-15)
    whole = POSE.replace("x_mm,y_mm,z_mm", "m03_m,m13_mm,m23_mm").replace("1,2,3", "0.1,2,3")
    cells = ",".join(f"m{k // 3}{k % 3}" for k in range(9)), ",".join(map(str, matrix.ravel()))
    table = parse_table(whole.format(*cells), "t.csv", ("rad",))
    np.testing.assert_allclose((table.rotation[0], table.xyz[0]), (TURN, (0.1, 2e-3, 3e-3)), atol=1e-14)
    table = parse_table(POSE.format("qw,qx,qy,qz", "1,0,0,0") + "position,0.5,t,1,2,3,,,,\n", "t.csv", ("rad",))
    np.testing.assert_allclose(table.rotation, [[0.0] * 3, [np.nan] * 3])


@pytest.mark.parametrize(
    ("names", "values", "place"),
    [
        ("qw,qx,qy,qz", "1,1,0,0", "row 2"),  # not of length 1
        ("qw,qx,qy", "1,0,0", "qz"),
        ("qw,qx,qy,qz", "1,0,,0", "row 2: "),
        ("r11,r12,r13,r21,r22,r23,r31,r32,r33", "1,0,0,0,1,0,0,0,-1", "row 2: r11 to r33"),  # a mirror
        ("m00,m01,m02,m10,m11,m12,m20,m21,m22", "1,0,0,0,1,0,0,0,-1", "row 2: m00 to m22"),
        ("m00,m01,m02,m03,m10,m11,m12,m20,m21,m22", "1,0,0,4,0,1,0,0,0,1", r"column 10 \('m03'\).*m03_m, m03_mm"),
        ("qw,qx,qy,qz,rx_rad", "1,0,0,0,0", "ry"),
    ],
)
def test_orientations_that_are_none_are_refused(names, values, place) -> None:
    with pytest.raises(TableError, match=place):
        parse_table(POSE.format(names, values), "t.csv", ("rad",))


EVERY_RIG = """
[[target]]
name = "{target}"
xyz_mm = [0, 0, 100]
sigma_mm = "unknown"

[[tracker]]
name = "{tracker}"
sigma_mm = [0.02, 0.02, 0.02]
"""


def test_one_entry_stands_for_all_names_of_a_column(tmp_path: Path) -> None:
    robot, rng = truearm.load_robot("ur5e"), np.random.default_rng(2)
    q = rng.uniform(-2.0, 2.0, (120, 6))
    names = [("T.1", "ball.a"), ("T.2", "ball.b"), ("T.1", "ball.b")]
    points = {"ball.a": (0.02, 0.0, 0.1), "ball.b": (0.0, 0.03, 0.1)}
    lines = [f"kind,tracker,target,{','.join(f'q{i}_rad' for i in range(1, 7))},x_m,y_m,z_m"]
    for k, pose in enumerate(robot.forward(q)):
        tracker, target = names[k % 3]
        p = pose[:3, :3] @ points[target] + pose[:3, 3] + 2e-5 * rng.normal(size=3)
        lines.append(",".join(["position", tracker, target, *map(str, (*q[k], *p))]))
    (tmp_path / "t.csv").write_text("\n".join(lines))
    table = truearm.read_table(tmp_path / "t.csv", robot)
    rigs = {}
    for every in (True, False):
        pairs = [("*", "*")] if every else names[:2]
        (tmp_path / "r.toml").write_text("".join(EVERY_RIG.format(tracker=a, target=b) for a, b in pairs))
        rigs[every] = truearm.read_rig(tmp_path / "r.toml")
    options = truearm.IdentifyOptions(joint_laws="none")
    estimates = [truearm.identify(robot, table, rigs[every], options=options).estimate for every in (True, False)]
    assert estimates[0].parameter_names == estimates[1].parameter_names
    assert {"target.ball.a.x", "tracker.T.2.rz"} < {*estimates[0].parameter_names}
    np.testing.assert_allclose(estimates[0].value, estimates[1].value, atol=1e-12)
    with refused("malformed-file", "'.front'", place="t.csv row 2 column place"):
        parse_table("kind,q1_rad,place,socket\nseat,1,.front,0\n", "t.csv")


def test_a_compressed_table_is_read_and_a_bomb_is_not(tmp_path: Path) -> None:
    file = tmp_path / "t.csv.xz"
    packed = lzma.compress(GOOD.encode())
    file.write_bytes(packed)
    assert read_table(file).q.tolist() == parse_table(GOOD, "t.csv").q.tolist()
    rows = GOOD.splitlines(keepends=True)
    file.write_bytes(b"".join(lzma.compress(row.encode()) for row in rows))  # as several streams
    assert len(read_table(file)) == 1
    for data, what in ((packed[:-20], "incomplete"), (packed[:6], "incomplete"), (GOOD.encode(), "decompressed")):
        file.write_bytes(data)
        with pytest.raises(TableError, match=what):
            read_table(file)
    file.write_bytes(lzma.compress(b"\n" * 60_000_000, preset=0))  # 9 kB
    tracemalloc.start()
    with refused("too-large"):
        read_table(file)
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()


def test_only_x_in_metres_is_a_measurement_and_others_are_kept_to_hold_out_by() -> None:
    text = SEAT.replace("socket", "socket,x_cm,x_,x_text").replace("front,0", f"front,0,warm,1,{'a' * 65}")
    table = parse_table(text, "t.csv")
    assert np.isnan(table.xyz).all()
    assert (table.x_cm.tolist(), table["x_"].tolist(), table.x_text.tolist()) == (["warm"], ["1"], [""])
    assert parse_table(format_table(table, ("rad",)), "t.csv").x_cm.tolist() == ["warm"]
    assert ObservationTable.joined([table, parse_table(SEAT, "u.csv")]).x_cm.tolist() == ["warm", ""]


def test_blank_empty_and_foreign_rows_and_line_ends_are_passed_over(tmp_path):
    # Every row after them is still there, and numbered as an editor numbers it.
    table = parse_table(SEAT + "\n" * 250_000 + "seat,0.7,front,1\n", "t.csv")
    assert table.q[:, 0].tolist() == [0.5, 0.7]
    assert table.source[1] == "t.csv row 250003"
    text = "kind,q1_rad,place,socket,,\n,,,,,\nseat,0.5,front,0,,\n , ,,,,\nseat,0.7,front,1,,\n,,,,,\n"
    table = parse_table(text, "t.csv")
    assert table.q[:, 0].tolist() == [0.5, 0.7]
    assert table.source.tolist() == ["t.csv row 3", "t.csv row 5"]
    path = tmp_path / "t.csv"
    path.write_bytes(b'\xef\xbb\xbf kind ,q1_rad,place,socket,note,x_temp\r\n\r\nseat, 1 ,a,0,"two\r\nlines",warm\r\n')
    table = read_table(path)
    assert len(table) == 1
    assert table.q[0, 0] == 1.0


names = st.from_regex(r"[A-Za-z0-9_é-]{1,64}", fullmatch=True)
angles = st.floats(-60.0, 60.0)
lengths = st.floats(min_value=1e-9, max_value=100.0)

KINDS = ("ball_bar", "line", "plane", "pose", "position", "seat")  # whose columns ``tables`` fills in


@st.composite
def tables(draw: st.DrawFn) -> ObservationTable:
    joints, n = draw(st.integers(1, 8)), draw(st.integers(1, 5))
    kind = np.array(draw(st.lists(st.sampled_from(KINDS), min_size=n, max_size=n)))

    def identifier(*kinds: str) -> np.ndarray:
        return np.where(np.isin(kind, kinds), draw(st.lists(names, min_size=n, max_size=n)), "")

    def matrix(numbers: st.SearchStrategy[float], columns: int) -> np.ndarray:
        row = st.lists(numbers, min_size=columns, max_size=columns)
        return np.array(draw(st.lists(row, min_size=n, max_size=n)))

    pointed, every = np.isin(kind, ("line", "position", "pose"))[:, None], KINDS
    moving = np.array(draw(st.lists(st.booleans(), min_size=n, max_size=n)))[:, None]
    sigma = np.array(draw(st.lists(st.just(math.nan) | st.floats(1e-9, 0.1), min_size=n, max_size=n)))
    return ObservationTable(
        q=matrix(angles, joints),
        kind=kind,
        value=np.where(np.isin(kind, ("ball_bar", "plane")), matrix(lengths, 1)[:, 0], math.nan),
        sigma=sigma,
        bar=identifier("ball_bar"),
        chuck=identifier("ball_bar"),
        sphere=identifier("ball_bar", "seat"),
        socket=identifier("seat"),
        place=identifier(*every),
        shell=identifier(*every),
        source=np.array([f"t.csv row {i + 2}" for i in range(n)]),
        xyz=np.where(pointed, matrix(st.floats(-100.0, 100.0), 3), math.nan),
        xyz_sigma=np.where(pointed & moving, matrix(st.floats(1e-9, 0.1), 3), math.nan),
        rotation=np.where(kind[:, None] == "pose", matrix(st.floats(-6.0, 6.0), 3), math.nan),
        q_rate=np.where(moving, matrix(angles, joints), math.nan),
        target=identifier("line", "position", "pose", "plane"),
        line=identifier("line"),
        tracker=identifier("position", "pose"),
        plane=identifier("plane"),
        rig=identifier(*every),
        time=matrix(st.floats(0.0, 1e10), 1)[:, 0],
        temperature=matrix(st.floats(-20.0, 60.0) | st.just(math.nan), 1)[:, 0],
    )


@settings(max_examples=25, deadline=None)
@given(tables())
def test_a_written_table_comes_back_bit_for_bit(table: ObservationTable) -> None:
    units = ("rad",) * table.q.shape[1]
    back = parse_table(format_table(table, units), "t.csv", units)
    for name in table.columns:
        np.testing.assert_array_equal(back[name], table[name], err_msg=name)


WRONG = {
    "empty": ("", "no-rows"),
    "no rows": ("kind,q1_rad,place,socket\n", "no-rows"),
    "no header": ("seat,0.5,front,0\n", "missing-column"),
    "semicolons between quoted titles": ('"kind";"q1_rad"\n"seat";0,5\n', "separate them by commas"),
    "values without a title": ("kind,q1_rad,,place,socket\nseat,0,7,a,0\n", "column 3:"),
    "negative payload": (
        "kind,q1_rad,place,socket,payload_kg\nseat,0,a,0,-3\n",
        "row 2 column payload_kg: -3 kg",
    ),
    "not an observation kind": ("q1_rad,place\n0,a\n", "missing-column"),
    "unknown column": ("kind,q1_rad,plaec\nseat,0,a\n", "did you mean plane or place?"),
    "nothing like it": ("kind,q1_rad,humidity\nseat,0,20\n", "x_"),
    "length without unit": ("kind,q1_rad,length\nball_bar,0,1\n", "wrong-value"),
    "unknown unit": ("kind,q1_grad\nseat,0\n", "wrong-value"),
    "both units": ("kind,q1_rad,q1_deg\nseat,0,0\n", "given-twice"),
    "no joints": ("kind,place,socket\nseat,a,0\n", "missing-column"),
    "a gap in q": ("kind,q1_rad,q3_rad,place,socket\nseat,0,0,a,0\n", "none for q2"),
    "text for a number": (SEAT.replace("0.5", "half"), "row 2 column q1_rad: 'half'"),
    "NaN": (SEAT.replace("0.5", "NaN"), "row 2 column q1_rad: NaN"),
    "overflow": (SEAT.replace("0.5", "1e999"), "row 2 column q1_rad: '1e999'"),
    "no reading": (SEAT.replace("0.5", ""), "row 2 column q1_rad"),
    "ragged": (SEAT + "seat,0.5,front\n", "row 3"),
    "unknown kind": (SEAT + "sofa,0.5,front,0\n", "row 3 column kind: 'sofa'"),
    "no socket": (SEAT.replace("front,0", "front,"), "needs a socket"),
    "no length": (GOOD.replace("460.25", ""), "needs length_mm or length_m"),
    "length of a seat": ("kind,q1_rad,length_m,place,socket\nseat,0,1,a,0\n", "has no length"),
    "line without a point": ("kind,q1_rad,line\nline,0,left\n", "line row needs x_mm, y_mm, z_mm"),
    "half a point": (LINE.replace("250.5", ""), "row 2:"),
    "point of a seat": (
        SEAT.replace("socket", "socket,x_m,y_m,z_m").replace("front,0", "front,0,1,1,1"),
        "has no x_mm",
    ),
    "rotation sigma of a point": (
        "kind,q1_rad,tracker,x_m,y_m,z_m,rotation_sigma_deg\nposition,0,t,0,0,0,0.1\n",
        "no rotation_sigma_deg or rotation_sigma_rad",
    ),
    "rotation sigma of 0": (
        "kind,q1_rad,tracker,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad,rotation_sigma_deg\npose,0,t,0,0,0,0,0,0,0\n",
        "row 2 column rotation_sigma_deg: 0 deg",
    ),
    "pose without a turn": (
        "kind,q1_rad,tracker,x_m,y_m,z_m\npose,0,t,0,0,0\n",
        "needs rx_deg, ry_deg, rz_deg (or _rad)",
    ),
    "turn in degrees called rad": (
        "kind,q1_rad,tracker,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad\npose,0,t,0,0,0,90,0,0\n",
        "column rx_rad: 90 rad",
    ),
    "touch of no plane": ("kind,q1_rad,plane\nplane,0,\n", "a plane row needs a plane"),
    "speed of one joint": ("kind,q1_rad,q2_rad,qd1_rad_s,place,socket\nseat,0,0,0,a,0\n", "2 joint columns but 1"),
    "speed of a slide": ("kind,q1_rad,qd1_mm_s,place,socket\nseat,0,0,a,0\n", "qd1_mm_s: does"),
    "speed without per second": ("kind,q1_rad,qd1_rad\nseat,0,0\n", "wrong-value"),
    "a length of nothing": (GOOD.replace("460.25", "1e-300"), "row 2 column length_mm: 1e-300 mm"),
    "a sigma of a picometre": (GOOD.replace("0.1,", "1e-9,"), "sigma_mm: 1e-09 mm"),
    "mm called m": (GOOD.replace("length_mm", "length_m"), "in another unit"),
    "negative length": (GOOD.replace("460.25", "-1"), "column length_mm: -1 mm"),
    "odd identifier": (SEAT.replace("front", "front left"), "'front left'"),
    "open quote": (SEAT + '"seat,0.5,front,0\n', "CSV"),
    "wide": (",".join(["kind", *(f"x_{i}" for i in range(300))]) + "\n", "301 columns"),
    "tall": ("kind,q1_rad\n" + "a,1\n" * 200_001, "more than 200000 rows"),
    "long cell": ("kind,q1_rad,x_a\nseat,0," + "9" * 200_000 + "\n", "CSV"),
    "long number": (SEAT.replace("0.5", "9" * 5000), "row 2 column q1_rad: '999"),
}


@pytest.mark.parametrize(("text", "message"), WRONG.values(), ids=WRONG.keys())
def test_wrong_tables_are_told_in_one_line(text: str, message: str) -> None:
    with refused(message) as caught:
        parse_table(text, "poses.csv")
    assert str(caught.value).startswith("poses.csv")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 250


def test_joints_must_be_the_robots_and_alike():
    with refused("other-robot", joints=2, expected=6):
        parse_table(GOOD, "t.csv", ("rad",) * 6)
    with pytest.raises(TableError, match="column q2_deg:"):
        parse_table(GOOD, "t.csv", ("rad", "m"))
    table = parse_table(GOOD, "a.csv")
    both = concatenate([table, parse_table(GOOD, "b.csv")])
    assert both.source.tolist() == ["a.csv row 2", "b.csv row 2"]
    with refused("malformed-file", " 1 joints", "a.csv row 2", place="b.csv row 2"):
        concatenate([table, parse_table(SEAT, "b.csv")])


def test_rows_that_do_not_fit_the_rig_are_told():
    bar = BallBar("b46", 0.4, 1.0, 0.075, 1e-4)
    rig = Rig(bars={"b46": bar}, chucks={"c1": Point("c1", (0.0, 0.0, 0.0))})
    with refused("not-in-rig", place="t.csv row 2", what="sphere", name="s1"):
        check_against_rig(parse_table(GOOD, "t.csv"), rig)
    with refused("not-in-rig", what="chuck", name="c7", names=["c1"]):
        check_against_rig(parse_table(GOOD.replace("c1", "c7"), "t.csv"), rig)
    check_against_rig(parse_table(SEAT, "t.csv"), Rig())
    lines, point = parse_table(LINE, "t.csv"), (0.0, 0.0, 0.0)
    check_against_rig(lines, Rig())  # lines come as they are, until a rig lists them
    cov = ((1e-8, 0.0, 0.0), (0.0, 1e-8, 0.0), (0.0, 0.0, 1e-8))
    with refused("not-in-rig", what="line", name="left", names=["right"]):
        check_against_rig(lines, Rig(lines={"right": Device("right", cov)}))
    with pytest.raises(TableError, match="column target:"):
        check_against_rig(lines, Rig(targets={name: Point(name, point) for name in "ab"}))
    touch = parse_table("kind,q1_rad,plane\nplane,0,floor\n", "t.csv")
    # A gauge reads a distance on either side of the plane; a length has no sides.
    either = parse_table("kind,q1_rad,plane,length_mm\nplane,0,floor,-0.02\nplane,0,floor,0\n", "t.csv")
    np.testing.assert_allclose(either.value, [-2e-5, 0.0])
    check_against_rig(touch, Rig(planes={"floor": Plane("floor", point, (0.0, 0.0, 1.0), 1e-5)}))
    with refused("not-in-rig", what="plane", name="floor"):
        check_against_rig(touch, Rig())
    seats = parse_table(SEAT + "seat,0.5,front,1\nseat,0.5,back,2\n", "t.csv")
    balls = {name: Point(name, (0.0, 0.0, 0.0)) for name in ("s1", "s2")}
    with pytest.raises(TableError, match="row 2 column sphere:"):
        check_against_rig(seats, Rig(spheres=balls))
    check_against_rig(seats, Rig(socket_distances=(SocketDistance(("0", "1"), 0.05, 1e-4),)))
    check_against_rig(seats, Rig(sockets={("front", "1"): Point("1", (0.0, 0.0, 0.0))}))
    with pytest.raises(TableError, match="rig's socket 1 at place 'back'"):
        check_against_rig(seats, Rig(sockets={("back", "1"): Point("1", (0.0, 0.0, 0.0))}))
    with pytest.raises(TableError, match="in sockets 0, 1, 2, and no place"):
        check_against_rig(seats, Rig(socket_distances=(SocketDistance(("0", "2"), 0.05, 1e-4),)))


def test_files_that_are_no_text_are_refused(tmp_path: Path) -> None:
    for name, data, code in (
        ("latin1.csv", "kind,note\nseat,\xe9\n".encode("latin-1"), "not-text"),
        ("nul.csv", b"kind\0", "not-text"),
        ("big.csv", b"x" * (16 * 2**20 + 1), "too-large"),
    ):
        (tmp_path / name).write_bytes(data)
        with refused(code, place=tmp_path / name):
            read_table(tmp_path / name)
    with refused("unreadable-file", place=tmp_path):
        read_table(tmp_path)
    with refused("missing-file"):
        read_table(tmp_path / "none.csv")
    with refused("unreadable-file"):
        read_table(Path("/dev/zero"))
