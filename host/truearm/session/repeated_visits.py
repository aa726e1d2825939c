"""What a session says of the way a robot comes to its poses: from which side, how fast it settles, what noise it rests in.

A second look at the samples, for ``truearm characterize``. From the dwells that gave an observation (``SyncResult``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from truearm.session.dwell_samples import collect_samples
from truearm.session.dwells import Dwell
from truearm.session.joint_readings import Bins
from truearm.session.lvdt import bar_length, extension
from truearm.session.observations import SyncResult, came_from, disjoint
from truearm.session.sample_statistics import Allan, allan, mean_variance
from truearm.types import Floats, Rig

BEFORE_S = 0.6  # of the approach, looked at with each dwell
LONG_S = 8.0  # a dwell so long shows slow noise
FAR = 4.0  # bands; a bar that comes from nearer has not come into the band from outside
SIGMAS = 6.0  # a band must be wider than so many sigmas of a sample


@dataclass(frozen=True)
class Visits:
    """The n dwells of a session that gave an observation.

    ``direction`` (n, j): in which each joint moved last, −1 or 1, 0 where it did not. ``settling`` (n, b) [s]: how long after the
    bar first came within each of the bands of its mean it stayed there for good; NaN where it did not come from outside
    or the noise is too large for the band. ``mean_var`` (n, j) [rad², m²]: of the mean reading, its correlation counted, its
    quantisation not. ``spacing_s`` (n,): time between independent samples. ``rests``: samples [m] of each dwell that has a whole piece.
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
        """Of the long dwells, of all if none is long."""
        long = [rest for rest in self.rests if rest.size * self.period_s >= LONG_S]
        return allan(long or self.rests, self.period_s)


def joined(parts: Sequence[Visits]) -> Visits:
    """The visits of a session's parts, with the same bands, as one."""
    with_samples = [part.period_s for part in parts if part.rests]
    return Visits(
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
) -> Visits:
    """What the dwells of ``result`` have in common with the samples around them. ``bands`` [m] are those of the settling."""
    used = [dwell for dwell in result.dwells if not dwell.reason]
    bins = result.survey.joints.bins
    rests: list[Floats] = []
    settling, spacing, period_s = np.full((len(used), len(bands)), np.nan), np.full(len(used), np.nan), float("nan")
    before = round(1e9 * BEFORE_S)
    stood = [d.start_host_ns - round(1e9 * (d.start_s - d.stood_s)) for d in used]
    wanted = disjoint([(i, stood[i] - before, d.end_host_ns) for i, d in enumerate(used)])
    for taken in collect_samples(result.survey.samples, result.survey.clocks, wanted):
        dwell = used[taken.dwell]
        if taken.channel is None:
            continue
        bar = rig.bars[dwell.mounted["bar"]]
        begin_ns, counts = taken.longest_piece
        length = bar_length(extension(counts, taken.channel), bar)
        period_s = 1e-9 * taken.period_ns
        for k, band in enumerate(bands):
            if band > SIGMAS * dwell.noise:
                settling[taken.dwell, k] = stabilisation_time(length - dwell.value, band, period_s)
        rests.append(length[max(0, int(np.ceil((dwell.start_host_ns - begin_ns) / taken.period_ns))) :])
        spacing[taken.dwell] = period_s * dwell.n_samples / dwell.n_eff
    j = len(result.survey.joints.step)
    direction = np.array([came_from(bins, d) for d in used]).reshape(-1, j) if bins is not None else np.zeros((0, j))
    mean_var = np.array([_mean_var(bins, d) for d in used]).reshape(-1, j) if bins is not None else np.zeros((0, j))
    return Visits(tuple(used), direction, np.array(bands), settling, mean_var, period_s, spacing, tuple(rests))


def stabilisation_time(deviation: Floats, band: float, period_s: float) -> float:
    """From the first sample (n,) in the band to the one from which all are (ISO 9283, 7.4), after the last far excursion.

    NaN where the samples did not come from outside.
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
    """Variance (j,) of the mean reading of a dwell, by the means of its bins."""
    means = bins.mean[slice(*dwell.bins)]
    if len(means) < 4:
        return np.full(means.shape[1], np.nan)
    deviation = means - np.mean(means, axis=0)
    return np.array([mean_variance(column)[0] for column in deviation.T])
