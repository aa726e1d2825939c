"""docs/reference/result-format.md, as far as it can be checked automatically, beyond what ``Result`` declares."""

import json
from typing import Any

import numpy as np
import pytest

from truearm.estimate.result_file import ParameterEstimate, Result, checksum, parse_result
from truearm.kinds.columns import ORIGINS, identifiers

RMS = ("rms_before", "rms_after")
RAW = ("rms_raw", "rms_declared", "rms_unexplained")
BY_UNIT = (*RMS, *RAW, "rms_history")
FIELDS = {name for name in Result.__struct_fields__ if not name.startswith(BY_UNIT)} | {"checksum"}


def signed(document: dict[str, Any]) -> str:
    """Return the text of a result that another program changed, with its checksum."""
    return json.dumps({**document, "checksum": checksum(document)})


def check_schema(result: dict[str, Any]) -> None:
    """Check a result: it has all fields, and what they say of one another."""
    units = result["residual_units"]
    assert units
    assert set(units) <= {"mm", "deg"}

    def each(*figures: str) -> set[str]:
        return {f"{figure}_{unit}" for figure in figures for unit in units}

    assert set(result) == FIELDS | each(*BY_UNIT)
    assert parse_result(json.dumps(result), "r.json").document == result
    for parameter in result["parameters"]:
        assert set(parameter) - {"law"} == set(ParameterEstimate.__struct_fields__) - {"law"}
        assert (parameter["sigma"] is None) == (not parameter["seen"])
    free = [p["name"] for p in result["parameters"] if p["free"]]
    assert result["free"] == result["covariance"]["names"] == free
    unseen = {name for direction in result["null_space"] for name in direction["names"]}
    assert unseen >= {p["name"] for p in result["parameters"] if p["free"] and not p["seen"] and p["of"] == "robot"}
    assert unseen <= {p["name"] for p in result["parameters"] if p["free"] and not p["seen"]}
    for direction in (*result["null_space"], *result["defaults"]["frames"]):
        assert np.abs(direction["weights"]).max() == pytest.approx(1.0)
    assert len(result["suggested_free"]) == result["rank"]
    assert set(result["suggested_free"]) <= set(free)
    for entry in result["observations"]:
        names = {f"{column}s" for column in identifiers() if column not in ORIGINS}
        assert set(entry) == {"rig", "kind", "fitted", "held_out", *names} | each(*RMS, "rms_held_out")
    defaults = result["defaults"]
    for direction in defaults["frames"]:
        assert {*direction["names"]} & {*defaults["base"], *defaults["tool"]}
    held = {name for key in ("base", "tool", "lost") for name in defaults[key]}
    assert held <= {p["name"] for p in result["parameters"]} - set(free)
    assert set(defaults["believed"]) <= set(free)
    predicted = result["predicted_error"]
    assert predicted is None or set(predicted) == {"rms_mm", "max_mm", "scatter_mm", "at", "n", "relative"}
    for key in ("held_out", "held_out_before"):
        figures = {"n", "n_settled", "n_left_out"} | each("rms", "mean", "max", "n")
        assert result[key] is None or set(result[key]) == figures
