"""How the CPU processes the samples that ads131m04_dma.py's DMA leaves in its rings. No call allocates.

`survey` examines frames in the order of the ring, `unload` hands them out. A frame is handed out only if its CRC is
correct, STATUS shows that the converter is configured and the data are new, and DRDY came one period after the previous
one. **Any other frame is dropped**: the index jumps (the wire shows the gap), and FLAG_CONVERTER is set in the next
block. A wrong value is never handed out. Indices come from the stamps: a sample's index is that of the last one plus
the number of periods in between, so they are correct whatever was lost and why. A converter that was reset (RESET in
STATUS, other registers) or has fallen silent is configured again. A silent one has reported nothing, so the wire shows
a gap and no FLAG_CONVERTER. 5 to 30 ms are lost, and conversions are then at other times, so t0 jumps by a fraction of
a period more than n0 indicates. If the loop stops for longer than the rings hold, the number shows this and half a ring
is skipped; a stop of more than 17 minutes would not be detected correctly.
"""

from truearm_wire.fast import const, micropython, ptr8, ptr16, ptr32

RECORD = const(24)  # bytes of a frame in the ring: six words, the 24 bits in the lower three bytes
FRAMES = const(1 << 14)  # bytes of the ring
STAMPS = const(1 << 10)  # stamps, more than frames fit
HOLDS = const(FRAMES // RECORD - 1)  # conversions before LATEST that are complete
# A reader that lags by more skips half a ring: 32.55 kHz continues for 1.2 ms while `survey` runs.
FAR = const(HOLDS - 41)

_WORDS = const(RECORD // 4)
_IN_RING = const(FRAMES // 4 - 1)  # mask of the place of a word
_IN_STAMPS = const(STAMPS - 1)
_MASK = const(0x3FFFFFFF)  # of counts and times
_HALF = const(0x20000000)  # set in the difference of two counts: the first one is behind

# how a frame is examined
_GOOD = const(0)
_WRONG_CRC = const(1)
_RESET = const(2)  # the converter is not configured
_OLD = const(3)  # no new data

# words of the survey; counts and times modulo 2^30, to be small integers on the chip
LATEST = const(0)  # number of the newest conversion, from 1 on, written by DMA: all before it are complete in the ring
READ = const(1)  # number of the oldest frame not handed out
SEEN = const(2)  # good, consecutive frames from READ on
BROKEN = const(3)  # 1: followed by a frame that is not consecutive
STAMP = const(4)  # time of the last sample handed out
FIRST = const(5)  # 1: none yet
JUMP = const(6)  # periods without a sample before the one at READ
LOST_CONVERTER = const(7)  # 1: it must be configured again
EVENTS = const(8)  # frames dropped since FLAG_CONVERTER was last read, including those of a converter that was reset
CRC_ERRORS = const(9)
OSR6 = const(10)  # 25 periods in µs: a period is 0.24 µs · oversampling
SHORTEST = const(11)  # interval of stamps, µs: a period less the fraction and 1 µs of lateness of the previous one
LONGEST = const(12)
SILENCE = const(13)  # µs without a sample before the converter is configured again
ALIVE = const(14)  # time of the last good conversion, or of the last attempt to get one
SURVEY = const(15)


@micropython.viper
def survey(s: ptr32, ring: ptr32, stamps: ptr32, timer: ptr32, table: ptr16, want: int) -> int:
    """Examine frames until `want` consecutive good ones are known. Returns how many are.

    Stops at LOST_CONVERTER. 31 µs and 10 µs per frame on the emulated chip; `take` of 13 needs 0.4 ms in total.
    """
    latest = s[LATEST] & _MASK
    if (latest - s[READ]) & _MASK > FAR and (latest - s[READ]) & _HALF == 0:
        s[READ] = (latest - HOLDS // 2) & _MASK
        s[SEEN] = 0
        s[BROKEN] = 0
    while s[SEEN] < want and s[BROKEN] == 0 and s[LOST_CONVERTER] == 0:
        number = (s[READ] + s[SEEN]) & _MASK
        ahead = (latest - number) & _MASK
        if ahead == 0 or ahead & _HALF:
            break
        at = number * _WORDS & _IN_RING
        crc = 0xFFFF
        i = 0
        while i < _WORDS - 1:
            word = ring[at]
            crc = (crc << 8 & 0xFF00) ^ table[crc >> 8 ^ (word >> 16 & 255)]
            crc = (crc << 8 & 0xFF00) ^ table[crc >> 8 ^ (word >> 8 & 255)]
            crc = (crc << 8 & 0xFF00) ^ table[crc >> 8 ^ (word & 255)]
            at = (at + 1) & _IN_RING
            i += 1
        status = ring[number * _WORDS & _IN_RING] >> 8 & 0xFFFF
        worth = _GOOD
        if crc != ring[at] >> 8 & 0xFFFF:
            worth = _WRONG_CRC
        elif status & 0xBF00 != 0x0100:
            worth = _RESET
        elif status & 15 != 15:
            worth = _OLD
        stamp = stamps[number & _IN_STAMPS] & _MASK
        jump = 0
        if worth == _GOOD and s[SEEN]:
            interval = (stamp - stamps[(number - 1) & _IN_STAMPS]) & _MASK
            if interval < s[SHORTEST] or interval > s[LONGEST]:
                jump = 1
        elif worth == _GOOD and s[FIRST] == 0:
            interval = (stamp - s[STAMP]) & _MASK
            jump = interval // s[OSR6] * 25 + (interval % s[OSR6] * 25 + s[OSR6] // 2) // s[OSR6] - 1
            if jump < 0:
                worth = _OLD
        if s[SEEN]:
            if worth or jump:
                s[BROKEN] = 1
            else:
                s[SEEN] = s[SEEN] + 1
        elif worth:
            s[READ] = (number + 1) & _MASK
            s[EVENTS] = (s[EVENTS] + 1) & _MASK
            if worth == _RESET:
                s[LOST_CONVERTER] = 1
            else:
                s[CRC_ERRORS] = (s[CRC_ERRORS] + 1) & _MASK
        else:
            s[JUMP] = jump
            s[SEEN] = 1
        if worth == _GOOD:
            s[ALIVE] = stamp
    if s[SEEN] < want and (timer[0] - s[ALIVE]) & _MASK > s[SILENCE]:
        if s[SEEN]:
            s[BROKEN] = 1
        else:
            s[LOST_CONVERTER] = 1
    return s[SEEN]


@micropython.viper
def unload(s: ptr32, ring: ptr32, stamps: ptr32, n: int, dst: ptr8, at: int, stamp: ptr8) -> int:
    """Move n frames from READ on to dst[at:], the time of the first to stamp. Returns 0 if the ring was lapped."""
    first = stamps[s[READ] & _IN_STAMPS]
    last = stamps[(s[READ] + n - 1) & _IN_STAMPS]
    i = 0
    while i < n:
        k = (s[READ] + i) * _WORDS + 1
        end = k + _WORDS - 2
        while k < end:
            word = ring[k & _IN_RING]
            dst[at] = word & 255
            dst[at + 1] = word >> 8 & 255
            dst[at + 2] = word >> 16 & 255
            dst[at + 3] = 255 if word & 0x800000 else 0
            at += 4
            k += 1
        i += 1
    if (s[LATEST] - s[READ]) & _MASK > HOLDS:
        return 0
    stamp[0] = first >> 24 & 255
    stamp[1] = first >> 16 & 255
    stamp[2] = first >> 8 & 255
    stamp[3] = first & 255
    s[READ] = (s[READ] + n) & _MASK
    s[SEEN] = s[SEEN] - n
    s[STAMP] = last & _MASK
    s[FIRST] = 0
    s[JUMP] = 0
    return 1


@micropython.viper
def number_now(s: ptr32) -> int:
    """Return the number of the newest conversion."""
    return s[LATEST] & _MASK
