"""``truearm box flash``: the firmware onto a box, by its boot drive or as files, and then its answer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import OptionalBoxOption, StopOption
from truearm.cli.output import print_lines


def flash(
    image: Annotated[Path | None, typer.Argument(metavar="IMAGE.uf2", help="The image, as make uf2 makes it.")] = None,
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

    The image is checked first. A box that runs is asked to enter its boot loader (--box); a new Pico is plugged in with
    BOOTSEL held, and its drive is found or named (--drive). With --stock there is no image: the firmware's files are copied to a
    board that runs MicroPython. What a box stores, its configuration and calibrations, outlives all of this.

    \b
    Examples:
      truearm box flash build/uf2/truearm-0.4.0.uf2
      truearm box flash build/uf2/truearm-0.4.0.uf2 --box /dev/ttyACM0
      truearm box flash --stock --box /dev/ttyACM0
    """
    from truearm.box.flash import FlashOptions, flash_box

    print_lines(flash_box(FlashOptions(image, device, drive, stock, timeout, stop, not no_check)))
