"""``truearm box gauge``: a sensor's calibration against reference readings, into the box."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import BoxOption, ForceOption, StopOption, out_file
from truearm.units import UM


def gauge(
    channel: Annotated[str, typer.Argument(metavar="CHANNEL", help="lvdt, transverse_a, magnetostrictive …")],
    device: BoxOption,
    references: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The references in order (.csv with a column reference_mm, _um or _in)."),
    ] = None,
    unit: Annotated[str, typer.Option(metavar="UNIT", help="Of what is typed: mm, um or in.")] = "mm",
    seconds: Annotated[float, typer.Option(metavar="S", min=0.1, max=600, help="Samples at each place.")] = 2.0,
    order: Annotated[
        int | None, typer.Option(metavar="N", min=1, max=7, help="Of the polynomial; default: by the left-out error.")
    ] = None,
    serial: Annotated[str | None, typer.Option(metavar="TEXT", help="Of the sensor; default: as before.")] = None,
    out: Annotated[Path | None, out_file("the page (.html); default: gauge-CHANNEL.html")] = None,
    instrument: Annotated[
        str, typer.Option(metavar="TEXT", help="The reference, for the page: its type, serial number and certificate.")
    ] = "",
    uncertainty_um: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1e4,
            metavar="UM",
            help="The reference's expanded uncertainty (k = 2), as its certificate has it.",
        ),
    ] = None,
    operator: Annotated[str, typer.Option(metavar="TEXT", help="Who calibrates, for the page.")] = "",
    yes: Annotated[bool, typer.Option("--yes", help="Store the calibration without asking.")] = False,
    stop: StopOption = False,
    force: ForceOption = False,
) -> None:
    """Calibrate a sensor against a reference: gauge blocks, a micrometer, a stage with a scale.

    Set the reference, type what it reads, and leave it alone while the box samples; five places or more, over the whole travel,
    best there and back. An empty line ends, "undo" drops the last place. The order of the polynomial is the lowest whose error at
    places that were left out is as small as the best one's; the magnetostrictive sensor gets its velocity of sound and delay. A
    page shows what is left, and if you agree the box stores the calibration with its date and temperature.

    \b
    Example:
      truearm box gauge lvdt --box /dev/ttyACM0 --instrument "micrometer head 164-163, certificate 4711" --uncertainty-um 2
    """
    from truearm.box.gauge_run import GaugeOptions, gauge_channel

    uncertainty = None if uncertainty_um is None else UM.to_si(uncertainty_um)
    options = GaugeOptions(
        channel, references, unit, seconds, order, serial, out, yes, force, instrument, uncertainty, operator
    )
    gauge_channel(device, options, _Terminal(), stop)


class _Terminal:
    """The operator of ``gauge`` at standard input and output."""

    def say(self, text: str) -> None:
        typer.echo(text)

    def ask(self, prompt: str) -> str | None:
        typer.echo(prompt, nl=False)
        try:
            return input().strip()
        except EOFError:
            typer.echo()
            return None
