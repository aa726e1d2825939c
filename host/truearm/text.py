"""Text for terminals."""

from __future__ import annotations


def one_line(text: str) -> str:
    """``text`` on one line, with control characters (of strangers' names, say) made visible."""
    # file names that the locale could not decode come as surrogates; most are UTF-8 all the same
    text = text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in " ".join(text.split()))


def with_article(noun: str) -> str:
    """A noun with its indefinite article: "a seat", "an inclinometer"."""
    return f"{'an' if noun[:1] in 'aeiou' else 'a'} {noun}"
