"""Progress of steps longer than two seconds, on the terminal: name, percentage, elapsed and remaining time."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress

from rich.console import Console, RenderableType
from rich.progress import Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from truearm.progress import Advance, listening
from truearm.text import one_line

QUIET_S = 2.0  # shorter steps are not shown
PER_SECOND = 2.0  # times that they are drawn


class Shown(Progress):
    """Shows the steps below other output on a terminal, and clears them at their end.

    A terminal that is gone stops nothing.
    """

    def __init__(self, console: Console) -> None:
        super().__init__(
            TextColumn("{task.description}", markup=False),
            TaskProgressColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
            refresh_per_second=PER_SECOND,
            transient=True,
            redirect_stdout=sys.stdout.isatty(),
        )

    @contextmanager
    def running(self, name: str) -> Iterator[Advance]:
        """Show a step while it is under way; the first one starts the drawing."""
        with suppress(OSError):
            self.start()
        task = self.add_task(one_line(name), total=None)
        try:
            yield lambda share: self.update(task, total=1.0, completed=share)
        finally:
            self.remove_task(task)
            if not self.tasks:  # others may draw on the terminal now
                with suppress(OSError):
                    self.stop()

    def refresh(self) -> None:
        """Draw the steps."""
        with suppress(OSError):
            super().refresh()

    def get_renderables(self) -> Iterable[RenderableType]:
        """Yield the steps that are older than two seconds."""
        yield self.make_tasks_table([task for task in self.tasks if (task.elapsed or 0.0) >= QUIET_S])


@contextmanager
def shown_progress() -> Iterator[None]:
    """Show the progress of steps inside this context on standard error, a terminal."""
    with listening(Shown(Console(stderr=True)).running):
        yield
