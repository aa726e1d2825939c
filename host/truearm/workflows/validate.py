"""Validate a calibration: errors of the robot as described and as identified, by region, and a verdict.

The verdict compares the errors with the expected ones: the noise declared by rig and table, and the uncertainty of the
identification (``estimate.validation.consistency``). "Without" means the robot as described, after its base and tool
have been fitted to these rows. How they are mounted is not an error that a calibration could take credit for. The
calibration's own residuals are not used as a measure, because a calibration that fits badly would then be judged
leniently. There are three verdicts. The errors are consistent with the expected ones; they are smaller than without the
calibration, but partly unexplained; or they are not smaller.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from truearm.checks.examination import MEAN, faults_beside
from truearm.errors import Argument, InputError
from truearm.estimate.circumstances import payloads_of
from truearm.estimate.copied_rows import copied_rows
from truearm.estimate.defaults import moved
from truearm.estimate.frame_choice import mounting
from truearm.estimate.result_document import copies_of, fault_entries
from truearm.estimate.result_file import Input
from truearm.estimate.validation import Expected, Judgement, consistency, expected, judge
from truearm.findings import Finding, entries, findings_of
from truearm.kinds.registry import regions as regions_of_kinds
from truearm.kinds.table import ObservationTable
from truearm.model.chain import forward
from truearm.progress import step
from truearm.report.validation_findings import BY_PLACE, error_tables, validation_findings
from truearm.results import Effect, Figures
from truearm.text import without_nan
from truearm.types import Displayed, Floats, Mask, Rig, Rigs, rms
from truearm.units import MM, UNITS, key, shown
from truearm.workflows.calibration import Calibration, covariance_of, unseen_of
from truearm.workflows.inputs import Observed
from truearm.workflows.selection import parse_effect

LEAST_ROWS = 5  # in a region: fewer are not meaningful
NOTHING = 1e-7  # m, rad: less than the last digit that is printed
BETTER = 3.0  # standard errors by which a mean square must differ from another to count as different


ByUnit = Mapping[str, Figures]


@dataclass(frozen=True)
class ValidationRegion:
    """Errors of the rows in one part of the space, or of one group, without (``before``) and with the calibration.

    Errors are given by SI unit. ``expected`` is the RMS explained by declared noise and the calibration's own
    uncertainty, NaN if unknown.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table, rig = truearm.read_table("friday.csv", robot), truearm.read_rig("rig.toml")
    >>> region = truearm.validate(truearm.read_result("result.json"), table, rig).regions[0]
    >>> region.n >= 5, region.after["m"].rms < region.before["m"].rms
    (True, True)
    """

    name: str
    n: int
    before: ByUnit
    after: ByUnit
    expected: Mapping[str, float]


@dataclass(frozen=True, repr=False)
class Validation(Displayed):
    """The performance of a calibration on ``n`` other observations.

    Printing it shows errors in mm and deg, and the verdict.

    ``before`` and ``after`` are errors by SI unit, without the calibration and with it. For ``before``, base and tool
    are fitted to these rows as far as the rows determine them, if all rows can still be judged afterwards. ``n_unseen``
    rows depend on directions that the calibration did not observe. ``expected`` is the RMS explained by declared noise
    and the calibration's own uncertainty in the other rows, empty if there are none. ``n_left_out`` rows are not
    judged, because they fit the unknowns of the rig whatever their values; ``n_settled`` such unknowns were estimated
    on these rows. ``regions`` are groups and parts of the space. ``document`` is what ``truearm validate --json``
    prints.

    Examples
    --------
    >>> import truearm
    >>> robot = truearm.load_robot("puma560")
    >>> table, rig = truearm.read_table("friday.csv", robot), truearm.read_rig("rig.toml")
    >>> found = truearm.validate(truearm.read_result("result.json"), table, rig)
    >>> found.n, found.after["m"].rms < 0.1 * found.before["m"].rms
    (45, True)
    >>> found.summary() == str(found)
    True
    """

    verdict: str
    n: int
    n_left_out: int
    n_settled: int
    n_unseen: int
    before: ByUnit
    after: ByUnit
    expected: Mapping[str, float]
    regions: tuple[ValidationRegion, ...]
    document: Mapping[str, Any]

    def __str__(self) -> str:
        return self.summary()

    def _headline(self) -> str:
        return self.verdict

    def _columns(self) -> Mapping[str, Any]:
        rows = [
            (region.name, unit, region.n, region.before[unit].rms, region.after[unit].rms)
            for region in self.regions
            for unit in region.after
        ]
        return dict(zip(("region", "unit", "n", "rms_before", "rms_after"), zip(*rows, strict=True)))

    def summary(self) -> str:
        """Return errors, what is expected, and the verdict, as ``truearm validate`` prints them."""
        return "\n".join([*(finding.text() for finding in self.findings), *map(str, error_tables(self.document))])

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the command states: the verdict, what limits it, notes; each with a code, values and a text."""
        return tuple(findings_of(self.document))


def validated(calibration: Calibration, observed: Observed, keep_rig: bool = False) -> Validation:
    """Return numbers and verdict.

    ``keep_rig``: unknowns of the rig are held at their identified values. Raises InputError if no row can judge, or if
    nothing of the rig can be kept.
    """
    chain, stored, rig, table = calibration.chain, calibration.stored, observed.rigs, observed.table
    copied, all_rows = copied_rows(chain, rig, table), table
    table = table.select(copied < 0)
    rig_values = _identified_rig(calibration) if keep_rig else {}
    allowed = _allowed(calibration) if keep_rig else ()
    raw, judged = (
        judge(chain, rig, table, p, rig_values, None, allowed) for p in (calibration.nominal, calibration.identified)
    )
    n_settled, n_rig_values = int(judged.settled.sum()), len(judged.identified) - len(calibration.nominal)
    if keep_rig and n_settled and not n_rig_values:
        names = [name for name, settled in zip(judged.problem.names, judged.settled, strict=True) if settled]
        text = f": the result identified no unknown of this rig, such as {names[0]}; use the names of the rig that it was identified with"
        raise InputError(Argument("keep_rig"), text)
    nominal, drawing = _placed(calibration, rig, table, raw, rig_values, allowed), calibration.robot.drawing
    drawn = None
    if drawing is not None:
        drawn = judge(chain, rig, table, drawing, rig_values, None, allowed)
        drawn = _placed(replace(calibration, nominal=drawing), rig, table, drawn, rig_values, allowed)
    judging = nominal.judging & judged.judging
    if not judging.any():
        raise InputError(
            "no row can judge the calibration: unknowns of the rig fit each of them exactly; measure more rows there"
        )
    covariance, unseen = (function(stored, judged.identified) for function in (covariance_of, unseen_of))
    due = expected(judged, covariance, unseen)
    elsewhere = moved(chain, stored.defaults.still, table.q)
    if elsewhere.any():  # these rows depend on what their joints did not show in the identification
        lost = np.array([[name == held for held in stored.defaults.lost] for name in judged.identified], dtype=float)
        unseen = np.concatenate([unseen, lost], axis=1)
    test = consistency(judged, covariance, unseen)
    with step("testing for faults"):
        faults = () if test is None else faults_beside(judged, test.ways, table)
    errors: dict[str, RowErrors] = {}
    for si, error in judged.error.items():
        rows = judging & np.isfinite(error)
        if rows.any():
            determined = rows & ~(due[si].unseen | elsewhere)
            errors[si] = RowErrors(nominal.error[si], error, due[si], rows, determined)
    fitted = {entry.sha256 for entry in stored.inputs}
    hashes = [entry for entry in observed.inputs if entry.role == "observations"]
    named_regions = _named_regions(calibration, table)
    overall, *regions = (_region(name, rows & judging, errors) for name, rows in (("", judging), *named_regions))
    regions = [region for region in regions if region.n >= LEAST_ROWS]
    expected_errors = {si: e.expected() for si, e in errors.items()}
    expected_rms = {si: sizes["rms"] for si, sizes in expected_errors.items() if not math.isnan(sizes["rms"])}
    expected_entries = {
        key(name, si): shown(value, si) for si, sizes in expected_errors.items() for name, value in sizes.items()
    }
    n_judging = overall.n
    n_unseen = int(np.any([e.rows & ~e.observed for e in errors.values()], axis=0).sum())
    document: dict[str, Any] = {
        "simulated": all_rows.simulated or calibration.simulated,
        "rows": n_judging,
        "left_out": judging.size - n_judging,
        "copies": copies_of(copied, all_rows),
        "without_rig": _missing_rig(stored.inputs, rig),
        "settled": n_settled,
        "kept": n_rig_values,
        "identified_from": [entry.name for entry in hashes if entry.sha256 in fitted],
        "residual_units": [UNITS[si].scale.suffix for si in errors],
        **{key("reference", si): _reference(calibration.document, si) for si in errors},
        **_figure_entries(overall),
        "placed": nominal is not raw,
        **{key("rms_drawing", si): drawn and shown(rms(drawn.error[si][e.rows]), si) for si, e in errors.items()},
        **{key("rms_raw", si): shown(rms(raw.error[si][e.rows]), si) for si, e in errors.items()},
        "unseen": n_unseen,
        "expected": expected_entries if expected_rms else None,
        **{key("unexplained", si): shown(e.unexplained, si) for si, e in errors.items()},
        "better": {UNITS[si].scale.suffix: e.is_better for si, e in errors.items()},
        "consistent": test and test.chi2 <= test.limit and not faults,
        "chi2_reduced": test and test.chi2 / test.freedom,
        "chi2_limit": test and test.limit / test.freedom,
        "chi2_freedom": test and test.freedom,
        "faults": fault_entries(faults, table),
        "worst_region": _worst_region(errors, named_regions),
        "regions": [
            {
                "region": region.name,
                "rows": region.n,
                **_figure_entries(region),
                **{key("rms_expected", si): shown(rms, si) for si, rms in region.expected.items()},
            }
            for region in regions
        ],
    }
    document = without_nan(document)
    because, payloads = stored.unusable_because, payloads_of(rig, table.select(judging))
    unusable = [Finding("calibration-unusable", {"because": because})] if because else []
    findings = validation_findings(document, [*unusable, *observed.findings, *calibration.payload_findings(payloads)])
    words = next(finding.text() for finding in findings if finding.code != "simulated")
    counts = n_judging, judging.size - n_judging, n_settled, n_unseen
    document |= {"verdict": words, "findings": entries(findings)}
    return Validation(words, *counts, overall.before, overall.after, expected_rms, tuple(regions), document)


def _missing_rig(inputs: Sequence[Input], rig: Rigs) -> str | None:
    """Return the name of the rig file that the identification used, if these rows come without any rig."""
    names = (entry.name for entry in inputs if entry.role == "rig")
    return next(names, None) if rig == Rig() else None


def _identified_rig(calibration: Calibration) -> dict[str, float]:
    """Return the identified values of the rig, by name."""
    parameters = calibration.stored.parameters
    return {entry.name: entry.value for entry in parameters if entry.of == "rig" and entry.value is not None}


def _allowed(calibration: Calibration) -> tuple[Effect, ...]:
    """Return the faults that the identification estimated in all rows: a constant error of a rig part persists.

    A slip or a drift within that session does not apply to another one.
    """
    texts = (calibration.stored.made_with or {}).get("apply")
    if not isinstance(texts, tuple):
        return ()
    effects = [parse_effect(text) for text in texts if text != MEAN]
    return tuple(effect for effect in effects if effect == Effect(effect.what))


def _placed(
    calibration: Calibration,
    rig: Rigs,
    table: ObservationTable,
    raw: Judgement,
    rig_values: Mapping[str, float],
    allowed: Sequence[Effect],
) -> Judgement:
    """Return the robot as described, with base and tool fitted to the rows.

    It is left unchanged if too few rows could judge afterwards, or if the rows determine neither pose.
    """
    chain, stored = calibration.chain, calibration.stored
    place = mounting(chain, calibration.nominal).either & stored.column("free")[stored.column("of") == "robot"]
    if not place.any():
        return raw
    placed = judge(chain, rig, table, calibration.nominal, rig_values, place, allowed)
    if (raw.judging & ~placed.judging).any():
        return raw
    pairs = ((raw.error[si], error) for si, error in placed.error.items())
    equal = (np.allclose(*pair, rtol=0.0, atol=NOTHING, equal_nan=True) for pair in pairs)
    return raw if all(equal) else placed


class RowErrors(NamedTuple):
    """Errors of n rows in one SI unit, without and with the calibration; ``rows`` that have such an error and judge.

    ``observed``: those of them that depend only on what the identification observed.
    """

    nominal: Floats
    identified: Floats
    due: Expected
    rows: Mask
    observed: Mask

    @property
    def explained(self) -> Floats:
        """Return the squares (n,) expected from declared noise and the covariance, NaN where not ``observed``."""
        return np.where(self.observed, self.due.by_noise + self.due.by_parameters, np.nan)

    @property
    def unexplained(self) -> float:
        """Return the RMS of the errors that is not expected; NaN if no row has an expected error."""
        unexplained = (self.identified**2 - self.explained)[self.observed]
        return math.sqrt(max(float(unexplained.mean()), 0.0)) if unexplained.size else math.nan

    def expected(self) -> dict[str, float]:
        """Return the expected RMS, its parts and the RMS, of the rows that have all; NaN if there are none."""
        squares = self.explained, self.due.by_noise, self.due.by_parameters, self.identified**2
        names = "rms", "by_noise", "by_parameters", "rms_after"
        return {name: _root_mean(square[self.observed]) for name, square in zip(names, squares, strict=True)}

    @property
    def is_better(self) -> bool:
        """Return whether the errors are smaller with the calibration than without, beyond chance."""
        gain = self.nominal[self.rows] ** 2 - self.identified[self.rows] ** 2
        return bool(gain.mean() * math.sqrt(gain.size) > BETTER * gain.std())


def _worst_region(errors: Mapping[str, RowErrors], regions: Sequence[tuple[str, Mask]]) -> str | None:
    """Return the region where the errors exceed the expected ones most, if by more than elsewhere, beyond chance."""
    excesses: list[tuple[float, str | None]] = [(0.0, None)]
    for e in errors.values():
        ratio = e.identified**2 / np.maximum(e.explained, 1e-300)
        for name, inside in regions:
            region, elsewhere = ratio[e.observed & inside], ratio[e.observed & ~inside]
            if min(region.size, elsewhere.size) >= LEAST_ROWS:
                excess = float(region.mean() - elsewhere.mean())
                error = math.sqrt(region.var() / region.size + elsewhere.var() / elsewhere.size)
                excesses += [(excess, name)] * (excess > BETTER * error)
    return max(excesses, key=lambda excess: excess[0])[1]


def _region(name: str, rows: Mask, errors: Mapping[str, RowErrors]) -> ValidationRegion:
    """Return the errors of some rows (n,), and what is expected of them."""
    before = {si: Figures.of(e.nominal[rows & e.rows]) for si, e in errors.items()}
    after = {si: Figures.of(e.identified[rows & e.rows]) for si, e in errors.items()}
    due = {si: _root_mean(e.explained[rows & e.rows]) for si, e in errors.items()}
    return ValidationRegion(name, int(rows.sum()), before, after, due)


def _figure_entries(region: ValidationRegion) -> dict[str, float]:
    """Return figures for display; NaN if no row has such an error."""
    entries = {
        key(f"{figure}_{state}", si): shown(getattr(errors[si], figure), si)
        for state, errors in (("before", region.before), ("after", region.after))
        for si in errors
        for figure in ("rms", "mean", "max")
    }
    return entries | {key("n", si): figures.n for si, figures in region.after.items()}


def _root_mean(square: Floats) -> float:
    """Return the root of a mean; NaN without rows or if one of them has no such square."""
    return float(np.sqrt(np.mean(square))) if square.size else math.nan


def _reference(document: Mapping[str, Any], si: str) -> float | None:
    """Return the calibration's RMS, for display, on rows to which it was not fitted, else on those to which it was."""
    held_out, value = document["held_out"], document.get(key("rms_after", si))
    return value if held_out is None else held_out.get(key("rms", si))


def _named_regions(calibration: Calibration, table: ObservationTable) -> list[tuple[str, Mask]]:
    """Return the groups named by the rows, and four parts of the space by the position of the end."""
    regions = []
    for column in regions_of_kinds():
        names = [str(name) for name in np.unique(table[column]) if name]
        if len(names) > 1:
            regions += [(f"{column}={name}", table[column] == name) for name in names]
    return regions + _quarters(calibration, table)


def _quarters(calibration: Calibration, table: ObservationTable) -> list[tuple[str, Mask]]:
    """Return near and far, low and high: halves by the end's distance from the base's z axis, and by its height."""
    p = forward(calibration.chain, calibration.identified, table.q)[:, :3, 3]
    reach = np.hypot(p[:, 0], p[:, 1])
    outer, high = reach > np.median(reach), p[:, 2] > np.median(p[:, 2])
    split = MM.text(np.median(reach), ".0f"), MM.text(np.median(p[:, 2]), ".0f")
    quarters = []
    for is_far, is_high in itertools.product((False, True), repeat=2):
        name = f"{BY_PLACE}{'>' if is_far else '≤'} {split[0]}, z {'>' if is_high else '≤'} {split[1]}"
        quarters.append((name, (outer == is_far) & (high == is_high)))
    return quarters
