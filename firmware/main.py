"""The sensor box: runs until the host asks for MicroPython's prompt. `board` is whichever board file the box carries; the simulator brings its own."""

from board import Board

from truearm_box.box import run

run(Board())
