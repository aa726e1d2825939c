"""``truearm box gauge``: calibrate a sensor against a reference, and store the calibration in the box."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from truearm.cli.options import BoxOption, ForceOption, StopOption, out_file
from truearm.units import MM, UM


def gauge(
    channel: Annotated[
        str, typer.Argument(metavar="CHANNEL", help="Channel to calibrate: lvdt, transverse_a, magnetostrictive …")
    ],
    device: BoxOption,
    references: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The references in order (.csv with a column reference_mm, _um or _in)."),
    ] = None,
    unit: Annotated[str, typer.Option(metavar="UNIT", help="Unit of what you type: mm, um or in.")] = "mm",
    seconds: Annotated[
        float, typer.Option(metavar="S", min=0.1, max=600, help="How long to sample at each place.")
    ] = 2.0,
    order: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, max=7, help="Order of the polynomial. Default: chosen by cross-validation."),
    ] = None,
    serial: Annotated[
        str | None, typer.Option(metavar="TEXT", help="Serial number of the sensor. Default: unchanged.")
    ] = None,
    stroke_mm: Annotated[
        float | None,
        typer.Option(
            min=0.1,
            max=1e4,
            metavar="MM",
            help="Stroke of the sensor; references farther apart are refused. Default: 100, and for the magnetostrictive sensor "
            "as far as its pulses reach.",
        ),
    ] = None,
    out: Annotated[Path | None, out_file("the report (.html; default: gauge-CHANNEL.html)")] = None,
    instrument: Annotated[
        str, typer.Option(metavar="TEXT", help="The reference, for the report: type, serial number and certificate.")
    ] = "",
    uncertainty_um: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1e4,
            metavar="UM",
            help="Expanded uncertainty (k = 2) of the reference, from its certificate.",
        ),
    ] = None,
    operator: Annotated[str, typer.Option(metavar="TEXT", help="Name of the operator, for the report.")] = "",
    yes: Annotated[bool, typer.Option("--yes", help="Store the calibration without asking.")] = False,
    stop: StopOption = False,
    force: ForceOption = False,
) -> None:
    """Calibrate a sensor against a reference: gauge blocks, a micrometer, a stage with a scale.

    Set the reference, type its reading, and do not touch it while the box samples. Measure at least five places over the whole
    travel, preferably there and back. An empty line ends the measurement if the places are enough; "undo" drops the last place. With
    --references, Enter samples the place that is asked for, "s" skips it, and "q" ends the measurement. truearm chooses the
    lowest order of the polynomial that is not significantly worse than the best in cross-validation. For the magnetostrictive sensor, the velocity of sound and the
    delay are estimated. The report shows the remaining errors. If you agree, the box stores the calibration with its date and
    temperature. If a run ends early, the same command continues from the places that were measured.

    \b
    Example:
      truearm box gauge lvdt --box /dev/ttyACM0 --instrument "micrometer head 164-163, certificate 4711" --uncertainty-um 2
    """
    from truearm.box.gauge_run import GaugeOptions, gauge_channel

    uncertainty = None if uncertainty_um is None else UM.to_si(uncertainty_um)
    stroke = None if stroke_mm is None else MM.to_si(stroke_mm)
    options = GaugeOptions(
        channel, references, unit, seconds, order, serial, stroke, out, yes, force, instrument, uncertainty, operator
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
