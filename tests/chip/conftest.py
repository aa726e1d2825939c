"""The box at chip level: MicroPython's RP2040 image with the firmware, in the emulator, as built by `make test`."""

import cbor2
import numpy as np
import pytest

from tests.wire_frames import command, frames
from truearm_sim.box import POWER, BoxSetup
from truearm_sim.chip import ANY_ROOM, ChipBox
from truearm_sim.hardware import Boot
from truearm_wire import messages
from truearm_wire.messages import GET_CONFIG, IDENT, PUT_CONFIG, REPLY

READY_S = 3.2  # the boot window of 2 s, the self-test, the first ident
MS = 1000  # µs


class Counting:
    """Signals whose values are the sample's number."""

    def counts(self, k0, k1, start_ns, period_ns):
        k = np.arange(k0, k1, dtype=np.int64)[:, None]
        return ((k * 4 + np.arange(4)) % 2**22).astype(np.int32)

    def flight_times(self, k0, k1, start_ns, period_ns):
        return 100_000_000 + 8_000 * np.arange(k0, k1, dtype=np.int64)  # one tick more per shot

    def thermometers(self, device_us):
        return ()


class Chip:
    """A box that was switched on, with short calls to talk to it. Its flash is a folder and allows restarts."""

    def __init__(self, folder, cause=POWER, config=None, start_us=0, signals=None, prompt=False):
        boot = Boot(folder, BoxSetup(config=config), 0x12345678, cause, signals or Counting())
        self.hardware = ChipBox(boot, start_us=start_us, prompt=prompt)
        self.now_us = start_us
        self.end = ""
        self.req_id = 0
        self.rest = b""  # of an incomplete frame
        self.toggles = 0  # of the trigger output
        self.transfers = []  # what it sent latest, as it was handed over

    def give(self, us, rx=b"", edges=(), room=ANY_ROOM, flags=0):
        """Write `rx` now and let the box run; return the bytes it sent. `end` is how it ended, if it did."""
        answers = list(self.hardware.advance(self.now_us, rx, edges, room, 0, 24_500))
        self.now_us += us
        answers += self.hardware.advance(self.now_us, b"", (), room, flags, 24_500)
        self.end, self.sampling = answers[-1].end, answers[-1].sampling
        self.toggles += sum(len(answer.toggles) for answer in answers)
        self.transfers = [answer.tx for answer in answers if answer.tx]
        return b"".join(self.transfers)

    def hear(self, us, **grant):
        """Let it run; return the complete frames received."""
        whole, zero, self.rest = (self.rest + self.give(us, **grant)).rpartition(b"\0")
        return frames(whole + zero)

    def boot(self):
        """Let it boot; return what it sent."""
        return self.hear(int(READY_S * 1e6))

    def ask(self, *values, ms=100):
        """Give a command; return the frames received within `ms`."""
        self.req_id += 1
        return self.hear(ms * MS, rx=command(values[0], self.req_id, *values[1:]))

    def config(self):
        return cbor2.loads(document(self.ask(GET_CONFIG), REPLY))

    def put_config(self, config, ms=400):
        """Put all pages; return the frames that answer the last one."""
        parts = messages.pages(cbor2.dumps(config))
        for page, pages, data in parts[:-1]:
            assert self.ask(PUT_CONFIG, page, pages, data)[-1][0] == REPLY
        return self.ask(PUT_CONFIG, *parts[-1], ms=ms)

    def close(self):
        self.hardware.close()


def document(found: list[list], kind: int) -> bytes:
    """Return the joined pages of an ident or reply."""
    return b"".join(f[5] for f in found if isinstance(f, list) and f[0] == kind)


def ident(found: list[list]) -> dict:
    return cbor2.loads(document(found, IDENT))


@pytest.fixture
def power_on(tmp_path):
    """Return a function that switches on boxes with one flash in turn; each ends when the next is switched on."""
    switched_on = []

    def switch_on(**options):
        for chip in switched_on:
            chip.close()
        switched_on.append(Chip(tmp_path, **options))
        return switched_on[-1]

    yield switch_on
    for chip in switched_on:
        chip.close()
