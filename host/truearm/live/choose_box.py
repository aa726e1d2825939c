"""Choose the box: the one named, or the only one connected."""

from __future__ import annotations

from typing import TextIO

from truearm.errors import InputError, LinkError
from truearm.text import one_line


def choose_box(device: str | None, output: TextIO) -> str:
    """Return the device of the box; print it on ``output`` if it was not named.

    Raises LinkError if there is none, InputError if there are several.
    """
    from truearm.record.links import find_boxes

    if device is not None:
        return device
    boxes = find_boxes()
    if not boxes:
        raise LinkError("no-box-plugged-in")
    listed = [one_line(f"{box.device} ({box.product}{box.serial and ', serial '}{box.serial})") for box in boxes]
    if len(boxes) == 1:
        print(f"box: {listed[0]}", file=output)
        return boxes[0].device
    raise InputError("several-boxes", boxes=listed)
