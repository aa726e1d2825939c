"""Simulate a recording and identify the robot from it (``truearm demo``)."""

from __future__ import annotations

import numpy as np

from truearm.files.plan_file import read_plan
from truearm.types import Plan
from truearm.workflows.identify import DEFAULTS, Identification, IdentifyFiles, identify_files
from truearm.workflows.inputs import Sources
from truearm.workflows.requests import SimulateOptions
from truearm.workflows.session_observations import Say
from truearm.workflows.simulate import SESSION, simulate_fast


def demonstrate(options: SimulateOptions, command: str, say: Say, warn: Say) -> Identification:
    """Write session, observations, result and report into ``options.out``; ``command`` is printed on the report. Raises InputError."""
    simulate_fast(options, say)
    folder = options.out
    files = IdentifyFiles(
        options.robot,
        Sources((folder / SESSION,), say=warn),
        (folder / "result.json",),
        folder / "observations.csv",
        folder / "report.html",
        command,
        force=True,
    )
    return identify_files(files, _held_out(read_plan(folder / "plan.csv")), DEFAULTS)


def _held_out(plan: Plan) -> list[str]:
    """Return the last bar and the last line of a plan; a fifth of the poses if it has one of each at most."""
    names = {column: [name for name in np.unique(getattr(plan, column)).tolist() if name] for column in ("bar", "line")}
    return [f"{column}={names[-1]}" for column, names in names.items() if len(names) > 1] or ["0.2"]
