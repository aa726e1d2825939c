"""Find serial ports that may be boxes, by their USB descriptors."""

from __future__ import annotations

from dataclasses import dataclass

from serial.tools import list_ports

from truearm.errors import LinkError
from truearm.record.links import Clock, SerialLink

# Raspberry Pi's vendor number; its products with a serial port are MicroPython and programs made with the Pico SDK.
VENDOR = 0x2E8A
PRODUCTS = {0x0005: "MicroPython", 0x000A: "Pico SDK", 0x0009: "Pico SDK (RP2350)"}


@dataclass(frozen=True)
class UsbPort:
    """A serial port. ``usb`` is "2e8a:0005", or "" if it is not on USB; ``candidate``: it may be a box."""

    device: str
    usb: str
    serial: str
    product: str
    candidate: bool


def usb_ports() -> list[UsbPort]:
    """Return all serial ports of this machine, possible boxes first."""
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
    """Return the ports that may be boxes, in order of their names."""
    return [port for port in usb_ports() if port.candidate]


class BoxPort:
    """Opens a box's port, and later the port with the same USB identity: a reconnected box may get another name.

    ``device`` is its last name. Without an identity (a socket, a pseudo-terminal), only the name is used.
    """

    def __init__(self, device: str, clock: Clock) -> None:
        self.device = device
        self._clock = clock
        self._identity = next((_identity(port) for port in usb_ports() if port.device == device), None)

    def __call__(self) -> SerialLink:
        """Open the port. Raises LinkError and InputError as ``SerialLink`` does, and LinkError if no port has the
        identity.
        """
        if self._identity is not None:
            names = [port.device for port in usb_ports() if _identity(port) == self._identity]
            if not names:
                raise LinkError("no-box", place=self.device)
            self.device = names[0]
        return SerialLink(self.device, self._clock)


def _identity(port: UsbPort) -> tuple[str, str] | None:
    return (port.usb, port.serial) if port.usb and port.serial else None
