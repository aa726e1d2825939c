"""Findings: templates, the catalogue, and that every reader of a result has the same list."""

import ast
import errno
import json
import re
from pathlib import Path

import pytest
from tests.host.findings_bench import stated

import truearm.finding_texts
from truearm.cli.main import command_tree
from truearm.cli.output import show
from truearm.errors import Argument, InputError, PlanError, ProblemError, RobotError, TableError
from truearm.finding_texts import ERRORS, REASONS, STATEMENTS, Severity
from truearm.findings import Finding, worded

HOST = Path(truearm.finding_texts.__file__).parent


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
        ("a[{y:!} b|| {x:g}].", {"x": 0.0, "y": True}, "a b."),
        ("a[{y:!} b|| {x:g}].", {"x": 0.0, "y": False}, "a 0."),
        ("give {@leave_out} {x}", {"x": "a\nb"}, "give --leave_out a b"),
        ("give {rows:@apply}", {"rows": ["a b", "c"]}, "give --apply 'a b' --apply c"),
        ("run it {rows:@@leave_out} {@@no_check}", {"rows": ["a"]}, "run it --leave-out a --no-check"),
        ("{texts:;}.", {"texts": ["a, b"] * 13}, "; ".join(["a, b"] * 13) + "."),
        (STATEMENTS["box-fault"].sentence, {"fault": "a"}, "warning: a"),
        ("{text}", {"text": "[{not} a template]"}, "[{not} a template]"),
    ],
)
def test_a_template_is_filled(template, values, text):
    assert worded(template, values, "--{}".format) == text


def test_codes_and_entries_belong_together():
    # The codes in the source of truearm are those of the catalogue.
    every = [path.read_text("utf-8") for path in HOST.rglob("*.py") if path.name != "finding_texts.py"]
    texts = [text for text in every if "from truearm.findings import" in text]
    strings = {string for text in every for string in re.findall(r'"([a-z0-9-]+)"', text)}
    assert {code for code in STATEMENTS if code not in ERRORS} <= strings
    first = {code for text in texts for code in re.findall(r'Finding\(\s*"([a-z-]+)"', text)}
    assert first <= set(STATEMENTS)
    tables = [table for name, table in vars(truearm.finding_texts).items() if name.isupper() and type(table) is dict]
    codes = [code for table in tables if table is not STATEMENTS for code in table]
    assert len(STATEMENTS) == len({*codes} & {*STATEMENTS})
    assert not {code for code in codes if codes.count(code) > 1} - set(truearm.finding_texts.INPUTS)


@pytest.mark.parametrize("code", STATEMENTS)
def test_an_entry_is_a_sentence(code):
    severity, *texts = STATEMENTS[code]
    assert severity in Severity
    assert re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", code)
    for text in filter(None, texts):
        assert text.count("[") == text.count("]")
        assert not re.search(r"  |--", text)
        assert not re.search(
            r"truearm [a-z][^.,;|\[\]]*\{\w*:?@\w", text
        )  # in a command an option is one in Python too


def test_options_that_an_entry_names_exist():
    tree = command_tree()
    groups, options = [tree], {"robot"}  # the argument of --model
    for group in groups:
        groups += [command for command in getattr(group, "commands", {}).values() if command not in groups]
        options |= {name.removeprefix("--") for parameter in group.params for name in parameter.opts}
    named = {
        name for texts in [*STATEMENTS.values(), *REASONS.values()] for name in re.findall(r"@(\w+)\}", str(texts))
    }
    assert {name.replace("_", "-") for name in named} - options == {"help"}


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


NOTE, WARNING, REFUSAL = Finding("refit-next"), Finding("backlash-varies", {"probability": 0.1}), Finding("no-stops")


@pytest.mark.parametrize(
    ("findings", "tables", "hint", "shown", "has_hint"),
    [
        ([REFUSAL] * 20, (), "more", [20, 0], False),
        ([REFUSAL, *[WARNING] * 20, REFUSAL], (), "more", [2, 6], True),
        ([REFUSAL, *[WARNING] * 20, REFUSAL], (), "", [2, 20], False),
        ([REFUSAL], ("table",), "more", [1, 0], True),
        ([REFUSAL, Finding("faults-applied", {"applied": "x"})], (), "more", [1, 0], True),
    ],
)
def test_what_the_short_form_leaves_out(capsys, findings, tables, hint, shown, has_hint):
    show(findings, tables, hint=hint)
    lines = capsys.readouterr().out.splitlines()
    assert [sum(line.startswith(finding.text()[:20]) for line in lines) for finding in (REFUSAL, WARNING)] == shown
    assert lines[-1].endswith("more") == has_hint


def test_errors_have_codes_values_and_places():
    error = TableError("a.csv row 3 column q1_rad: 'x' is not a number; write digits: -1.5")
    reason = "'x' is not a number; write digits: -1.5"
    assert error.finding == Finding("malformed-file", {"place": "a.csv row 3 column q1_rad", "reason": reason})
    error = InputError(Argument("rate"), " 7 Hz is too much; give ", Argument("force"))
    assert error.finding == Finding("invalid-input", {"place": "rate", "reason": "7 Hz is too much; give force"})
    assert error.text("--{}".format) == "--rate 7 Hz is too much; give --force"
    assert ProblemError("no rows").finding == Finding("unsolvable", {"place": "", "reason": "no rows"})
    assert PlanError("no pose is within reach; move the chucks").finding.code == "no-plan"  # of no file
    error = TableError("too-large", most=3).within("a.csv")
    assert error.finding == Finding("too-large", {"place": "a.csv", "most": 3})
    assert str(error.within("b.zip")).startswith("b.zip: a.csv: ")
    assert RobotError("no ", Argument("tip")).within("a.urdf").text("--{}".format) == "a.urdf: no --tip"
    with pytest.raises(KeyError):
        Finding("no such code").text()


@pytest.mark.parametrize(
    ("error", "code", "place"),
    [
        (TableError("my poses.csv row 3: no"), "malformed-file", "my poses.csv row 3"),
        (InputError("--rig a: no"), "invalid-input", "--rig a"),
        (PlanError("no pose is within reach: give other bars"), "no-plan", ""),
        (ProblemError("they say nothing; measure more: rows"), "unsolvable", ""),
    ],
)
def test_a_sentence_before_a_colon_is_no_place(error, code, place):
    assert (error.finding.code, error.finding.values["place"]) == (code, place)
    assert error.finding.text() == str(error)


@pytest.mark.parametrize("values", [{"names": ["a"]}, {"form": "two numbers"}])
@pytest.mark.parametrize("value", ["", "b"])
def test_an_empty_value_is_refused_too(values, value):
    assert str(InputError("wrong-value", place="x", value=value, **values)).startswith("x")


def test_a_missing_file_is_a_file_not_found_and_every_input_error_a_value_error(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        truearm.read_rig(tmp_path / "rig.toml")
    assert (caught.value.filename, caught.value.errno) == (str(tmp_path / "rig.toml"), errno.ENOENT)
    assert issubclass(truearm.InputError, ValueError)


def test_a_command_gives_its_error_as_json(run, tmp_path):
    outcome = run("inspect", tmp_path / "gone.mcap", "--json")
    error = json.loads(outcome.out)["error"]
    assert (outcome.code, error["code"], error["values"]["place"]) == (2, "missing-file", str(tmp_path / "gone.mcap"))
    assert outcome.err == f"truearm: {error['text']}\n"
    assert json.loads(run("inspect", "--json", "--no-such-option").out)["error"]["code"] == "usage"


def test_every_code_that_is_raised_has_an_entry_with_its_values_and_every_entry_is_raised():
    raised = set(ERRORS) & {"usage"}
    for path in HOST.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") in ("default_code", "other_code"):
                raised.add(node.value.value)
            code = node.args[0] if isinstance(node, ast.Call) and node.args else None
            if not isinstance(code, ast.Constant) or not re.search(
                r"(Error|^error|^LinkClosed)$", ast.unparse(node.func)
            ):
                continue
            if re.fullmatch(r"[a-z]+(-[a-z]+)*", str(code.value)):
                raised.add(code.value)
                _, *texts = STATEMENTS[code.value]
                required = re.sub(r"\[[^\]]*\]", "", "".join(texts))
                names = set(re.findall(r"\{(\w+)", required))
                assert names <= {keyword.arg for keyword in node.keywords}, (path, code.value)
    assert raised >= set(ERRORS)
