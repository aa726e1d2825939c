"""Choose the box: the one named, or the only one connected."""

from __future__ import annotations

from typing import TextIO

from truearm.errors import Argument, InputError, LinkError
from truearm.text import one_line

NONE = (
    "no box is plugged in: no serial port has a Pico's USB identity. Plug it in (a new Pico: truearm box flash), name its port with ",
    Argument("box"),
    ", or try all with truearm box list --all; without hardware, truearm simulate simulates a box",
)


def choose_box(device: str | None, output: TextIO) -> str:
    """Return the device of the box; print it on ``output`` if it was not named.

    Raises LinkError if there is none, InputError if there are several.
    """
    from truearm.record.ports import find_boxes

    if device is not None:
        return device
    boxes = find_boxes()
    if not boxes:
        raise LinkError(*NONE)
    listed = [one_line(f"{box.device} ({box.product}{box.serial and ', serial '}{box.serial})") for box in boxes]
    if len(boxes) == 1:
        print(f"box: {listed[0]}", file=output)
        return boxes[0].device
    raise InputError("several-boxes", boxes=listed)
