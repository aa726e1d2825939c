"""``truearm box``: find, flash, test, configure, calibrate and monitor a sensor box."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import click

from truearm.bounds import DURATION
from truearm.box import configuration
from truearm.box.condition import FAIL, PASS, WARN, entry, findings, ident_lines, port_lines
from truearm.box.control import conversation, one_line_of
from truearm.box.flash import CHIPS, find_drives, flash_box
from truearm.box.requests import FlashOptions, GaugeOptions
from truearm.cli.command import Answer, command
from truearm.cli.output import print_lines
from truearm.cli.project import CommandGroup
from truearm.disk import check_writable, read_text, write_atomic
from truearm.errors import ConfigError, ExitCode, InputError, TruearmError
from truearm.findings import Finding, entries, option, ordered
from truearm.live.choose_box import choose_box
from truearm.record.links import usb_ports
from truearm_wire.messages import RESTART

SHOW_S, PLAIN_S = 0.5, 1.0  # between two views of the monitor
_LIST_RETRIES = 6  # 3 s: a box that was just plugged in waits 2 s before it runs

app = CommandGroup(
    "box",
    help="Find, flash, test, configure, calibrate and monitor a sensor box.",
    epilog="Example: truearm box test --box /dev/ttyACM0",
)
config = CommandGroup(
    "config",
    help="Read and change a box's configuration: rates, channels, calibrations, magnetostrictive sensor.",
    epilog="Example: truearm box config get --box /dev/ttyACM0 --out box.toml",
)
app.add_command(config)


@command(app, "list")
def list_boxes(*, all: bool = False) -> Answer:
    """List the boxes that are plugged in.

    truearm asks every serial port with the USB identity of a Pico. A box that is being recorded is listed as in use.
    Boot drives are listed too. Other serial devices are asked only with --all, because the question may disturb them.

    Example: truearm box list

    Options
    -------
    all
        Ask every serial port, not only those of a Pico.
    """
    ports = [port for port in usb_ports() if port.candidate or all]
    rows = [_asked(port) for port in ports]
    drives = [str(drive) for chip in CHIPS.values() for drive in find_drives(chip.board)]
    stated = [Finding("boot-drive", {"drive": drive}) for drive in drives]
    if not rows and not drives:
        stated = [Finding("no-box-plugged-in")]
    document = {"ports": rows, "boot_drives": drives, "findings": entries(stated)}
    return Answer(document, [*(finding.text(option) for finding in stated), *port_lines(rows)])


def _asked(port: Any) -> dict[str, Any]:
    """Return a port and what answers there, as JSON."""
    row = {"device": port.device, "usb": port.usb, "serial": port.serial, "product": port.product, "box": None}
    try:
        with conversation(port.device, retries=_LIST_RETRIES) as box:
            ident = box.ident
    except InputError:
        raise
    except TruearmError as exc:
        return {**row, "answer": str(exc).removeprefix(f"{port.device}: ")}
    faults = f"; {'; '.join(ident.faults)}" if ident.faults else ""
    return {**row, "box": dict(ident.document), "answer": one_line_of(ident) + faults}


@command(app)
def info(*, box: str | None = None) -> Answer:
    """Print the description that a box gives of itself: firmware, streams, channels, calibrations, faults.

    Example: truearm box info --box /dev/ttyACM0
    """
    with conversation(choose_box(box, sys.stderr)) as connected:
        ident = connected.ident
    return Answer(ident.document, ident_lines(ident))


@command(app, "test")
def self_test(*, box: str | None = None, stop: bool = False) -> Answer:
    """Run the self-test of a box, and print whether it passes, then each result with what to do about it.

    The exit code is 1 if a test failed. A warning marks what was not measured or is near its limit.

    Example: truearm box test --box /dev/ttyACM0
    """
    device = choose_box(box, sys.stderr)
    with conversation(device, stop=stop) as connected:
        results = connected.self_test()
        ident = connected.identify()  # its faults are those of this test
    tested = findings(results, device)
    verdicts = Counter(finding.values["verdict"] for finding in tested.values())
    counts = {"passed": verdicts[PASS], "warned": verdicts[WARN], "failed": verdicts[FAIL], "box": one_line_of(ident)}
    faults = [  # but for the box's own fault of a failed self-test, whose results are stated
        fault for fault in ident.faults if not fault.startswith(("the box says 'self-test", 'the box says "self-test'))
    ]
    stated = [
        Finding("box-failed" if verdicts[FAIL] else "box-passed", counts),
        *sorted(tested.values(), key=lambda finding: finding.values["verdict"] != FAIL),
        *(Finding("box-fault", {"fault": fault}) for fault in faults),
    ]
    return Answer(
        [entry(name, finding) for name, finding in tested.items()],
        findings=ordered(stated),
        written=(),
        end=ExitCode.FAILED if verdicts[FAIL] else ExitCode.DONE,
    )


@command(app)
def reset(*, box: str | None = None, stop: bool = False) -> None:
    """Restart a box. This clears its stored traceback.

    Example: truearm box reset --box /dev/ttyACM0
    """
    device = choose_box(box, sys.stderr)
    with conversation(device, stop=stop) as connected:
        connected.reset(RESTART)
    click.echo(f"{device}: the box restarts")


@command(config)
def get(*, box: str | None = None, out: Path | None = None, force: bool = False, stop: bool = False) -> Answer:
    """Print a box's configuration as TOML.

    Example: truearm box config get --box /dev/ttyACM0 --out box.toml

    Options
    -------
    out : FILE
        File to write: the configuration (.toml), instead of printing it.
    """
    if out is not None:
        check_writable(out, force, kind="configuration")
    device = choose_box(box, sys.stderr)
    with conversation(device, stop=stop) as connected:
        config = configuration.checked_config(connected)
    text = configuration.format_config(config)
    if out is None:
        return Answer(config, text.splitlines())
    write_atomic(out, text)
    return Answer(config, [f"{out}: the configuration of {device}"])


@command(config, "set")
def put(changes: tuple[str, ...], *, box: str | None = None, dry_run: bool = False, stop: bool = False) -> Answer:
    """Change a box's configuration; print what changes.

    Values that you do not give stay unchanged; KEY= without a value removes an optional value, such as
    channel.lvdt.over. The box stores the new configuration at once. If the power fails meanwhile, it keeps either the
    old or the new one.

    Example:
      truearm box config set osr=2048 channel.lvdt.gain=2 magnetostrictive.us_per_inch=9.031 --box /dev/ttyACM0

    Arguments
    ---------
    changes : FILE.toml | KEY=VALUE...
        A file that truearm box config get wrote, or single values.

    Options
    -------
    dry_run
        Show what would change, and change nothing.
    """
    edits = [_edit(change) for change in changes]  # read before the box is asked
    device = choose_box(box, sys.stderr)
    with conversation(device, stop=stop) as connected:
        previous = config = configuration.checked_config(connected)
        for edit in edits:
            config = edit(config)
        configuration.check_ratios(configuration.check(config))
        changed = configuration.change_lines(previous, config)
        stored = bool(changed) and not dry_run
        if stored:
            connected.put_config(config)
    reason = "unchanged (--dry-run)" if changed else "nothing changes"
    outcome = "stored; the box uses it from now on" if stored else reason
    return Answer({"changes": changed, "stored": stored, "config": config}, [*changed, f"{device}: {outcome}"])


def _edit(change: str) -> Callable[[configuration.Values], configuration.Values]:
    """Return what changes a configuration according to a file or KEY=VALUE. Raises ConfigError."""
    path = Path(change)
    if "=" in change and not path.is_file():
        return partial(configuration.with_assignment, text=change)
    if not change.endswith(".toml") and not path.exists():
        raise ConfigError(f"{change[:60]!r} is neither KEY=VALUE, such as osr=2048, nor a file")
    return partial(configuration.with_file, text=read_text(path, configuration.MAX_BYTES, ConfigError), name=change)


@command(app)
def flash(options: FlashOptions) -> Answer:
    """Flash a box, then check that it answers.

    truearm checks the image first. An installed truearm contains its own; in a checkout, make uf2 builds it. With
    --box, a running box is asked to enter its boot loader. Without it, hold BOOTSEL while you plug in a new Pico: its
    drive is found, or given with --drive. The stored configuration and calibrations of a box are kept.

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
    stated = flash_box(options)
    return Answer({"findings": entries(stated)}, details_hint="")


@command(app)
def gauge(options: GaugeOptions) -> None:
    """Calibrate a sensor against a reference: gauge blocks, a micrometer, a stage with a scale.

    Set the reference, type its reading, and do not touch it while the box samples. Measure at least five places over
    the whole travel, preferably there and back. An empty line ends the measurement if the places are enough; "undo"
    drops the last place. With --references, Enter samples the place that is asked for, "s" skips it, and "q" ends the
    measurement. truearm chooses the lowest order of the polynomial that is not significantly worse than the best in
    cross-validation. For the magnetostrictive sensor, the velocity of sound and the delay are estimated. The report
    shows the remaining errors. If you agree, the box stores the calibration with its date and temperature. If a run
    ends early, the same command continues from the places that were measured.

    Example:
      truearm box gauge lvdt --box /dev/ttyACM0 --instrument "head 164-163, certificate 4711" --uncertainty-um 2

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
    from truearm.box.gauge import gauge_channel

    gauge_channel(choose_box(options.box, sys.stderr), options, click.echo, _answer)


def _answer(prompt: str) -> str | None:
    """Return what is typed at standard input, None at its end."""
    click.echo(prompt, nl=False)
    try:
        return input().strip()
    except EOFError:
        click.echo()
        return None


@command(app)
def monitor(*, box: str | None = None, duration: Annotated[float | None, DURATION] = None, plain: bool = False) -> None:
    """Show what a box measures: values in physical units with their noise, rates, losses, clock, temperature.

    Starts the box, and stops it at the end (Ctrl-C or --duration-s). Nothing is recorded.

    Example: truearm box monitor --box /dev/ttyACM0
    """
    from truearm.box.monitor import monitor_box

    with ExitStack() as stack:
        plain = plain or not sys.stdout.isatty()
        show = _plain if plain else _live(stack)
        print_lines(monitor_box(choose_box(box, sys.stderr), duration, PLAIN_S if plain else SHOW_S, show))


def _plain(rows: list[tuple[str, str]]) -> None:
    print("; ".join(f"{name} {value}" for name, value in rows), flush=True)


def _live(stack: ExitStack) -> Callable[[list[tuple[str, str]]], None]:
    from rich.live import Live

    from truearm.live.view import grid

    live = stack.enter_context(Live(auto_refresh=False, transient=False))
    return lambda rows: live.update(grid((*row, False) for row in rows), refresh=True)
