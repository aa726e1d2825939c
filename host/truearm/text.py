"""Text for terminals, and strict JSON, which has neither NaN nor infinity."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence
from typing import Any


def one_line(text: str) -> str:
    """Return ``text`` on one line, with control characters (for example in file names) escaped."""
    if text.isascii() and text.isprintable():
        return " ".join(text.split())
    # file names that the locale could not decode come as surrogates; most are UTF-8 anyway
    text = text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(text.split()))


def page(title: str) -> str:
    """Return a reference to a page of the documentation, by title, because an installed truearm has no docs folder."""
    return f'see "{title}" in the documentation'


def box_command(words: str, device: str) -> str:
    """Return a command of ``truearm box`` for the box at a port, as it is typed."""
    return f"truearm box {words} --box {shlex.quote(one_line(device))}"


def counted(count: int, singular: str, many: str = "") -> str:
    """Return a number with its noun: "1 row", "7 rows"."""
    return f"{count} {singular if count == 1 else many or singular + 's'}"


def listed(names: Sequence[str], most: int = 12) -> str:
    """Return names between commas; more than ``most`` are cut short, with their number."""
    return ", ".join(names[:most]) + (f", … ({len(names)} in all)" if len(names) > most else "")


def with_article(noun: str) -> str:
    """Return a noun with its indefinite article: "a seat", "an inclinometer"."""
    return f"{'an' if noun[:1] in 'aeiouAEIOU' else 'a'} {noun}"


def faster(rate_ppm: float, digits: int) -> str:
    """Return how much faster or slower a clock counts: "28.3 ppm slower"."""
    return f"{abs(rate_ppm):.{digits}f} ppm {'slower' if rate_ppm < 0 else 'faster'}"


def outcome(status: str, iterations: int | None = None) -> str:
    """Return how a fit ended in words, with its number of iterations if given."""
    converged = status == "converged"
    words = "converged" if converged else "not converged"
    return (
        words if iterations is None else f"{words} {'in' if converged else 'after'} {counted(iterations, 'iteration')}"
    )


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
    """Return a value as JSON text with one line for each innermost list or object.

    A number that does not exist is null.
    """
    return _json_text(without_nan(value), 0)


def _json_text(value: Any, indent: int) -> str:
    items = list(value.values()) if isinstance(value, dict) else value if isinstance(value, list) else []
    if not any(isinstance(item, dict | list) for item in items):
        return json.dumps(value, allow_nan=False)
    names = [f"{json.dumps(name)}: " for name in value] if isinstance(value, dict) else [""] * len(items)
    pad, (first, last) = "\n" + " " * indent, "{}" if isinstance(value, dict) else "[]"
    lines = (f"{pad}  {name}{_json_text(item, indent + 2)}" for name, item in zip(names, items, strict=True))
    return f"{first}{','.join(lines)}{pad}{last}"
