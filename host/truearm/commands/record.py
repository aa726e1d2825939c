"""``truearm record``: a session file from a box and, if there is one, a robot."""

from __future__ import annotations

import math
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from truearm.errors import InputError, LinkError, TruearmError

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from truearm.record.links import Clock
    from truearm.record.status import RecordSummary, Status
    from truearm.types import Plan, Rig

# The converter's modulator runs at 125 MHz / 15 / 2; a sample is osr of its periods.
MODULATOR_HZ = 125e6 / 15 / 2
OSRS = tuple(1 << k for k in range(7, 15))  # 128 … 16384
_MOUNTABLE = ("bar", "chuck", "sphere", "shell")
_PLAIN_EVERY_S = 10.0
_INTERRUPTED = 130
# Python lets a busy thread run for 5 ms before another gets its turn; the thread that stamps arrivals cannot wait so long.
_SWITCH_INTERVAL_S = 2e-4


def record(
    device: Annotated[
        str, typer.Option(metavar="DEVICE", help="The box: /dev/ttyACM0, COM3 or socket://127.0.0.1:7007.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The session file to write (.mcap).")],
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="The robot's joint readings: tcp://127.0.0.1:7008 (JSON lines), rtde://192.168.0.2 (Universal Robots), "
            "lines+tcp:// or lines+udp:// (CSV, or JSON with names and units of its own: docs/robots.md).",
        ),
    ] = None,
    plan: Annotated[Path | None, typer.Option(metavar="FILE", help="The poses that the robot visits (.csv).")] = None,
    rig: Annotated[Path | None, typer.Option(metavar="FILE", help="Chucks, spheres, bars (.toml).")] = None,
    mounted: Annotated[
        str | None, typer.Option(metavar="LIST", help="What is mounted: bar=bar46,chuck=c1,sphere=s1.")
    ] = None,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Samples a second; the nearest of the box's rates.")] = 1000,
    duration: Annotated[
        float | None, typer.Option(metavar="S", help="End after so many seconds; default: with the robot, or Ctrl-C.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the session file.")] = False,
) -> None:
    """Record a sensor box and a robot into a session file.

    Ends when the robot closes its stream, after --duration or with Ctrl-C; each completes the file. An earlier file is
    overwritten (--force) only once the box has started.

    \b
    Example:
      truearm record --device /dev/ttyACM0 --robot tcp://127.0.0.1:7008 --rig rig.toml --plan plan.csv --out session.mcap
    """
    from truearm.files.disk import check_writable

    osr = nearest_osr(rate)
    if duration is not None and not 0 < duration < math.inf:
        raise InputError(f"--duration {duration:g} is no time; give seconds above 0")
    check_writable(out, inputs=[path for path in (rig, plan) if path is not None])
    if out.exists() and not force:
        raise InputError(f"{out}: exists; choose another name or give --force")
    poses, rig_toml, mounting = _read_inputs(plan, rig, mounted)
    summary, kept = _record(device, robot, out, force, poses, rig_toml, mounting, osr, duration)
    where = f"what came is in {out}" if kept else "nothing was recorded"
    if kept:
        typer.echo(f"{out}: {_totals(summary)}; ended: {summary.reason}")
        for fault in summary.faults:
            typer.echo(f"{out}: {fault}")
    if summary.reason == "interrupted":
        if not kept:
            typer.echo("interrupted before the box had started; nothing was recorded", err=True)
        raise typer.Exit(_INTERRUPTED)
    missing = what_is_missing(summary, robot is not None)
    if missing:
        raise LinkError(f"{missing}; {where}")


def what_is_missing(summary: RecordSummary, with_robot: bool) -> str:
    """Why a recording that ended is not what was asked for; "" if it is."""
    said = []
    if summary.reason in ("link lost", "robot lost", "no readings"):
        said.append(summary.text)
    elif with_robot and not summary.counters.robot_lines:
        closed = "the robot closed its stream without" if summary.reason == "robot closed" else "there is not"
        said.append(f"{closed} a joint reading")
    if summary.box_gone and summary.reason != "link lost":
        lost_s = summary.duration_s - summary.heard_s
        said.append(f"the box was gone at the end, and silent for the last {lost_s:.1f} s ({summary.box_gone})")
    return "; ".join(said)


def _record(
    device: str,
    robot: str | None,
    out: Path,
    force: bool,
    poses: list[dict[str, Any]],
    rig_toml: bytes | None,
    mounting: Mapping[str, str],
    osr: int,
    duration: float | None,
) -> tuple[RecordSummary, bool]:
    """The summary, and whether there is a file."""
    from truearm.record.links import HostClock
    from truearm.record.ports import BoxPort
    from truearm.record.recorder import record as record_session
    from truearm.record.reopening import Reopening
    from truearm.record.session_writer import SessionWriter

    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    clock = HostClock()
    with (
        closing(Reopening(BoxPort(device, clock))) as link,
        _robot_link(robot, clock) as robot_link,
        SessionWriter(out, clock, overwrite=force, hold=True) as writer,
        asked_to_stop() as interrupted,
        _progress(duration) as progress,
    ):
        try:
            summary = record_session(
                link,
                writer,
                clock,
                robot=robot_link,
                plan=poses,
                rig_toml=rig_toml,
                mounted=mounting,
                osr=osr,
                duration_s=duration,
                interrupted=interrupted,
                progress=progress,
            )
        except TruearmError as exc:
            kept = f"; what came until then is in {out}" if writer.kept else ""
            raise type(exc)(f"{exc}{kept}") from exc
        return summary, writer.kept


def _robot_link(url: str | None, clock: Clock) -> AbstractContextManager[Any]:
    from truearm.record.robots.open import open_source

    return nullcontext() if url is None else closing(open_source(url, clock))


def nearest_osr(rate: float) -> int:
    """The oversampling ratio whose rate is nearest to ``rate`` [Hz]. Raises InputError beyond the box's rates."""
    slowest, fastest = MODULATOR_HZ / OSRS[-1], MODULATOR_HZ / OSRS[0]
    if not 0.9 * slowest <= rate <= 1.1 * fastest:
        raise InputError(f"--rate {rate:g} Hz is not within the box's {slowest:.0f} to {fastest:.0f} Hz")
    return min(OSRS, key=lambda osr: abs(MODULATOR_HZ / osr - rate))


def parse_mounted(text: str) -> dict[str, str]:
    """``bar=bar46,chuck=c1`` as a mapping. Raises InputError."""
    mounting: dict[str, str] = {}
    for entry in text.split(","):
        key, separator, name = (part.strip() for part in entry.partition("="))
        if key not in _MOUNTABLE or not separator or not name:
            raise InputError(f"--mounted: {entry[:40]!r} is not KEY=NAME with a key of {', '.join(_MOUNTABLE)}")
        if key in mounting:
            raise InputError(f"--mounted names a {key} twice")
        mounting[key] = name
    return mounting


def _read_inputs(
    plan_path: Path | None, rig_path: Path | None, mounted: str | None
) -> tuple[list[dict[str, Any]], bytes | None, dict[str, str]]:
    """The plan as ``/plan`` holds it, the rig file's bytes and what is mounted, each held against the rig."""
    from truearm.errors import RigError
    from truearm.files.disk import read_bytes
    from truearm.files.plan import check_against_rig, read_plan
    from truearm.files.rig import MAX_BYTES, read_rig

    mounting = {} if mounted is None else parse_mounted(mounted)
    plan = None if plan_path is None else read_plan(plan_path)
    rig_toml = None
    if rig_path is not None:
        rig = read_rig(rig_path)
        rig_toml = read_bytes(rig_path, MAX_BYTES, RigError)
        _check_mounted(mounting, rig, str(rig_path))
        if plan is not None:
            check_against_rig(plan, rig, str(plan_path))
    return ([] if plan is None else plan_rows(plan)), rig_toml, mounting


def _check_mounted(mounting: Mapping[str, str], rig: Rig, name: str) -> None:
    for key, known in (("bar", rig.bars), ("chuck", rig.chucks), ("sphere", rig.spheres)):
        if key in mounting and mounting[key] not in known:
            names = ", ".join(sorted(known)) or "none"
            raise InputError(f"--mounted: {key} {mounting[key][:40]!r} is not in {name} (it has {names})")


def plan_rows(plan: Plan) -> list[dict[str, Any]]:
    """The messages of ``/plan``, one a row."""
    return [_plan_row(plan, pose) for pose in range(len(plan))]


def _plan_row(plan: Plan, pose: int) -> dict[str, Any]:
    row: dict[str, Any] = {"pose": pose, **{name: str(getattr(plan, name)[pose]) for name in plan.IDS}}
    if plan.move[pose] != "dwell":
        row["move"] = str(plan.move[pose])
    if plan.lines[pose]:
        row |= {"line": str(plan.line[pose]), "target": str(plan.target[pose]), "speed_m_s": float(plan.speed[pose])}
    return row | {"q": plan.q[pose].tolist()}


@contextmanager
def asked_to_stop() -> Iterator[Callable[[], bool]]:
    """Ctrl-C and SIGTERM only raise a flag: an exception could strike in the middle of a record of the file."""
    asked = threading.Event()
    before = {number: signal.signal(number, lambda *_: asked.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _progress(duration: float | None) -> Iterator[Callable[[Status], None]]:
    """A live line on a terminal, else a plain line every ten seconds; what is wrong with the box at once. All on stderr."""
    if not sys.stderr.isatty():
        yield _warning(_plain_progress(), lambda text: print(text, file=sys.stderr, flush=True))
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(bar_width=10), TimeElapsedColumn())
    with Progress(*columns, TextColumn("{task.fields[text]}"), console=Console(stderr=True), transient=True) as display:
        task = display.add_task("identifying", total=duration, text="")

        def show(status: Status) -> None:
            display.update(task, description=status.state, completed=status.elapsed_s, text=describe(status))

        yield _warning(show, lambda text: display.console.print(text, markup=False, highlight=False))


def _warning(show: Callable[[Status], None], say: Callable[[str], None]) -> Callable[[Status], None]:
    """``show``, which first says each fault of the box, once, and each time that the box is lost or back."""
    said: set[str] = set()
    box_ok = True

    def watch(status: Status) -> None:
        nonlocal box_ok
        for fault in status.faults:
            if fault not in said:
                said.add(fault)
                say(f"warning: {fault}; its samples are recorded all the same")
        if status.box_ok != box_ok:
            box_ok = status.box_ok
            say(_box_words(status))
        show(status)

    return watch


def _box_words(status: Status) -> str:
    if status.box_ok:
        return f"{status.elapsed_s:.1f} s: the box is back"
    if status.state == "link lost":
        return f"warning: {status.elapsed_s:.1f} s: the link to the box was lost; trying to open it again"
    return f"warning: {status.elapsed_s:.1f} s: the box has been silent for 3 s; is it stuck?"


def _plain_progress() -> Callable[[Status], None]:
    due_s = _PLAIN_EVERY_S

    def show(status: Status) -> None:
        nonlocal due_s
        if status.elapsed_s >= due_s:
            due_s += _PLAIN_EVERY_S
            print(f"{status.elapsed_s:.0f} s: {describe(status)}", file=sys.stderr, flush=True)

    return show


def describe(status: Status) -> str:
    """Samples, rate, losses, clock and robot on one line."""
    counters = status.counters
    rate = counters.samples / status.elapsed_s if status.elapsed_s > 0 else 0.0
    parts = [f"{counters.samples} samples", f"{rate:.1f} Hz", f"{counters.lost_frames} lost"]
    if status.rtt_us is not None:
        parts.append(f"rtt {status.rtt_us:.0f} µs")
    if status.robot_ok is not None:
        parts.append(f"robot {'ok' if status.robot_ok else 'gone'} ({counters.robot_lines})")
    if not status.box_ok:
        parts.append("box gone")
    return ", ".join(parts)


def _totals(summary: RecordSummary) -> str:
    counters = summary.counters
    parts = [f"{summary.duration_s:.1f} s", f"{counters.samples} samples", f"{counters.lost_frames} frames lost"]
    if counters.robot_lines or counters.robot_console_bytes:
        parts.append(f"{counters.robot_lines} robot lines")
    if counters.robot_other_joints:
        parts.append(f"{counters.robot_other_joints} malformed (another number of joints than the first)")
    if counters.restarts:
        parts.append(f"{counters.restarts} box restarts")
    if counters.link_losses:
        parts.append(f"link lost {counters.link_losses} times")
    return ", ".join(parts)
