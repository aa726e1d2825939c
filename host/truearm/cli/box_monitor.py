"""``truearm box monitor``: what a box measures and how well it does, live."""

from __future__ import annotations

from typing import Annotated

import typer

from truearm.box.conversation import Device


def monitor(
    device: Device,
    duration: Annotated[
        float | None, typer.Option(metavar="S", help="End after so many seconds; default: Ctrl-C.")
    ] = None,
    plain: Annotated[bool, typer.Option("--plain", help="A line a second, as when the output is no terminal.")] = False,
) -> None:
    """Show what a box measures: values in physical units with their noise, rates, losses, clock, temperature.

    Starts the box (and stops it in the end: Ctrl-C or --duration). Nothing is recorded.

    Example: truearm box monitor --device /dev/ttyACM0
    """
    from truearm.box.monitor import monitor_box

    monitor_box(device, duration, plain)
