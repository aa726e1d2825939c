"""Characterize robot and sensor from a session of approaches, as a document and a noise file."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from truearm.clocks import WANDER
from truearm.errors import Argument, InputError, RigError, SessionError
from truearm.estimate.repeatability import (
    MISFIT,
    Interval,
    Repeatability,
    Visited,
    mean_interval,
    quantile_interval,
    repeatability,
    rounding_variance,
    sigma_interval,
)
from truearm.files.disk import check_writable, write_atomic
from truearm.files.noise_file import NoiseFile, format_noise
from truearm.files.plan_file import read_plan
from truearm.files.rig_file import read_rig
from truearm.findings import entries
from truearm.model.chain import Chain, along, trace_point
from truearm.progress import step
from truearm.report.repeatability_findings import remarks, repeatability_findings
from truearm.session.box_ident import Ident, recorded_ident
from truearm.session.clock import recorded_wander
from truearm.session.dwells import Dwell
from truearm.session.observations import SyncResult, observations, survey
from truearm.session.pose_visits import PoseVisits, joined, visits
from truearm.session.session_file import Messages, Session, Source, columns_of
from truearm.text import counted, one_line
from truearm.types import DwellLabel, Floats, Message, Rig
from truearm.workflows.requests import CharacterizeFiles
from truearm.workflows.session_observations import labels_of, reasons_text, recorded_rig
from truearm.workflows.session_parts import open_finished, session_parts

LEAST_VISITS = 6


class Part(NamedTuple):
    """One file of a session: its messages, its name, and what its metadata say of the box and of the host's clock."""

    messages: Source
    name: str
    ident: Ident | None = None
    labels: tuple[DwellLabel, ...] | None = None
    wander: float = WANDER


@step("characterizing")
def characterize_files(files: CharacterizeFiles, bands: Sequence[float]) -> dict[str, Any]:
    """Read all parts of a session and write the noise file; return the results.

    ``bands`` [m]: for the settling time. Raises InputError, RigError, SessionError.
    """
    paths = session_parts(files.session)
    if files.out is not None:
        read = [*paths, *filter(None, [files.rig, files.plan]), *files.robot.files]
        check_writable(files.out, files.force, inputs=read, kind="noise")
    chain = files.robot.load().chain
    opened = {path: open_finished(path, files.allow_damaged) for path in paths}
    rig = _rig(opened, files.rig)
    parts = [
        Part(_with_plan(one, files.plan), path.name, recorded_ident(one), labels_of(path), recorded_wander(one))
        for path, one in opened.items()
    ]
    found, noise = characterized(parts, chain, rig, bands)
    if files.out is not None:
        write_atomic(files.out, format_noise(noise, list(remarks(found)), "m" in chain.joint_units))
    return {**found, "findings": entries(repeatability_findings(found))}


def _rig(opened: Mapping[Path, Session], given: Path | None) -> Rig:
    """Return the given rig, else the one with which all parts were recorded."""
    if given is not None:
        return read_rig(given)
    recorded = {path: recorded_rig(session, path) for path, session in opened.items()}
    first, rig = next(iter(recorded.items()))
    for path, other in recorded.items():
        if other != rig:
            raise RigError(f"{path}: was recorded with another rig than {first}; give one as ", Argument("rig"))
    return rig


def _with_plan(session: Session, path: Path | None) -> Source:
    """Return the contents of the session, with the rows of a plan file in place of its own plan."""
    from truearm.workflows.record import plan_rows  # imports the live view

    if path is None:
        return session.batches
    rows = [Message("/plan", 0, json.dumps(row).encode()) for row in plan_rows(read_plan(path))]

    def messages() -> Iterator[Messages]:
        yield columns_of(rows)
        for batch in session.batches():
            yield batch.without(lambda topic: topic == "/plan")

    return messages


def characterized(
    parts: Sequence[Part], chain: Chain, rig: Rig, bands: Sequence[float]
) -> tuple[dict[str, Any], NoiseFile]:
    """Return everything that a session, in one or more files, shows about the robot's repeatability.

    Raises InputError if it is of another robot or its parts do not belong together, SessionError if required data is
    missing.
    """
    synced = [_synced(part, chain, rig, bands) for part in parts]
    results, of_parts = [result for result, _ in synced], [found for _, found in synced]
    found = joined(of_parts)
    if len(found.dwells) < LEAST_VISITS:
        rejected = sum((Counter(result.reasons) for result in results), Counter[str]())
        raise SessionError(
            f"{parts[0].name}: only {counted(len(found.dwells), 'dwell')} can be used, {LEAST_VISITS} are needed "
            f"({reasons_text(rejected) or 'the session has no others'}); see truearm inspect {parts[0].name}"
        )
    for part, one in zip(parts, of_parts, strict=True):
        if one.rests and one.period_s != found.period_s:
            raise InputError(
                f"{part.name}: the box's sample rate differs from that of the session's first part; record all parts at one rate"
            )
    # A short part may not show the finest steps of the joints.
    step = np.min([result.survey.joints.step for result in results if len(result.table)], axis=0)
    bar = _usual([dwell.mounted["bar"] for dwell in found.dwells])
    of_bar = np.array([dwell.mounted["bar"] == bar for dwell in found.dwells])
    visited = _visited(found, of_bar, chain, rig, step)
    spread = repeatability(visited)
    sigma = tuple(one.value for one in spread.joint_sigma)
    cov = tuple(tuple(s * s if i == k else 0.0 for k in range(len(sigma))) for i, s in enumerate(sigma))
    document = {
        "session": parts[0].name,
        "parts": len(parts),
        "simulated": any(result.table.simulated for result in results),
        "bar": bar,
        "joints": [one_line(joint.name) for joint in chain.joints],
        "dwells": len(found.dwells),
        "visits": spread.n_visits,
        "poses": spread.n_poses,
        "sides": spread.n_sides,
        "repeatability": _repeatability(spread),
        "settling": _settling(found),
        "readings": _readings(found, step),
        "sensor": _sensor(found),
        "noise": {
            "bar_sigma_m": spread.bar_sigma._asdict(),
            "declared_bar_sigma_m": rig.bars[bar].sigma,
            "joint_sigma_si": [one._asdict() for one in spread.joint_sigma],
        },
    }
    # none for a joint that does not affect the bar
    widths = [one.value for one in spread.backlash]
    width, known_to = (np.nan_to_num(values) for values in (widths, spread.backlash_sigma))
    backlash = tuple(width.tolist()), tuple(known_to.tolist())
    return document, NoiseFile(cov, {bar: spread.bar_sigma.value}, parts[0].name, *backlash)


def _synced(part: Part, chain: Chain, rig: Rig, bands: Sequence[float]) -> tuple[SyncResult, PoseVisits]:
    """Return the results of one file."""
    read = survey(part.messages, part.ident, wander=part.wander)
    result = observations(part.messages, rig, name=part.name, found=read, labels=part.labels)
    n_joints = result.table.q.shape[1]
    if len(result.table) and n_joints != len(chain.joints):
        raise InputError("other-robot", place=part.name, joints=n_joints, expected=len(chain.joints))
    reached = visits(result, rig, bands)
    if not reached.dwells:  # without a robot the number of joints is unknown
        none = np.zeros((0, len(chain.joints)))
        reached = replace(reached, direction=none, mean_var=none)
    return result, reached


def _usual(names: list[str]) -> str:
    return max(sorted(set(names)), key=names.count)


def _visited(found: PoseVisits, rows: Floats, chain: Chain, rig: Rig, step: Floats) -> Visited:
    dwells = [dwell for dwell, used in zip(found.dwells, rows, strict=True) if used]
    q = np.array([dwell.q for dwell in dwells])
    rounding = rounding_variance(step, _reading_sigma(dwells, step))
    return Visited(
        length=np.array([dwell.value for dwell in dwells]),
        length_var=np.array([dwell.value_var for dwell in dwells]),
        q=q,
        side=found.direction[rows],
        jac=np.concatenate([_derivatives(chain, rig, dwell) for dwell in dwells]),
        reading_var=found.mean_var[rows] + rounding,
    )


def _derivatives(chain: Chain, rig: Rig, dwell: Dwell) -> Floats:
    """Return ∂length/∂joints (1, j) for the robot as described, by finite differences: an accuracy of 1 % is enough."""
    p_sphere = np.array(rig.spheres[dwell.mounted["sphere"]].xyz)
    trace = trace_point(chain, chain.params_nominal, dwell.q[None], p_sphere)
    vector = trace.p_base - np.array(rig.chucks[dwell.mounted["chuck"]].xyz)
    return np.asarray(along(trace, vector / np.linalg.norm(vector)).jac_joints)


def _reading_sigma(dwells: Sequence[Dwell], step: Floats) -> Floats:
    """Return the standard deviation of one reading (j,) before rounding, by Sheppard's correction."""
    variance = np.mean([dwell.q_var for dwell in dwells], axis=0) - step**2 / 12.0  # of the rounded readings
    return np.asarray(np.sqrt(np.maximum(variance - step**2 / 12.0, 0.0)))


def _repeatability(found: Repeatability) -> dict[str, Any]:
    return {
        "along_m": found.along._asdict(),
        "unexplained_m": found.unexplained._asdict(),
        "backlash_si": [one._asdict() for one in found.backlash],
        "reading_spread_si": [one._asdict() for one in found.spread],
        "reading_difference_si": [one._asdict() for one in found.difference],
        "misfit_probability": found.misfit,
        "backlash_explains": not found.misfit < MISFIT,
    }


def _settling(found: PoseVisits) -> dict[str, Any]:
    own = np.array([dwell.start_s - dwell.stood_s for dwell in found.dwells])
    bands = [
        {
            "within_m": float(band),
            "visits": int(np.isfinite(times).sum()),
            "median_s": quantile_interval(times, 0.5)._asdict(),
            "share_95_s": quantile_interval(times, 0.95)._asdict(),
        }
        for band, times in zip(found.bands, found.settling.T, strict=True)
    ]
    return {"bands": bands, "dwells_begin_s": {"median": float(np.median(own)), "largest": float(np.max(own))}}


def _readings(found: PoseVisits, step: Floats) -> list[dict[str, Any]]:
    """Return the noise of single readings for each joint: as read, and what remains of it and of rounding in a mean."""
    variances = np.array([dwell.q_var for dwell in found.dwells]) - step**2 / 12.0
    rounding = rounding_variance(step, _reading_sigma(found.dwells, step))
    return [
        {
            "step_si": float(step[j]),
            "reading_si": sigma_interval(variances[:, j])._asdict(),
            "mean_si": sigma_interval(found.mean_var[:, j])._asdict(),
            "rounding_si": float(np.sqrt(rounding[j])),
        }
        for j in range(len(step))
    ]


def _sensor(found: PoseVisits) -> dict[str, Any]:
    noise = sigma_interval(np.square([dwell.noise for dwell in found.dwells]))
    spacing = mean_interval(found.spacing_s)
    document = {"sample_m": noise._asdict(), "period_s": found.period_s, "independent_after_s": spacing._asdict()}
    allan = found.allan
    if not allan.tau_s.size:
        return document | {"allan": [], "floor": None}
    rows = [
        {"tau_s": float(tau), **_of_freedom(float(deviation), float(freedom))._asdict()}
        for tau, deviation, freedom in zip(*allan, strict=True)
    ]
    return document | {"allan": rows, "floor": min(rows, key=lambda row: row["value"])}


def _of_freedom(deviation: float, freedom: float) -> Interval:
    from scipy.special import chdtri

    low, high = chdtri(freedom, np.array([0.025, 0.975]))
    return Interval(deviation, deviation * float(np.sqrt(freedom / low)), deviation * float(np.sqrt(freedom / high)))
