"""Text for terminals."""

from __future__ import annotations


def one_line(text: str) -> str:
    """``text`` on one line, with control characters (of strangers' names, say) made visible."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(text.split()))
