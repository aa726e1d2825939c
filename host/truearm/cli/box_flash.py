"""``truearm box flash``: the firmware onto a box, by its boot drive or as files, and then its answer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import OptionalBoxOption, StopOption
from truearm.cli.output import print_lines


def flash(
    image: Annotated[
        Path | None, typer.Argument(metavar="IMAGE.uf2", help="The image; default: the one of this version.")
    ] = None,
    device: OptionalBoxOption = None,
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
    stop: StopOption = False,
    no_check: Annotated[bool, typer.Option("--no-check", help="Do not wait for the box to answer.")] = False,
) -> None:
    """Flash a box, then check that it answers.

    The image is checked first; the wheel has its own, and make uf2 builds one. A box that runs is asked to enter its boot loader (--box); a new Pico is plugged in with
    BOOTSEL held, and its drive is found or named (--drive). With --stock there is no image: the firmware's files are copied to a
    board that runs MicroPython. What a box stores, its configuration and calibrations, outlives all of this.

    \b
    Examples:
      truearm box flash
      truearm box flash --box /dev/ttyACM0
      truearm box flash truearm-0.4.0.uf2 --drive /media/RPI-RP2
      truearm box flash --stock --box /dev/ttyACM0
    """
    from truearm.box.flash import FlashOptions, flash_box

    print_lines(flash_box(FlashOptions(image, device, drive, stock, timeout, stop, not no_check)))
