"""The HTML report of a validation: its certificate, the verdict, and the errors in parts of the workspace."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from truearm.findings import findings_of
from truearm.report.certificate import Certificate, certificate_section
from truearm.report.page_parts import command_block, finding_parts, html_page, section, table_of
from truearm.report.page_text import escape
from truearm.report.validation_findings import error_tables


def render(robot: str, certificate: Certificate, document: Mapping[str, Any], command: str) -> str:
    """Return the page as HTML text, to be written as UTF-8; ``document`` is what ``truearm validate --json`` prints."""
    tables = ""
    for titles, *rows in error_tables(document):
        cells = ([escape(cell) for cell in row] for row in rows)
        tables += table_of([escape(title) for title in titles], cells, "errors")
    verdict, doubts, notes = finding_parts(findings_of(document))
    sections = (
        certificate_section(certificate),
        f"<section>{verdict}{doubts}</section>\n",
        section("Errors", tables + notes),
        section("How it was made", command_block(command)) if command else "",
    )
    watermark = "simulated" * bool(document["simulated"])
    return html_page("truearm validate", f"Validation of {robot}", "", sections, watermark=watermark)
