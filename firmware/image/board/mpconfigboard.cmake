# The box is a Raspberry Pi Pico; MicroPython for it is what that board's is, but for its name.
set(PICO_BOARD "pico")
set(PICO_PLATFORM "rp2040")
