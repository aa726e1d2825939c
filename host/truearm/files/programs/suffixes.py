"""The languages of robot programs, and the suffixes of their files."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

ProgramLanguage = Literal["urscript", "rapid"]
RAPID_SUFFIXES = (".mod", ".prg", ".modx", ".sys", ".sysx")
SCRIPT_SUFFIXES = (".script", ".urscript")


def suffixes_like(path: Path) -> tuple[str, ...]:
    """Return the suffixes of programs in the language of a program."""
    return SCRIPT_SUFFIXES if language_of(path) == "urscript" else RAPID_SUFFIXES


def is_program(path: Path) -> bool:
    """Return whether a file is a robot program, by its suffix."""
    return path.suffix.lower() in (*RAPID_SUFFIXES, *SCRIPT_SUFFIXES)


def language_of(path: Path) -> ProgramLanguage:
    """Return the language of a program, by its suffix."""
    return "urscript" if path.suffix.lower() in SCRIPT_SUFFIXES else "rapid"
