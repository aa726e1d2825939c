"""Boxes for the tests: the firmware in a real MicroPython, and in CPython where the result must be the same."""

import struct

import cbor2
import pytest

from tests.wire_frames import command, frames
from truearm_sim import micropython
from truearm_sim.box import NO_ANSWER, THERMOMETER, BoxProcess, BoxSetup, Grant, write_flash
from truearm_wire import messages

OSR = 4096
PERIOD_NS = 983040


def records(index: int, n: int, t_start_us: int = 0) -> bytes:
    """Return n samples from `index` on whose counts identify them."""
    counts = [struct.pack("<4i", k % 2**23, -(k % 2**23), 2**23 - 1, -(2**23)) for k in range(index, index + n)]
    return stamps(index, n, t_start_us) + b"".join(counts)


def stamps(index: int, n: int, t_start_us: int) -> bytes:
    """Return the stamps of n samples from `index` on."""
    return b"".join(struct.pack(">I", (t_start_us + k * PERIOD_NS // 1000) % 2**32) for k in range(index, index + n))


def ticks(k: int) -> int:
    """Return the time of flight of shot k: 100 to 400 µs in ticks of 8 ns."""
    return 12500 + 997 * k % 37500


def shots(index: int, n: int, t_start_us: int = 0, missing: frozenset[int] = frozenset()) -> bytes:
    """Return n shots of the magnetostrictive head from `index` on."""
    flights = [struct.pack("<i", 0 if k in missing else ticks(k)) for k in range(index, index + n)]
    return stamps(index, n, t_start_us) + b"".join(flights)


class Bench:
    """A box that was booted at time 0, with short calls to talk to it."""

    def __init__(self, interpreter, flash=None, boot_id=0xDEADBEEF, thermometers=(), **setup):
        """``thermometers``: (uid, m°C) each; one with None does not answer."""
        self.box = BoxProcess(interpreter, BoxSetup(**setup), boot_id, flash=flash)
        self.thermometers = thermometers
        self.now_us = 0
        self.index = 0
        self.req_id = 1000
        self.boot = frames(self._grant().tx)

    def give(self, us=1000, **grant):
        self.now_us += us
        self.answer = self._grant(**grant)
        return frames(self.answer.tx)

    def _grant(self, **grant):
        records = [THERMOMETER.pack(uid, NO_ANSWER if mdegc is None else mdegc) for uid, mdegc in self.thermometers]
        return self.box.grant(Grant(self.now_us, thermometers=b"".join(records), **grant))

    def start(self):
        assert self.give(rx=command(49, 1, 0, OSR))[0][:1] == [64]
        assert self.give(rx=command(50, 2))[0][:1] == [64]
        self.t_start_us, self.index = self.now_us, 0

    def sample(self, n, both=False, missing=frozenset(), **grant):
        """Let n samples pass, from the converter alone or from both sources."""
        samples = records(self.index, n, self.t_start_us)
        if both:
            grant.update(mag=shots(self.index, n, self.t_start_us, missing), mag_index=self.index)
        index, self.index = self.index, self.index + n
        self.now_us = self.t_start_us + self.index * PERIOD_NS // 1000
        return self.give(us=0, samples=samples, index=index, **grant)

    def command(self, kind, *values):
        """Give a command with its own id; return the frames of its answer."""
        self.req_id += 1
        return [f for f in self.give(rx=command(kind, self.req_id, *values)) if f[0] not in (16, 18)]

    def document(self, kind):
        """Return the document that answers a command."""
        found = self.command(kind)
        assert {f[0] for f in found} == {messages.REPLY}
        return cbor2.loads(b"".join(f[5] for f in found))

    def put(self, config):
        """Put a configuration; return the frames that answer its last page."""
        pages = messages.pages(cbor2.dumps(config))
        for page, count, data in pages[:-1]:
            assert [f[0] for f in self.command(messages.PUT_CONFIG, page, count, data)] == [messages.REPLY]
        return self.command(messages.PUT_CONFIG, *pages[-1])


def real_micropython():
    interpreter = micropython.find()
    assert interpreter is not None, "no MicroPython: run make micropython"
    return interpreter


def flash_folder(path, config=None):
    """Return a folder with the box's file system, which outlives its boxes."""
    write_flash(path, config)
    return path


@pytest.fixture(params=["micropython", "cpython"])
def bench(request):
    bench = Bench(real_micropython() if request.param == "micropython" else None)
    yield bench
    bench.box.close()


@pytest.fixture
def chip():
    """Return the firmware in MicroPython, with the chip's heap."""
    bench = Bench(real_micropython())
    yield bench
    bench.box.close()


def ident_document(found: list[list]) -> dict:
    pages = [f for f in found if f[0] == messages.IDENT]
    assert [(f[3], f[4]) for f in pages] == [(i, len(pages)) for i in range(len(pages))]
    return cbor2.loads(b"".join(f[5] for f in pages))
