"""The sensor box: runs until the host requests MicroPython's prompt. `board` is the board file of box or simulator."""

from board import Board

from truearm_box.box import run

run(Board())
