"""Clock exchanges on the chip: the image's C module stamps a request in the USB interrupt and an answer just before the FIFO."""

import numpy as np

from tests.chip.conftest import MS
from tests.wire_frames import command
from truearm.session.clock import fit_clock
from truearm_wire.messages import CONFIGURE, START, SYNC_REPLY, SYNC_REQUEST

LOOK_US = 20  # how often the host looks for bytes
BOUND_US = 100


def exchange(chip, number, pieces):
    """Return (t0, t1, t2, t3) [µs] of one request, sent in ``pieces`` with waits [µs] between them."""
    t0 = chip.now_us
    found = []
    for piece, wait_us in pieces:
        found += chip.hear(wait_us, rx=piece)
    while chip.now_us < t0 + 80 * MS:
        for reply in found:
            if isinstance(reply, list) and reply[0] == SYNC_REPLY and reply[2] == number:
                return t0, reply[3], reply[4], chip.now_us
        found = chip.hear(LOOK_US)
    raise AssertionError("no answer")


def exchanged(chip, rng):
    """Twenty-five exchanges at random times: (25, 4) µs, how late t1 is after each request and how long t2 is before the answer's end."""
    exchanges = []
    for k in range(25):
        chip.hear(int(rng.integers(3, 16)) * MS + int(rng.integers(1000)))
        exchanges.append(exchange(chip, 100 + k, [(command(SYNC_REQUEST, 100 + k), LOOK_US)]))
    t = np.array(exchanges)
    assert np.all(np.diff(t, axis=1) >= 0)
    late, left = t[:, 1] - t[:, 0], t[:, 3] - t[:, 2]
    print(f"t1 {late.min()} to {late.max()} µs after the request, t2 {left.min()} to {left.max()} µs before its end")
    return t, late, left


def bounded(t):
    """Return the largest bound [µs] of the clock that the exchanges give; the error is within it at all times."""
    fitted = fit_clock(0, t * np.array([1000, 1, 1, 1000]))
    assert fitted is not None
    clock, report = fitted
    inside = np.linspace(t[0, 1], t[-1, 1], 200).astype(np.int64)  # device and host count the same time here
    host_ns, bound_ns = clock.to_host_ns(inside)
    assert np.all(np.abs(host_ns - 1000 * inside) <= bound_ns)
    print(f"bound {report.bound_ns / 1000:.1f} µs")
    return report.bound_ns / 1000


def test_exchanges_bound_the_clock_while_both_sources_stream(power_on):
    """Twenty-five exchanges, as many as come in 6 s. The emulator's USB takes 53 µs a packet and way, which no stamp can see."""
    chip = power_on()
    chip.boot()
    chip.ask(CONFIGURE, 1, 983_040)
    chip.ask(START)
    rng = np.random.default_rng(1)
    t, late, left = exchanged(chip, rng)
    assert late.max() < 53 + 50  # every one, not the quickest: the interrupt waits for nothing
    assert left.max() < 53 + 60 + LOOK_US
    assert bounded(t) <= BOUND_US


def test_no_request_is_stamped_before_it_came(power_on):
    """In pieces, behind other requests in one packet, behind rubbish, and while the box sends: t1 is never too early.

    Each frame is handed over when it is sent, not at the end of a long grant.
    """
    chip = power_on(prompt=True)
    chip.boot()
    chip.ask(START)
    rng = np.random.default_rng(2)
    for k in range(25):
        chip.hear(int(rng.integers(0, 9)) * MS + int(rng.integers(1000)))
        request = command(SYNC_REQUEST, 300 + k)
        if k % 3 == 0:
            chip.hear(int(rng.integers(0, 700)), rx=b"\0rubbish\0")
        elif k % 3 == 1:
            chip.hear(int(rng.integers(0, 700)), rx=command(SYNC_REQUEST, 900 + k))
        cut = int(rng.integers(1, len(request)))
        pieces = [(request[:cut], int(rng.integers(0, 400))), (request[cut:], LOOK_US)]
        t0, t1, t2, t3 = exchange(chip, 300 + k, pieces)
        assert t0 <= t1 <= t2 <= t3
    chip.hear(100 * MS)
    assert len(chip.transfers) > 5
    assert all(transfer.endswith(b"\0") for transfer in chip.transfers)
