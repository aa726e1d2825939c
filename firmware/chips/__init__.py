"""One table a chip: what a driver has to know of it. RP2350 would be one more file with the same names."""
