"""Findings: templates, the catalogue, and that every reader of a result has the same list."""

import ast
import json
import re
from pathlib import Path

import pytest
from tests.host.findings_bench import stated

import truearm.finding_texts
from truearm.finding_texts import STATEMENTS, Severity
from truearm.findings import Finding, worded

HOST = Path(truearm.finding_texts.__file__).parent
REPORT = HOST / "report"


@pytest.mark.parametrize(
    ("template", "values", "text"),
    [
        ("{n:#row}", {"n": 1}, "1 row"),
        ("{n:#entry|entries} {n:?is|are} bad", {"n": 2}, "2 entries are bad"),
        ("{rows:#row}", {"rows": ["a", "b"]}, "2 rows"),
        ("{names}", {"names": ["a", "b"]}, "a, b"),
        ("{size}", {"size": {"mm": 0.12345, "deg": 0.5}}, "0.123 mm and 0.5000 deg"),
        ("{size:.1f}", {"size": {"mm": 0.12345}}, "0.1 mm"),
        ("{size}", {"size": {"mm": None}}, "-"),
        ("a[ b {x}][{y:!} c].", {"x": None, "y": True}, "a c."),
        ("a[ b {x}][{y:!} c].", {"x": 3, "y": False}, "a b 3."),
        ("give {@leave_out} {x}", {"x": "a\nb"}, "give --leave_out a b"),
        ("give {rows:@allow}", {"rows": ["a b", "c"]}, "give --allow 'a b' --allow c"),
        ("{text}", {"text": "[{not} a template]"}, "[{not} a template]"),
    ],
)
def test_a_template_is_filled(template, values, text):
    assert worded(template, values, "--{}".format) == text


def test_every_code_of_a_result_has_an_entry_and_every_entry_a_code():
    """The codes in the source of report/ are those of the catalogue."""
    texts = [path.read_text(encoding="utf-8") for path in (REPORT / "result_findings.py", REPORT / "law_findings.py")]
    strings = {
        node.value
        for text in texts
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert set(STATEMENTS) <= strings
    first = {code for text in texts for code in re.findall(r'Finding\(\s*"([a-z-]+)"', text)}
    assert first <= set(STATEMENTS)


@pytest.mark.parametrize("code", STATEMENTS)
def test_an_entry_is_a_sentence(code):
    severity, *texts = STATEMENTS[code]
    assert severity in Severity
    assert re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", code)
    for text in filter(None, texts):
        assert text.count("[") == text.count("]")
        assert not re.search(r"  |--", text)


def test_screen_page_json_and_file_have_the_same_findings(run, good, tmp_path):
    files = ["--out", tmp_path / "r.json", "--report", tmp_path / "r.html", "--hold-out", "0.2"]
    screen = " ".join(run(*good, *files, "--details").out.split())
    result = json.loads((tmp_path / "r.json").read_text())
    page = (tmp_path / "r.html").read_text()
    findings = stated(result)
    assert [entry["code"] for entry in result["findings"]] == list(findings)
    assert len(findings) >= 6
    for finding in findings.values():
        assert " ".join(finding.text(lambda name: f"--{name.replace('_', '-')}").split()) in screen
        assert finding.text().replace('"', "&quot;").replace("'", "&#x27;") in page


def test_the_short_form_begins_with_the_verdict_and_fits_fifteen_lines(run, good):
    lines = run(*good, "--hold-out", "0.2").out.splitlines()
    assert lines[0].startswith("Usable: ")
    assert len(lines) <= 15


def test_an_unknown_code_is_no_finding():
    with pytest.raises(KeyError):
        Finding("no such code").text()
