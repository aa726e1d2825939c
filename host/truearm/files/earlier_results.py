"""Results of the format versions 1 to 3 in the form of version 4; nothing else knows that they exist.

What they do not have is optional in version 4, so it takes its default. Their checksum, if there is one, has been
compared: only what version 4 does not have is checked here.
"""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from msgspec import Struct

from truearm.estimate.solvers import Prior
from truearm.files.result_covariance import Covariance, Names
from truearm.results import Unusable


class _Matrix(Struct, frozen=True):
    names: Names
    units: Names
    matrix: tuple[tuple[float | None, ...], ...]


class _EarlierResult(Struct, frozen=True):
    covariance: _Matrix


def converted(document: dict[str, Any]) -> dict[str, Any]:
    """Return the content of a result in the form of version 4. Raises msgspec.ValidationError."""
    if "faults" not in document:
        document = _with_faults(document)
    pose_error = document.get("pose_error")
    if isinstance(pose_error, dict) and "sigma_mm" in pose_error:
        renamed = {"sigma_mm": "shared_mm", "row_variance": "factor"}
        document = {**document, "pose_error": {renamed.get(name, name): size for name, size in pose_error.items()}}
    return document if document["format_version"] == 4 else _of_version_4(document)


def _of_version_4(document: dict[str, Any]) -> dict[str, Any]:
    covariance = msgspec.convert(document, _EarlierResult).covariance
    n = len(covariance.names)
    if [len(row) for row in covariance.matrix] != [n] * n:
        raise msgspec.ValidationError(f"needs {n} rows of {n} numbers, one per name - at `$.covariance.matrix`")
    packed = Covariance.of(covariance.names, covariance.units, np.array(covariance.matrix, dtype=float).reshape(n, n))
    converged, made_with = document.get("status") == "converged", document.get("made_with")
    verdict = {"usable": converged, "unusable_because": None if converged else Unusable.NOT_CONVERGED}
    for options in (document, made_with):
        if isinstance(options, dict) and options.get("prior") == "default":
            options["prior"] = Prior.WHERE_NEEDED
    document = {**verdict, "residual_units": ["mm"], **document}
    return {**document, "format_version": 4, "covariance": msgspec.to_builtins(packed)}


def _with_faults(document: dict[str, Any]) -> dict[str, Any]:
    """Return the content with its systematic errors as faults; what was not stored is null."""
    moves = (document.get("without_systematic") or {}).get("tool_moves_mm")
    made_with = document.get("made_with")
    if isinstance(made_with, dict) and "allow" in made_with:
        made_with = {"apply" if name == "allow" else name: value for name, value in made_with.items()}
    return {
        **document,
        "faults": [_fault(entry, moves) for entry in document.get("systematic", ())],
        "explanations": [
            {**entry, "apply": {"apply": entry["apply"]["allow"]}} if "allow" in (entry.get("apply") or {}) else entry
            for entry in document.get("explanations", ())
            if "code" in entry  # earlier ones have a text instead
        ],
        "made_with": made_with,
    }


def _fault(entry: dict[str, Any], moves: float | None) -> dict[str, Any]:
    """Return a systematic error as a fault: its cause, and its rivals, with the same rows."""
    first, last = entry["rows"]
    unknown = dict.fromkeys(("weight", "error_mm", "gain", "gain_t"))
    rows = {"first": first, "last": last, "from": entry.get("from", ""), "to": entry.get("to", "")}
    what = f"{entry.get('what') or 'rows'}.{entry.get('form', 'offset')}"
    causes = [(what, (entry.get("apply") or {}).get("allow", "")), *((name, "") for name in entry.get("rivals", ()))]
    size = {"unit": entry.get("unit"), "value": entry.get("size"), "sigma": entry.get("sigma")}
    return {
        "aliases": [],
        "sizes": [size] if entry.get("unit") else [],
        "rivals": [{"name": name, "apply": apply, **unknown, **rows, "moves_mm": moves} for name, apply in causes],
        "mean": {"name": "mean", "apply": "", **unknown, **dict.fromkeys(rows), "moves_mm": moves},
        "chi2_drop": entry.get("chi2_drop"),
        "freedom": entry.get("freedom", 0),
        "log_evidence": None,
        "deciding": [],
    }
