"""The truearm wire (protocol/SPEC.md) for CPython and MicroPython; it imports no other part of truearm.

fast      CRC-32, COBS and byte counters in place, without allocation (viper on MicroPython)
cbor      the subset of CBOR that the wire uses, both ways
messages  the layout of every frame, encode and decode
version   of package, firmware and image
frame     payload ↔ frame, and the splitter of a byte stream
"""

PROTOCOL = (1, 4)
