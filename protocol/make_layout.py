"""Write truearm_wire/layout.py, which lists the elements of every frame, from frames.cddl. A test compares the two.

python protocol/make_layout.py
"""

import re
from pathlib import Path

FOLDER = Path(__file__).parent
GRAMMAR, LAYOUT = FOLDER / "frames.cddl", FOLDER / "truearm_wire" / "layout.py"
# types that readers need: fixed widths, and how to combine an element over the heartbeats of a session
KEPT = ("u32", "u64", "counter", "largest", "smallest")
HEAD = '''"""The elements of every frame after its type. Written by protocol/make_layout.py from frames.cddl: do not edit.

"name:u32" and "name:u64" are of fixed width, all other integers are shortest; "name:counter", "name:largest" and
"name:smallest" say what becomes of an element over a session.
"""

'''


def frames(grammar: str) -> dict[int, tuple[list[str], int]]:
    """Return for each frame type the elements after the type, and how many of the last ones minor versions appended."""
    found = {}
    text = re.sub(r";.*", "", grammar)
    for kind, body in re.findall(r"^[\w-]+ = \[(\d+), (.*?)\]$", text, re.MULTILINE | re.DOTALL):
        first, _, appended = body.partition("? (")
        parts = [re.findall(r"(\w+): ([\w-]+)", part) for part in (first, appended)]
        entries = [f"{name}:{kind}" if kind in KEPT else name for part in parts for name, kind in part]
        found[int(kind)] = entries, len(parts[1])
    return found


def layout(grammar: str) -> str:
    """Return the text of layout.py."""
    lines = ["LAYOUT = {"]
    of = frames(grammar)
    for kind, (entries, _) in of.items():
        if len(entries) == 1:
            lines.append(f'    {kind}: ("{entries[0]}",),')
        else:
            lines += [f"    {kind}: (", *(f'        "{entry}",' for entry in entries), "    ),"]
    lines += [
        "}",
        "",
        "# elements at the end of a layout that minor versions appended: an older box does not send them",
    ]
    appended = ", ".join(f"{kind}: {count}" for kind, (_, count) in of.items() if count)
    return HEAD + "\n".join([*lines, f"APPENDED = {{{appended}}}", ""])


if __name__ == "__main__":
    LAYOUT.write_text(layout(GRAMMAR.read_text(encoding="utf-8")), encoding="utf-8")
    print(f"{LAYOUT} written")
