"""Compute the effect of a correction and the expected errors, as a document and as findings.

These are shifts, expected errors, margins, straight moves and configurations of the arm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from truearm.correct.configurations import SAME
from truearm.correct.correction import Correction, ModelPair, StraightMoves, limit_margins
from truearm.estimate.prediction import ParametersKnown, end_sigmas
from truearm.findings import Finding
from truearm.model.inverse import singular_value
from truearm.model.transforms import apart, inverted, position_and_rotation
from truearm.report.correction_page import STRAIGHT
from truearm.text import listed, number_or_null
from truearm.types import CurveKnots, Floats, rms
from truearm.units import DEG, MM, MRAD, key, shown
from truearm.workflows.calibration import Calibration, unseen_within

COVERAGE = 2.0  # k of the expanded uncertainty, about 95 % of a normal error
RMS_OF_MEAN = math.sqrt(0.5 * math.pi)  # over the mean of |x| for normal x
FORMAT = "truearm-correction"
FORMAT_VERSION = 2


class CorrectedTargets(NamedTuple):
    """n targets as requested and as commanded (n, 4, 4), in the frame of the file.

    ``tools`` (n, 4, 4) are poses of the tools in the end frame; the errors of ``correction`` are theirs.
    """

    places: tuple[str, ...]  # "line 12", "row 3"
    joints: NDArray[np.bool_]  # (n,) a target of joint readings
    requested: Floats
    commanded: Floats
    tools: Floats
    correction: Correction

    def error_point(self, end_frame: str) -> str:
        """Return whose errors they are: "the tool", or the end frame if no target has a tool."""
        return end_frame if np.array_equal(self.tools, np.broadcast_to(np.eye(4), self.tools.shape)) else "the tool"


class CorrectedMoves(NamedTuple):
    """n straight moves between corrected targets, by the places of both ends.

    ``unchecked``: straight moves with an unknown start, or too many of them.
    """

    places: tuple[str, ...] = ()
    starts: tuple[str, ...] = ()
    straight: StraightMoves | None = None
    unchecked: int = 0


class OtherConfigurations(NamedTuple):
    """The first ``n_targets`` of those whose configuration only ``home`` determines, in m configurations of the arm.

    ``shift`` (m,) [m]: how far each command is from the one in the configuration near home. ``q`` (m, j): the corrected
    joint readings; ``tools`` (m, 4, 4) in the end frame.
    """

    n_targets: int
    shift: Floats
    q: Floats
    tools: Floats


class Corrected(NamedTuple):
    """Corrected targets and straight moves, with the ``contents`` of the table or the program files by name.

    ``refused``: what was left unchanged, as JSON; ``notes``: remarks. ``configurations``: targets in the arm's other
    configurations, if only ``home`` determines theirs.
    """

    targets: CorrectedTargets
    moves: CorrectedMoves = CorrectedMoves()
    configurations: OtherConfigurations | None = None
    refused: Sequence[Mapping[str, Any]] = ()
    notes: tuple[Finding, ...] = ()
    contents: Mapping[str, bytes] = {}


def _expected_errors(
    calibration: Calibration, pair: ModelPair, q: Floats, tools: Floats
) -> tuple[Floats, tuple[str, ...]]:
    """Return the expanded uncertainty (n, 2) [m, rad] of tools (n, 4, 4) at readings (n, j), and its frame.

    It is that of covariance and unexplained error, NaN if unknown. Errors in the poses of these frames ("base", "tool")
    are not part of it. Tools are relative to the flange of ``pair``.
    """
    points = (inverted(pair.mountings.tool) @ tools)[:, :3, 3]
    is_own_base = not np.allclose(pair.mountings.base, np.eye(4), rtol=0.0, atol=1e-12)
    unseen, relative_to = unseen_within(calibration)
    distribution = ParametersKnown(calibration.chain, calibration.identified, calibration.covariance, unseen)
    sigmas = end_sigmas(distribution, q, points, any_base=is_own_base)
    if sigmas is None:
        return np.full((len(q), 2), np.nan), relative_to
    if sigmas.relative and "base" not in relative_to:
        relative_to = ("base", *relative_to)
    both = np.stack([sigmas.position, sigmas.rotation], axis=1)
    return COVERAGE * np.hypot(both, unexplained_error(calibration.document)), relative_to


def comparison(
    calibration: Calibration, pair: ModelPair, configurations: OtherConfigurations | None
) -> tuple[list[Finding], dict[str, Any] | None]:
    """Compare corrections and expected errors over the arm's configurations, as a finding and as JSON."""
    if configurations is None:
        return [], None
    expected = _expected_errors(calibration, pair, configurations.q, configurations.tools)[0][:, 0]
    ends = configurations.shift.max(initial=0.0), expected.min(initial=np.inf), expected.max(initial=-np.inf)
    spread, lowest, highest = (number_or_null(MM.of(float(length))) for length in ends)
    lengths = {"spread": spread, "least": lowest, "most": highest}
    figures = {"correction_spread_mm": spread, "expected_min_mm": lowest, "expected_max_mm": highest}
    values = {name: None if mm is None else {"mm": mm} for name, mm in lengths.items()}
    return [Finding("other-configurations", values)], {"targets": configurations.n_targets, **figures}


def unexplained_error(document: Mapping[str, Any]) -> tuple[float, float]:
    """Return the standard deviation [m, rad] of the error not explained by the calibration's declared noise, or 0.

    result.json has the mean of the error's norm. For a normal error along one axis the RMS is √(π/2) times that, for
    one along three axes only 1.09 times. If the arm's own scatter was learned, the larger of the two is used; earlier
    results have only the part of it that rows of a pose share. Neither includes how far the tool moves without bad rows
    that are in the fit, so that counts if it is larger than both.
    """
    mm, deg = (_number(document, "unexplained", name) for name in ("mean_mm", "mean_deg"))
    shared = math.sqrt(3.0) * _number(document, "pose_error", "shared_mm")
    scatter = max(_number(document, "predicted_error", "scatter_mm"), shared)
    moved = _number(document, "without_bad_rows", "tool_moves_mm")
    return MM.to_si(max(RMS_OF_MEAN * mm, scatter, moved)), RMS_OF_MEAN * DEG.to_si(deg)


def _number(document: Mapping[str, Any], entry: str, name: str) -> float:
    """Return a number of an entry of result.json, 0 if it is not there."""
    return float((document.get(entry) or {}).get(name) or 0.0)


def correction_findings(calibration: Calibration, corrected: Corrected) -> list[Finding]:
    """Return what was corrected, and what the operator must know before the program is run."""
    targets, refused = corrected.targets, corrected.refused
    done, places = targets.correction, targets.places
    rms_before, rms_after = ({"mm": float(MM.of(rms(error[:, 0])))} for error in (done.before, done.after))
    values = {"point": targets.error_point(calibration.chain.end_frame), "before": rms_before, "after": rms_after}
    code = "partly-corrected" if refused else "corrected"
    findings = [Finding(code, {**values, "n": len(places), "refused": len(refused)})]
    if rms_after["mm"] > rms_before["mm"]:
        findings.append(Finding("correction-worse", values))
    if calibration.stored.status != "converged":
        findings.append(Finding("fit-not-converged"))
    outside = calibration.outside(done.q)
    if outside is None:
        findings.append(Finding("range-unknown"))
    elif (rows := np.flatnonzero(outside.any(axis=1))).size:
        joints = [calibration.chain.joints[j].name for j in np.flatnonzero(outside.any(axis=0))]
        has_curves = any(isinstance(law, CurveKnots) for law in calibration.stored.laws)
        values_outside = {"n": int(rows.size), "joints": joints, "places": _several(places, rows), "curves": has_curves}
        findings.append(Finding("targets-outside", values_outside))
    return [*findings, *_move_findings(corrected.moves)]


def _move_findings(moves: CorrectedMoves) -> Iterator[Finding]:
    drive = moves.straight
    if drive is not None:
        bent, blocked = np.flatnonzero(drive.deviation > STRAIGHT), np.flatnonzero(~drive.drivable)
        if bent.size:
            worst = int(bent[np.argmax(drive.deviation[bent])])
            lengths = {"limit": {"mm": MM.of(STRAIGHT)}, "worst": {"mm": float(MM.of(drive.deviation[worst]))}}
            values = {"n": int(bent.size), "places": _several(moves.places, bent), "place": moves.places[worst]}
            yield Finding("moves-bent", {**lengths, **values})
        if blocked.size:
            yield Finding("moves-bent", {"n": int(blocked.size), "places": _several(moves.places, blocked)})
    if moves.unchecked:
        yield Finding("moves-unchecked", {"n": moves.unchecked})


def document_of(
    calibration: Calibration, pair: ModelPair, corrected: Corrected, names: Mapping[str, str]
) -> dict[str, Any]:
    """Return a correction, and what is expected of it, as JSON (docs/reference/target-format.md).

    ``names``: of the targets' ``file``, of the corrected one, ``out``, and of the ``result``.
    """
    targets, unexplained = corrected.targets, unexplained_error(calibration.document)
    expected, relative_to = _expected_errors(calibration, pair, targets.correction.q, targets.tools)
    chain = calibration.chain
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "robot": chain.name,
        "base_frame": chain.base_frame,
        "end_frame": chain.end_frame,
        **names,
        "coverage_factor": COVERAGE,
        "unexplained_mm": float(MM.of(unexplained[0])),
        "unexplained_mrad": float(MRAD.of(unexplained[1])),
        "expected_relative_to": relative_to,
        "error_point": targets.error_point(chain.end_frame),
        "targets": _target_entries(calibration, targets, expected),
        "moves": _move_entries(corrected.moves, calibration.joint_units),
    }


def _target_entries(calibration: Calibration, targets: CorrectedTargets, expected: Floats) -> list[dict[str, Any]]:
    done, units = targets.correction, calibration.joint_units
    poses = [position_and_rotation(frames) for frames in (targets.requested, targets.commanded)]
    shift = apart(targets.commanded, targets.requested)
    shift[np.isnan(done.before[:, 1]), 3:] = np.nan  # for positions alone the orientation is free
    limits = limit_margins(calibration.chain, done.q)
    singular = singular_value(calibration.chain, calibration.nominal, done.q)
    outside = calibration.outside(done.q)
    return [
        {
            "place": place,
            "joints": bool(targets.joints[i]),
            "before": _pose_entry(poses[0][i], done.q_nominal[i], units),
            "after": _pose_entry(poses[1][i], done.q[i], units),
            "shift_mm": float(MM.of(np.linalg.norm(shift[i, :3]))),
            "shift_mrad": number_or_null(MRAD.of(np.linalg.norm(shift[i, 3:]))),
            "error_before_mm": float(MM.of(done.before[i, 0])),
            "error_after_mm": float(MM.of(done.after[i, 0])),
            "error_before_deg": number_or_null(DEG.of(done.before[i, 1])),
            "error_after_deg": number_or_null(DEG.of(done.after[i, 1])),
            "expected_mm": number_or_null(MM.of(expected[i, 0])),
            "expected_mrad": number_or_null(MRAD.of(expected[i, 1])),
            **_limit_entry(limits[i], units),
            "singular_value": float(singular[i]),
            "outside": None if outside is None else [int(j) + 1 for j in np.flatnonzero(outside[i])],
        }
        for i, place in enumerate(targets.places)
    ]


def _limit_entry(limits: Floats, units: Sequence[str]) -> dict[str, float | int | None]:
    """Return the joint nearest to its limit, from 1, and the distance; both null if no joint has a limit."""
    nearest = int(np.argmin(limits))
    if not math.isfinite(limits[nearest]):
        return {"limit_joint": None, "limit_deg": None}
    return {"limit_joint": nearest + 1, key("limit", units[nearest]): float(shown(limits[nearest], units[nearest]))}


def _pose_entry(six: Floats, q: Floats, units: Sequence[str]) -> dict[str, float]:
    names = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg")
    pose = dict(zip(names, [*MM.of(six[:3]).tolist(), *DEG.of(six[3:]).tolist()], strict=True))
    return pose | {
        key(f"q{k}", unit): float(shown(value, unit)) for k, (value, unit) in enumerate(zip(q, units, strict=True), 1)
    }


def _move_entries(moves: CorrectedMoves, units: Sequence[str]) -> list[dict[str, Any]]:
    drive = moves.straight
    if drive is None:
        return []
    columns = zip(moves.places, moves.starts, *drive, strict=True)
    return [
        {
            "place": place,
            "from": start,
            "deviation_mm": number_or_null(MM.of(deviation)),
            "singular_value": number_or_null(singular),
            **_limit_entry(limits, units),
            "drivable": bool(drivable),
        }
        for place, start, deviation, singular, limits, drivable in columns
    ]


def _several(places: Sequence[str], rows: NDArray[np.intp]) -> str:
    """Join the places of rows under one name: "lines 3, 5 and 9"."""
    nouns, _, numbers = zip(*dict.fromkeys(places[row].partition(" ") for row in rows), strict=True)
    return f"{nouns[0]}{'s' if len(numbers) > 1 else ''} {listed(numbers)}"


MOST_NAMED = 6  # quarter turns


def _other_quarters(lines: Sequence[str], q: Floats, quarters: Floats, wrong: NDArray[np.bool_]) -> list[str]:
    """Return "line 2: cf4 is 0, axis 4 at -95° needs -2" for the first wrong quarter turns (n, j)."""
    places = np.argwhere(wrong)
    texts = [
        f"line {lines[i]}: cf{j + 1} is {quarters[i, j]:.0f}, axis {j + 1} at {_in_its_quarter(DEG.of(q[i, j]))}° needs {np.floor(q[i, j] / (0.5 * np.pi)):.0f}"
        for i, j in places[:MOST_NAMED].tolist()
    ]
    return texts + [f"and {len(places) - MOST_NAMED} more"] * (len(places) > MOST_NAMED)


def _in_its_quarter(angle: float) -> str:
    """Return an angle [deg] with as many digits as show its quarter turn: -95, but -0.03."""
    shown = (f"{angle:.{digits}f}" for digits in range(6))
    return next((text for text in shown if float(text) // 90.0 == angle // 90.0), f"{angle:.3g}")


def configuration_notes(
    q: Floats, quarters: Floats, determined: NDArray[np.bool_], lines: Sequence[str]
) -> Iterator[Finding]:
    """Yield the arm configurations to check.

    They are those that only ``home`` determines, and those that contradict the program's own data.

    ``determined`` (n,): the program determines the configuration.
    """
    if not determined.all():
        places = [line for line, is_determined in zip(lines, determined, strict=False) if not is_determined]
        yield Finding("home-decides", {"lines": places})
    wrong = np.abs(q - 0.5 * np.pi * (quarters + 0.5)) > 0.25 * np.pi + SAME  # never true for NaN
    if wrong.any():
        details = "; ".join(_other_quarters(lines, q, quarters, wrong))
        yield Finding("configuration-data", {"n": int(wrong.any(axis=1).sum()), "details": details})
