"""CRC and survey of the converter's driver on manually filled rings; runs on CPython and on MicroPython.

micropython check_ads131m04.py ROOT VECTORS      prints one line per failure, then "N vectors, M failed"; exit 1 on
failure
"""

import json
import sys
from array import array

sys.path.insert(0, sys.argv[1] + "/protocol")
sys.path.insert(0, sys.argv[1] + "/firmware")
from drivers import ads131m04, ads131m04_survey
from truearm_wire.messages import COUNTER

OSR = 4096
PERIOD_US = 983.04


def frame(status, channels):
    """Return six words as the state machine pushes them."""
    words = [status << 8] + [value & 0xFFFFFF for value in channels]
    data = bytearray()
    for word in words:
        data += bytes([word >> 16, word >> 8 & 255, word & 255])
    words.append(ads131m04.crc16(data, 0, 15) << 8)
    return words


class Rings:
    """What the DMA channels would have written by the end of conversion `latest`."""

    def __init__(self, first=1, start_us=1000):
        self.ring = array("I", bytes(ads131m04_survey.FRAMES))
        self.stamps = array("I", bytes(4 * ads131m04_survey.STAMPS))
        self.timer = array("I", [0])
        self.s = array("I", bytes(4 * ads131m04_survey.SURVEY))
        self.s[ads131m04_survey.READ] = first
        self.s[ads131m04_survey.FIRST] = 1
        self.s[ads131m04_survey.OSR6] = 6 * OSR
        self.s[ads131m04_survey.SHORTEST] = OSR * 6 // 25 - 1
        self.s[ads131m04_survey.LONGEST] = OSR * 6 // 25 + 2
        self.s[ads131m04_survey.SILENCE] = 50000
        self.s[ads131m04_survey.ALIVE] = start_us & COUNTER
        self.start_us = start_us
        self.first = first
        self.number = first
        self.late_us = 0

    def convert(self, n=1, status=0x010F, broken=False, delay_us=0):
        for _ in range(n):
            self.late_us += delay_us
            words = frame(status, [self.number, -self.number, 8388607, -8388608])
            if broken:
                words[2] ^= 1
            for i in range(6):
                self.ring[(self.number * 6 + i) % (ads131m04_survey.FRAMES // 4)] = words[i]
            us = self.start_us + int((self.number - self.first + 1) * PERIOD_US) + self.late_us
            self.stamps[self.number % ads131m04_survey.STAMPS] = us & 0xFFFFFFFF
            self.timer[0] = us & 0xFFFFFFFF
            self.number += 1
            self.s[ads131m04_survey.LATEST] = self.number & 0xFFFFFFFF
        return self

    def look(self, want=64):
        return ads131m04_survey.survey(self.s, self.ring, self.stamps, self.timer, ads131m04.TABLE, want)

    def unload(self, n):
        """Return (numbers of the samples, stamp), or None if the ring was lapped."""
        dst = bytearray(16 * n + 3)
        stamp = bytearray(4)
        if not ads131m04_survey.unload(self.s, self.ring, self.stamps, n, dst, 3, stamp):
            return None
        values = array("i", bytes(dst[3:]))
        for k in range(n):
            number, minus, top, bottom = values[4 * k : 4 * k + 4]
            if (minus, top, bottom) != (-number, 8388607, -8388608):
                return list(values)
        return [values[4 * k] for k in range(n)], int.from_bytes(stamp, "big")


failures = []


def expect(what, got, wanted):
    if got != wanted:
        failures.append("%s: %s, not %s" % (what, got, wanted))


def check_survey():
    literals = (
        ads131m04_survey.HOLDS,
        ads131m04_survey.FAR,
        ads131m04_survey.FRAMES // 4 - 1,
        ads131m04_survey.STAMPS - 1,
        COUNTER,
    )
    expect("the numbers that survey and unload spell out", literals, (681, 640, 4095, 1023, 0x3FFFFFFF))
    rings = Rings().convert(20)
    expect("whole frames", rings.look(), 20)
    expect("no more than asked", Rings().convert(20).look(13), 13)
    expect("samples", rings.unload(13), (list(range(1, 14)), 1983))
    expect("the rest", (rings.look(), rings.unload(7)), (7, (list(range(14, 21)), 14762)))

    rings = Rings().convert(5).convert(2, broken=True).convert(5)
    expect(
        "before a wrong CRC",
        (rings.look(), rings.s[ads131m04_survey.BROKEN], rings.s[ads131m04_survey.CRC_ERRORS]),
        (5, 1, 0),
    )
    rings.unload(5)
    rings.s[ads131m04_survey.BROKEN] = 0
    expect("after it", (rings.look(), rings.s[ads131m04_survey.JUMP], rings.s[ads131m04_survey.CRC_ERRORS]), (5, 2, 2))

    for status in (0x050F, 0x210F, 0x000F, 0x090F):
        rings = Rings().convert(1, status=status)
        expect("status %04x" % status, (rings.look(), rings.s[ads131m04_survey.LOST_CONVERTER]), (0, 1))
    rings = Rings().convert(1, status=0x0107).convert(1, status=0x410F)
    expect("data not new; resynchronised", (rings.look(), rings.s[ads131m04_survey.CRC_ERRORS]), (1, 1))

    rings = Rings().convert(3).convert(1, delay_us=3 * 983).convert(3)
    expect("a late edge ends the row", (rings.look(), rings.s[ads131m04_survey.BROKEN]), (3, 1))
    rings.unload(3)
    rings.s[ads131m04_survey.BROKEN] = 0
    expect("and three are missing", (rings.look(), rings.s[ads131m04_survey.JUMP]), (4, 3))
    rings = Rings().convert(3).convert(1, delay_us=-900).convert(3, delay_us=0)
    rings.look()
    rings.unload(3)
    rings.s[ads131m04_survey.BROKEN] = 0
    rings.look()
    expect("an edge out of turn is none", rings.s[ads131m04_survey.CRC_ERRORS], 1)


def check_wraps():
    rings = Rings(start_us=2**32 - 5000).convert(13)
    expect("the timer wraps", (rings.look(), rings.unload(13)), (13, (list(range(1, 14)), 2**32 - 5000 + 983)))
    first = 2**30 - 3  # number and stamps as the survey keeps them
    rings = Rings(first=first, start_us=2**30 - 5000)
    expect("numbers wrap at 2^30", wrapped(rings), 13)


def wrapped(rings):
    # values of the frames are 24 bit here, so only the survey looks at them
    for k in range(13):
        number = rings.first + k
        words = frame(0x010F, [k, -k, 0, 0])
        for i in range(6):
            rings.ring[(number * 6 + i) % (ads131m04_survey.FRAMES // 4)] = words[i]
        rings.stamps[number % ads131m04_survey.STAMPS] = rings.start_us + int((k + 1) * PERIOD_US)
        rings.timer[0] = rings.stamps[number % ads131m04_survey.STAMPS]
    rings.s[ads131m04_survey.LATEST] = rings.first + 13
    return rings.look()


def check_lap():
    rings = Rings().convert(3)
    rings.look()
    rings.unload(3)
    rings.convert(2000)
    expect("half a ring is left", rings.look(400), 340)
    expect("the jump tells how many", rings.s[ads131m04_survey.JUMP], 2000 - 340)
    rings = Rings().convert(20)
    rings.look()
    rings.convert(681)
    expect("lapped while it was read", rings.unload(13), None)


def check_silence():
    rings = Rings().convert(5)
    rings.timer[0] += 50001
    expect(
        "what is there comes first",
        (rings.look(), rings.s[ads131m04_survey.BROKEN], rings.s[ads131m04_survey.LOST_CONVERTER]),
        (5, 1, 0),
    )
    rings.unload(5)
    rings.s[ads131m04_survey.BROKEN] = 0
    expect("then it is lost", (rings.look(), rings.s[ads131m04_survey.LOST_CONVERTER]), (0, 1))


class Bus:
    """Stores what is sent; answers each frame with the next of `answers`, then with NULL's of a waiting converter."""

    def __init__(self, answers):
        self.answers = answers
        self.sent = []

    def write_readinto(self, out, into):
        self.sent.append(bytes(out))
        word = self.answers.pop(0) if self.answers else 0x0100
        data = bytes([word >> 8, word & 255]) + bytes(13)
        crc = ads131m04.crc16(data, 0, 15)
        for i, byte in enumerate(data + bytes([crc >> 8, crc & 255, 0])):
            into[i] = byte

    def on(self):
        pass

    off = on


def check_commands():
    """Check command words that worked on a real ADS131M02: TI E2E forum, thread 1075315 (CLOCK, response 4180)."""
    bus = Bus([0, 0x030E, 0, 0x4180, 0x030A])
    registers = ads131m04.Registers(bus, bus, bus, None)
    expect("read", registers.read(ads131m04.CLOCK), 0x030E)
    expect("written", registers.write(ads131m04.CLOCK, 0x030A), True)
    wanted = [b"\xa1\x80", b"\0\0", b"\x61\x80\0\x03\x0a", b"\xa1\x80", b"\0\0"]
    expect("commands", bus.sent, [word + bytes(18 - len(word)) for word in wanted])
    expect("a gain word", ads131m04.gain_word((1, 2, 16, 128)), 0x7410)


if __name__ == "__main__":
    with open(sys.argv[2]) as f:
        vectors = json.load(f)
    for vector in vectors:
        text = vector["hex"]
        data = bytes([int(text[i : i + 2], 16) for i in range(0, len(text), 2)])
        expect(vector["source"], ads131m04.crc16(data, 0, len(data)), vector["crc"])
    check_commands()
    check_survey()
    check_wraps()
    check_lap()
    check_silence()
    for line in failures:
        print("FAILED " + line)
    print("%d vectors, %d failed on %s" % (len(vectors), len(failures), sys.implementation.name))
    sys.exit(1 if failures else 0)
