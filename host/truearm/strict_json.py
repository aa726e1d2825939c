"""Strict JSON, which has neither NaN nor infinity."""

from __future__ import annotations

import json
import math
from typing import Any


def number_or_null(value: Any) -> float | None:
    """Return a number for JSON, or None if it is not finite."""
    return float(value) if math.isfinite(value) else None


def without_nan(value: Any) -> Any:
    """Return a JSON value with null in place of every non-finite number; tuples become lists."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def strict_json(value: Any) -> str:
    """Return a value as JSON text with one line for each innermost list or object; a number that does not exist is null."""
    return _text(without_nan(value), 0)


def _text(value: Any, indent: int) -> str:
    items = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    if not any(isinstance(item, dict | list) for item in items):
        return json.dumps(value, allow_nan=False)
    names = [f"{json.dumps(name)}: " for name in value] if isinstance(value, dict) else [""] * len(items)
    pad, (first, last) = "\n" + " " * indent, "{}" if isinstance(value, dict) else "[]"
    lines = (f"{pad}  {name}{_text(item, indent + 2)}" for name, item in zip(names, items, strict=True))
    return f"{first}{','.join(lines)}{pad}{last}"
