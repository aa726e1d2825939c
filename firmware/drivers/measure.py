"""The self-test's measurements of converter and magnetostrictive head, with the sampling sources. May take a second."""

from array import array

OSR = 4096
BLOCK = 8
BLOCKS = 12  # of 8 samples: 96 samples, 0.1 s
SHOTS = 16
PERIOD_NS = 2000000
WAIT_MS = 300  # longest wait for a block
NV_PER_COUNT_NUM, NV_PER_COUNT_DEN = 1200000000, 1 << 23  # 1.2 V / 2^23


def converter(adc, channels, sleep_ms, feed):
    """Return converter_id, excitation [uV], noise_0 … noise_3 [nV RMS]; what cannot be measured is omitted.

    The excitation is that of the channel by which another is divided; a box without such a channel has no LVDT to test.
    """
    found = {"converter_id": max(0, adc.registers.read(0))}
    samples = _run(adc, True, sleep_ms, feed)
    if samples:
        for channel in range(4):
            found["noise_%d" % channel] = _spread(samples[channel]) * NV_PER_COUNT_NUM // NV_PER_COUNT_DEN
    names = [channel["name"] for channel in channels]
    drives = [channel["over"] for channel in channels if channel.get("over") in names]
    samples = _run(adc, False, sleep_ms, feed) if drives else None
    if samples:
        values = samples[names.index(drives[0])]
        found["excitation"] = sum(values) // len(values) * (NV_PER_COUNT_NUM // 1000) // NV_PER_COUNT_DEN
    return found


def stops(mag, sleep_ms, feed):
    """Return how many of 16 interrogations were answered."""
    block = bytearray(4 * SHOTS)
    mag.start(PERIOD_NS)
    came = _take(mag, SHOTS, block, sleep_ms, feed)
    mag.stop()
    if not came:
        return 0
    return sum([1 for i in range(SHOTS) if block[4 * i : 4 * i + 4] != b"\0\0\0\0"])


def _run(adc, shorted, sleep_ms, feed):
    """Return samples of the four channels at gain 1, or None if none arrived."""
    gain_word = adc.registers.gain_word
    adc.registers.gain_word = 0
    adc.registers.shorted = shorted
    block = bytearray(16 * BLOCK)
    samples = ([], [], [], [])
    adc.start(OSR)
    for _ in range(BLOCKS):
        if not _take(adc, BLOCK, block, sleep_ms, feed):
            samples = None
            break
        for i, value in enumerate(array("i", block)):
            samples[i & 3].append(value)
    adc.stop()
    adc.registers.shorted = False
    adc.registers.gain_word = gain_word
    return samples


def _take(source, n, block, sleep_ms, feed):
    index = bytearray(8)
    stamp = bytearray(4)
    for _ in range(WAIT_MS):
        if source.take(n, block, 0, index, stamp):
            return True
        feed()
        sleep_ms(1)
    return False


def _spread(values):
    """Return the RMS deviation from the mean, rounded down, in integers."""
    mean = sum(values) // len(values)
    square = sum([(value - mean) * (value - mean) for value in values]) // len(values)
    root = 0
    bit = 1 << 30
    while bit:
        if (root + bit) * (root + bit) <= square:
            root += bit
        bit >>= 1
    return root
