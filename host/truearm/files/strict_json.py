"""Strict JSON, which knows neither NaN nor infinity."""

from __future__ import annotations

import json
import math
from typing import Any


def without_nan(value: Any) -> Any:
    """Return a JSON value with null in place of every number that is not finite; tuples become lists."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def strict_json(value: Any, indent: int) -> str:
    """Return a value as JSON text; a number that does not exist is null."""
    return json.dumps(without_nan(value), indent=indent, allow_nan=False)
