"""Numbers and external strings as text of a page: display units (mm, deg), everything escaped."""

from __future__ import annotations

import html
import math

from truearm.units import shown, symbol

ABSENT = "–"
MINUS = "\u2212"
SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def escape(text: str, limit: int = 200) -> str:
    """Return ``text`` for HTML content and attributes: markup escaped, unprintable characters replaced, cut at
    ``limit``.

    The replaced characters are control characters, marks that reverse the writing direction, and lone surrogates (from
    file names), which UTF-8 cannot hold.
    """
    short = text if len(text) <= limit else text[: limit - 1] + "…"
    return html.escape("".join(c if c.isprintable() else " " if c.isspace() else "\ufffd" for c in short))


def number(value: float, decimals: int, sign: bool = False) -> str:
    """Return a fixed number of decimals with a true minus, none before zero; a dash if the number does not exist."""
    if not math.isfinite(value):
        return ABSENT
    value = round(value, decimals) + 0.0  # no minus before a zero
    return f"{value:{'+' if sign and value else ''}.{decimals}f}".replace("-", MINUS)


def figures(value: float, count: int = 3) -> str:
    """Return ``count`` significant figures, with a power of ten below 1e-4 and from 1e6: 10.2, 0.0821, 2.8·10¹²."""
    if not math.isfinite(value):
        return ABSENT
    if value == 0.0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if not -4 <= exponent < 6:
        mantissa = number(value / 10.0**exponent, count - 1)
        return f"{mantissa}·10{str(exponent).translate(SUPERSCRIPT)}"
    return number(value, max(count - 1 - exponent, 0))


def size(value: float, si: str, unit: str | None = None) -> str:
    """Return an SI value with three significant figures in its display unit; ``unit`` replaces the symbol after it."""
    if not math.isfinite(value):
        return ABSENT
    return f"{figures(shown(value, si))} {symbol(si) if unit is None else unit}".rstrip()
