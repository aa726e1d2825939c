"""What MkDocs does not find in docs/: pages made of the code, and links that leave the folder.

- reference/commands/: a page a command, of what its parser knows;
- reference/api.md: the public names and their docstrings, where the page has ``<!-- names -->`` and ``<!-- docstrings -->``;
- reference/findings.md: the codes of findings, where the page has ``<!-- findings -->``;
- reference/wire.md: protocol/SPEC.md; changes.md: CHANGELOG.md; notebooks/: a page a notebook.

A link to another file of the repository goes to TRUEARM_URL where that is set; without it the file's name stays as text.
After a build, external-links.txt in the site lists every link that leaves it, with the pages that have it.
"""

from __future__ import annotations

import inspect
import json
import os
import posixpath
import re
from collections import defaultdict
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import truearm
from truearm.cli.main import command_tree
from truearm.finding_texts import REASONS, STATEMENTS

ROOT = Path(__file__).resolve().parents[2]
COPIED = {"protocol/SPEC.md": "reference/wire.md", "CHANGELOG.md": "changes.md"}  # file of the repository → page
COMMANDS = "reference/commands"
DOCSTRINGS = "<!-- docstrings -->"
NAMES = "<!-- names -->"
FINDINGS = "<!-- findings -->"
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]+)(#[^)\s]*)?\)")
external: dict[str, set[str]] = defaultdict(set)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Name the commands' pages in the navigation, where it has the folder."""
    for section in config.nav or []:
        for pages in section.values():
            if isinstance(pages, list):
                for entry in pages:
                    if isinstance(entry, dict) and entry.get("Commands") == COMMANDS:
                        entry["Commands"] = [f"{COMMANDS}/{name}.md" for name in command_pages()]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made."""
    made = {f"{COMMANDS}/{name}.md": text for name, text in command_pages().items()}
    made |= {page: (ROOT / source).read_text(encoding="utf-8") for source, page in COPIED.items()}
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        files.remove(files.src_uris[f"notebooks/{path.name}"])
        made[f"notebooks/{path.stem}.md"] = notebook_page(json.loads(path.read_text(encoding="utf-8")))
    for uri, text in made.items():
        files.append(File.generated(config, uri, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put the docstrings in, and point links that leave docs/ to where the file is found."""
    if DOCSTRINGS in markdown:
        markdown = markdown.replace(DOCSTRINGS, "\n".join(docstring_section(name) for name in truearm.__all__))
    markdown = markdown.replace(NAMES, name_table()).replace(FINDINGS, finding_table())
    uri = page.file.src_uri
    home = next((source for source, made in COPIED.items() if made == uri), f"docs/{uri}")
    return LINK.sub(lambda found: _link(found, home, uri), markdown)


def on_post_build(config: MkDocsConfig) -> None:
    """List the links that leave the site."""
    lines = [f"{url}  {' '.join(sorted(pages))}" for url, pages in sorted(external.items())]
    Path(config.site_dir, "external-links.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _link(found: re.Match[str], home: str, uri: str) -> str:
    mark, text, target, anchor = found[1], found[2], found[3], found[4] or ""
    if re.match(r"\w+:", target):
        external[target].add(uri)
        return found[0]
    path = posixpath.normpath(posixpath.join(posixpath.dirname(home), target))
    page = COPIED.get(path) or (path.removeprefix("docs/") if path.startswith("docs/") else None)
    if page is not None and not page.endswith(".py"):
        page = re.sub(r"^(notebooks/.*)\.ipynb$", r"\1.md", page)
        return f"{mark}[{text}]({posixpath.relpath(page, posixpath.dirname(uri) or '.')}{anchor})"
    if not (ROOT / path).exists():
        raise FileNotFoundError(f"{home}: link to {target}, which does not exist")
    url = os.environ.get("TRUEARM_URL", "").rstrip("/")
    return f"[{text}]({url}/blob/HEAD/{path}{anchor})" if url else text


def finding_table() -> str:
    """All findings: code, severity, cause and remedy; then the reasons that are values of findings about programs."""
    rows = [
        f"| `{code}` | {statement.severity} | {_escaped(statement.sentence)} | {_escaped(statement.remedy)} |"
        for code, statement in STATEMENTS.items()
    ]
    rows += [f"| `{code}` | of a move | {_escaped(clause)} | |" for code, clause in REASONS.items()]
    return "\n".join(["| code | severity | sentence | remedy |", "|---|---|---|---|", *rows])


# commands


def command_pages() -> dict[str, str]:
    """Text of the page of each command by name, in the order of ``truearm --help``; subcommands stand on their command's page."""
    root: Any = command_tree()
    return {name: command_page(f"truearm {name}", command) for name, command in root.commands.items()}


def command_page(path: str, command: Any, level: int = 1) -> str:
    """What the parser of a command knows of it: help, usage, arguments, options, subcommands."""
    subcommands = getattr(command, "commands", {})
    text, _, example = inspect.cleandoc(command.help or "").partition("Example:")
    text = text.replace("\b", "").replace("\f", "")
    lines = [f"{'#' * level} {path}", "", _escaped(text.strip()), ""]
    context = command.context_class(command, info_name=path)
    usage = " ".join(command.collect_usage_pieces(context))
    if not subcommands:
        lines += ["```text", f"{path} {usage}", "```", ""]
    if example.strip():
        lines += ["Example:", "", "```text", inspect.cleandoc(example).strip(), "```", ""]
    rows: dict[str, list[str]] = defaultdict(list)  # by heading of the help page
    for parameter in () if subcommands else command.params:
        if record := parameter.get_help_record(context):
            rows["expert option" if parameter.name in command.expert else "argument or option"].append(_row(*record))
    for heading, texts in rows.items():
        lines += [f"| {heading} | meaning |", "|---|---|", *texts, ""]
    for name, sub in subcommands.items():
        lines += [command_page(f"{path} {name}", sub, level + 1)]
    return "\n".join(lines)


def _row(names: str, said: str) -> str:
    """A row of a table of options, of what the help page says of one."""
    meaning = _escaped(" ".join(said.split())).replace("|", r"\|")
    return f"| `{names}` | {meaning} |"


def _escaped(text: str) -> str:
    text = re.sub("(?<!`)<", "&lt;", re.sub("(?<!`)>", "&gt;", text))  # Markdown knows no backslash before them
    return re.sub(r"(?<!`)([*_\[\]])", r"\\\1", text)


# Python


def name_table() -> str:
    """Every public name with the first line of its docstring: functions, then classes."""
    names = sorted((n for n in truearm.__all__ if not n.startswith("__")), key=lambda name: (name[0].isupper(), name))
    first = {name: (inspect.getdoc(getattr(truearm, name)) or "").partition("\n")[0] for name in names}
    rows = [f"| [`{name}`](#{name}) | {line.replace('``', '`')} |" for name, line in first.items()]
    return "\n".join(["| name | description |", "|---|---|", *rows])


def docstring_section(name: str) -> str:
    """A public name with its signature and its docstring."""
    if name.startswith("__"):
        return ""
    thing = getattr(truearm, name)
    text, heading, examples = (inspect.getdoc(thing) or "").partition("Examples\n--------\n")
    text = re.sub(r"^(\w+)\n-{3,}$", r"**\1**\n", text, flags=re.MULTILINE)
    text = re.sub(r"^(\S.*)\n((?: {4}.*\n?)+)", _entry, text, flags=re.MULTILINE)
    lines = [
        f"### `{name}` {{ #{name} }}",
        "",
        "```python",
        f"{name}{_signature(thing)}",
        "```",
        "",
        text.replace("``", "`"),
    ]
    if heading:
        lines += ["**Examples**", "", "```pycon", examples.rstrip(), "```"]
    return "\n".join([*lines, ""])


def _entry(found: re.Match[str]) -> str:
    """A name and its indented lines as an item of a list."""
    name, _, what = found[1].partition(" : ")
    said = " ".join(found[2].split())
    return f"- `{name}`{' : ' + what if what else ''}. {said}\n"


def _signature(thing: Any) -> str:
    """Return the names and defaults of the arguments; the docstring has their types."""
    try:
        signature = inspect.signature(thing)
    except ValueError:
        return ""
    arguments = [one.replace(annotation=one.empty) for one in signature.parameters.values()]
    text = str(signature.replace(parameters=arguments, return_annotation=signature.empty))
    return re.sub(r"<[\w.]+: ('\w+')>", r"\1", text).replace("<factory>", "…")


# notebooks


def notebook_page(notebook: dict[str, Any]) -> str:
    """A notebook as a page: its text, its code and what is kept of its outputs."""
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/svg+xml" in data:
                parts.append("".join(data["image/svg+xml"]))
            elif "image/png" in data:
                png = "".join(data["image/png"]).replace("\n", "")
                parts.append(f'<img alt="what the cell draws" src="data:image/png;base64,{png}">')
            else:
                text = "".join(data.get("text/plain", output.get("text", "")))
                parts.append(f"```text\n{text.rstrip()}\n```")
    return "\n\n".join(parts) + "\n"
