"""Whatever comes over the link: each frame has an answer or is counted as bad, and the box samples on.

What is expected of a run of bytes is decided here by the specification (SPEC §1, §6), run by run.
"""

import random

import cbor2
import pytest

from tests.firmware.conftest import PERIOD_NS, Bench, real_micropython, records, shots
from tests.wire_frames import command
from truearm_wire import cbor, frame, messages
from truearm_wire.messages import DATA, ERROR, EVENT, HEARTBEAT, IDENT, REPLY, SYNC_REPLY

COMMANDS = range(messages.IDENTIFY, messages.REPLY)
LEAVING = (messages.TO_REPL, messages.RESET)


def some_value(rng, depth=0):
    kind = rng.randrange(8 if depth < 3 else 5)
    if kind < 2:
        return rng.choice([0, 1, 2, 8, 31, 255, 4096, 983_040, 2**30 - 1, 2**30, 2**53, 2**64 - 1, -1, -(2**31)])
    if kind == 2:
        return rng.randbytes(rng.randrange(40))
    if kind == 3:
        return "é\0x"[: rng.randrange(4)] * rng.randrange(9)
    if kind == 4:
        return rng.randrange(100)
    if kind < 7:
        return [some_value(rng, depth + 1) for _ in range(rng.randrange(4))]
    return {str(i): some_value(rng, depth + 1) for i in range(rng.randrange(3))}


def some_command(rng, config_pages):
    kind = rng.choice([*COMMANDS, *range(messages.IDENTIFY, messages.PULSE + 1), messages.SYNC_REQUEST, 0, 64, 200])
    if kind == messages.PUT_CONFIG and rng.random() < 0.5:
        page, count, data = rng.choice(config_pages)
        data = bytearray(data)
        if rng.random() < 0.7:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        return [kind, rng.randrange(1, 2**20), page, count, bytes(data)]
    number = rng.randrange(1, 2**20) if rng.random() < 0.8 else some_value(rng)
    return [kind, number, *(some_value(rng) for _ in range(rng.randrange(5)))]


def some_run(rng, config_pages):
    """Return bytes as a stranger or a bad line might send them."""
    kind = rng.randrange(10)
    if kind == 0:
        return rng.randbytes(rng.randrange(1, 400))
    if kind == 1:
        return bytes(rng.choice(b"\0\x01\x05\xff") for _ in range(rng.randrange(1, 300)))
    if kind == 2:  # a good checksum over anything
        return frame.frame(rng.randbytes(rng.randrange(1, frame.PAYLOAD_MAX + 1)))
    payload = cbor.encode(some_command(rng, config_pages))[: frame.PAYLOAD_MAX]
    data = bytearray(frame.frame(payload))
    if kind == 3:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    if kind == 4:
        del data[rng.randrange(len(data))]
    if kind == 5:
        data[len(data) // 2 : len(data) // 2] = rng.randbytes(rng.randrange(1, 200))
    return bytes(data)


def asked(run):
    """Type and id of a run that must be answered, None for one that must be counted as bad."""
    payload = frame.unframe(run) if len(run) <= 255 else None
    try:
        values = cbor.decode(payload) if payload else None
    except cbor.CborError:
        return None
    if not isinstance(values, list) or len(values) < 2 or not all(isinstance(v, int) for v in values[:2]):
        return None
    kind, number = values[:2]
    if not 0 <= number < 2**30 or not (kind == messages.SYNC_REQUEST or (kind in COMMANDS and number > 0)):
        return None
    return kind, number


class Fuzzed(Bench):
    """A box that samples on its own once it was started."""

    starts = 0

    def feed(self, rx):
        if self.answer.starts != self.starts:
            self.starts, self.index, self.t_start_us = self.answer.starts, 0, self.now_us
        grant = {}
        if self.answer.sampling:
            index, self.index = self.index, self.index + 13
            grant = {"samples": records(index, 13, self.t_start_us), "index": index}
            if self.answer.mag_sampling:
                grant.update(mag=shots(index, 13, self.t_start_us), mag_index=index)
            self.now_us = self.t_start_us + self.index * PERIOD_NS // 1000
        return self.give(us=0 if grant else 1000, rx=rx, **grant)


def fuzz(box, n, seed):
    rng = random.Random(seed)
    box.give()
    config_pages = messages.pages(cbor2.dumps(box.document(messages.GET_CONFIG)))
    bad, answered, known = 0, 0, {DATA, EVENT, HEARTBEAT, IDENT, SYNC_REPLY, REPLY, ERROR}
    last_seq = box.give(rx=command(32, 1))[0][1]
    for _ in range(n):
        run = some_run(rng, config_pages)
        if any(found and found[0] in LEAVING for found in map(asked, run.split(b"\0"))):
            continue  # it would obey
        found = box.feed(run + b"\0")
        assert box.answer.end == "", run
        wanted = [asked(part) for part in run.split(b"\0") if part]
        bad += wanted.count(None)
        assert all(isinstance(f, list) and f[0] in known for f in found)
        for f in found:
            assert f[1] == (last_seq + 1) % 2**32
            last_seq = f[1]
        for kind, number in filter(None, wanted):
            kinds = (SYNC_REPLY,) if kind == messages.SYNC_REQUEST else (REPLY, ERROR, IDENT)
            assert any(f[0] in kinds and f[2] == number for f in found), (run, found)
            answered += 1
    return bad, answered


def check(n, seed):
    box = Fuzzed(real_micropython())
    try:
        box.give()
        bad, answered = fuzz(box, n, seed)
        box.give(rx=command(51, 2**29))
        assert box.give(rx=command(49, 2**29 + 1, 0, 4096))[0][0] == REPLY
        (beat,) = [f for f in box.give(us=2_000_000) if f[0] == HEARTBEAT]
        assert beat[8] == bad > n // 10
        assert answered > n // 4
        assert beat[7] == 0, "no sample was lost on the way"
        assert box.give(rx=command(50, 2**29 + 2))[0][0] == REPLY
        box.t_start_us, box.index = box.now_us, 0
        blocks = [f for _ in range(8) for f in box.sample(13) if f[0] == DATA]
        assert [f[3] for f in blocks] == [13 * k for k in range(8)]
    finally:
        box.box.close()


def test_thousands_of_runs_of_anything():
    check(4_000, 11)


@pytest.mark.soak
def test_a_hundred_thousand_runs_of_anything():
    check(100_000, 12)
