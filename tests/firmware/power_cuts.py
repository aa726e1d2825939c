"""Power failures while the box stores a configuration: on a littlefs in MicroPython, at every kind of flash operation.

    micropython power_cuts.py CUTS SEED        prints its findings; exit 1 if ever neither the old nor the new one was there

The flash is a small version of a Pico's: blocks of 4096 bytes that are erased as a whole, pages of 256. A cut
interrupts the current operation: a page is written in part, a block is erased in part. Each save continues from the
state that the last cut left.
"""

import os
import sys

from truearm_box import config, storage

BLOCK = 4096
BLOCKS = 24
PATH = "/flash/config.json"


EIO = -5  # returned by a dead flash


class Flash:
    """A block device over a buffer; after `left` more operations the power fails."""

    def __init__(self, buf):
        self.buf = buf
        self.left = -1  # never
        self.dead = False
        self.operations = 0
        self.tear = 0

    def readblocks(self, block, out, offset=0):
        if self.dead:
            return EIO
        at = block * BLOCK + offset
        out[:] = self.buf[at : at + len(out)]
        return 0

    def writeblocks(self, block, data, offset=0):
        if self.dead:
            return EIO
        at = block * BLOCK + offset
        for i in range(self._operation(len(data))):
            self.buf[at + i] &= data[i]  # as NOR flash: bits can only be cleared
        return EIO if self.dead else 0

    def ioctl(self, op, argument):
        if op == 4:
            return BLOCKS
        if op == 5:
            return BLOCK
        if op == 6 and not self.dead:
            n = self._operation(BLOCK)
            at = argument * BLOCK
            self.buf[at : at + n] = b"\xff" * n
        return EIO if self.dead else 0

    def _operation(self, size):
        """Return how many bytes of an operation are completed."""
        self.operations += 1
        if self.left == 0:
            self.dead = True
            return self.tear * size >> 8
        self.left -= 1
        return size


class Random:
    """The same numbers everywhere (Lehmer)."""

    def __init__(self, seed):
        self.state = seed

    def below(self, n):
        self.state = self.state * 48271 % 2147483647
        return self.state % n


def accept(_):
    return None


def variant(n):
    new = dict(config.DEFAULT)
    new["serial"] = n
    new["note"] = "x" * (n * 37 % 900)  # lengths from inlined to several pages
    return new


def serial():
    found, fault = storage.load(PATH, accept)
    if fault:
        raise ValueError(fault)
    return found.get("serial", 0)


def mounted(buf, make=False):
    flash = Flash(buf)
    if make:
        os.VfsLfs2.mkfs(flash, progsize=256)
    os.mount(os.VfsLfs2(flash, progsize=256), "/flash")
    return flash


def unmount():
    try:
        os.umount("/flash")
    except OSError:  # a dead flash
        return


def cuts(n, seed):
    """Return (interrupted saves, those of them with the new configuration, operations per save)."""
    random = Random(seed)
    buf = bytearray(b"\xff" * (BLOCK * BLOCKS))
    flash = mounted(buf, True)
    storage.save(PATH, variant(1), accept)
    flash.operations = 0
    storage.save(PATH, variant(2), accept)
    usual, now, cut, new_found = flash.operations, 2, 0, 0
    for k in range(n):
        flash.left = random.below(usual + 4)
        flash.tear = random.below(257)
        try:
            storage.save(PATH, variant(now + 1), accept)
            done = True
        except OSError:
            done = False
            cut += 1
        unmount()
        flash = mounted(buf)
        found = serial()
        if found not in (now, now + 1) or (done and found == now):
            raise ValueError("cut %d: %d was there, %d was stored; found %d" % (k, now, now + 1, found))
        new_found += found == now + 1 and not done
        now = found
        if now % 50 == 0:  # the traceback is stored on the same flash
            storage.keep_error("/flash/last_error.txt", "error %d" % now)
    unmount()
    return cut, new_found, usual


def full_flash():
    """Check a full flash: refused or stored, never lost; and normal operation once there is space again."""
    buf = bytearray(b"\xff" * (BLOCK * BLOCKS))
    mounted(buf, True)
    storage.save(PATH, variant(1), accept)
    with open("/flash/big", "wb") as f:
        try:
            while True:
                f.write(bytes(64))
                f.flush()
        except OSError:
            pass
    refused = 0
    for n in range(2, 12):
        expected = n
        before = serial()
        try:
            storage.save(PATH, variant(n), accept)
        except OSError:
            refused += 1
            expected = before
        if serial() != expected:
            raise ValueError("%d on flash, %d expected" % (serial(), expected))
    storage.keep_error("/flash/last_error.txt", "y" * 600)
    os.remove("/flash/big")
    storage.save(PATH, variant(50), accept)
    if serial() != 50:
        raise ValueError("there is room again, and 50 is not stored")
    unmount()
    return refused


if __name__ == "__main__":
    cut, new_found, usual = cuts(int(sys.argv[1]), int(sys.argv[2]))
    print("%d cut, %d of them with the new one, %d operations a save" % (cut, new_found, usual))
    print("%d refused by a full flash" % full_flash())
