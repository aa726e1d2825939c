"""The sensor box: runs for ever. `board` is whichever board file the box carries; the simulator brings its own."""

from board import Board

from truearm_box.box import run

run(Board())
