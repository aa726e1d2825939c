"""A sensor with a driver of its own, from the wire to the identified robot: the recipes' code, unchanged."""

import csv
import json
import math
import subprocess

import numpy as np
import pytest

from tests.firmware.conftest import real_micropython
from tests.recipes.recipes import Copy

COUNT_RAD = 95873799242853e-18
RIG = "".join(
    f'\n[[inclinometer]]\nname = "{name}"\nsigma_deg = 0.006\naxis = {axis}\nzero_sigma_deg = "unknown"\n'
    for name, axis in (("i1", [1, 0, 0]), ("i2", [0, 1, 0]))
)
# The firmware in a real MicroPython, recorded with the robot; then what the world knows of each dwell.
RECORD = f"""
import json, sys
from pathlib import Path
import numpy as np
sys.path.append("firmware/drivers")
from scl3300 import Inclinometer
from truearm.extend import forward
from truearm.kinds.rig_file import format_rig
from truearm.workflows.record import plan_rows
from truearm.record.recorder import RecordOptions, record
from truearm.record.session_writer import SessionWriter
from truearm_sim.lab import Lab
from truearm_sim.micropython import probe
from truearm_sim.simbox import SimulatedBox
from truearm_sim.world import Sensor, Setup, World, standard_plan

RAD = {COUNT_RAD}

def counts(chain, params, q):
    return np.arcsin(forward(chain, params, q)[:, 2, :2]) / RAD

world = World(3, standard_plan(40, 3), setup=Setup(sensors=(Sensor(Inclinometer.stream, counts),)))
rig = format_rig(world.rig) + {RIG!r}
Path("rig.toml").write_text(rig)
box = SimulatedBox(world, probe(Path(sys.argv[1])), seed=3)
lab = Lab(world, box, 3)
options = RecordOptions(plan=plan_rows(world.controller.plan), rig_toml=rig.encode())
record(lab.box_link, SessionWriter(Path("s.mcap"), lab.clock), lab.clock, robot=lab.robot_link, options=options)
box.close()
q = world.controller.q_true(world.truth.dwell_end - 0.1)
json.dump((RAD * counts(world.chain, world.params, q)).tolist(), sys.stdout)
"""
# The sensor's side of the bus, by its data sheet; the heap is locked while the driver reads.
DRIVER = """
import micropython, sys
sys.path.append("firmware/drivers")
from scl3300 import Inclinometer, crc8

class Bus:
    data = {b"\\x24\\x00\\x00\\xc7": -12345, b"\\x28\\x00\\x00\\xcd": 321}
    def __init__(self):
        self.answers = {command: bytearray((command[0] | 1, n >> 8 & 255, n & 255, 0)) for command, n in self.data.items()}
        for answer in self.answers.values():
            answer[3] = crc8(answer)
        self.answer = self.started = bytearray(4)
    def write_readinto(self, command, buf):
        for i in range(4):
            buf[i] = self.answer[i]
        self.answer = self.answers.get(command, self.started)

class Pin:
    def value(self, level):
        pass

bus, out, answered = Bus(), bytearray(8), False
sensor = Inclinometer(bus, Pin(), lambda ms: None)
micropython.heap_lock()
answered = sensor.read(out)
micropython.heap_unlock()
print(answered, int.from_bytes(out[:4], "little") - (1 << 32), int.from_bytes(out[4:], "little"))
bus.answers[b"\\x24\\x00\\x00\\xc7"][1] ^= 1
print(sensor.read(out))
"""


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """The repository with the sensor and its kind."""
    copy = Copy(tmp_path_factory.mktemp("sensor"), ("host", "protocol", "firmware", "hil_sim"))
    copy.apply("A kind of observation")
    copy.apply("A sensor of the box")
    assert copy.changes() == {
        "firmware/board_pico.py": "+3 -0",
        "firmware/drivers/scl3300.py": "new file",
        "host/truearm/kinds/__init__.py": "+1 -0",
        "host/truearm/kinds/inclinometer.py": "new file",
    }
    return copy


def test_a_session_with_the_sensor_is_identified(copy):
    true = json.loads(copy.python("-c", RECORD, str(real_micropython().path)).out)
    inspected, exported, identified = copy.run_each(
        ("inspect", "s.mcap", "--json"),
        ("session", "export", "s.mcap", "--out", "exported"),
        ("identify", "s.mcap", "--model", "puma560", "--details", "--out", "result.json", "--joint-laws", "none"),
    )
    assert [inspected.code, exported.code, identified.code] == [0, 0, 0], (inspected, exported.err, identified)
    assert json.loads(inspected.out)["losses"]["box"]["overruns"] == 0
    with (copy.folder / "exported/observations.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["kind"] == "inclinometer"]
    for name, angles in zip(("i1", "i2"), np.array(true).T, strict=True):
        readings = np.array([float(row["inclination_rad"]) for row in rows if row["inclinometer"] == name])
        nearest = np.abs(readings[:, None] - angles).min(axis=0)  # it is also read where no bar is mounted
        assert len(readings) > len(angles) == 80
        assert nearest.max() < 0.5 * COUNT_RAD + 1e-6
    kinds = {entry["kind"]: entry for entry in json.loads((copy.folder / "result.json").read_text())["observations"]}
    assert kinds["ball_bar"]["fitted"] > 0
    assert math.radians(kinds["inclinometer"]["rms_after_deg"]) < 0.5 * COUNT_RAD


def test_the_driver_reads_the_sensor_in_micropython(copy):
    done = subprocess.run(
        [real_micropython().path, "-c", DRIVER], cwd=copy.folder, capture_output=True, text=True, check=False
    )
    assert done.stdout.split("\n")[:2] == ["True -12345 321", "False"], done.stderr
