"""The last words of ``truearm demo``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from truearm.kinds.table import ObservationTable
from truearm.results import Figures
from truearm.session.observations import SyncResult
from truearm.text import outcome
from truearm.types import BallBar
from truearm.units import CM, MM, NS, US
from truearm.workflows.demo_ball_bar import BallBarCalibration
from truearm.workflows.demo_lines import N_LINES, LineCalibration, delay_words
from truearm.workflows.demo_steps import ClockTruth, Steps


def recording_lines(result: SyncResult, truth: ClockTruth, steps: Steps, used: str) -> list[str]:
    """Seconds in all, what was recorded, lost and used, and how well the box's clock is known."""
    losses = result.losses
    lost = losses.samples_lost + losses.samples_overrun
    return [
        f"\n{'total':<42}{steps.total_s:7.1f} s\n",
        f"samples         {result.samples_seen:,} recorded, {lost} lost; {used}",
        f"clock           largest error {US.text(NS.to_si(truth.error_ns), '.0f')} against the simulator's truth, "
        f"{'within' if truth.within else 'OUTSIDE'} its reported bound ({US.text(NS.to_si(truth.bound_ns), '.0f')} at most)",
    ]


def used(table: ObservationTable) -> str:
    """How many observations of each kind were used."""
    dwells, points = int(np.sum(table.kind == "ball_bar")), int(np.sum(table.kind == "line"))
    return " and ".join([f"{dwells} dwells"] * (dwells > 0) + [f"{points} points on lines used"])


def shells(bar: BallBar) -> str:
    """What the shells of a bar are called."""
    return f"{CM.of(bar.zero):.0f} cm shells"


def ball_bar_lines(found: BallBarCalibration) -> list[str]:
    """What the ball-bar found: rank, and the errors on the shells that were fitted and on the others."""
    estimate = found.estimate
    n_free, n_fitted = int(estimate.free.sum()), int(estimate.fitted.sum())
    subject = found.subject
    expected = MM.of(subject.fitted.sigma * (1.0 - estimate.rank / n_fitted) ** 0.5)
    lines = [
        f"parameters      rank {estimate.rank} of {n_free} free (rank {found.all_free.rank} if all {len(estimate.free)} were free), "
        f"{outcome(estimate.status, estimate.iterations)}",
        f"{shells(subject.fitted):<16}{MM.text(estimate.rms_before['m'], '.3f')} RMS before, {MM.text(estimate.rms_after['m'], '.4f')} after "
        f"({n_fitted} dwells; noise alone would leave {expected:.4f})",
    ]
    before, after = estimate.held_out_before, estimate.held_out
    if before is not None and after is not None:
        lines.append(
            f"{shells(subject.judging):<16}{MM.text(before.figures['m'].rms, '.3f')} RMS before, "
            f"{MM.text(after.figures['m'].rms, '.4f')} after ({after.n} dwells that were not fitted)"
        )
    return lines


def line_lines(found: LineCalibration) -> list[str]:
    """What lines found, by themselves or beside the ball-bar."""
    estimate, other, table = found.estimate, found.other, found.table
    text = [
        f"robot's delay   {delay_words(estimate)}",
        f"parameters      rank {estimate.rank} of {int(estimate.free.sum())} free (rig included), {outcome(estimate.status)}",
    ]
    is_line, fitted = table.kind == "line", estimate.fitted
    sensors = MM.of(float(np.linalg.norm(found.rig.line_sigma)))
    if found.with_bar:
        text += _group(shells(found.subject.fitted), found, ~is_line & fitted, "")
        text += _group(shells(found.subject.judging), found, ~is_line & ~fitted, ", not fitted")
    text += _group(f"{N_LINES} lines", found, is_line & fitted, f"; the sensors alone would leave {sensors:.4f}")
    text += _group("validation line", found, is_line & ~fitted, ", not fitted")
    if not found.with_bar:
        steps_of = " → ".join(f"{MM.of(rms):.3f}" for rms in estimate.rms_history["m"][:4])
        text.append(f"by iteration    {steps_of} mm RMS on the {N_LINES} lines, beginning with the rig as described")
        text.append("before          the nominal robot with rig, base and tool fitted to it")
        robot = slice(estimate.n_robot_parameters)
        seen = estimate.sigma[robot] > 0.0
        apart = np.abs(other.value[robot] - estimate.value[robot])[seen] / estimate.sigma[robot][seen]
        text.append(f"row by row      the recursive solver ends within {apart.max():.1g} σ of this estimate")
    else:
        alone = Figures.of(other.residual["m"][is_line & ~fitted]).rms
        text.append(f"ball-bar alone  would leave {MM.text(alone, '.4f')} on the validation line")
    return text


def _group(label: str, found: LineCalibration, rows: NDArray[np.bool_], note: str) -> list[str]:
    before, after = (Figures.of(r["m"][rows]).rms for r in (found.estimate.residual_before, found.estimate.residual))
    n = int(rows.sum())
    return [f"{label:<16}{MM.text(before, '.3f')} RMS before, {MM.text(after, '.4f')} after ({n} observations{note})"]
