"""Joint sources before hostile input: nothing but our own errors, no more memory than what came, no reading that was not sent.

The mutations know the structure: sizes, types, recipes and lengths of packages, numbers and brackets of lines, pages of files, are
changed as well as bits, and pieces are dropped, doubled, swapped and cut at random.
"""

import json
import random
import re
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mutations import bytes_changed, is_clear, parts_changed
from ros_bags import joint_state, write_bag
from tcp_peer import Played

from truearm.errors import InputError, LinkError
from truearm.record.intake import MAX_LINE
from truearm.record.robots import rtde
from truearm.record.robots.sources import FileOptions, readings_of_file
from truearm.record.robots.text_lines import LineDialect, LinesLink
from truearm.session.joint_format import parse_line

rounds = pytest.mark.parametrize("n", [500, pytest.param(10_000, marks=pytest.mark.soak)])
NUMBERS = [0, 1, 2, 3, 4, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0x8000, 0xFFFF]


class Clock:
    """Each reading of it takes 50 ms, so code that waits for nothing waits at most a hundred times."""

    kind = "virtual"

    def __init__(self):
        self.t_ns = 0

    def now_ns(self):
        self.t_ns += 50_000_000
        return self.t_ns


def cut(rng, data):
    """Return the same bytes in pieces."""
    places = sorted(rng.randrange(len(data) + 1) for _ in range(rng.randrange(6)))
    return [data[a:b] for a, b in zip([0, *places], [*places, len(data)], strict=True) if b > a]


def mutated(rng, parts):
    """Return the parts, some with changed bytes or another size in front, in another order."""
    parts = [bytes_changed(rng, part) if rng.random() < 0.3 else part for part in parts]
    if rng.random() < 0.2:
        i = rng.randrange(len(parts))
        parts[i] = struct.pack(">H", rng.choice([*NUMBERS, abs(len(parts[i]) - 1), len(parts[i]) + 1])) + parts[i][2:]
    return parts_changed(rng, parts) if rng.random() < 0.5 else parts


def package(kind, payload):
    return struct.pack(">HB", 3 + len(payload), ord(kind)) + payload


ANSWERS = [
    package("V", b"\1"),
    package("v", struct.pack(">4I", 5, 11, 0, 0)),
    package("O", b"\1DOUBLE,VECTOR6D,VECTOR6D,VECTOR6D,VECTOR6D,UINT64,INT32,UINT32"),
    package("S", b"\1"),
]
LAYOUT = struct.Struct(">Bd24dQiI")


def stream(rng):
    """Return data packages with a text message and an unknown package among them."""
    data = [
        LAYOUT.pack(1, k / 500, *(rng.uniform(-7, 7) for _ in range(24)), 0, 7, 2) for k in range(rng.randrange(1, 8))
    ]
    parts = [package("U", payload) for payload in data]
    parts.insert(rng.randrange(len(parts) + 1), package("M", b"\5hello\2me\1"))
    parts.insert(rng.randrange(len(parts) + 1), package("X", rng.randbytes(9)))
    return parts


def reference(data):
    """Return time and joints of the data packages in a stream, by an independent reader."""
    at, found = 0, []
    while at + 3 <= len(data):
        size, kind = struct.unpack_from(">HB", data, at)
        if size < 3 or at + size > len(data):
            break
        if kind == ord("U") and size == 3 + LAYOUT.size and data[at + 3] == 1:
            found.append(LAYOUT.unpack_from(data, at + 3)[1:8])
        at += size
    return found


def play(monkeypatch, pieces, ends=True):
    """Return all lines that a client makes from them."""
    played = Played(pieces, ends)
    monkeypatch.setattr(rtde, "TcpLink", played)
    lines = []
    try:
        link = rtde.RtdeLink("rtde://played", Clock())
        while (arrivals := link.read(0.0)) or played.pieces or ends:
            lines += [data for _, data in arrivals]
    except LinkError as exc:
        is_clear(exc)
    return lines


@rounds
def test_rtde_streams(monkeypatch, n):
    """The set-up is whole, the stream is not: each reading is one that an independent reader finds, all of them are there."""
    readings = 0
    for seed in range(n):
        rng = random.Random(seed)
        data = b"".join(mutated(rng, stream(rng)))
        lines = play(monkeypatch, [*ANSWERS, *cut(rng, data)], rng.random() < 0.5)
        found = [reading for line in lines if (reading := parse_line(line)) is not None]
        known = [row for row in reference(data) if all(abs(q) < 1e9 for q in row[1:]) and 0 <= row[0] < 4e9]
        assert [(reading.t, *reading.q) for reading in found] == known
        assert sum(map(len, lines)) <= 8 * len(data) + 200 * (len(lines) + 1)  # 8 bytes of a double are up to 25 digits
        readings += len(found)
    assert readings > n  # most of the stream survives


@rounds
def test_rtde_set_ups(monkeypatch, n):
    """Whatever the controller answers, in whatever order: a client or one clear line, after a bounded wait."""
    for seed in range(n):
        rng = random.Random(seed)
        parts = mutated(rng, [*ANSWERS, *stream(rng)])
        play(monkeypatch, cut(rng, b"".join(parts)), rng.random() < 0.5)


LINES = [
    b"t_s,seq,q1_deg,q2_deg,q1_cmd_deg,q2_cmd_deg,inputs\n",
    b"1.5,1,10,20,10,20,3\n",
    b"1.502,2,10.5,20.5,10,20,3\n",
    b'{"t": 1.5, "seq": 3, "q": [0.1, -2.0], "q_cmd": [0.1, -2.0]}\n',
    b'{"names": {"t": "stamp", "q": ["j1", "j2"]}, "unit": "deg,mm", "t_unit": "ns"}\n',
    b'{"stamp": 1500000000, "j1": 10, "j2": 20, "qd": [1, 2]}\n',
    b"hello\n",
]
TOKENS = re.compile(rb'[{}\[\],:"\n]|-?[0-9.]+|[a-z_0-9]+| ')
ODD = (
    *(b"", b"1e999", b"-1", b"9" * 400, b"NaN", b"null", b"true", b"[" * 2000, b'"', b"\xff", b"\0", b"\n"),
    *(b"t_s,q1_rad,", b"{}", b"x" * 9000),
)


def odd_lines(rng):
    tokens = TOKENS.findall(b"".join(rng.choices(LINES, k=rng.randrange(1, 12))))
    for _ in range(rng.randrange(1, 6)):
        tokens[rng.randrange(len(tokens))] = rng.choice([*ODD, rng.choice(tokens)])
    return b"".join(tokens)


def read_lines(pieces, of):
    link, lines = LinesLink(Played(pieces), Clock(), LineDialect(of)), []
    try:
        while True:
            lines += [data for _, data in link.read(0.0)]
    except LinkError as exc:
        is_clear(exc)
    return lines


@rounds
def test_lines(n):
    """What comes out is stored by the recorder's reader of lines; it is no more than came in, six times over at most: escapes."""
    readings = 0
    for seed in range(n):
        rng = random.Random(seed)
        data = odd_lines(rng)
        of = rng.choice([{}, {"unit": "deg"}, {"q": "j1,j2"}, {"columns": "t_s,seq,q1_deg,q2_deg,x_1,x_2,x_3"}])
        lines = read_lines(cut(rng, data), of)
        assert all(len(line) <= MAX_LINE + 100 for line in lines)
        assert sum(map(len, lines)) <= 6 * len(data) + 300 * len(lines)
        readings += sum(parse_line(line) is not None for line in b"".join(lines).split(b"\n"))
    assert readings > n / 4


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda x: st.lists(x, max_size=4),
    max_leaves=8,
)


@settings(max_examples=100, deadline=None)
@given(
    st.dictionaries(
        st.sampled_from(["t", "seq", "q", "q_cmd", "qd", "inputs", "current", "names", "unit", "t_unit", "j1"]), JSON
    ),
    st.sampled_from([{}, {"unit": "deg,mm"}, {"q": "j1,j1", "t": "t"}]),
)
def test_json_of_any_values(row, of):
    line = json.dumps(row).encode()
    found = read_lines([line + b"\n"], of)
    assert len(found) == 1


@rounds
def test_tables(tmp_path, n):
    path = tmp_path / "table.csv"
    for seed in range(n):
        rng = random.Random(seed)
        path.write_bytes(odd_lines(rng) if seed % 2 else b"".join(mutated(rng, LINES[:3])))
        try:
            found = list(readings_of_file(path, FileOptions("")))
        except InputError as exc:
            is_clear(exc, str(path))
        else:
            assert all(parse_line(reading.line).t == reading.t for reading in found)


@pytest.fixture(scope="module", params=["mcap", "sqlite3"])
def bag(request, tmp_path_factory):
    names = ["b", "a"]
    states = [(10**18 + k, joint_state(10**18 + k, names, [k, -k])) for k in range(60)]
    folder = write_bag(tmp_path_factory.mktemp("bag") / "bag", request.param, states)
    (path,) = (file for file in folder.iterdir() if file.suffix != ".yaml")
    return path


@pytest.mark.parametrize("n", [150, pytest.param(5000, marks=pytest.mark.soak)])  # of each storage
def test_bags(bag, tmp_path, n):
    """Bytes, fields of 2, 4 and 8 bytes, and whole stretches: a clear line, or readings.

    Neither kind has checksums here: a changed page of a database may show a row twice, but a row takes two bytes of a page at least.
    """
    whole = bag.read_bytes()
    path = tmp_path / f"odd{bag.suffix}"
    readable = 0
    for seed in range(n):
        rng = random.Random(seed)
        data = bytearray(whole)
        for _ in range(rng.randrange(1, 4)):
            at, width = rng.randrange(len(data)), rng.choice([1, 1, 2, 4, 8])
            value = rng.choice([0, 1, 2 ** (8 * width) - 1, 2 ** (8 * width - 1), rng.randrange(2 ** (8 * width))])
            data[at : at + width] = value.to_bytes(width, rng.choice(["little", "big"]))
        if rng.random() < 0.2:
            a, b = sorted(rng.randrange(len(data)) for _ in range(2))
            del data[a:b]
        path.write_bytes(data)
        try:
            found = list(readings_of_file(path, FileOptions("/joint_states", ["a", "b"], rng.random() < 0.5)))
        except InputError as exc:
            is_clear(exc, str(path))
        else:
            readable += 1
            assert len(found) <= len(data) // 2
    assert readable < n
