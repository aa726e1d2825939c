"""Descriptions of box and robot, interpreted by the same code for recorder and reader; counts to metres."""

import json
import math
from fractions import Fraction
from pathlib import Path

import cbor2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from session_stream import ident_document, metres_of

from truearm.errors import ProtocolError, SessionError
from truearm.session.frames import Channel, Pages, decimal, decode_ident, find_channels, parse_ident, recorded_ident
from truearm.session.joint_format import JointLine, parse_line
from truearm.session.samples import extension, shown, volts
from truearm.session.session_file import Session


@given(st.integers(-(2**63), 2**63), st.integers(-30, 30))
def test_decimal_is_the_nearest_float(mantissa, exponent):
    assert decimal([mantissa, exponent], "scale") == float(Fraction(mantissa) * Fraction(10) ** exponent)


@pytest.mark.parametrize(
    "value", [None, 5, [1], [1, 2, 3], [1.5, 0], ["1", 0], [1, 301], [2**64, 0], [True, 0], [2**63, 300]]
)
def test_what_is_no_decimal_is_refused(value):
    with pytest.raises(ValueError, match="scale"):
        decimal(value, "scale")


def recorded(text):
    """Return what a session says whose metadata have this text."""
    return recorded_ident(Session(Path("s.mcap"), {"box": {"ident": text}}))


def test_counts_to_metres_by_the_ident():
    stream, (column,) = find_channels(parse_ident(ident_document()), "lvdt")
    assert (stream.name, column, stream.group_delay_ns) == ("adc", 0, 1_500_000)
    counts = np.array([[0, -8_000_000], [1, 8_000_000]], dtype=np.int32)
    assert np.allclose(extension(counts, stream.channels[0]), metres_of(counts), rtol=0, atol=1e-17)
    assert volts(counts, stream.channels[0])[1, 1] == pytest.approx(1.144, abs=1e-15)
    assert find_channels(parse_ident(ident_document()), "other") is None
    channel = Channel("lvdt", "V", 1e-6, "mm", (1.0, 30.0))
    assert extension(np.array([1_000_000]), channel)[0] == pytest.approx(0.031, abs=1e-17)
    assert shown(channel, 1_000_000) == (f"{channel.name}_m", pytest.approx(0.031, abs=1e-17))


@pytest.mark.parametrize(
    "channel", [Channel("x", "V", 1.0), Channel("x", "V", 1.0, "inch", (0.0, 1.0)), Channel("x", "V", 1.0, "m")]
)
def test_no_calibration_is_said(channel):
    with pytest.raises(SessionError, match="no calibration to metres"):
        extension(np.array([1]), channel)


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, '{"streams": []}', "9" * 5000])
def test_metadata_that_are_no_ident(text):
    with pytest.raises(SessionError):
        recorded(text)


def with_channel(**change):
    """An ident whose first channel, the LVDT, says something else."""
    document = ident_document()
    document["streams"][0]["channels"][0].update(change)
    return document


FAULTY = [
    ({"scale": "abc"}, "scale"),
    ({"scale": [1]}, "scale"),
    ({"scale": [True, 1]}, "scale"),
    ({"scale": [1, 400]}, "scale"),
    ({"calibration": {"unit": "m", "poly": [1, 2]}}, r"poly\[0\]"),
    ({"calibration": {"unit": "m", "poly": [[1, 0]] * 17}}, "poly: .*length <= 16"),
    ({"calibration": {"unit": 5, "poly": [[1, 0]]}}, "unit"),
    ({"calibration": [1]}, "calibration"),
    ({"unit": 5}, "unit"),
]


class TestIdent:
    @pytest.mark.parametrize(("change", "says"), FAULTY, ids=str)
    def test_a_faulty_channel_is_no_faulty_box(self, change, says):
        """Recorded and read alike; the channel says what is wrong, the others are whole."""
        found = decode_ident(cbor2.dumps(with_channel(**change)))
        stream, (column,) = find_channels(found, "lvdt")
        assert column == 0
        assert math.isnan(stream.channels[0].scale)
        assert [c.fault for c in stream.channels[1:]] == ["", "", ""]
        (fault,) = found.faults
        assert "'lvdt'" in fault
        assert fault.endswith(stream.channels[0].fault)
        with pytest.raises(SessionError, match=f"'lvdt'.*{says}"):
            extension(np.array([1]), stream.channels[0])

    def test_a_channel_without_a_name_and_one_that_is_none(self):
        document = ident_document()
        document["streams"][0]["channels"][1:3] = [{"unit": "V", "scale": [1, 0]}, 7]
        found = parse_ident(document)
        assert [c.name for c in found.streams[0].channels] == ["lvdt", "", "", "ch3"]
        assert len(found.faults) == 2

    def test_what_the_box_itself_says_is_wrong(self):
        found = parse_ident({**ident_document(), "fault": "config\x1b[2J damaged" + "x" * 100, "firmware": 7})
        assert found.firmware == ""
        assert len(found.faults) == 2
        assert found.faults[0].startswith("the box says 'config\\x1b[2J damaged")
        assert max(map(len, found.faults)) < 100

    @pytest.mark.parametrize(
        ("text", "shown"),
        [
            (
                "Traceback (most recent call last):\n  File x\nOSError: [Errno 28] ENOSPC\n",
                "'OSError: [Errno 28] ENOSPC'",
            ),
            ("", "''"),
            (7, "7"),
            ("\x1b[2J" * 99, "'\\x1b[2J\\x1b[2J"),
        ],
    )
    def test_the_last_error_of_its_firmware(self, text, shown):
        (fault,) = parse_ident({**ident_document(), "last_error": text}).faults
        assert shown in fault
        assert len(fault) < 120

    def test_a_stream_of_flight_times(self):
        """What a box says of its magnetostrictive head: 8 ns a count, metres by its calibration; it has no oversampling."""
        document = ident_document()
        calibration = {"unit": "m", "poly": [[-33567, -7], [28066298, -4]], "serial": "T1", "date": "2026-01-02"}
        channel = {"name": "magnetostrictive", "unit": "s", "scale": [8, -9], "calibration": calibration}
        mag = {"id": 1, "name": "mag", "period_ns": 983040, "osr": 0, "group_delay_ns": 0, "channels": [channel]}
        document["streams"].append(mag)
        found = parse_ident(document)
        stream, (column,) = find_channels(found, "magnetostrictive")
        assert (stream.id, stream.osr, column, found.faults) == (1, 0, 0, ())
        assert extension(np.array([12_500]), stream.channels[0])[0] == pytest.approx(-33567e-7 + 2806.6298 * 100e-6)

    def test_the_document_is_kept_whole_and_fit_for_json(self):
        extra = {1: 2.5, "b": b"\xff", "big": 1 << 20_000, "t": cbor2.CBORTag(4711, "x"), b"k": [None, True]}
        found = decode_ident(cbor2.dumps({**ident_document(), "extra": extra}))
        kept = {"1": "2.5", "b": "ff", "big": "<int>", "t": "<CBORTag>", "6b": [None, True]}
        assert found.document["extra"] == kept
        assert found.document["uid"] == "0102"
        assert recorded(json.dumps(found.document)) == found

    @pytest.mark.parametrize(
        ("change", "says"),
        [
            ({"protocol": "1.0"}, "protocol version"),
            ({"protocol": [1]}, "protocol version"),
            ({"protocol": [2, 0]}, r"protocol 2\.0, this truearm 1\.x.*update truearm$"),
            ({"protocol": [0, 9]}, r"protocol 0\.9, this truearm 1\.x.*truearm box flash$"),
            ({"boot_id": None}, "boot_id"),
            ({"boot_id": True}, "boot_id"),
            ({"boot_id": -1}, "boot_id"),
            ({"streams": {}}, "streams"),
            ({"streams": []}, "streams"),
            ({"streams": [7]}, r"streams\[0\]"),
            ({"streams": ident_document()["streams"] * 2}, "two streams.* id or name"),
            ({"streams": ident_document()["streams"] * 17}, "streams"),
            *(
                ({"streams": [{**ident_document()["streams"][0], **change}]}, says)
                for change, says in [
                    ({"name": "console"}, "'console'"),
                    ({"name": "../adc"}, "name"),
                    ({"name": 5}, "name"),
                    ({"channels": []}, "channels"),
                    ({"channels": [{"name": "x", "scale": [1, 0]}] * 63}, "channels"),
                    ({"id": 2**70}, "id"),
                    ({"osr": None}, "osr"),
                    ({"period_ns": -1}, "period_ns"),
                    ({"group_delay_ns": 1.5}, "group_delay_ns"),
                ]
            ),
        ],
        ids=lambda value: str(value)[:60],
    )
    def test_what_cannot_be_used(self, change, says):
        document = {**ident_document(), **change}
        with pytest.raises(ProtocolError, match=says):
            decode_ident(cbor2.dumps(document))
        with pytest.raises(SessionError, match="session's metadata"):
            recorded(json.dumps({**document, "uid": "0102"}))

    @pytest.mark.parametrize("references", ["d81c81d81d00", "d81c82d81d0001"])
    def test_a_document_that_holds_itself(self, references):
        raw = cbor2.dumps({**ident_document(), "x": 0})
        with pytest.raises(ProtocolError, match="cannot be decoded"):
            decode_ident(raw[:-1] + bytes.fromhex(references))

    @given(st.integers(0, 600), st.integers(1, 255))
    @example(at=22, flip=32)  # the firmware's version becomes a byte string
    @example(at=173, flip=85)  # the calibration becomes a simple value, which is false as null is
    @example(at=239, flip=48)  # a channel's name becomes a byte string
    def test_a_changed_byte_means_the_same_recorded_and_read(self, at, flip):
        """Whatever the recorder accepts, the session's metadata say again."""
        raw = bytearray(cbor2.dumps(ident_document()))
        raw[at % len(raw)] ^= flip
        try:
            found = decode_ident(bytes(raw))
        except ProtocolError:
            return
        again = recorded(json.dumps(found.document))
        assert repr(again.streams) == repr(found.streams)  # NaN is not equal to itself
        assert (again.boot_id, again.firmware, len(again.faults)) == (found.boot_id, found.firmware, len(found.faults))


class TestPages:
    def test_joined(self):
        pages = Pages()
        assert pages.push(1, 0, 2, b"ab") is None
        assert pages.push(1, 1, 2, b"cd") == b"abcd"

    def test_another_document_drops_the_first(self):
        pages = Pages()
        pages.push(1, 0, 3, b"a")
        pages.push(1, 1, 3, b"b")
        pages.push(2, 0, 3, b"x")
        assert pages.push(2, 1, 3, b"y") is None
        assert pages.push(2, 2, 3, b"z") == b"xyz"

    @pytest.mark.parametrize("order", [(0, 2, 1), (0, 2, 2), (1, 2, 0)])
    def test_a_missing_page(self, order):
        pages = Pages()
        assert [pages.push(1, page, 3, b"x") for page in order] == [None, None, None]

    @pytest.mark.parametrize(("page", "pages", "n"), [(0, 0, 1), (0, 33, 1), (1, 1, 1), (0, 1, 201), (-1, 2, 1)])
    def test_beyond_the_bounds(self, page, pages, n):
        assert Pages().push(1, page, pages, b"x" * n) is None


class TestReading:
    @pytest.mark.parametrize(
        ("line", "found"),
        [
            (b'{"t": 1.5, "seq": 3, "q": [0.1, -2]}', JointLine(1.5, [0.1, -2.0], 3)),
            (b'{"t": 1.5, "q": [0.1, -2]}\r', JointLine(1.5, [0.1, -2.0])),
            (b'{"t": 2, "q": [1], "q_cmd": "x", "more": {"y": 1}}', JointLine(2.0, [1.0])),
            (b'{"t": 2, "seq": null, "q": [1]}', None),
            (b'{"t": 2, "seq": true, "q": [1]}', None),
            (b'{"t": 2, "seq": 4611686018427387904, "q": [1]}', None),
            (b'{"t": -1, "q": [1]}', None),
        ],
    )
    def test_lines(self, line, found):
        assert parse_line(line) == found
