"""The firmware of the truearm sensor box; MicroPython ≥ 1.25. Hardware is behind the board object alone.

box       the main loop: what is sent and answered when
stream    samples from the board into frames that wait in the ring
ring      frames of fixed size in one buffer; trigger edges
link      one frame at a time onto the link; seq, short writes
commands  what the host may ask, and the answers
settings  the configuration in force, rates, faults
config    what a configuration is
storage   configuration and last traceback on flash
ident     what the box says of itself
selftest  what the board measured, judged
health    counters, heartbeat, LED, garbage collection at a chosen moment
"""
