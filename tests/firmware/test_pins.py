"""docs/hardware.md's wiring table is that of firmware/board_pico.py."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
ADC_PIN = 26  # the RP2040's analogue input 0


def constants(path):
    """A module's top-level names that are literals."""
    found = {}
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            found[node.targets[0].id] = ast.literal_eval(node.value)
    return found


def test_the_wiring_table_has_the_pins_of_the_board():
    rows = re.findall(r"^\| GP(\d+) \| ([^|]+) \| ([^|]+) \|$", (ROOT / "docs" / "hardware.md").read_text(), re.M)
    table = {int(pin): to for pin, to, _ in rows}
    assert len(table) == len(rows), "a pin is listed twice"
    board = constants(ROOT / "firmware" / "board_pico.py")
    names = ("U2 DOUT", "U2 CS", "U2 SCLK", "U2 DIN", "U2 DRDY", "U2 SYNC/RESET", "U2 XTAL1/CLKIN")
    first = board["TRIGGER_PINS"]
    assert table == {
        **dict(zip(board["CONVERTER_PINS"], names, strict=True)),
        **dict(zip(board["HEAD_PINS"], ("U4 DI", "U4 RO"), strict=True)),
        **dict(zip(range(first, first + 3), ("U5 out", "U6 out", "U7 LED"), strict=True)),
        ADC_PIN + board["RAIL_5V_ADC"]: "5 V through 20 kΩ / 10 kΩ",
        board["LED_PIN"]: "on the board",
    }
