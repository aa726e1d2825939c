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

from truearm_wire.fast import micropython, ptr8, ptr16, ptr32

RECORD = 24  # bytes of a frame in the ring: six words, the 24 bits in the lower three bytes
FRAMES = 1 << 14  # bytes of the ring
STAMPS = 1 << 10  # stamps, more than frames fit
HOLDS = FRAMES // RECORD - 1  # conversions before LATEST that are complete
FAR = HOLDS - 41  # a reader that lags by more skips half a ring: 32.55 kHz continues for 1.2 ms while `survey` runs

# words of the survey; counts and times modulo 2^30, to be small integers on the chip
LATEST = 0  # number of the newest conversion, from 1 on, written by DMA: all before it are complete in the ring
READ = 1  # number of the oldest frame not handed out
SEEN = 2  # good, consecutive frames from READ on
BROKEN = 3  # 1: followed by a frame that is not consecutive
STAMP = 4  # time of the last sample handed out
FIRST = 5  # 1: none yet
JUMP = 6  # periods without a sample before the one at READ
LOST_CONVERTER = 7  # 1: it must be configured again
EVENTS = 8  # frames dropped since FLAG_CONVERTER was last read, including those of a converter that was reset
CRC_ERRORS = 9
OSR6 = 10  # 25 periods in µs: a period is 0.24 µs · oversampling
SHORTEST = 11  # interval of stamps, µs: a period less the fraction and 1 µs of lateness of the previous one
LONGEST = 12
SILENCE = 13  # µs without a sample before the converter is configured again
ALIVE = 14  # time of the last good conversion, or of the last attempt to get one
SURVEY = 15


@micropython.viper
def survey(s: ptr32, ring: ptr32, stamps: ptr32, timer: ptr32, table: ptr16, want: int) -> int:
    """Examine frames until `want` consecutive good ones are known. Returns how many are.

    Stops at LOST_CONVERTER. 31 µs and 10 µs per frame on the emulated chip; `take` of 13 needs 0.4 ms in total.
    """
    latest = s[0] & 0x3FFFFFFF
    if (latest - s[1]) & 0x3FFFFFFF > 640 and (latest - s[1]) & 0x20000000 == 0:
        s[1] = (latest - 340) & 0x3FFFFFFF
        s[2] = 0
        s[3] = 0
    while s[2] < want and s[3] == 0 and s[7] == 0:
        number = (s[1] + s[2]) & 0x3FFFFFFF
        ahead = (latest - number) & 0x3FFFFFFF
        if ahead == 0 or ahead & 0x20000000:
            break
        at = number * 6 & 4095
        crc = 0xFFFF
        i = 0
        while i < 5:
            word = ring[at]
            crc = (crc << 8 & 0xFF00) ^ table[crc >> 8 ^ (word >> 16 & 255)]
            crc = (crc << 8 & 0xFF00) ^ table[crc >> 8 ^ (word >> 8 & 255)]
            crc = (crc << 8 & 0xFF00) ^ table[crc >> 8 ^ (word & 255)]
            at = (at + 1) & 4095
            i += 1
        status = ring[number * 6 & 4095] >> 8 & 0xFFFF
        worth = 0
        if crc != ring[at] >> 8 & 0xFFFF:
            worth = 1
        elif status & 0xBF00 != 0x0100:
            worth = 2
        elif status & 15 != 15:
            worth = 3
        stamp = stamps[number & 1023] & 0x3FFFFFFF
        jump = 0
        if worth == 0 and s[2]:
            interval = (stamp - stamps[(number - 1) & 1023]) & 0x3FFFFFFF
            if interval < s[11] or interval > s[12]:
                jump = 1
        elif worth == 0 and s[5] == 0:
            interval = (stamp - s[4]) & 0x3FFFFFFF
            jump = interval // s[10] * 25 + (interval % s[10] * 25 + s[10] // 2) // s[10] - 1
            if jump < 0:
                worth = 3
        if s[2]:
            if worth or jump:
                s[3] = 1
            else:
                s[2] = s[2] + 1
        elif worth:
            s[1] = (number + 1) & 0x3FFFFFFF
            s[8] = (s[8] + 1) & 0x3FFFFFFF
            if worth == 2:
                s[7] = 1
            else:
                s[9] = (s[9] + 1) & 0x3FFFFFFF
        else:
            s[6] = jump
            s[2] = 1
        if worth == 0:
            s[14] = stamp
    if s[2] < want and (timer[0] - s[14]) & 0x3FFFFFFF > s[13]:
        if s[2]:
            s[3] = 1
        else:
            s[7] = 1
    return s[2]


@micropython.viper
def unload(s: ptr32, ring: ptr32, stamps: ptr32, n: int, dst: ptr8, at: int, stamp: ptr8) -> int:
    """Move n frames from READ on to dst[at:], the time of the first to stamp. Returns 0 if the ring was lapped."""
    first = stamps[s[1] & 1023]
    last = stamps[(s[1] + n - 1) & 1023]
    i = 0
    while i < n:
        k = (s[1] + i) * 6 + 1
        end = k + 4
        while k < end:
            word = ring[k & 4095]
            dst[at] = word & 255
            dst[at + 1] = word >> 8 & 255
            dst[at + 2] = word >> 16 & 255
            dst[at + 3] = 255 if word & 0x800000 else 0
            at += 4
            k += 1
        i += 1
    if (s[0] - s[1]) & 0x3FFFFFFF > 681:
        return 0
    stamp[0] = first >> 24 & 255
    stamp[1] = first >> 16 & 255
    stamp[2] = first >> 8 & 255
    stamp[3] = first & 255
    s[1] = (s[1] + n) & 0x3FFFFFFF
    s[2] = s[2] - n
    s[4] = last & 0x3FFFFFFF
    s[5] = 0
    s[6] = 0
    return 1


@micropython.viper
def number_now(s: ptr32) -> int:
    """Return the number of the newest conversion."""
    return s[0] & 0x3FFFFFFF
