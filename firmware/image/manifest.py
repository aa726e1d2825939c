# The content frozen into the image: MicroPython's own boot files, and the folder that build.py creates next to this
# file: main.py, board.py (board_pico.py under the name that main imports), truearm_box, truearm_wire, drivers, chips.
freeze("$(PORT_DIR)/modules")
freeze("frozen")
