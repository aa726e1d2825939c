"""Find how the robot approaches its poses, how fast it settles, and the noise at rest: for ``truearm characterize``.

``visits`` takes a second look at the samples of the dwells that gave an observation (``SyncResult``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from truearm.session.dwells import Dwell
from truearm.session.joint_readings import Bins
from truearm.session.observations import BAR, SyncResult, came_from
from truearm.session.sample_noise import Allan, allan, mean_variance
from truearm.session.samples import extension
from truearm.types import Floats, Rig

BEFORE_S = 0.6  # of the approach, included with each dwell
LONG_S = 8.0  # a dwell of this length shows slow noise
FAR = 4.0  # bands; a bar that starts nearer has not entered the band from outside
SIGMAS = 6.0  # a band must be wider than this many standard deviations of a sample


@dataclass(frozen=True)
class PoseVisits:
    """The n dwells of a session that gave an observation.

    ``direction`` (n, j): the last motion of each joint, −1 or 1, 0 if it did not move. ``settling`` (n, b) [s]: time
    from first entering each of the bands around the bar's mean to staying in it; NaN if the bar did not come from
    outside or the noise is too large for the band. ``mean_var`` (n, j) [rad², m²]: variance of the mean reading
    including correlation, without quantisation. ``spacing_s`` (n,): time between independent samples. ``rests``:
    samples [m] of each dwell with a gap-free piece.
    """

    dwells: tuple[Dwell, ...]
    direction: Floats
    bands: Floats  # (b,) m
    settling: Floats
    mean_var: Floats
    period_s: float
    spacing_s: Floats
    rests: tuple[Floats, ...]

    @property
    def allan(self) -> Allan:
        """Return the Allan deviation of the long dwells, or of all dwells if none is long."""
        long = [rest for rest in self.rests if rest.size * self.period_s >= LONG_S]
        return allan(long or self.rests, self.period_s)


def joined(parts: Sequence[PoseVisits]) -> PoseVisits:
    """Join the visits of a session's parts, which have the same bands."""
    with_samples = [part.period_s for part in parts if part.rests]
    return PoseVisits(
        dwells=tuple(dwell for part in parts for dwell in part.dwells),
        direction=np.concatenate([part.direction for part in parts]),
        bands=parts[0].bands,
        settling=np.concatenate([part.settling for part in parts]),
        mean_var=np.concatenate([part.mean_var for part in parts]),
        period_s=with_samples[0] if with_samples else float("nan"),
        spacing_s=np.concatenate([part.spacing_s for part in parts]),
        rests=tuple(rest for part in parts for rest in part.rests),
    )


def visits(
    result: SyncResult,
    rig: Rig,
    bands: Sequence[float],
) -> PoseVisits:
    """Combine the dwells of ``result`` with the samples around them. ``bands`` [m] are those of the settling time."""
    used = [dwell for dwell in result.dwells if not dwell.reason]
    bins = result.survey.joints.bins
    rests: list[Floats] = []
    settling, spacing, period_s = np.full((len(used), len(bands)), np.nan), np.full(len(used), np.nan), float("nan")
    before = round(1e9 * BEFORE_S)
    (samples,) = result.survey.samples[BAR]
    for i, dwell in enumerate(used):
        stood_ns = dwell.start_host_ns - round(1e9 * (dwell.start_s - dwell.stood_s))
        taken = samples.during(stood_ns - before, dwell.end_host_ns)
        if taken is None:
            continue
        bar = rig.bars[dwell.mounted["bar"]]
        begin_ns, counts = taken.longest()
        length = bar.zero + bar.gain * extension(counts, taken.channels[0])
        period_s = 1e-9 * taken.period_ns
        for k, band in enumerate(bands):
            if band > SIGMAS * dwell.noise:
                settling[i, k] = stabilisation_time(length - dwell.value, band, period_s)
        rests.append(length[max(0, int(np.ceil((dwell.start_host_ns - begin_ns) / taken.period_ns))) :])
        spacing[i] = period_s * dwell.n_samples / dwell.n_eff
    j = len(result.survey.joints.step)
    direction = np.array([came_from(bins, d) for d in used]).reshape(-1, j) if bins is not None else np.zeros((0, j))
    mean_var = np.array([_mean_var(bins, d) for d in used]).reshape(-1, j) if bins is not None else np.zeros((0, j))
    return PoseVisits(tuple(used), direction, np.array(bands), settling, mean_var, period_s, spacing, tuple(rests))


def stabilisation_time(deviation: Floats, band: float, period_s: float) -> float:
    """Return the time from the first sample (n,) in the band to the one from which all are in it (ISO 9283, 7.4).

    Counted after the last large excursion. NaN if the samples did not come from outside.
    """
    size = np.abs(deviation)
    farthest = float(np.max(size, initial=0.0))
    if farthest < FAR * band:
        return float("nan")
    coming = int(np.flatnonzero(size >= 0.5 * farthest)[-1])
    inside = size[coming:] <= band
    if not inside[-1]:
        return float("nan")
    first = int(np.argmax(inside))
    outside = np.flatnonzero(~inside)
    return period_s * max(0, int(outside[-1]) + 1 - first)


def _mean_var(bins: Bins, dwell: Dwell) -> Floats:
    """Return the variance (j,) of the mean reading of a dwell, from the means of its bins."""
    means = bins.mean[slice(*dwell.bins)]
    if len(means) < 4:
        return np.full(means.shape[1], np.nan)
    deviation = means - np.mean(means, axis=0)
    return np.array([mean_variance(column)[0] for column in deviation.T])
