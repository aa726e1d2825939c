"""Find how fast the bar settles at each pose, and the noise at rest: for ``truearm characterize``.

``visits`` takes a second look at the samples of the dwells that gave an observation of the bar (``SyncResult``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from truearm.session.dwells import Dwell
from truearm.session.joint_readings import Bins
from truearm.session.observations import BAR, SyncResult
from truearm.session.sample_noise import mean_variance
from truearm.session.samples import extension
from truearm.types import Floats, Rig

BEFORE_NS = 600_000_000  # of the approach, included with each dwell
FAR = 4.0  # bands; a bar that starts nearer has not entered the band from outside
SIGMAS = 6.0  # a band must be wider than this many standard deviations of a sample


@dataclass(frozen=True)
class PoseVisit:
    """A dwell of j joints that gave an observation.

    ``side`` (j,): the last motion of each joint, −1 or 1, NaN if it did not move. ``mean_var`` (j,) [rad², m²]: variance
    of the mean reading including correlation, without quantisation. ``settling`` (b,) [s]: time from first entering each
    band around the bar's mean to staying in it; NaN if the bar did not come from outside or the noise is too large for
    the band. ``rest`` (n,) [m]: the samples at rest, ``period_s`` apart, of the longest piece without a gap.
    """

    dwell: Dwell
    side: Floats
    mean_var: Floats
    settling: Floats
    rest: Floats
    period_s: float


def visits(result: SyncResult, rig: Rig, bands: Sequence[float]) -> list[PoseVisit]:
    """Return the visits of a session. ``bands`` [m] are those of the settling time."""
    dwells = [dwell for dwell in result.dwells if not dwell.reason]
    sides = result.table.side[result.table.kind == BAR]
    return [_visit(dwell, side, result, rig, bands) for dwell, side in zip(dwells, sides, strict=True)]


def _visit(dwell: Dwell, side: Floats, result: SyncResult, rig: Rig, bands: Sequence[float]) -> PoseVisit:
    stood_ns = dwell.start_host_ns - round(1e9 * (dwell.start_s - dwell.stood_s))
    (channel,) = result.survey.samples[BAR]
    samples = channel.during(stood_ns - BEFORE_NS, dwell.end_host_ns)
    assert samples is not None  # the dwell has some
    bar, period_s = rig.bars[dwell.mounted["bar"]], 1e-9 * samples.period_ns
    begin_ns, counts = samples.longest()
    length = bar.zero + bar.gain * extension(counts, samples.channels[0])
    times = [
        stabilisation_time(length - dwell.value, band, period_s) if band > SIGMAS * dwell.noise else np.nan
        for band in bands
    ]
    n_before = max(0, -(-(dwell.start_host_ns - begin_ns) // samples.period_ns))
    mean_var = _mean_var(result.survey.joints.bins, dwell)
    return PoseVisit(dwell, side, mean_var, np.array(times), length[n_before:], period_s)


def stabilisation_time(deviation: Floats, band: float, period_s: float) -> float:
    """Return the time from the first sample (n,) in the band to the one from which all are in it (ISO 9283, 7.4).

    Counted after the last large excursion. NaN if the samples did not come from outside.
    """
    size = np.abs(deviation)
    farthest = float(np.max(size, initial=0.0))
    if farthest < FAR * band or size[-1] > band:
        return float("nan")
    inside = size[np.flatnonzero(size >= 0.5 * farthest)[-1] :] <= band
    outside = np.flatnonzero(~inside)  # the first sample is outside
    return period_s * (int(outside[-1]) + 1 - int(np.argmax(inside)))


def _mean_var(bins: Bins | None, dwell: Dwell) -> Floats:
    """Return the variance (j,) of the mean reading of a dwell, from the means of its bins."""
    means = np.zeros((0, dwell.q.size)) if bins is None else bins.mean[slice(*dwell.bins)]
    if len(means) < 4:
        return np.full(dwell.q.size, np.nan)
    return np.array([mean_variance(column)[0] for column in (means - np.mean(means, axis=0)).T])
