"""Files on the box's flash: the configuration, and the last traceback. Never used while streaming: flash stops the chip.

A configuration is written beside the one that is there, read back, and takes its place by renaming, which littlefs does at
once; the one before stays as .old. Wherever power fails, one of the two is whole, and `load` finds it:

    before the last rename   path or path.old is what was there; path.new is not looked at
    after it                 path is new
"""

import json
import os

from . import config
from .ident import ERROR_MAX, plain

# bytes of a configuration's JSON; more would not fit the heap next to the ring, several times over
SIZE_MAX = 8000
PIECE = 256  # characters that are read back at once
END = 100  # bytes in which a file has to end


def load(path, try_out):
    """(configuration, fault in words or None): of the file, else of the one before it, else the default one.

    `try_out(configuration)` raises ValueError for one that cannot be used. No file at all is not a fault.
    """
    found, fault = _read(path, try_out)
    if found:
        return found, None
    before, _ = _read(path + ".old", try_out)
    if before:
        return before, fault and fault + "; the one before it is used"
    return config.DEFAULT, fault and fault + "; the default one is used"


def _read(path, try_out):
    try:
        size = os.stat(path)[6]
        if size > SIZE_MAX:
            raise ValueError("it is longer than %d bytes" % SIZE_MAX)
        with open(path, "rb") as f:  # as a stream: a heap that holds the firmware's code may have no 8 kB in one piece
            f.seek(max(0, size - END))
            if f.read().strip()[-1:] != b"}":  # MicroPython takes a table that breaks off for a whole one
                raise ValueError("it is not a table, or is cut off")
            f.seek(0)
            found = config.check(config.completed(json.load(f)))
        try_out(found)
        return found, None
    except OSError:
        return None, None
    except ValueError as e:
        return None, "config: %s" % e
    except MemoryError:  # short, yet of too many parts
        return None, "config: it does not fit the memory"


def save(path, settings, try_out):
    """Store a configuration; raises OSError if the flash does not take it, and what was there is still there.

    Raises ValueError if it is too long.
    """
    text = json.dumps(settings)
    if len(text) > SIZE_MAX:
        raise ValueError("it is longer than %d characters" % SIZE_MAX)
    new = path + ".new"
    try:
        with open(new, "w") as f:
            f.write(text)
        with open(new) as f:
            for at in range(0, len(text), PIECE):  # the heap may have no room for all of it twice
                if f.read(PIECE) != text[at : at + PIECE]:
                    raise OSError("it does not read back")
        text = None
        if _read(path, try_out)[0]:  # a damaged one does not replace a good one
            os.rename(path, path + ".old")
        os.rename(new, path)
        _sync()
    except OSError:
        _remove(new)  # half a file would keep a full flash full
        raise


def keep_error(path, text):
    """Store the end of a traceback, unless it is the one that is stored: a box that fails at every boot wears no flash."""
    text = plain(text[-ERROR_MAX:], ERROR_MAX)  # the end says what happened
    try:
        if last_error(path) != text:
            with open(path, "w") as f:
                f.write(text)
            _sync()
    except OSError:
        _remove(path)  # a full flash; the text goes over the link anyway


def last_error(path):
    """The text of the traceback that is stored, or ""."""
    try:
        with open(path) as f:
            return f.read(ERROR_MAX)
    except (OSError, ValueError):  # ValueError: it is not text any more
        return ""


def forget_error(path):
    _remove(path)


def _remove(path):
    try:
        os.remove(path)
    except OSError:  # there was none
        return


def _sync():
    if hasattr(os, "sync"):  # MicroPython for a PC has none
        os.sync()
