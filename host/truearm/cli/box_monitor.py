"""``truearm box monitor``: show what a box measures, live."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack

from truearm.cli.command import command
from truearm.cli.output import print_lines
from truearm.live.choose_box import choose_box

SHOW_S = 0.5
PLAIN_S = 1.0


@command()
def monitor(
    *,
    box: str | None = None,
    duration_s: float | None = None,
    plain: bool = False,
) -> None:
    """Show what a box measures: values in physical units with their noise, rates, losses, clock, temperature.

    Starts the box, and stops it at the end (Ctrl-C or --duration-s). Nothing is recorded.

    Example: truearm box monitor --box /dev/ttyACM0
    """
    from truearm.box.monitor import monitor_box

    with ExitStack() as stack:
        plain = plain or not sys.stdout.isatty()
        show = _plain if plain else _live(stack)
        print_lines(monitor_box(choose_box(box, sys.stderr), duration_s, PLAIN_S if plain else SHOW_S, show))


def _plain(rows: list[tuple[str, str]]) -> None:
    print("; ".join(f"{name} {value}" for name, value in rows), flush=True)


def _live(stack: ExitStack) -> Callable[[list[tuple[str, str]]], None]:
    from rich.live import Live
    from rich.table import Table
    from rich.text import Text

    live = stack.enter_context(Live(auto_refresh=False, transient=False))

    def show(rows: list[tuple[str, str]]) -> None:
        table = Table.grid(padding=(0, 2))
        for name, value in rows:
            table.add_row(Text(name), Text(value))
        live.update(table, refresh=True)

    return show
