"""What a choice of poses can be good for, by name. Imports nothing, so that ``--help`` can list them (``choose`` uses them)."""

from __future__ import annotations

from collections.abc import Mapping

CRITERIA: Mapping[str, str] = {
    "I": "the error in the region",
    "D": "all parameters at once",
    "A": "their mean",
    "E": "the worst of them",
}
