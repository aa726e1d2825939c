"""The one version number of package, firmware and image; the wire has its own (PROTOCOL, protocol/SPEC.md §7)."""

MARK = "truearm_box 0.4.0"  # in one piece, so that it can be read in an image (host/truearm/box/flash.py)
VERSION = MARK[12:]
