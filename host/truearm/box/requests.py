"""What commands for a box take: their options in SI units, declared once.

``--help`` reads this, so it imports nothing slow.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from truearm.bounds import OneOf, Within


@dataclass(frozen=True)
class FlashOptions:
    """What to flash, and where: an ``image`` through a boot drive.

    ``box``: a running box, None for a new one. ``timeout`` [s]: for drive and box. ``stop``: stop a streaming box.
    ``no_check``: do not wait for the box to answer.
    """

    image: Path | None = None
    box: str | None = None
    drive: Path | None = None
    timeout: Annotated[float, Within(0, 600)] = 30
    stop: bool = False
    no_check: bool = False


@dataclass(frozen=True)
class GaugeOptions:
    """How to calibrate a channel.

    ``references``: a file of them, None to ask for each in ``unit``. ``sample`` [s]: duration at each position.
    ``order``: of the polynomial, None for the one with the smallest cross-validation error. ``serial``: of the sensor,
    None to keep it. ``stroke`` [m]: greatest distance of two references, None for that of a usual sensor. ``out``: page
    to write, None for a name derived from the channel. ``yes``: store the calibration without asking. The page names
    the reference ``instrument``, its expanded ``uncertainty`` [m] (k = 2) and the ``operator``.
    """

    channel: str
    box: str | None = None
    references: Path | None = None
    unit: Annotated[str, OneOf(("mm", "um", "in"))] = "mm"
    sample: Annotated[float, Within(0.1, 600)] = 2.0
    order: Annotated[int | None, Within(1, 7)] = None
    serial: str | None = None
    stroke: Annotated[float | None, Within(1e-4, 10.0)] = None
    out: Path | None = None
    instrument: str = ""
    uncertainty: Annotated[float | None, Within(0.0, 1e-2)] = None
    operator: str = ""
    yes: bool = False
    stop: bool = False
    force: bool = False
