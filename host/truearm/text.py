"""Text for terminals."""

from __future__ import annotations

import shlex
from collections.abc import Sequence


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
