"""``truearm box gauge``: calibrate a sensor against a reference, and store the calibration in the box."""

from __future__ import annotations

import sys

import typer

from truearm.box.requests import GaugeOptions
from truearm.cli.command import command
from truearm.live.choose_box import choose_box


@command()
def gauge(options: GaugeOptions) -> None:
    """Calibrate a sensor against a reference: gauge blocks, a micrometer, a stage with a scale.

    Set the reference, type its reading, and do not touch it while the box samples. Measure at least five places over the whole
    travel, preferably there and back. An empty line ends the measurement if the places are enough; "undo" drops the last place. With
    --references, Enter samples the place that is asked for, "s" skips it, and "q" ends the measurement. truearm chooses the
    lowest order of the polynomial that is not significantly worse than the best in cross-validation. For the magnetostrictive sensor, the velocity of sound and the
    delay are estimated. The report shows the remaining errors. If you agree, the box stores the calibration with its date and
    temperature. If a run ends early, the same command continues from the places that were measured.

    Example:
      truearm box gauge lvdt --box /dev/ttyACM0 --instrument "micrometer head 164-163, certificate 4711" --uncertainty-um 2

    Arguments
    ---------
    channel : CHANNEL
        Channel to calibrate: lvdt, transverse_a, magnetostrictive …

    Options
    -------
    references : FILE
        The references in order (.csv with a column reference_mm, _um or _in).
    unit : UNIT
        Unit of what you type: mm, um or in.
    sample_s : S
        How long to sample at each place.
    serial : TEXT
        Serial number of the sensor. Default: unchanged.
    out : FILE
        File to write: the report (.html; default: gauge-CHANNEL.html).
    instrument : TEXT
        The reference, for the report: type, serial number and certificate.
    uncertainty_um : UM
        Expanded uncertainty (k = 2) of the reference, from its certificate.
    operator : TEXT
        Name of the operator, for the report.
    yes
        Store the calibration without asking.

    Expert options
    --------------
    order : N
        Order of the polynomial. Default: chosen by cross-validation.
    stroke_mm : MM
        Stroke of the sensor; references farther apart are refused. Default: 100, and for the magnetostrictive sensor as
        far as its pulses reach.
    """
    from truearm.box.gauge_run import gauge_channel

    gauge_channel(choose_box(options.box, sys.stderr), options, _Terminal(), options.stop)


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
