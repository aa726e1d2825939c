"""One table per chip: what a driver must know about it. RP2350 would be one more file with the same names."""
