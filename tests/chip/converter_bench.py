"""The converter's driver on the emulated chip: scripts that sample, and checks of their output against the model."""

import struct

SETTLING = 6  # conversions after a SYNC pulse that the driver discards


MAKE = """
import binascii, micropython
from drivers.ads131m04_dma import Adc
adc = Adc(machine, rp2, chip, (16, 17, 18, 19, 20, 21, 22))
block = bytearray(208)
index = bytearray(8)
stamp = bytearray(4)
kept = bytearray(24000)
used = 0
def pull():
    global used
    n = 13
    if not adc.take(n, block, 0, index, stamp):
        n = adc.waiting() if adc.broken() else 0
        if n == 0 or not adc.take(n, block, 0, index, stamp):
            return
    struct.pack_into(">BBHQ", kept, used, n, adc.fault(), adc.lost(), int.from_bytes(index, "big"))
    kept[used + 12 : used + 16] = stamp
    kept[used + 16 : used + 16 + 16 * n] = block[: 16 * n]
    used += 16 + 16 * n
def sample(osr, ms):
    global used
    used = 0
    before = adc.crc_errors, adc.resets
    adc.start(osr)
    end = time.ticks_add(time.ticks_ms(), ms)
    while time.ticks_diff(end, time.ticks_ms()) > 0:
        pull()
    adc.stop()
    print('[%d, %d, "%s"]' % (adc.crc_errors - before[0], adc.resets - before[1], binascii.hexlify(kept[:used]).decode()))
    gc.collect()
gc.collect()
"""


def counts(index: int, t_ns: float, gains=(1, 1, 1, 1)) -> tuple[int, ...]:
    """Return the signals of driver_bench.mjs, amplified and saturated."""
    raw = [((index * 4 + c) * 2654435 + (round(t_ns) % 1000003) * 7) % 8388608 - 4194304 for c in range(4)]
    return tuple(max(-(2**23), min(2**23 - 1, value * gain)) for value, gain in zip(raw, gains, strict=True))


class Blocks:
    """The output of a step's `sample`: n, flags, previous losses, index and stamp of each block, and its samples."""

    def __init__(self, step: dict):
        self.crc_errors, self.resets, text = step["out"][-1]
        self.asked = step["conversions"]
        self.blocks = []
        data = bytes.fromhex(text)
        while data:
            n, flags, lost, index, stamp = struct.unpack_from(">BBHQI", data)
            self.blocks.append((index, stamp, flags, lost, list(struct.iter_unpack("<4i", data[16 : 16 + 16 * n]))))
            data = data[16 + 16 * n :]

    @property
    def gaps(self) -> list[tuple[int, int]]:
        """Return (index after, samples missing) of each gap."""
        ends = [index + len(samples) for index, _, _, _, samples in self.blocks]
        return [
            (block[0], block[0] - end) for block, end in zip(self.blocks[1:], ends, strict=False) if block[0] != end
        ]

    def conversions(self, osr: int, gains=(1, 1, 1, 1)) -> dict[int, float]:
        """Return the time of each sample by its index, after checking values and stamps.

        Every value must be the model's, every stamp within a microsecond of the conversion.
        """
        by_value = {counts(i, t, gains): t for i, t in self.asked}
        found = {}
        for index, stamp, _, _, samples in self.blocks:
            for k, sample in enumerate(samples):
                assert sample in by_value, f"sample {index + k} is not a conversion of the model"
                t_ns = by_value[sample]
                late_ns = (stamp - t_ns // 1000 + 2**31) % 2**32 - 2**31 + k * osr * 0.24
                late_ns = late_ns * 1000 - t_ns % 1000
                # the timer's current microsecond when DMA reads it, at most 0.3 us after the conversion
                assert -1000 < late_ns <= 300
                found[index + k] = t_ns
        return found

    def assert_honest(self, osr: int, conversions: dict[int, float]) -> None:
        """Check that losses add up to the gaps, and that an index gives the time to half a period."""
        assert sum(block[3] for block in self.blocks) == sum(n for _, n in self.gaps)
        start = conversions[0]
        for index, t_ns in conversions.items():
            assert abs(t_ns - start - index * osr * 240) <= osr * 120
