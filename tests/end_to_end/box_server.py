"""A simulated box in real time on a socket or pseudo-terminal, in a thread, with a stage to move and a boot drive."""

import threading
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from tests.end_to_end.conftest import interpreter

from truearm.cli.main import main
from truearm_sim.ports import Port, Terminal
from truearm_sim.sensors import SOUND, VOLTS_PER_COUNT
from truearm_sim.serve import Pace, serve
from truearm_sim.simbox import SimulatedBox
from truearm_sim.world import Setup, World, standard_plan

MAG_PERIOD_NS = 983_040  # as for the converter
NOISE_V = 5e-6
NOISE_PS = 1800.0
NOISE = np.random.default_rng(4).standard_normal((65_536, 4))


def box(*arguments):
    """Run ``truearm box`` as an operator types it; return the exit code."""
    return main(["box", *map(str, arguments)])


class Stage(World):
    """A world with a manually set stage: ``position`` [m]. Its LVDT is ``bent``, its head has 9.031 µs per inch."""

    POLY = (-3.1e-4, 3.8e-2, 4e-4)  # position [m] of volts
    DELAY_PS = 1.5e6

    def __init__(self, mag_period_ns=0):
        super().__init__(7, standard_plan(9, 7), setup=Setup(mag_period_ns=mag_period_ns))
        self.position = 0.0
        self.magnet = True

    def _noise(self, k0, k1):
        """Return noise that belongs to the sample and the stage's position, whenever it is requested."""
        return NOISE[(np.arange(k0, k1) + 7919 * round(1e4 * self.position)) % len(NOISE)]

    def volts(self):
        zero, gain, bend = self.POLY
        return float(min(np.roots([bend, gain, zero - self.position]), key=abs))

    def counts(self, k0, k1, t_start_device_ns, period):
        noise = self._noise(k0, k1)
        volts = np.array([self.volts(), 0.3, -0.1, 0.75]) + NOISE_V * noise
        return np.rint(volts / VOLTS_PER_COUNT).astype(np.int32)

    def flight_times(self, k0, k1, t_start_device_ns, period_ns):
        noise = NOISE_PS * self._noise(k0, k1)[:, 0]
        speed = SOUND * 9.05 / 9.031
        flights = np.rint(1e12 * (0.3 + self.position) / speed + self.DELAY_PS + noise).astype(np.int64)
        return flights if self.magnet else np.full_like(flights, -1)


class BootDrive:
    """A box whose boot loader shows a drive in ``folder``; it restarts when a complete image was written to it."""

    INFO = "UF2 Bootloader v3.0\nModel: Raspberry Pi RP2\nBoard-ID: RPI-RP2\n"

    def __init__(self, box, folder: Path):
        self.box, self._folder, self._shown = box, folder, False
        self.written = b""

    def advance(self, t_ns, rx=b"", tx_room=0xFFFF):
        if self.box._boot_at_ns is None and self.box._hardware is None:
            self._show(t_ns)
        return self.box.advance(t_ns, rx, tx_room)

    def output_at(self, t):
        return self.box.output_at(t)

    def _show(self, t_ns):
        info = self._folder / "INFO_UF2.TXT"
        if not self._shown:
            self._folder.mkdir(parents=True, exist_ok=True)
            info.write_text(self.INFO)
            self._shown = True
        for path in self._folder.glob("*.uf2"):
            self.written = path.read_bytes()
            whole = len(self.written) >= 512 and len(self.written) == 512 * int.from_bytes(
                self.written[24:28], "little"
            )
            if whole:
                info.unlink()
                path.unlink()
                self._shown = False
                self.box.power_cycle(t_ns)


@contextmanager
def served(world=None, *, pty=False, drive=None, **options):
    """Return (device, world, box) of a box that lives until the end of the block."""
    world = world or Stage()
    box = SimulatedBox(world, interpreter(), seed=7, **options)
    shown = box if drive is None else BootDrive(box, drive)
    port, robot = (Terminal() if pty else Port.listen("127.0.0.1", 0)), Port.listen("127.0.0.1", 0)
    stop = threading.Event()
    thread = threading.Thread(
        target=serve, args=(world, shown, port, robot), kwargs={"stop": stop.is_set, "pace": Pace()}, daemon=True
    )
    thread.start()
    try:
        yield (port.path if pty else f"socket://127.0.0.1:{port.number}"), world, shown
    finally:
        stop.set()
        thread.join(20)
        box.close()
        port.close()
        robot.close()
