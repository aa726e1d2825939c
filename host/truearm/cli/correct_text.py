"""What ``truearm correct`` prints."""

from __future__ import annotations

import math

import numpy as np

from truearm.text import one_line
from truearm.types import Floats
from truearm.units import DEG, MM
from truearm.workflows.calibration import mounting_lines
from truearm.workflows.correct import SHOWN, CorrectedFile


def lines(found: CorrectedFile) -> list[str]:
    """What was corrected, target by target, and what is left to doubt."""
    done, calibration, chain = found.correction, found.calibration, found.calibration.chain
    if found.own_frames:
        frames = "Targets lie in the robot's own base and flange frames; these mountings are left to you:"
    else:
        frames = (
            f"Targets are of {chain.end_frame} in {chain.base_frame}; how robot and tool were mounted is corrected too:"
        )
    said = [
        one_line(frames),
        *(f"  {one_line(line)}" for line in mounting_lines(chain, calibration.nominal, calibration.identified)),
    ]
    said.append(f"{'target':<10}{'before [mm]':>14}{'after [mm]':>14}{'before [deg]':>14}{'after [deg]':>14}")
    rows = list(zip(found.places, done.before, done.after, strict=True))
    said += [f"{place:<10}{_cells(before, after)}" for place, before, after in rows[:SHOWN]]
    said += [f"and {len(rows) - SHOWN} more"] * (len(rows) > SHOWN)
    before, after = (np.sqrt(np.mean(np.square(error), axis=0)) for error in (done.before, done.after))
    said.append(f"{'RMS':<10}{_cells(before, after)}")
    said.append("These errors are what the identified robot says; its own uncertainty comes on top.")
    return [*said, *found.notes, f"Written: {one_line(str(found.out))}"]


def _cells(before: Floats, after: Floats) -> str:
    mm = [f"{MM.of(error[0]):>14.4f}" for error in (before, after)]
    deg = [f"{DEG.of(error[1]):>14.5f}" if math.isfinite(error[1]) else f"{'-':>14}" for error in (before, after)]
    return "".join(mm + deg)
