"""``truearm box``: find, flash, test, configure, calibrate and monitor a sensor box."""

from __future__ import annotations

import sys
from typing import Any

import typer

from truearm.box.conversation import conversation, ident_of, one_line_of
from truearm.cli.box_config import config
from truearm.cli.box_flash import flash
from truearm.cli.box_gauge import gauge
from truearm.cli.box_monitor import monitor
from truearm.cli.command import command
from truearm.cli.output import command_group, print_result
from truearm.cli.project import ProjectCommand
from truearm.errors import InputError, TruearmError
from truearm.exit_codes import ExitCode
from truearm.live.choose_box import choose_box

_LIST_RETRIES = 6  # 3 s: a box that was just plugged in waits 2 s before it runs

app = command_group(
    "box",
    "Find, flash, test, configure, calibrate and monitor a sensor box.",
    "Example: truearm box test --box /dev/ttyACM0",
)


@app.command("list", cls=ProjectCommand)
@command()
def list_boxes(
    *,
    all: bool = False,
    json: bool = False,
) -> None:
    """List the boxes that are plugged in.

    truearm asks every serial port with the USB identity of a Pico. A box that is being recorded is listed as in use. Boot drives
    are listed too. Other serial devices are asked only with --all, because the question may disturb them.

    Example: truearm box list

    Options
    -------
    all
        Ask every serial port, not only those of a Pico.
    """
    from truearm.box.boot_drive import find_drives
    from truearm.box.description import port_lines
    from truearm.box.uf2 import CHIPS
    from truearm.record.ports import usb_ports

    ports = [port for port in usb_ports() if port.candidate or all]
    rows = [_asked(port) for port in ports]
    drives = [str(drive) for chip in CHIPS.values() for drive in find_drives(chip.board)]
    print_result({"ports": rows, "boot_drives": drives}, port_lines(rows, drives), json)


def _asked(port: Any) -> dict[str, Any]:
    """Return a port and what answers there, as JSON."""
    row = {"device": port.device, "usb": port.usb, "serial": port.serial, "product": port.product, "box": None}
    try:
        with conversation(port.device, retries=_LIST_RETRIES) as box:
            ident = ident_of(box)
    except InputError:
        raise
    except TruearmError as exc:
        return {**row, "answer": str(exc).removeprefix(f"{port.device}: ")}
    faults = f"; {'; '.join(ident.faults)}" if ident.faults else ""
    return {**row, "box": dict(ident.document), "answer": one_line_of(ident) + faults}


@app.command(cls=ProjectCommand)
@command()
def info(
    *,
    box: str | None = None,
    json: bool = False,
) -> None:
    """Print the description that a box gives of itself: firmware, streams, channels, calibrations, faults.

    Example: truearm box info --box /dev/ttyACM0
    """
    from truearm.box.description import ident_lines

    with conversation(choose_box(box, sys.stderr)) as connected:
        ident = ident_of(connected)
    print_result(ident.document, ident_lines(ident), json)


@app.command("test", cls=ProjectCommand)
@command()
def self_test(
    *,
    box: str | None = None,
    stop: bool = False,
    json: bool = False,
) -> None:
    """Run the self-test of a box, and print each result with what to do about it.

    The exit code is 1 if a test failed. A warning marks what was not measured or is near its limit.

    Example: truearm box test --box /dev/ttyACM0
    """
    from truearm.box.description import finding_lines
    from truearm.box.selftest import FAIL, WARN, findings

    device = choose_box(box, sys.stderr)
    with conversation(device, stop=stop) as connected:
        results = connected.self_test()
        ident = connected.identify()  # its faults are those of this test
    found = findings(results, device)
    failed, warned = (sum(f.verdict == verdict for f in found) for verdict in (FAIL, WARN))
    faults = [fault for fault in ident.faults if not fault.startswith("the box says 'self-test")]
    counts = f"{len(found) - failed - warned} passed, {warned} with a warning, {failed} failed"
    lines = [one_line_of(ident), *finding_lines(found), *(f"warning: {fault}" for fault in faults), counts]
    print_result([vars(f) for f in found], lines, json)
    if failed:
        raise typer.Exit(ExitCode.FAILED)


@app.command(cls=ProjectCommand)
@command()
def reset(
    *,
    box: str | None = None,
    stop: bool = False,
) -> None:
    """Restart a box. This clears its stored traceback.

    Example: truearm box reset --box /dev/ttyACM0
    """
    from truearm_wire.messages import RESTART

    device = choose_box(box, sys.stderr)
    with conversation(device, stop=stop) as connected:
        connected.reset(RESTART)
    typer.echo(f"{device}: the box restarts")


app.command(cls=ProjectCommand)(flash)
app.command(cls=ProjectCommand)(gauge)
app.command(cls=ProjectCommand)(monitor)
app.add_typer(config, name="config")
