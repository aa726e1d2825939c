"""Drivers on the emulated chip: scripts for MicroPython's raw REPL, and what the parts on the pins recorded.

The emulator's side is driver_bench.mjs.
"""

import json
import subprocess
from pathlib import Path

from truearm_sim import node
from truearm_sim.latency import USB_PACKET_NS

BENCH = Path(__file__).with_name("driver_bench.mjs")
SETUP = """
import gc, machine, rp2, struct, time
from chips import rp2040 as chip
gc.disable()
"""


def run_steps(steps: list[dict], start_ns: int = 0) -> list[dict]:
    """Boot once and run the steps. `out` of each is the output of its script, one JSON value per line."""
    message = {
        "uf2": str(node.image()),
        "packetNs": USB_PACKET_NS,
        "startNs": start_ns,
        "steps": [{"script": SETUP}, *steps],
    }
    done = subprocess.run(
        [str(node.ready().path), str(BENCH)], input=json.dumps(message), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout)
    for step in found:
        assert not step["err"], step["err"]
        step["out"] = [json.loads(line) for line in step["out"].splitlines()]
    return found[1:]
