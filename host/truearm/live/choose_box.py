"""Choose the box: the one named, the only one connected, or the one picked by the operator."""

from __future__ import annotations

import sys
from typing import TextIO

from truearm.errors import Argument, InputError, LinkError
from truearm.text import one_line

NONE = (
    "no box is plugged in: no serial port has a Pico's USB identity. Plug it in (a new Pico: truearm box flash), name its port with ",
    Argument("box"),
    ", or try all with truearm box list --all; without hardware, truearm simulate simulates a box",
)


def choose_box(device: str | None, output: TextIO) -> str:
    """Return the device of the box and print it on ``output``.

    If there are several and ``output`` is a terminal, the operator is asked there and answers on standard input. Raises
    LinkError if there is none, InputError if there are several and nobody to ask.
    """
    from truearm.record.ports import find_boxes

    if device is not None:
        return device
    boxes = find_boxes()
    if not boxes:
        raise LinkError(*NONE)
    if len(boxes) == 1:
        print(f"box: {one_line(boxes[0].device)} ({_words(boxes[0].product, boxes[0].serial)})", file=output)
        return boxes[0].device
    listed = [f"{one_line(box.device)} ({_words(box.product, box.serial)})" for box in boxes]
    if not (sys.stdin.isatty() and output.isatty()):
        raise InputError("several-boxes", boxes=listed)
    return boxes[_ask(listed, output)].device


def _words(product: str, serial: str) -> str:
    return one_line(f"{product}, serial {serial}" if serial else product)


def _ask(listed: list[str], output: TextIO) -> int:
    print("Which box?", file=output)
    for number, text in enumerate(listed, start=1):
        print(f"  {number}  {text}", file=output)
    while True:
        print(f"1 to {len(listed)}: ", end="", file=output, flush=True)
        answer = sys.stdin.readline()
        if not answer:
            raise InputError("needs-option", place="the command without a terminal", needed=Argument("box"))
        if answer.strip().isdecimal() and 1 <= int(answer) <= len(listed):
            return int(answer) - 1
