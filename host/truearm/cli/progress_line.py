"""Progress of steps that take longer than two seconds, on the terminal: name, percentage, elapsed and remaining time."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple

from rich.console import Console, RenderableType
from rich.progress import Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from truearm.progress import listening
from truearm.text import one_line

QUIET_S = 2.0  # shorter steps are not shown
PER_SECOND = 2.0  # times that they are drawn


class RunningStep(NamedTuple):
    """A step that is under way."""

    shown: Shown
    task: TaskID

    def advance(self, share: float) -> None:
        """Set the share that is done, 0 to 1."""
        self.shown.update(self.task, total=1.0, completed=share)

    def end(self) -> None:
        """End the step."""
        self.shown.remove_task(self.task)
        if not self.shown.tasks:  # others may draw on the terminal now
            with suppress(OSError):
                self.shown.stop()


class Shown(Progress):
    """Shows the steps below other output on a terminal, and clears them at their end. A terminal that is gone stops nothing."""

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

    def begin(self, name: str) -> RunningStep:
        """Begin a step; the first one starts the drawing."""
        with suppress(OSError):
            self.start()
        return RunningStep(self, self.add_task(one_line(name), total=None))

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
    with listening(Shown(Console(stderr=True))):
        yield
