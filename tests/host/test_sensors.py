"""Counts to metres."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sync_stream import ident_document, metres_of

from truearm.errors import SessionError
from truearm.sensors.ident import Channel, decimal, find_channel, parse_ident, parse_ident_json
from truearm.sensors.lvdt import RAIL_HIGH, RAIL_LOW, bar_length, extension, out_of_travel, railed, volts
from truearm.types import BallBar


@given(st.integers(-(2**63), 2**63), st.integers(-30, 30))
def test_decimal_is_the_nearest_float(mantissa, exponent):
    assert decimal([mantissa, exponent], "scale") == float(Fraction(mantissa) * Fraction(10) ** exponent)


@pytest.mark.parametrize("value", [None, 5, [1], [1, 2, 3], [1.5, 0], ["1", 0], [1, 301], [2**64, 0], [True, 0]])
def test_what_is_no_decimal_is_refused(value):
    with pytest.raises(SessionError, match="scale"):
        decimal(value, "scale")


def test_counts_to_metres_by_the_ident():
    stream, column = find_channel(parse_ident(ident_document()), "lvdt")
    assert (stream.name, column, stream.group_delay_ns) == ("adc", 0, 1_500_000)
    counts = np.array([[0, -8_000_000], [1, 8_000_000]], dtype=np.int32)
    assert np.allclose(extension(counts, stream.channels[0]), metres_of(counts), rtol=0, atol=1e-17)
    assert volts(counts, stream.channels[0])[1, 1] == pytest.approx(1.144, abs=1e-15)
    assert find_channel(parse_ident(ident_document()), "other") is None


def test_millimetres_at_the_border():
    channel = Channel("lvdt", "V", 1e-6, "mm", (1.0, 30.0))
    assert extension(np.array([1_000_000]), channel)[0] == pytest.approx(0.031, abs=1e-17)


@pytest.mark.parametrize(
    "channel", [Channel("x", "V", 1.0), Channel("x", "V", 1.0, "inch", (0.0, 1.0)), Channel("x", "V", 1.0, "m")]
)
def test_no_calibration_is_said(channel):
    with pytest.raises(SessionError, match="no calibration to metres"):
        extension(np.array([1]), channel)


def test_rails():
    counts = np.array([RAIL_LOW, RAIL_LOW + 1, 0, RAIL_HIGH - 1, RAIL_HIGH])
    assert railed(counts).tolist() == [True, False, False, False, True]
    assert (RAIL_LOW, RAIL_HIGH) == (-8_388_608, 8_388_607)


def test_length_and_travel_of_a_bar():
    bar = BallBar("b", 0.46, 1.01, 0.075, 1e-4)
    assert bar_length(np.array([0.02]), bar)[0] == pytest.approx(0.4802, abs=1e-15)
    assert out_of_travel(np.array([-0.0376, -0.0374, 0.0374, 0.0376]), bar).tolist() == [True, False, False, True]


@pytest.mark.parametrize("text", ["", "[]", "{", "[" * 100_000, '{"streams": []}'])
def test_metadata_that_are_no_ident(text):
    with pytest.raises(SessionError):
        parse_ident_json(text)
