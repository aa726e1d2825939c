"""The HTML report of an error map: its findings, the arm with the cells in 3-D, the picture."""

from __future__ import annotations

from collections.abc import Sequence

from truearm.findings import Finding
from truearm.report.page_parts import finding_parts, html_page, scrolled, section
from truearm.report.scene_view import Scene, script, view_section


def render(robot: str, findings: Sequence[Finding], picture: str, scene: Scene) -> str:
    """Return the page as HTML text, to be written as UTF-8."""
    verdict, doubts, notes = finding_parts(findings)
    sections = (
        f"<section>{verdict}{doubts}{notes}</section>\n",
        view_section(scene),
        section("The section", f'<figure class="map">{scrolled(picture, "map")}</figure>'),
    )
    simulated = any(finding.code == "simulated" for finding in findings)
    title = f"Error of {robot} without calibration"
    return html_page(
        "truearm map", title, "over a section of the workspace", sections, "simulated" * simulated, script(scene)
    )
