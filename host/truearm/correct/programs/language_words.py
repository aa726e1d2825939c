"""The words of the robots' languages, from ``words.toml``: what each of them does."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib import resources
from typing import Any

from truearm.correct.programs.program import Step


@cache
def table_of(language: str) -> dict[str, Any]:
    """Return the table of a language as it is written."""
    text = resources.files(__package__).joinpath("words.toml").read_text("utf-8")
    return dict(tomllib.loads(text)[language])


def words_of(language: str) -> dict[str, frozenset[str]]:
    """Return the lists of words by their names."""
    return {name: frozenset(text.split()) for name, text in table_of(language).items() if isinstance(text, str)}


def steps_of(language: str) -> dict[str, Step]:
    """Return what each word that begins, continues or ends a block is between moves."""
    return {word: Step(step) for step, text in table_of(language)["steps"].items() for word in text.split()}
