"""All commands and Python blocks in the documentation run as written, page by page."""

import ast
import importlib
import json
import re
import shlex
import shutil
from pathlib import Path

import pytest

import truearm
import truearm.extend
from tests.docs.pages import PAGES, ROOT, Block, blocks, page_skip, unprinted
from truearm.cli.main import command_tree, main
from truearm.report.result_findings import FORMS

BLOCKS = {page: blocks(page.read_text(encoding="utf-8")) for page in PAGES}
RUN = [(page, kept) for page, found in BLOCKS.items() if (kept := [block for block in found if not block.skip])]
SKIPPED = [(page, block) for page, found in BLOCKS.items() for block in found if block.skip]


def cases():
    for page, found in RUN:
        name = str(page.relative_to(ROOT))
        yield pytest.param([b for b in found if not b.soak], id=name)
        if any(b.soak for b in found):
            yield pytest.param(found, marks=pytest.mark.soak, id=f"{name}-soak")


@pytest.mark.parametrize("found", list(cases()))
def test_page(found, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("MPLBACKEND", "agg")
    names: dict[str, object] = {"__name__": "__main__"}
    for block in found:
        printed = run(block, names, monkeypatch, capfd)
        assert unprinted(block.shown, printed) is None, f"line {block.line}:\n{printed}"


def run(block: Block, names, monkeypatch, capfd) -> str:
    match block.language:
        case "file":
            Path(block.file).parent.mkdir(parents=True, exist_ok=True)
            Path(block.file).write_text(block.body, encoding="utf-8")
        case "python":
            exec(compile(block.body, f"line {block.line}", "exec"), names)
        case _:
            for line in block.body.replace("\\\n", " ").splitlines():
                command(shlex.split(line, comments=True), block, monkeypatch)
    out, err = capfd.readouterr()
    return err + out


def command(words: list[str], block: Block, monkeypatch) -> None:
    match words:
        case []:
            pass
        case ["truearm", *arguments]:
            assert main(arguments) == 0, f"line {block.line}: {' '.join(words)}"
        case ["cd", folder]:
            monkeypatch.chdir(folder)
        case ["copy", source, *name] if block.language == "setup":
            shutil.copy(ROOT / source, Path(*name) if name else Path())
        case ["rows", source, pattern, name] if block.language == "setup":
            head, *rows = (ROOT / source).read_text(encoding="utf-8").splitlines(keepends=True)
            Path(name).write_text("".join([head, *(row for row in rows if pattern in row)]), encoding="utf-8")
        case ["cut", name, size] if block.language == "setup":
            Path(name).write_bytes(Path(name).read_bytes()[: int(size)])
        case ["tree", folder] if block.language == "setup":
            shutil.copytree(ROOT / folder, folder)
        case _:
            raise AssertionError(f"line {block.line}: what is {words[0]}? Mark the block: <!-- test: skip, REASON -->")


def test_the_tutorials_and_guides_are_run():
    """A page of these folders runs something, or says on the page why not."""
    run_pages = {page for page, _ in RUN}
    for page in PAGES:
        if page.parent.name in ("tutorials", "how-to") and "```sh" in page.read_text(encoding="utf-8"):
            assert page in run_pages or "<!-- test: " in page.read_text(encoding="utf-8"), page


@pytest.mark.parametrize(("page", "block"), SKIPPED, ids=lambda of: getattr(of, "stem", getattr(of, "line", "")))
def test_what_is_not_run_is_parsed(page, block, tmp_path, monkeypatch):
    """A command that needs a box, a robot or an hour has the options and arguments that its parser knows."""
    monkeypatch.chdir(tmp_path)
    for line in block.body.replace("\\\n", " ").splitlines() if block.language == "sh" else ():
        words = shlex.split(line, comments=True)
        if words[:1] != ["truearm"]:
            continue
        command, words = command_tree(), words[1:]
        while commands := getattr(command, "commands", None):
            command, words = commands[words[0]], words[1:]
        command.make_context(command.name, words)


def test_what_is_not_run_names_tests_that_exist():
    reasons = [(page, block.skip) for page, block in SKIPPED]
    reasons += [(page, why) for page in PAGES if (why := page_skip(page.read_text(encoding="utf-8")))]
    assert len(reasons) >= 10
    for page, why in reasons:
        for path in re.findall(r"tests/[\w/.]*\w", why):
            assert (ROOT / path).exists(), f"{page.name}: {path}"


def test_formulas_name_functions_and_tests_that_exist():
    page = (ROOT / "docs" / "explanation" / "hypotheses.md").read_text(encoding="utf-8")
    table = page[page.index("| formula | function | test |") :]
    functions = re.findall(r"`([a-z_]+)\.([a-z_]+)`", table)
    tests = re.findall(r"`(test_\w+)`", table)
    assert min(len(functions), len(tests)) >= 15
    for module, name in functions:
        assert hasattr(importlib.import_module(f"truearm.checks.{module}"), name), f"{module}.{name}"
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests" / "host").glob("test_*.py"))
    for name in tests:
        assert f"def {name}(" in sources, name


def test_every_form_of_a_fault_is_explained():
    page = (ROOT / "docs" / "how-to" / "fit-not-usable.md").read_text(encoding="utf-8")
    table = page[page.index("## Faults") : page.index("## In a script")]
    for words in FORMS.values():
        assert f"*{words}*" in table


def test_messages_name_pages_by_a_title_that_exists():
    """And no message names a file of docs/, which an installed truearm does not have."""
    titles = {line[2:] for page in PAGES for line in page.read_text(encoding="utf-8").splitlines()[:1]}
    for path in sorted((ROOT / "host" / "truearm").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if "docs/" not in text and "page(" not in text:
            continue
        tree = ast.parse(text)
        alone = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}  # docstrings
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "page":
                assert ast.literal_eval(node.args[0]) in titles, path
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in alone:
                assert "docs/" not in node.value, f"{path}:{node.lineno}: name the page by truearm.text.page"


PAGE = """
<!-- test: setup
copy tests/data/README
-->
```csv title="a.csv"
x
```
```sh
truearm a
```

```text
one … three
```
<!-- test: skip, needs a box -->
```sh
truearm b
```
<!-- test: soak -->
```sh
truearm c
```
"""


def test_blocks_of_a_page_and_what_they_must_print():
    setup, file, first, skipped, slow = blocks(PAGE)
    assert (skipped.body, skipped.skip) == ("truearm b\n", "needs a box")
    assert (setup.language, setup.body.strip()) == ("setup", "copy tests/data/README")
    assert (file.file, file.body) == ("a.csv", "x\n")
    assert (first.body, first.shown, first.soak) == ("truearm a\n", ("one … three",), False)
    assert (slow.body, slow.soak) == ("truearm c\n", True)
    assert blocks("<!-- test: page skip, a list -->\n" + PAGE) == []
    with pytest.raises(ValueError, match="line 1: sometimes"):
        blocks("<!-- test: sometimes -->")
    assert unprinted(("a … c", "d"), "a b c\nd\n") is None
    assert unprinted(("d", "a … c"), "a b c\nd\n") == "a … c"
    assert unprinted(("ab",), "abc") == "ab"


def internal_names(code: str) -> set[str]:
    """Return what code imports of truearm's internal modules: all but ``truearm``, ``truearm.extend`` and ``truearm.clocks``."""
    public = {"truearm.extend": dir(truearm.extend), "truearm.clocks": ["fit"], "truearm": [*truearm.__all__, "extend"]}
    imported = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names = public.get(node.module, [])
            imported |= {f"{node.module}.{alias.name}" for alias in node.names if alias.name not in names}
    return {name for name in imported if name.startswith("truearm") and name not in ("truearm", "truearm.extend")}


def examples() -> dict[str, list[str]]:
    """Return the Python code of every page, notebook and example of a plug-in."""
    code = {}
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        code[page.name] = re.findall(r"^```python[^\n]*\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    for path in (ROOT / "docs" / "notebooks").glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        code[path.name] = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    plug_in = ROOT / "tests" / "host" / "incline_kind.py"
    return code | {plug_in.name: [plug_in.read_text(encoding="utf-8")]}


def is_python(code: str) -> bool:
    """Return whether code can be parsed alone; a line of a registry cannot."""
    try:
        ast.parse(code)
    except SyntaxError:
        return False
    return True


def test_examples_import_the_public_interface_alone():
    internal = {name: set().union(*map(internal_names, filter(is_python, code))) for name, code in examples().items()}
    assert {name: names for name, names in internal.items() if names} == {}
    assert len([name for name, code in examples().items() if "truearm.extend" in "".join(code)]) == 3
    code = "import truearm, truearm.cli\nfrom truearm import Rig, kinds\nfrom truearm.extend import Kind, kinds\nfrom truearm.kinds.kind import Kind"
    assert internal_names(code) == {"truearm.cli", "truearm.kinds", "truearm.extend.kinds", "truearm.kinds.kind.Kind"}
