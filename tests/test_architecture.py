"""Who may import whom (docs/decisions/0001): the imports are read from the source and checked against this table."""

import ast
import re
import runpy
import tomllib
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path

import pytest

import truearm
from truearm_wire.version import MARK, VERSION

ROOT = Path(__file__).parents[1]
HOST = ROOT / "host" / "truearm"

# modules that every room may use, and which use no room
COMMON = {path.stem for path in HOST.glob("*.py")} - {"__init__", "__main__", "api", "extend"}
# core and edge: what is built on the core could stand in a package of its own
CORE = {"model", "kinds", "estimate", "checks", "session", "record"}
EDGE = {"plan", "correct", "export", "report", "box", "live", "workflows", "cli", "api", "extend", "__main__"}
# room of truearm → rooms it may import besides itself and COMMON; imports run downwards
ROOMS = {name: set() for name in COMMON | {"model"}} | {
    "kinds": {"model"},
    "estimate": {"kinds", "model"},
    "checks": {"estimate", "kinds", "model"},
    "plan": {"estimate", "kinds", "model"},
    "correct": {"kinds", "model"},  # of kinds its tables of CSV
    "export": {"model"},
    "session": {"kinds"},  # the table that its observations are given as
    "record": {"kinds", "session"},
    "report": {"estimate", "kinds", "session"},  # the registries, and why dwells were rejected
    "box": {"kinds", "record", "report", "session"},
    "live": {"box", "record", "session"},
    "workflows": CORE | {"box", "live", "report", "plan", "correct", "export"},
    "cli": (CORE | EDGE) - {"cli", "checks", "api", "extend", "__main__"},
    "extend": {"kinds", "model", "export", "record", "session"},
    "api": {"workflows", "plan", "correct", "export", "estimate", "kinds", "model"},
    "__main__": {"cli"},
}
WIRE_ALLOWED = {"record", "session", "box", "live", "version", "cli", "workflows"}
SIMULATOR_ALLOWED = {"cli", "workflows"}
# they turn bytes into objects and back; what opens a file is truearm.disk, and none of them touches the network
PURE = ("model", "kinds", "estimate", "checks", "correct", "plan", "export")
IO_MODULES = {"socket", "serial", "urllib", "http", "subprocess", "shutil", "tempfile", "os", "mcap"}
OPENS = {"open", "exists", "is_file", "iterdir", "stat", "mkdir", "unlink", "read_bytes", "write_text", "write_bytes"}
DEVICE_MODULES = {"machine", "rp2", "usb_stamp"}
# what the parts of the box may import: drivers know neither box nor chip, which board files bring together
MICROPYTHON = {"array", "gc", "io", "json", "sys", "micropython", "os", "truearm_wire"}
ON_THE_BOX = {
    "protocol/truearm_wire": {"array", "sys", "micropython", "truearm_wire"},
    "firmware/truearm_box": MICROPYTHON | {"truearm_box"},
    "firmware/drivers": MICROPYTHON | {"drivers"},
    "firmware/chips": MICROPYTHON | {"chips"},
    "firmware": MICROPYTHON | {"board", "truearm_box"},
    "firmware/board": MICROPYTHON | DEVICE_MODULES | {"chips", "drivers", "select", "time"},
}


@cache
def imports(path: Path) -> set[str]:
    """Dotted names of all modules that a file imports, wherever in the file; relative ones resolved."""
    found = set()
    package = list(path.relative_to(path_root(path)).with_suffix("").parts[:-1])
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *(node.module.split(".") if node.module else [])])
            found |= {f"{module}.{alias.name}" for alias in node.names} | {module}
    return found


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def of_each(paths: Iterable[Path], within: Path) -> Callable[[Callable[[Path], None]], Callable[[], None]]:
    """One test for all files, which says each file that fails: a test of its own for each takes 5 ms, of which there would be 2200."""

    def decorated(check: Callable[[Path], None]) -> Callable[[], None]:
        def test() -> None:
            checked, failed = 0, []
            for path in paths:
                checked += 1
                try:
                    check(path)
                except AssertionError as exc:
                    failed.append(f"{path.relative_to(within)}: {exc}")
            assert checked
            assert not failed, "\n".join(failed)

        test.__doc__ = check.__doc__
        return test

    return decorated


def path_root(path: Path) -> Path:
    for folder in ("host", "protocol", "hil_sim", "firmware", "tests"):
        if path.is_relative_to(ROOT / folder):
            return ROOT / folder
    raise AssertionError(path)


def python_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*.py") if "__pycache__" not in p.parts)


def room_of(path: Path) -> str:
    return path.relative_to(HOST).with_suffix("").parts[0]


@of_each(python_files(HOST), HOST)
def test_host(path):
    room = room_of(path)
    if room == "__init__":  # nothing is imported before it is used
        assert {name for name in imports(path) if name.startswith("truearm")} == {
            "truearm.version.VERSION",
            "truearm.version",
        }
        return
    assert room in ROOMS, f"{room} is a new room: say in ROOMS which ones it may import"
    for name in imports(path):
        top, *rest = name.split(".")
        if top == "truearm" and rest and rest[0] not in COMMON | {room}:
            assert rest[0] in ROOMS[room], f"{room} may not import {name}"
        assert name not in ("truearm.__version__", "truearm.__all__"), "the arrows end at truearm.version"
        assert top != "truearm_wire" or room in WIRE_ALLOWED, f"{room} may not import {name}"
        assert top != "truearm_sim" or room in SIMULATOR_ALLOWED, f"{room} may not import {name}"
        assert top not in DEVICE_MODULES
        if room in PURE:
            assert top not in IO_MODULES, f"{room} does no input or output, yet imports {name}"
    if room in PURE:
        calls = [node.func for node in ast.walk(tree_of(path)) if isinstance(node, ast.Call)]
        opens = {getattr(call, "attr", getattr(call, "id", "")) for call in calls} & OPENS
        assert path.name == "robot_file.py" or not opens, f"{room} opens no file, yet calls {opens}"  # own resources


def rooms_below(room: str) -> set[str]:
    """Return all rooms that a room may import, itself or through others."""
    return set().union(*({below} | rooms_below(below) for below in ROOMS[room]))


def test_the_core_imports_nothing_of_the_edge():
    for room in CORE:
        assert not rooms_below(room) & EDGE, room
    assert rooms_below("cli") >= CORE


# texts below the command line name arguments, which the command line shows as its options (errors.Argument)
BELOW_CLI = [p for p in python_files(HOST) if room_of(p) not in ("cli", "__main__")]


@of_each(BELOW_CLI, HOST)
def test_only_the_command_line_names_options(path):
    """But for whole commands to paste."""
    tree = tree_of(path)
    said = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr)}  # docstrings
    for text in (n for n in ast.walk(tree) if isinstance(n, ast.JoinedStr | ast.Constant)):
        parts = [part for part in getattr(text, "values", [text]) if isinstance(part, ast.Constant)]
        if any("truearm " in str(part.value) for part in parts):
            said |= {id(part) for part in parts}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in said:
            assert not re.search(r"(?<![\w-])--[a-z]", node.value), f"line {node.lineno}: {node.value!r}"


def test_one_version_of_package_firmware_and_image():
    """It stands in truearm_wire/version.py; what shows an image's name shows that one."""
    built = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "version" in built["project"]["dynamic"]
    assert built["tool"]["hatch"]["version"]["path"] == "protocol/truearm_wire/version.py"
    assert truearm.__version__ == VERSION == MARK.removeprefix("truearm_box ")
    assert "truearm_wire.version.VERSION" in imports(ROOT / "firmware" / "truearm_box" / "ident.py")
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *python_files(HOST)]
    named = {
        name for page in pages for name in re.findall(r"truearm-(\d[\w.]*)\.uf2", page.read_text(encoding="utf-8"))
    }
    assert named == {VERSION}
    assert f"\nversion: {VERSION}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(rf"^## {re.escape(VERSION)} ", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)


def test_only_simulate_knows_the_simulator():
    assert {p.stem for p in python_files(HOST) if any(i.startswith("truearm_sim") for i in imports(p))} <= {"simulate"}


def modules() -> dict[str, Path]:
    """Return the modules of the host by dotted name."""
    return {
        ".".join(path.relative_to(HOST.parent).with_suffix("").parts).removesuffix(".__init__"): path
        for path in python_files(HOST)
    }


def circles(graph: dict[str, set[str]]) -> list[str]:
    """Return the modules that reach themselves."""

    def reached(start: str) -> set[str]:
        seen: set[str] = set()
        waiting = [start]
        while waiting:
            new = graph[waiting.pop()] - seen
            seen |= new
            waiting += new
        return seen

    return sorted(name for name in graph if name in reached(name))


def test_no_module_imports_itself_on_any_way():
    """Neither a name for a type checker alone nor an import within a function may hide a circle."""
    known = modules()
    graph = {name: (imports(path) & set(known)) - {"truearm"} for name, path in known.items()}
    assert circles(graph) == []
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]


@cache
def closed_choices() -> set[str]:
    """Names of the enumerations of the host."""
    classes = (node for path in python_files(HOST) for node in tree_of(path).body if isinstance(node, ast.ClassDef))
    return {one.name for one in classes if any(ast.unparse(base).endswith("Enum") for base in one.bases)}


def open_choices(tree: ast.AST, choices: set[str]) -> dict[int, str]:
    """Return what leaves a closed choice open, by line.

    A ``match`` whose last case catches all and does anything but ``assert_never``, or that has no such case; a dictionary keyed
    by members of an enumeration; and an ``elif`` that compares with one.
    """
    openings = {}

    def member(node: ast.AST) -> bool:
        return isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in choices

    for node in ast.walk(tree):
        if isinstance(node, ast.Match):
            last = node.cases[-1]
            catches_all = isinstance(last.pattern, ast.MatchAs) and last.pattern.pattern is None and last.guard is None
            if not (catches_all and len(last.body) == 1 and ast.unparse(last.body[0]).startswith("assert_never(")):
                openings[node.lineno] = "match without assert_never"
        elif isinstance(node, ast.Dict) and any(key is not None and member(key) for key in node.keys):
            openings[node.lineno] = "dictionary keyed by a closed choice; use match"
        elif isinstance(node, ast.If) and len(node.orelse) == 1 and isinstance(node.orelse[0], ast.If):
            tests = (node.test, node.orelse[0].test)
            if all(isinstance(test, ast.Compare) and any(map(member, test.comparators)) for test in tests):
                openings[node.lineno] = "elif over a closed choice; use match"
    return openings


@of_each(python_files(HOST), HOST)
def test_every_closed_choice_is_exhaustive(path):
    """mypy proves that an ``assert_never`` cannot be reached: a further member is an error where it has no case."""
    assert not open_choices(tree_of(path), closed_choices())


OPEN = """
match move:
    case Move.VIA: a()
    case _: b()
match move:
    case Move.VIA: a()
WORDS = {Move.VIA: "via"}
if move is Move.VIA: a()
elif move == Move.LINE: b()
else: c()
match move:
    case Move.VIA: a()
    case _: assert_never(move)
"""


def test_the_check_of_closed_choices_finds_open_ones():
    assert sorted(open_choices(ast.parse(OPEN), {"Move"})) == [2, 5, 7, 8]


def device_files() -> list[Path]:
    """What runs on the box: the firmware but for image/, which builds it on a PC, and the wire format."""
    firmware = [p for p in python_files(ROOT / "firmware") if "image" not in p.parts]
    return firmware + python_files(ROOT / "protocol" / "truearm_wire")


@of_each(device_files(), ROOT)
def test_the_box_runs_on_micropython_alone(path):
    room = "firmware/board" if path.name.startswith("board") else path.parent.relative_to(ROOT).as_posix()
    assert {name.split(".")[0] for name in imports(path)} <= ON_THE_BOX[room]


@of_each(python_files(ROOT / "hil_sim"), ROOT)
def test_simulator_touches_no_hardware(path):
    assert not {n.split(".")[0] for n in imports(path)} & DEVICE_MODULES


PAGES = ("explanation/code_flow.md", "how-to/extending.md")
SOURCES = (HOST, ROOT / "protocol", ROOT / "firmware", ROOT / "hil_sim")
# where a file that the page names may stand
FILE_BASES = (ROOT, HOST, ROOT / "docs", ROOT / "protocol", ROOT / "protocol" / "truearm_wire")


@cache
def defined_names() -> set[str]:
    """``function``, ``module.function``, ``Class`` and ``Class.method`` of all that is shipped."""
    found = set()
    for path in (p for folder in SOURCES for p in python_files(folder)):
        for node in tree_of(path).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found |= {node.name, f"{path.stem}.{node.name}"}
            if isinstance(node, ast.ClassDef):
                found |= {f"{node.name}.{method.name}" for method in node.body if isinstance(method, ast.FunctionDef)}
    return found


def missing_names(text: str, known: set[str]) -> set[str]:
    """What a page calls by name, ``a.b.name()`` or ``Name``, and nothing defines."""
    quoted = re.findall(r"`([^`\n]+)`", text)
    calls = {name for code in quoted for name in re.findall(r"[A-Za-z_][\w.]*(?=\(\))", code)}
    classes = {code for code in quoted if re.fullmatch(r"(\w+\.)*[A-Z]\w*[a-z]\w*", code)}
    bare = known | {name.partition(".")[2] for name in known}
    return {name for name in calls | classes if ".".join(name.split(".")[-2:]) not in (known if "." in name else bare)}


def missing_files(text: str) -> set[str]:
    """Paths that a page names, and folders with a slash at their end, where nothing stands."""
    files = set(re.findall(r"[\w./-]*\w\.(?:py|md|cddl)\b", text)) | set(re.findall(r"`([\w/]+/)`", text))
    return {f for f in files if "NAME" not in f and not any((base / f).exists() for base in FILE_BASES)}


def prose(text: str) -> str:
    """A page without its links, its blocks of code and the files that its recipes make."""
    text = re.sub(r"\[[^\]]*\]\([^)]*\)", "", text)  # links are checked by make docs
    return re.sub(r"^New file `[^`]+`:$|^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES)
def test_pages_about_the_code_name_what_exists(page):
    text, known = prose((ROOT / "docs" / page).read_text(encoding="utf-8")), defined_names()
    assert not missing_names(text, known)
    assert not missing_files(text)


def test_the_picture_of_the_code_is_what_the_imports_make():
    made = runpy.run_path(str(ROOT / "docs" / "_site" / "architecture.py"))
    assert made["PICTURE"].read_text(encoding="utf-8") == made["picture"](), "run: make pictures"
    named = {room for room, paths in made["rooms"]().items() if paths[0].is_relative_to(HOST)}
    assert named == {room for room in ROOMS if (HOST / room).is_dir()} | {"api"}


DECISIONS = sorted((ROOT / "docs" / "decisions").glob("0*.md"))
NAMEABLE = [
    p for folder in (*SOURCES, *(ROOT / name for name in ("tests", "hardware", "docs"))) for p in folder.rglob("*.py")
]
OF_RAPID = {"MoveL", "CalcRobT"}  # words of a robot's language that a decision quotes


@of_each(DECISIONS, ROOT)
def test_decisions_name_what_exists(page):
    """Functions and classes, and files by the end of their paths."""
    text = prose(page.read_text(encoding="utf-8"))
    assert not missing_names(text, defined_names()) - OF_RAPID
    named = re.findall(r"`([\w/]*\w\.py)`", text)
    assert not [name for name in named if not any(path.as_posix().endswith(f"/{name}") for path in NAMEABLE)]


def test_every_decision_has_a_number_of_its_own():
    numbers = [page.name[:4] for page in DECISIONS]
    assert len(set(numbers)) == len(numbers)
    assert all(page.read_text(encoding="utf-8").startswith(f"# {int(page.name[:4])}. ") for page in DECISIONS)


def test_the_check_of_the_page_finds_what_is_gone():
    known = defined_names()
    page = "`Box.step()` `Box.nothing()` `session.observations.survey()` `session.hull.survey()` `gone()` `Gone` `session/gone.py`"
    assert missing_names(page, known) == {"Box.nothing", "session.hull.survey", "gone", "Gone"}
    assert missing_files(page) == {"session/gone.py"}
