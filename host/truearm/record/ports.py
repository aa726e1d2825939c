"""Serial ports that may be boxes, by what they say of themselves on USB."""

from __future__ import annotations

from dataclasses import dataclass

from serial.tools import list_ports

from truearm.errors import LinkError
from truearm.record.links import Clock, SerialLink

# Raspberry Pi's vendor number; its products that show a serial port: MicroPython, and programs made with the Pico's SDK.
VENDOR = 0x2E8A
PRODUCTS = {0x0005: "MicroPython", 0x000A: "Pico SDK", 0x0009: "Pico SDK (RP2350)"}


@dataclass(frozen=True)
class UsbPort:
    """A serial port. ``usb`` is "2e8a:0005", "" where it is not on USB; ``candidate``: it may be a box."""

    device: str
    usb: str
    serial: str
    product: str
    candidate: bool


def usb_ports() -> list[UsbPort]:
    """All serial ports of this machine, boxes-to-be first."""
    ports = [
        UsbPort(
            device=port.device,
            usb="" if port.vid is None else f"{port.vid:04x}:{port.pid:04x}",
            serial=port.serial_number or "",
            product=port.product or PRODUCTS.get(port.pid or 0, "") or port.description or "",
            candidate=port.vid == VENDOR and port.pid in PRODUCTS,
        )
        for port in list_ports.comports()
    ]
    return sorted(ports, key=lambda port: (not port.candidate, port.device))


def find_boxes() -> list[UsbPort]:
    """The ports that may be boxes, in order of their names."""
    return [port for port in usb_ports() if port.candidate]


class BoxPort:
    """Opens a box's port, and later the port that has the same USB identity: a box that is plugged in again may get another name.

    ``device`` is the name that it had last. Where it has no identity (a socket, a pseudo-terminal), the name is all there is.
    """

    def __init__(self, device: str, clock: Clock) -> None:
        self.device = device
        self._clock = clock
        self._identity = next((_identity(port) for port in usb_ports() if port.device == device), None)

    def __call__(self) -> SerialLink:
        """Raises LinkError, InputError as ``SerialLink`` does, LinkError too while no port has the identity."""
        if self._identity is not None:
            names = [port.device for port in usb_ports() if _identity(port) == self._identity]
            if not names:
                raise LinkError(f"{self.device}: is not there; is the box plugged in?")
            self.device = names[0]
        return SerialLink(self.device, self._clock)


def _identity(port: UsbPort) -> tuple[str, str] | None:
    return (port.usb, port.serial) if port.usb and port.serial else None
