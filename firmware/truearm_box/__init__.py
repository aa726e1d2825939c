"""The firmware of the truearm sensor box; MicroPython ≥ 1.25. Hardware is behind the board object alone.

box       the main loop: what is sent and answered when
stream    samples from the board into frames that wait in the ring
ring      frames of fixed size in one buffer
link      one frame at a time onto the link; seq, short writes
commands  identify, configure, start, stop, sync
health    counters, heartbeat, garbage collection at a chosen moment
config    rate and channel descriptions of the box
VERSION   of the firmware
"""

VERSION = "0.1.0"
