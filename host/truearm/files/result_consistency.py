"""Whether the numbers of a result.json can be those of one result: a checksum only shows that nobody changed them since.

Only what cannot be is refused: sizes, counts and variances below zero, text in place of numbers, numbers that are not
finite or out of order, and names that the result does not have. Fields that an earlier version does not have are not
needed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from truearm.estimate.solvers import SOLVERS, Loss, Prior
from truearm.results import ErrorForm, Unusable, WrongInput
from truearm.schema import SchemaError, quoted
from truearm.types import Floats
from truearm.units import SUFFIXES, UNITS

ROUNDING = 1e-6  # relative, of numbers that are computed in two ways
LARGEST = 1e12  # mm, mrad: of any error; also of a parameter in its SI unit
LARGEST_NUMBER = 1e30  # of any other number: products of two are finite
COUNTS = frozenset(("n_observations", "iterations", "n_free", "rank", "n", "n_settled", "n_left_out", "freedom"))
COUNTED = COUNTS | {"fitted", "held_out", "bars", "chucks", "spheres", "places", "sockets", "lines", "targets"}
COUNTED |= {"trackers", "planes", "shells"}
SIZES = frozenset(("chi2_reduced", "chi2_freedom", "chi2_drop", "sigma", "size", "chance", "held_out_ratio"))
SIZES |= {"o1", "o2", "o3", "o4"}
OF_UNIT = re.compile(r"(rms|rms_\w+|mean|mean_\w+|low|high|max|tool_moves|n)_(mm|mrad|us|deg)")
WHOLE = "so the file is damaged; copy it again or identify again"
EARLIER_PRIOR = "default"  # what earlier versions called Prior.WHERE_NEEDED
WORDS: Mapping[str, Collection[str | bool | None]] = {
    "solver": tuple(SOLVERS),
    "loss": tuple(Loss),
    "prior": (*Prior, EARLIER_PRIOR),
    "simulated": (True, False),
    "usable": (True, False),
    "unusable_because": (None, *Unusable),
}


SINGLE: Mapping[str, type | tuple[type, ...]] = {  # fields of the whole result that are neither lists nor objects
    **dict.fromkeys(("n_observations", "iterations", "n_free", "rank"), int),
    **dict.fromkeys(("rank_gap", "chi2_reduced", "chi2_freedom"), (int, float, type(None))),
    **dict.fromkeys(("message", "relabelling_search"), str),
}


def check_consistent(document: Mapping[str, Any]) -> None:
    """Raise SchemaError for a field of a result that contradicts itself or another."""
    for where, key, value in _fields({k: v for k, v in document.items() if k not in ("parameters", "covariance")}, ""):
        _check_number(where, key, value)
    _check_words(document)
    _check_single(document)
    names = [parameter["name"] for parameter in document["parameters"]]
    free = [parameter["name"] for parameter in document["parameters"] if parameter["free"]]
    for parameter in document["parameters"]:
        if parameter["unit"] not in UNITS:
            raise SchemaError(f"parameter {parameter['name']}: its unit is not known, {WHOLE}")
        _check_number(f"parameter {parameter['name']}: sigma", "sigma", parameter["sigma"])
        if any(abs(parameter[key] or 0.0) > LARGEST for key in ("nominal", "value", "sigma")):
            raise SchemaError(f"parameter {parameter['name']}: is larger than any parameter can be, {WHOLE}")
    covered = document["covariance"]["names"]
    if document.get("free", free) != free or not set(covered) <= set(free):
        raise SchemaError(f"free: is not the list of parameters that are free, {WHOLE}")
    unit_of = {parameter["name"]: parameter["unit"] for parameter in document["parameters"]}
    units = [unit_of[name] for name in covered]
    if covered and document["covariance"].get("units", units) != units:
        raise SchemaError(f"covariance: units: are not those of its parameters, {WHOLE}")
    if not set(document.get("suggested_free", ())) <= set(names):
        raise SchemaError(f"suggested_free: names parameters that the result does not have, {WHOLE}")
    _check_order("chi2_band", document.get("chi2_band"))
    made_with = document.get("made_with") or {}  # None: written by an earlier version
    allowed = made_with.get("allow", []) if isinstance(made_with, Mapping) else None
    if not isinstance(allowed, list) or not all(isinstance(text, str) for text in allowed):
        raise SchemaError(f"made_with: allow: is not a list of texts, {WHOLE}")
    for entry in (document.get(name) or {} for name in ("unexplained", "held_out", "held_out_before")):
        for suffix in SUFFIXES:
            for low, high in (("low", "mean"), ("mean", "high"), ("mean", "rms"), ("rms", "max")):
                pair = [entry.get(f"{name}_{suffix}") for name in (low, high)]
                _check_order(f"{low}_{suffix}, {high}_{suffix}", pair)
    for i, entry in enumerate(document.get("systematic", ()), start=1):
        for key in ("rows", "first_within", "last_within"):
            _check_order(f"systematic: item {i}: {key}", [1, *entry[key]])
        if entry["form"] not in tuple(ErrorForm) or entry["unit"] not in (*UNITS, None):
            raise SchemaError(f"systematic: item {i}: its form or unit is not known, {WHOLE}")
        if entry["chance"] is not None and entry["chance"] > 1.0:
            raise SchemaError(f"systematic: item {i}: chance: is larger than 1, {WHOLE}")
    joints = document.get("joint_range", {"lower": (), "upper": ()})
    for i, ends in enumerate(zip(joints["lower"], joints["upper"], strict=True), start=1):
        _check_order(f"joint_range: joint {i}", ends)


def check_covariance(names: Sequence[str], covariance: Floats, sigma: Mapping[str, float]) -> None:
    """Raise SchemaError if no estimates can have the covariance (f, f), or if ``sigma`` differs from it."""
    covariance = np.nan_to_num(covariance)
    bound = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.outer(bound, bound)
    if (np.abs(covariance - covariance.T) > ROUNDING * scale).any():
        raise SchemaError(f"covariance: is not symmetric, {WHOLE}")
    if (np.diag(covariance) < 0.0).any() or (np.abs(covariance) > (1.0 + ROUNDING) * scale).any():
        raise SchemaError(f"covariance: exceeds its variances, {WHOLE}")
    for name, expected in zip(names, bound, strict=True):
        if abs(sigma[name] - expected) > ROUNDING * expected:  # False for a NaN, of a parameter that is unidentifiable
            raise SchemaError(f"parameter {name}: its sigma is not that of the covariance, {WHOLE}")


def _fields(value: Any, where: str, key: str = "") -> Iterator[tuple[str, str, Any]]:
    """Yield the place, the key and the value of each field that is neither an object nor a list."""
    if isinstance(value, Mapping):
        for name, part in value.items():
            yield from _fields(part, f"{where}: {name}" if where else name, name)
    elif isinstance(value, list):
        for part in value:
            yield from _fields(part, where, key)
    else:
        yield where, key, value


def _check_words(document: Mapping[str, Any]) -> None:
    """Raise SchemaError for a word that this version never writes, and for a verdict that contradicts its reason."""
    for key, known in WORDS.items():
        value = document.get(key, next(iter(known)))
        if not isinstance(value, str | bool | None) or value not in known:
            text = ", ".join(json.dumps(word) for word in known)
            raise SchemaError(
                f"{key}: {quoted(value)} is not one of {text}: the file is damaged or comes from a later truearm; update truearm, or identify again"
            )
    for i, one in enumerate(document.get("explanations", ()), start=1):
        if one["what"] not in tuple(WrongInput):
            raise SchemaError(f"explanations: item {i}: what: {quoted(one['what'])} is not known, {WHOLE}")
    if "usable" in document and document["usable"] != (document.get("unusable_because") is None):
        raise SchemaError(f"usable: contradicts unusable_because, {WHOLE}")


def _check_single(document: Mapping[str, Any]) -> None:
    """Raise SchemaError for a field of another type, and for a rank that is larger than the number of free parameters."""
    for key, kind in SINGLE.items():
        value = document.get(key)
        if key in document and (not isinstance(value, kind) or isinstance(value, bool)):
            raise SchemaError(f"{key}: {quoted(value)} is of another type, {WHOLE}")
    if (document.get("rank_gap") or 0.0) < 0.0:
        raise SchemaError(f"rank_gap: is negative, {WHOLE}")
    if "rank" in document and "n_free" in document and document["rank"] > document["n_free"]:
        raise SchemaError(f"rank: is larger than n_free, {WHOLE}")


def _check_number(where: str, key: str, value: Any) -> None:
    """Raise SchemaError for a number that is not finite, or a count or size that cannot be one."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if number and not abs(value) <= LARGEST_NUMBER:  # JSON's 1e999 is infinite
        raise SchemaError(f"{where}: is too large for a number of a result, {WHOLE}")
    of_unit = OF_UNIT.fullmatch(key)
    counted = key in (COUNTED if where.startswith("observations: ") else COUNTS)
    if value is None or not (counted or of_unit or key in SIZES):
        return
    if not number or value < 0 or (counted and (not isinstance(value, int) or value > LARGEST)):
        kind = "count" if counted else "size"
        raise SchemaError(f"{where}: {str(value)[:20]!r} is not a {kind}, {WHOLE}")
    if of_unit and value > LARGEST:
        raise SchemaError(f"{where}: {value:.3g} is too large, {WHOLE}")


def _check_order(where: str, values: Sequence[float | None] | None) -> None:
    """Raise SchemaError for numbers that are not in ascending order; those that are null are skipped."""
    known = [value for value in values or () if value is not None]
    if any(not isinstance(value, int | float) for value in known):
        raise SchemaError(f"{where}: are not numbers, {WHOLE}")
    if any(b < a - ROUNDING * abs(a) for a, b in pairwise(known)):
        raise SchemaError(f"{where}: are not in order, {WHOLE}")
