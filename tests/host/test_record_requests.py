"""Request ids: unique, in the wire's range, and without a Ctrl-C byte in the frame at any time."""

from types import SimpleNamespace

import pytest

from truearm.record.requests import CTRL_C, Requests
from truearm_wire.frame import unframe
from truearm_wire.messages import CONFIGURE, IDENTIFY, PUT_CONFIG, RESET, START, SYNC_REQUEST, decode_payload


def at(now_ns):
    return Requests(None, SimpleNamespace(now_ns=lambda: now_ns), None)


@pytest.mark.parametrize("hours", [0, 1e-3, 200.0])
@pytest.mark.parametrize(("kind", "arguments"), [(IDENTIFY, ()), (SYNC_REQUEST, ()), (START, ()), (RESET, (0,))])
def test_no_frame_stops_a_box_that_boots(hours, kind, arguments):
    requests = at(int(hours * 3600e9))
    made = [requests.make(kind, *arguments) for _ in range(1000)]
    assert not any(CTRL_C in data for _, data in made)
    assert len({number for number, _ in made}) == 1000
    for number, data in made:
        assert decode_payload(unframe(data.strip(b"\0"))) == [kind, number, *arguments]


@pytest.mark.parametrize(("kind", "arguments"), [(PUT_CONFIG, (0, 1, b"\x03")), (CONFIGURE, (0, 4096))])
def test_what_holds_the_byte_whatever_its_id_is_sent_all_the_same(kind, arguments):
    """A page, or two zeros three bytes apart (COBS). They follow an answer, so the box has booted."""
    number, data = at(0).make(kind, *arguments)
    assert CTRL_C in data
    assert decode_payload(unframe(data.strip(b"\0"))) == [kind, number, *arguments]
