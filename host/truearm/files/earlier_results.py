"""Results of the format versions 1 to 3 in the form of version 4; nothing else knows that they exist.

What they do not have is optional in version 4, so it takes its default; their ``systematic`` errors are skipped, as any
field that version 4 does not know. Their checksum, if there is one, has been compared: only what version 4 does not
have is checked here.
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


RENAMED = {  # keys of entries, also in results of version 4 that are older than the names
    "pose_error": {"sigma_mm": "shared_mm", "row_variance": "factor"},
    "made_with": {"allow": "apply"},
}


def converted(document: dict[str, Any]) -> dict[str, Any]:
    """Return the content of a result in the form of version 4. Raises msgspec.ValidationError."""
    for field, names in RENAMED.items():
        entry = document.get(field)
        if isinstance(entry, dict):
            document[field] = {names.get(key, key): value for key, value in entry.items()}
    return document if document["format_version"] == 4 else _of_version_4(document)


def _of_version_4(document: dict[str, Any]) -> dict[str, Any]:
    covariance = msgspec.convert(document, _EarlierResult).covariance
    n = len(covariance.names)
    if [len(row) for row in covariance.matrix] != [n] * n:
        raise msgspec.ValidationError(f"needs {n} rows of {n} numbers, one per name - at `$.covariance.matrix`")
    packed = Covariance.of(covariance.names, covariance.units, np.array(covariance.matrix, dtype=float).reshape(n, n))
    is_converged = document.get("status") == "converged"
    verdict = {"usable": is_converged, "unusable_because": None if is_converged else Unusable.NOT_CONVERGED}
    for options in (document, document.get("made_with")):
        if isinstance(options, dict) and options.get("prior") == "default":
            options["prior"] = Prior.WHERE_NEEDED
    document = {**verdict, "residual_units": ["mm"], **document, "explanations": []}  # they were texts
    return {**document, "format_version": 4, "covariance": msgspec.to_builtins(packed)}
