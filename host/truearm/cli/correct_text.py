"""What ``truearm correct`` prints."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from truearm.model.robot_mounting import mountings
from truearm.text import counted, one_line
from truearm.types import Floats, rms_of_columns
from truearm.units import DEG, MM
from truearm.workflows.calibration import Calibration, mounting_lines
from truearm.workflows.correct import SHOWN, CorrectedFile
from truearm.workflows.correction_findings import Refused

MOST_REFUSED = 30  # shown one by one
NOTHING = 1e-7  # m, rad: less than the last digit that is printed


def lines(found: CorrectedFile) -> list[str]:
    """Return the moves that were not corrected, what was corrected, target by target, and the warnings."""
    done, calibration, chain = found.correction, found.calibration, found.calibration.chain
    mounted = mounting_lines(chain, calibration.nominal, calibration.identified)
    if found.own_frames:
        frames = "Targets are in the robot's own base and flange frames; these mountings are not corrected:"
    elif _nominal_mountings(calibration):
        frames = f"Targets are poses of {chain.end_frame} in {chain.base_frame}; the mountings of robot and tool were held at their nominal values, so they are not corrected."
        mounted = []
    else:
        frames = f"Targets are poses of {chain.end_frame} in {chain.base_frame}; the mountings of robot and tool are corrected as far as they were identified:"
    text = [*refused_lines(found.refused), one_line(frames), *(f"  {one_line(line)}" for line in mounted)]
    text.append(f"{'target':<10}{'before [mm]':>14}{'after [mm]':>14}{'before [deg]':>14}{'after [deg]':>14}")
    rows = list(zip(found.places, done.before, done.after, strict=True))
    text += [f"{place:<10}{_cells(before, after)}" for place, before, after in rows[:SHOWN]]
    text += [f"and {len(rows) - SHOWN} more"] * (len(rows) > SHOWN)
    before, after = map(rms_of_columns, (done.before, done.after))
    text.append(f"{'RMS':<10}{_cells(before, after)}")
    text.append(
        f"These are the errors of {one_line(found.error_point)}, computed with the identified robot; its uncertainty is not included."
    )
    return [*text, *found.warnings, *found.notes, f"Written: {one_line(str(found.out))}"]


def _nominal_mountings(calibration: Calibration) -> bool:
    """Return whether the identification left base and tool where they are described."""
    found = mountings(calibration.chain, calibration.nominal, calibration.identified)
    return bool(np.allclose(found, np.eye(4), rtol=0.0, atol=NOTHING))


def refused_lines(refused: Sequence[Refused]) -> list[str]:
    """Return the statements of a program that move the robot or may move it and are not corrected, their number first."""
    if not refused:
        return []
    rows = [
        f"  {one_line(move.file)} line {move.line}: {one_line(move.statement)}: {move.reason.text('--{}'.format)}"
        for move in refused[:MOST_REFUSED]
    ]
    more = [f"  and {counted(len(refused) - MOST_REFUSED, 'more move')}"] * (len(refused) > MOST_REFUSED)
    return [f"{counted(len(refused), 'move')} not corrected:", *rows, *more]


def _cells(before: Floats, after: Floats) -> str:
    mm = [f"{MM.of(error[0]):>14.4f}" for error in (before, after)]
    deg = [f"{DEG.of(error[1]):>14.5f}" if math.isfinite(error[1]) else f"{'-':>14}" for error in (before, after)]
    return "".join(mm + deg)
