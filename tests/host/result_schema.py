"""docs/reference/result-format.md, as far as it can be checked automatically."""

import base64
import json
import zlib
from typing import Any

import numpy as np
import pytest

from truearm.files.result_file import checksum, parse_result
from truearm.kinds.columns import ORIGINS, identifiers

HELD_OUT_KEYS = {"n", "n_settled", "n_left_out"}
HELD_OUT_FIGURES = ("rms", "mean", "max", "n")


SCALARS: dict[str, type | tuple[type, ...]] = {
    "format": str,
    "format_version": int,
    "checksum": str,
    "truearm_version": str,
    "status": str,
    "message": str,
    "solver": str,
    "loss": str,
    "prior": str,
    "iterations": int,
    "n_observations": int,
    "n_free": int,
    "rank": int,
    "rank_gap": (float, type(None)),
    "chi2_reduced": (float, type(None)),
    "chi2_freedom": float,
    "alternatives_tried": int,
    "simulated": bool,
    "usable": bool,
    "unusable_because": (str, type(None)),
}
PARAMETER = {
    "name": str,
    "unit": str,
    "nominal": float,
    "value": float,
    "sigma": (float, type(None)),
    "free": bool,
    "seen": bool,
    "of": str,
}
LISTS = {
    "findings",
    *("inputs", "observations", "free", "null_space", "residual_units", "held_out_by", "parameters"),
    *("suggested_free", "additions", "chi2_band", "suspect", "hardly_seen", "faults", "applied", "sessions"),
    "all_held_out",
    "copies",
    "folds",
    "explanations",
}
OBJECTS = {
    "robot",
    "defaults",
    "scale",
    "claim",
    "with_outliers",
    "without_bad_rows",
    "unexplained",
    "mean_change",
    "pose_error",
    "held_out",
    "held_out_before",
    "held_out_drawing",
    "covariance",
    "observability",
    "predicted_error",
    "joint_range",
    "joint_laws",
    "made_with",
    "hold_out_proposal",
}


def signed(document: dict[str, Any]) -> str:
    """Return the text of a result that another program changed, with its checksum."""
    return json.dumps({**document, "checksum": checksum(document)})


RMS = ("rms_before", "rms_after")
RAW = ("rms_raw", "rms_declared", "rms_unexplained")


def check_schema(result: dict[str, Any]) -> None:
    """Check a result against docs/reference/result-format.md, as far as possible automatically."""
    units = result["residual_units"]
    assert units
    assert set(units) <= {"mm", "deg"}

    def each(*figures: str) -> set[str]:
        return {f"{figure}_{unit}" for figure in figures for unit in units}

    assert set(result) == {*SCALARS, *LISTS, *OBJECTS, *each(*RMS, *RAW, "rms_history")}
    assert all(isinstance(result[key], float | None) for key in each(*RMS, *RAW))
    for key, kind in SCALARS.items():
        assert isinstance(result[key], kind), key
    for parameter in result["parameters"]:
        assert set(parameter) - {"law"} == set(PARAMETER)
        assert all(isinstance(parameter[key], kind) for key, kind in PARAMETER.items()), parameter
        assert parameter["unit"] in ("m", "rad", "1")
        assert (parameter["sigma"] is None) == (not parameter["seen"])
    free = [p["name"] for p in result["parameters"] if p["free"]]
    assert result["free"] == result["covariance"]["names"] == free
    upper = np.frombuffer(zlib.decompress(base64.b64decode(result["covariance"]["upper"])), "<i4")
    assert len(upper) == len(free) * (len(free) + 1) // 2
    assert parse_result(json.dumps(result), "r.json").document == result
    unseen = {name for direction in result["null_space"] for name in direction["names"]}
    assert unseen >= {p["name"] for p in result["parameters"] if p["free"] and not p["seen"] and p["of"] == "robot"}
    assert unseen <= {p["name"] for p in result["parameters"] if p["free"] and not p["seen"]}
    for direction in result["null_space"]:
        assert max(map(abs, direction["weights"])) == pytest.approx(1.0)
    assert len(result["suggested_free"]) == result["rank"]
    assert set(result["suggested_free"]) <= set(free)
    assert set(result["observability"]) == {"o1", "o2", "o3", "o4"}
    assert len(result["chi2_band"]) == 2
    for entry in result["observations"]:
        names = {f"{column}s" for column in identifiers() if column not in ORIGINS}
        assert names >= {"chucks", "spheres", "bars", "places", "trackers", "planes"}
        assert set(entry) == {"rig", "kind", "fitted", "held_out", *names} | each(*RMS, "rms_held_out")
    names = {p["name"] for p in result["parameters"]}
    assert set(result["defaults"]) == {"base", "tool", "frames", "still", "lost", "believed"}
    for direction in result["defaults"]["frames"]:
        assert max(map(abs, direction["weights"])) == pytest.approx(1.0)
        assert set(direction["names"]) & {*result["defaults"]["base"], *result["defaults"]["tool"]}
    held = {name for key in ("base", "tool", "lost") for name in result["defaults"][key]}
    assert held <= names - set(free)
    assert set(result["defaults"]["believed"]) <= set(free)
    assert all(set(joint) == {"joint", "unit", "spread", "at"} for joint in result["defaults"]["still"])
    predicted = result["predicted_error"]
    assert predicted is None or set(predicted) == {"rms_mm", "max_mm", "scatter_mm", "at", "n", "relative"}
    for key in ("held_out", "held_out_before"):
        assert result[key] is None or set(result[key]) == HELD_OUT_KEYS | each(*HELD_OUT_FIGURES)
