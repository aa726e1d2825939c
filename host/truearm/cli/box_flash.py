"""``truearm box flash``: write the firmware to a box, and check that it answers."""

from __future__ import annotations

from truearm.box.requests import FlashOptions
from truearm.cli.command import command
from truearm.cli.output import print_lines


@command()
def flash(options: FlashOptions) -> None:
    """Flash a box, then check that it answers.

    truearm checks the image first. An installed truearm contains its own; in a checkout, make uf2 builds it. With --box, a running
    box is asked to enter its boot loader. Without it, hold BOOTSEL while you plug in a new Pico: its drive is found, or given with
    --drive. The stored configuration and calibrations of a box are kept.

    Examples:
      truearm box flash
      truearm box flash --box /dev/ttyACM0
      truearm box flash truearm-0.4.0.uf2 --drive /media/RPI-RP2

    Arguments
    ---------
    image : IMAGE.uf2
        The image. Default: the one of this version.

    Options
    -------
    box : DEVICE
        Port of a running box. Default: the boot drive of a new one.
    drive : FOLDER
        Folder of the boot drive, now or once it is mounted. Default: found automatically.

    Expert options
    --------------
    timeout_s : S
        How long to wait for the drive and the box.
    no_check
        Do not wait for the box to answer.
    """
    from truearm.box.flash import flash_box

    print_lines(flash_box(options))
