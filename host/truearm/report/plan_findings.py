"""The findings of a plan, from the content of ``truearm plan --json``: what is measured and what it will determine."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from truearm import option_defaults
from truearm.findings import Finding, ordered, stated
from truearm.report.result_findings import held_frames

Document = Mapping[str, Any]


def forecast_findings(document: Document, n_checks: int = 0) -> list[Finding]:
    """Return the verdict, then what limits the plan. ``n_checks``: of the check poses that were asked for."""
    return ordered([_planned(document), *_limits(document, n_checks)])


def _planned(document: Document) -> Finding:
    rms, largest = document["cartesian_rms_mm"], document["cartesian_worst_mm"]
    return stated(
        "planned",
        document,
        visits=document["visits"] if document.get("visits", 1) > 1 else None,
        checks=document.get("check_poses"),
        lines=len(document.get("lines", ())),
        minutes=round(document["minutes"]),
        rms=None if rms is None else {"mm": rms},
        largest=None if rms is None else {"mm": largest},
        relative=rms is not None and document["cartesian_relative"],
    )


def _limits(document: Document, n_checks: int) -> Iterator[Finding]:
    unseen, weak, defaults = document["null_space"], document["hardly_seen"], document["defaults"]
    yield stated("planned-rank", document, unseen=len(unseen), weak=len(weak))
    if "poses" in document and document["poses"] < document["rank"] + len(unseen):
        yield Finding("few-poses", {"n": document["poses"]})
    yield from held_frames(defaults)
    if defaults["lost"] or defaults["believed"]:
        yield stated("planned-held", defaults)
    checks = document.get("check_poses", 0)
    if n_checks not in (option_defaults.CHECK_POSES, checks):
        yield Finding("fewer-checks", {"asked": n_checks, "planned": checks, "visits": document["visits"] > 1})


def approach_findings(document: Document) -> list[Finding]:
    """Return what ``plan characterize`` planned."""
    return [stated("planned-approaches", document, minutes=round(document["minutes"]))]
