"""``truearm box config``: read and change the configuration of a box."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import typer

from truearm.box.conversation import conversation
from truearm.cli.command import command
from truearm.cli.output import command_group, print_json, print_lines
from truearm.cli.project import ProjectCommand
from truearm.errors import ConfigError
from truearm.live.choose_box import choose_box

config = command_group(
    "config",
    "Read and change a box's configuration: rates, channels, calibrations, magnetostrictive sensor.",
    "Example: truearm box config get --box /dev/ttyACM0 --out box.toml",
)


@config.command(cls=ProjectCommand)
@command()
def get(
    *,
    box: str | None = None,
    out: Path | None = None,
    force: bool = False,
    stop: bool = False,
    json: bool = False,
) -> None:
    """Print a box's configuration as TOML.

    Example: truearm box config get --box /dev/ttyACM0 --out box.toml

    Options
    -------
    out : FILE
        File to write: the configuration (.toml), instead of printing it.
    """
    from truearm.box.configuration import format_config
    from truearm.files.disk import check_writable, write_atomic

    if out is not None:
        check_writable(out, force, kind="configuration")
    device = choose_box(box, sys.stderr)
    with conversation(device, stop=stop) as connected:
        found = connected.config()
    text = format_config(found)
    if out is not None:
        write_atomic(out, text)
    if json:
        print_json(found)
    elif out is None:
        typer.echo(text, nl=False)
    else:
        typer.echo(f"{out}: the configuration of {device}")


@config.command("set", cls=ProjectCommand)
@command()
def put(
    changes: list[str],
    *,
    box: str | None = None,
    dry_run: bool = False,
    stop: bool = False,
    json: bool = False,
) -> None:
    """Change a box's configuration; print what changes.

    Values that you do not give stay unchanged; KEY= without a value removes an optional value, such as
    channel.lvdt.over. The box stores the new configuration at once. If the power fails meanwhile, it
    keeps either the old or the new one.

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
    from truearm.box.configuration import change_lines, checked_config

    texts = _read(changes)
    device = choose_box(box, sys.stderr)
    with conversation(device, stop=stop) as connected:
        before = checked_config(connected)
        after = _changed(before, texts)
        changed = change_lines(before, after)
        stored = bool(changed) and not dry_run
        if stored:
            connected.put_config(after)
    if json:
        print_json({"changes": changed, "stored": stored, "config": after})
        return
    print_lines(changed)
    if stored:
        typer.echo(f"{device}: stored; the box uses it from now on")
    else:
        typer.echo(f"{device}: unchanged (--dry-run)" if changed else f"{device}: nothing changes")


def _read(changes: list[str]) -> list[tuple[str, str | None]]:
    """(name of a file, its text) or (KEY=VALUE, None) of each argument."""
    from truearm.box.configuration import MAX_BYTES
    from truearm.files.disk import read_text

    found: list[tuple[str, str | None]] = []
    for change in changes:
        is_value = "=" in change and not Path(change).is_file()
        if "=" not in change and not change.endswith(".toml") and not Path(change).exists():
            raise ConfigError(f"{change[:60]!r} is neither KEY=VALUE, such as osr=2048, nor a file")
        found.append((change, None if is_value else read_text(Path(change), MAX_BYTES, ConfigError)))
    return found


def _changed(config: dict[str, Any], texts: list[tuple[str, str | None]]) -> dict[str, Any]:
    from truearm.box.configuration import check_ratios, with_assignment, with_file
    from truearm.box.configuration_schema import check

    for name, text in texts:
        config = with_assignment(config, name) if text is None else with_file(config, text, name)
    check_ratios(check(config))
    return config
