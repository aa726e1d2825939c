"""Serial ports that may be boxes, by what they say of themselves on USB."""

from __future__ import annotations

from dataclasses import dataclass

from serial.tools import list_ports

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
