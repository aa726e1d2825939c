"""The firmware of the truearm sensor box; MicroPython ≥ 1.25. Only the board object accesses hardware.

box       the main loop: what is sent and answered when
stream    samples from the board into frames that wait in the ring
ring      frames of fixed size in one buffer; trigger edges
link      one frame at a time onto the link; seq, short writes
commands  the host's requests, and the answers
settings  the current configuration, rates, faults
config    the content of a configuration
storage   configuration and last traceback on flash
ident     the box's description of itself
selftest  the board's measurements, evaluated
health    counters, heartbeat, LED, garbage collection at a chosen moment
"""
