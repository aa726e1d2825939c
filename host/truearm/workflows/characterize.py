"""Characterize robot and sensor from a session of approaches, as a document and a noise file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isfinite
from statistics import mode
from typing import Any

import numpy as np

from truearm.disk import check_writable, write_atomic
from truearm.errors import Argument, InputError, RigError, SessionError
from truearm.estimate import repeatability
from truearm.findings import Finding, entries, ordered, stated
from truearm.kinds.rig_file import NoiseFile, format_noise, read_rig
from truearm.model.chain import Chain, distance_jacobian
from truearm.plan.plan_file import read_plan
from truearm.progress import step
from truearm.report.tables import Table
from truearm.session.dwells import Dwell, mean_variance
from truearm.session.joint_readings import Bins
from truearm.session.observations import BAR, SyncResult
from truearm.session.samples import extension
from truearm.session.session_file import Session
from truearm.text import counted, one_line
from truearm.types import Floats, Rig
from truearm.units import MM, MRAD, MS, UM, S, Scale
from truearm.workflows.recorded_session import (
    observations_of_session,
    open_finished,
    reasons_text,
    recorded_rig,
    session_parts,
)
from truearm.workflows.requests import CharacterizeFiles

Document = Mapping[str, Any]

JOINTS = ("joint", "backlash/mrad", "difference/mrad", "scatter/mrad", "sigma to use/mrad")
LEAST_VISITS = 6
LONG_S = 8.0  # a dwell of this length shows slow noise
BEFORE_NS = 600_000_000  # of the approach, included with each dwell
FAR = 4.0  # bands; a bar that starts nearer has not entered the band from outside
SIGMAS = 6.0  # a band must be wider than this many standard deviations of a sample


@step("characterizing")
def characterize_files(files: CharacterizeFiles, bands: Sequence[float]) -> dict[str, Any]:
    """Read all parts of a session and write the noise file; return the results.

    ``bands`` [m]: for the settling time. Raises InputError, RigError, SessionError.
    """
    paths = session_parts(files.session)
    if files.out is not None:
        inputs = [*paths, *filter(None, [files.rig, files.plan]), *files.robot.files]
        check_writable(files.out, files.force, inputs=inputs, kind="noise")
    chain = files.robot.load().chain
    sessions = [open_finished(path, files.allow_damaged) for path in paths]
    rig = _recorded_rig(sessions) if files.rig is None else read_rig(files.rig)
    plan = None if files.plan is None else read_plan(files.plan)
    results = [observations_of_session(session, rig, may_be_empty=True, plan=plan) for session in sessions]
    document, noise = characterized(results, chain, rig, bands, paths[0].name)
    if files.out is not None:
        write_atomic(files.out, format_noise(noise, list(remarks(document)), "m" in chain.joint_units))
    return {**document, "findings": entries(repeatability_findings(document))}


def _recorded_rig(sessions: Sequence[Session]) -> Rig:
    """Return the rig with which all parts of a session were recorded."""
    first, *later_parts = ((session.path, recorded_rig(session, session.path)) for session in sessions)
    for path, rig in later_parts:
        if rig != first[1]:
            raise RigError(f"{path}: was recorded with another rig than {first[0]}; give one as ", Argument("rig"))
    return first[1]


def characterized(
    results: Sequence[SyncResult], chain: Chain, rig: Rig, bands: Sequence[float], name: str
) -> tuple[dict[str, Any], NoiseFile]:
    """Return everything that the parts of a session show about the robot's repeatability.

    Raises InputError if it is of another robot or its parts do not belong together, SessionError if required data is
    missing.
    """
    visited = [visit for result in results for visit in visits(result, rig, bands)]
    if len(visited) < LEAST_VISITS:
        rejected = sum((Counter(result.reasons) for result in results), Counter[str]())
        raise SessionError(
            f"{name}: only {counted(len(visited), 'dwell')} can be used, {LEAST_VISITS} are needed "
            f"({reasons_text(rejected) or 'the session has no others'}); see truearm inspect {name}"
        )
    for visit in visited:
        if len(visit.side) != len(chain.joints):
            raise InputError("other-robot", place=name, joints=len(visit.side), expected=len(chain.joints))
        if visit.period_s != visited[0].period_s:
            raise InputError(f"{name}: the box's sample rate changes; record all parts of a session at one rate")
    # A short part may not show the finest steps of the joints.
    resolution = np.min([result.survey.joints.step for result in results if len(result.table)], axis=0)
    variances = _column(visited, "q_var") - resolution**2 / 12.0
    before_rounding = np.sqrt(np.maximum(np.mean(variances, axis=0) - resolution**2 / 12.0, 0.0))
    rounding_var = repeatability.rounding_variance(resolution, before_rounding)
    bar = mode(sorted(visit.dwell.mounted["bar"] for visit in visited))
    spread = repeatability.repeatability(_of_bar(visited, bar, chain, rig, rounding_var))
    document = asdict(spread)
    noise = {name: document.pop(name) for name in ("bar_sigma_m", "joint_sigma_si")}
    columns = resolution.tolist(), variances.T, _column(visited, "mean_var").T, np.sqrt(rounding_var).tolist()
    readings = [
        {
            "step_si": joint_step,
            "reading_si": asdict(repeatability.sigma_interval(reading_var)),
            "mean_si": asdict(repeatability.sigma_interval(mean_var)),
            "rounding_si": rounding,
        }
        for joint_step, reading_var, mean_var, rounding in zip(*columns, strict=True)
    ]
    return {
        "session": name,
        "parts": len(results),
        "simulated": any(result.table.simulated for result in results),
        "bar": bar,
        "joints": [one_line(joint.name) for joint in chain.joints],
        "dwells": len(visited),
        **{count: document.pop(count) for count in ("visits", "poses", "sides")},
        "repeatability": {**document, "backlash_explains": not spread.misfit_probability < repeatability.MISFIT},
        "settling": _settling(visited, bands),
        "readings": readings,
        "sensor": _sensor(visited),
        "noise": {**noise, "declared_bar_sigma_m": rig.bars[bar].sigma},
    }, _noise_file(spread, bar, name)


def _column(visited: Sequence[PoseVisit], name: str) -> Floats:
    """Return a field of all visits, or of their dwells."""
    return np.array([getattr(visit if hasattr(visit, name) else visit.dwell, name) for visit in visited])


def _of_bar(
    visited: Sequence[PoseVisit], bar: str, chain: Chain, rig: Rig, rounding_var: Floats
) -> repeatability.Visits:
    """Return the visits with one bar. The derivatives are those of the nominal robot: 1 % is accurate enough."""
    visited = [visit for visit in visited if visit.dwell.mounted["bar"] == bar]
    mounted = [visit.dwell.mounted for visit in visited]
    p_sphere = np.array([rig.spheres[names["sphere"]].xyz for names in mounted])
    p_chuck = np.array([rig.chucks[names["chuck"]].xyz for names in mounted])
    length, length_var, q, side = (_column(visited, name) for name in ("value", "value_var", "q", "side"))
    jac = distance_jacobian(chain, chain.params_nominal, q, p_sphere, p_chuck)
    return repeatability.Visits(length, length_var, q, side, jac, _column(visited, "mean_var") + rounding_var)


def _noise_file(spread: repeatability.Repeatability, bar: str, name: str) -> NoiseFile:
    """Return what identify uses; the backlash of a joint that does not affect the bar is 0."""
    widths = np.nan_to_num([[joint.value for joint in spread.backlash_si], spread.backlash_sigma_si])
    cov = np.diag([joint.value**2 for joint in spread.joint_sigma_si])
    backlash, backlash_sigma = map(tuple, widths.tolist())
    return NoiseFile(tuple(map(tuple, cov.tolist())), {bar: spread.bar_sigma_m.value}, name, backlash, backlash_sigma)


def _settling(visited: Sequence[PoseVisit], bands: Sequence[float]) -> dict[str, Any]:
    begin = [visit.dwell.start_s - visit.dwell.stood_s for visit in visited]
    columns = [
        {
            "within_m": band,
            "visits": int(np.isfinite(times).sum()),
            "median_s": asdict(repeatability.quantile_interval(times, 0.5)),
            "share_95_s": asdict(repeatability.quantile_interval(times, 0.95)),
        }
        for band, times in zip(bands, _column(visited, "settling").T, strict=True)
    ]
    return {"bands": columns, "dwells_begin_s": {"median": float(np.median(begin)), "largest": max(begin)}}


def _sensor(visited: Sequence[PoseVisit]) -> dict[str, Any]:
    rests, period_s = [visit.rest for visit in visited], visited[0].period_s
    noise, n_samples, n_eff = (_column(visited, name) for name in ("noise", "n_samples", "n_eff"))
    deviations = repeatability.allan(
        [samples for samples in rests if samples.size * period_s >= LONG_S] or rests, period_s
    )
    rows = [
        {"tau_s": tau, **asdict(repeatability.variance_interval(deviation**2, freedom))}
        for tau, deviation, freedom in np.stack(deviations, axis=1).tolist()
    ]
    return {
        "sample_m": asdict(repeatability.sigma_interval(noise**2)),
        "period_s": period_s,
        "independent_after_s": asdict(repeatability.mean_interval(period_s * n_samples / n_eff)),
        "allan": rows,
        "floor": min(rows, key=lambda row: row["value"], default=None),
    }


@dataclass(frozen=True)
class PoseVisit:
    """A dwell of j joints that gave an observation.

    ``side`` (j,): the last motion of each joint, −1 or 1, NaN if it did not move. ``mean_var`` (j,) [rad², m²]:
    variance of the mean reading including correlation, without quantisation. ``settling`` (b,) [s]: time from first
    entering each band around the bar's mean to staying in it; NaN if the bar did not come from outside or the noise is
    too large for the band. ``rest`` (n,) [m]: the samples at rest, ``period_s`` apart, of the longest piece without a
    gap.
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


def _mean_var(bins: Bins, dwell: Dwell) -> Floats:
    """Return the variance (j,) of the mean reading of a dwell, from the means of its bins."""
    means = bins.joints(*dwell.bins).mean
    if len(means) < 4:
        return np.full(dwell.q.size, np.nan)
    return np.array([mean_variance(column)[0] for column in (means - np.mean(means, axis=0)).T])


# in words


def repeatability_findings(document: Document) -> list[Finding]:
    """Return the repeatability, what identify uses, how the arm settles, and the noise; with intervals of 95 %."""
    spread, settling, noise, sensor = (document[name] for name in ("repeatability", "settling", "noise", "sensor"))
    widths = zip(spread["backlash_si"], document["joints"], strict=True)
    largest, joint = max(widths, key=lambda width: width[0]["value"] if isfinite(width[0]["value"]) else -1.0)
    noisiest, floor = max(document["readings"], key=lambda row: row["reading_si"]["value"]), sensor["floor"]
    bands = [
        f"{MM.text(band['within_m'])} after {interval(band['median_s'], S)} (median) and {interval(band['share_95_s'], S)} "
        f"(95th percentile) in {counted(band['visits'], 'visit')}"
        for band in settling["bands"]
        if band["visits"]
    ]
    verdict = {
        "along": interval(spread["along_m"], MM),
        "alone": interval(spread["unexplained_m"], MM),
        "backlash": interval(largest, MRAD),
        "joint": joint,
    }
    declared = {"mm": MM.of(noise["declared_bar_sigma_m"])}
    to_use = {"bar": document["bar"], "sigma": interval(noise["bar_sigma_m"], MM), "declared": declared}
    misfit = {"probability": spread["misfit_probability"]}
    begin = {name: {"s": value} for name, value in settling["dwells_begin_s"].items()}
    measured = {
        "reading": interval(noisiest["reading_si"], MRAD),
        "step": MRAD.text(noisiest["step_si"], ".3g"),
        "mean": interval(noisiest["mean_si"], MRAD),
        "rounding": f"{round(MRAD.of(noisiest['rounding_si']), 6):.2g} mrad",
        "sample": interval(sensor["sample_m"], UM),
        "period": MS.text(sensor["period_s"], ".3g"),
        "independent": interval(sensor["independent_after_s"], MS),
        "floor": floor and interval(floor, UM),
        "over": floor and floor["tau_s"],
    }
    findings = [
        stated("repeatability", document, **verdict),
        Finding("noise-to-use", to_use),
        *([] if spread["backlash_explains"] else [Finding("backlash-varies", misfit)]),
        Finding("settling-measured", {**begin, "bands": bands}),
        Finding("noise-measured", measured),
    ]
    return ordered(findings, document["simulated"])


def joint_table(document: Document) -> Table:
    """Return the figures of each joint [mrad]."""
    spread = document["repeatability"]
    columns = [spread[name] for name in ("backlash_si", "reading_difference_si", "reading_spread_si")]
    columns.append(document["noise"]["joint_sigma_si"])
    rows = zip(document["joints"], *columns, strict=True)
    return Table(JOINTS, [(joint, *(interval(figure, MRAD, False) for figure in figures)) for joint, *figures in rows])


def remarks(document: Document) -> Iterator[str]:
    """Return what stands at the head of the noise file."""
    noise = document["noise"]
    if document["simulated"]:
        yield Finding("simulated").text()
    name = one_line(document["session"])
    yield f"{name}: {counted(document['visits'], 'visit')} of {document['poses']} poses; intervals of 95 %"
    for joint, sigma in zip(document["joints"], noise["joint_sigma_si"], strict=True):
        yield f"{joint}: {interval(sigma, MRAD)}"
    yield f"bar {document['bar']}: {interval(noise['bar_sigma_m'], MM)}"


def interval(figure: Mapping[str, float], scale: Scale, unit: bool = True) -> str:
    """Return a figure with its interval in some unit; "-" if nothing is known."""
    value, low, high = (scale.of(figure[key]) for key in ("value", "low", "high"))
    if not isfinite(value):
        return "-"
    upper = _digits(high) if isfinite(high) else "…"
    return f"{_digits(value)} ({_digits(low)} to {upper})" + (f" {scale.symbol}" if unit else "")


def _digits(value: float) -> str:
    return f"{value:.3f}" if abs(value) >= 0.01 else f"{value:.2g}"
