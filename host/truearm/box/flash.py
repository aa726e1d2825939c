"""Write the firmware to a box by its boot drive, and wait for its answer (``truearm box flash``)."""

from __future__ import annotations

from pathlib import Path

from truearm.box.boot_drive import board_of, find_drives, wait_for, write_image
from truearm.box.conversation import conversation, one_line_of
from truearm.box.requests import FlashOptions
from truearm.box.uf2 import Image, read_uf2
from truearm.errors import Argument, InputError, LinkError
from truearm.findings import Finding
from truearm.progress import step
from truearm.record.ports import usb_ports
from truearm.session.box_ident import Ident
from truearm.version import VERSION
from truearm_wire.messages import BOOT_LOADER

_SHORT = 4  # attempts of half a second, repeated


def flash_box(options: FlashOptions) -> list[Finding]:
    """Flash a box and wait for its answer; return what was written and what answers. Raises InputError, ImageError, LinkError."""
    earlier_ports = {port.device for port in usb_ports()} - {options.box}
    path = options.image or own_image()
    image = read_uf2(path)
    drive = _drive_for(path, image, options)
    with step(f"writing {path.name}"):
        write_image(image, drive, path.name)
    written = {"image": str(path), "drive": str(drive), "chip": image.chip.name, "size": image.size // 1024}
    written |= {"other": not image.is_box, "version": image.version, "box": None}
    if options.no_check:
        return [Finding("flashed", written)]
    with step(f"waiting for the box, {options.timeout:g} s at most"):
        ident = _wait_for_box(options.box, earlier_ports, options.timeout, drive)
    other = image.version and ident.firmware != image.version
    return [
        Finding("flashed", {**written, "box": one_line_of(ident)}),
        *([Finding("other-firmware", {"image": image.version, "box": ident.firmware})] if other else []),
        *(Finding("box-fault", {"fault": fault}) for fault in ident.faults),
    ]


def own_image() -> Path:
    """Return the image of this version, from the wheel or built in this checkout by make uf2. Raises InputError."""
    package, name = Path(__file__).parent, f"truearm-{VERSION}.uf2"
    places = (package / "image" / name, package.parents[2] / "build" / "uf2" / name)
    for path in places:
        if path.is_file():
            return path
    raise InputError(f"{name} is not part of this installation; give the image to flash (make uf2 builds one)")


def _drive_for(path: Path, image: Image, options: FlashOptions) -> Path:
    """Return the boot drive to write to; a running box is first asked to present it."""
    device, drive, timeout = options.box, options.drive, options.timeout
    earlier_drives = find_drives(image.chip.board) if drive is None else []
    if device is None:
        return drive or _only(earlier_drives)
    if drive is None or board_of(drive) is None:
        with conversation(device, stop=options.stop) as box:
            box.reset(BOOT_LOADER)

    def appeared() -> Path | None:
        if drive is not None:
            return None if board_of(drive) is None else drive
        return next((place for place in find_drives(image.chip.board) if place not in earlier_drives), None)

    with step(f"waiting for the boot drive, {timeout:g} s at most"):
        boot_drive = wait_for(appeared, timeout)
    if boot_drive is None:
        raise LinkError(
            f"{device}: no boot drive appeared within {timeout:g} s; mount it and name its folder: truearm box flash {path} --drive FOLDER"
        )
    return boot_drive


def _only(drives: list[Path]) -> Path:
    if not drives:
        raise InputError(
            "no boot drive found; hold BOOTSEL while you plug the box in, name its folder with ",
            *(Argument("drive"), ", or give ", Argument("box"), " to restart a running box"),
        )
    if len(drives) > 1:
        raise InputError(
            f"there are several boot drives, {', '.join(map(str, drives))}; name one with ", Argument("drive")
        )
    return drives[0]


def _wait_for_box(device: str | None, earlier_ports: set[str], timeout: float, drive: Path) -> Ident:
    """Return the ident of the box that starts, at ``device`` or at a port that is not among ``earlier_ports``. Raises
    LinkError.
    """
    reason = ""

    def answering() -> Ident | None:
        nonlocal reason
        for place in _places(device, earlier_ports):
            try:
                with conversation(place, retries=_SHORT) as box:
                    return box.ident
            except LinkError as exc:
                reason = f" ({exc})"
        return None

    if (ident := wait_for(answering, timeout)) is None:
        raise LinkError(f"{drive}: written, but no box answered within {timeout:g} s{reason}; see truearm box list")
    return ident


def _places(device: str | None, earlier_ports: set[str]) -> list[str]:
    """Return where the box may be: its port may have another name after a restart."""
    if device is not None and ("://" in device or Path(device).exists()):
        return [device]
    return [port.device for port in usb_ports() if port.candidate and port.device not in earlier_ports]
