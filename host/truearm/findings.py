"""What truearm states about data: a short code with values. Screen, report and JSON put it into words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from truearm.errors import InputError


class Severity(StrEnum):
    """How much a finding matters: nothing is done because of it, the user must look at it, or it is a remark."""

    REFUSAL = "refusal"
    WARNING = "warning"
    NOTE = "note"


@dataclass(frozen=True)
class Finding:
    """A statement by its code, such as "shared-use", with the values that its text needs."""

    code: str
    values: Mapping[str, object] = field(default_factory=dict)
    severity: Severity = Severity.REFUSAL


class FindingError(InputError):
    """An input is refused because of a finding."""

    def __init__(self, finding: Finding, *text: str) -> None:
        super().__init__(*text)
        self.finding = finding
