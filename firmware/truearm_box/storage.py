"""Files on the box's flash: the configuration, and the last traceback.

Never used while streaming: flash stops the chip.

A configuration is written next to the existing one, read back, and then renamed to replace it, which littlefs does
atomically; the previous one remains as .old. Whenever power fails, one of the two is complete, and `load` finds it:

    before the last rename   path or path.old is the previous one; path.new is ignored
    after it                 path is new
"""

import json
import os

from . import config
from .ident import ERROR_MAX, plain

# bytes of a configuration's JSON; more would not fit the heap next to the ring, several times over
SIZE_MAX = 8000
PIECE = 256  # characters read back at once
END = 100  # bytes within which a file must end


def load(path, try_out):
    """Return (configuration, fault in words or None): from the file, otherwise the previous one, otherwise the default.

    `try_out(configuration)` raises ValueError for one that cannot be used. A missing file is not a fault.
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
        with open(path, "rb") as f:  # as a stream: a heap with the firmware's code may have no 8 kB block
            f.seek(max(0, size - END))
            if f.read().strip()[-1:] != b"}":  # MicroPython accepts a truncated table as complete
                raise ValueError("it is not a table, or is cut off")
            f.seek(0)
            found = config.check(config.completed(json.load(f)))
        try_out(found)
        return found, None
    except OSError:
        return None, None
    except ValueError as e:
        return None, "config: %s" % e
    except MemoryError:  # short, but with too many parts
        return None, "config: it does not fit the memory"


def save(path, settings, try_out):
    """Store a configuration; raises OSError if writing to flash fails, and the previous content is kept.

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
            for at in range(0, len(text), PIECE):  # the heap may have no space for two copies
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
    """Store the end of a traceback unless it is stored: a box that fails at every boot must not wear out its flash."""
    text = plain(text[-ERROR_MAX:], ERROR_MAX)  # the end describes what happened
    try:
        if last_error(path) != text:
            with open(path, "w") as f:
                f.write(text)
            _sync()
    except OSError:
        _remove(path)  # a full flash; the text is sent over the link anyway


def last_error(path):
    """Return the text of the stored traceback, or ""."""
    try:
        with open(path) as f:
            return f.read(ERROR_MAX)
    except (OSError, ValueError):  # ValueError: it is no longer text
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
