"""Names of commands and options: the new one of an earlier name, and the command that a wrong word means."""

from __future__ import annotations

from collections.abc import Iterator
from difflib import get_close_matches
from typing import Any

ALIKE = 0.75  # of two names, by difflib: less is another word

# Earlier names are refused with a message that gives the new one. An option after a command is one of that command only.
EARLIER = {
    "recover": "session recover",
    "relabel": "session relabel",
    "add-joints": "session add-joints",
    "export-session": "session export",
    "--device": "--box",
    "--rig-file": "--rig",
    "--robot": "--model",
    "record --robot": "--address",
    "simulate --robot": "--protocol",
    "--allow-truncated": "--allow-damaged",
    "--allow": "--apply",
    "--save-table": "--table-out",
    "--seconds": "--sample-s",
    "--long-s": "--long-dwell-s",
    "--known-mm": "--measured-with",
}
# What people call the work of a command. Names of subcommands ("gauge") need no entry: the tree has them.
MEANINGS = {
    "identify": "calibrate calibration fit solve estimate optimize optimise",
    "correct": "compensate apply fix",
    "validate": "verify check judge evaluate",
    "record": "measure acquire capture log",
    "simulate": "rehearse sim",
    "init": "new create setup",
    "inspect": "show view",
    "seats": "sockets rests",
    "report": "certificate page",
    "demo": "try example",
    "box": "pico firmware sensor",
    "session recover": "repair mend",
    "session relabel": "label",
    "session add-joints": "joints import merge",
    "session export": "convert csv parquet tables",
}


def command_for(root: Any, word: str) -> str | None:
    """Return why there is no command ``word`` and which one is meant, None if nothing is known about it."""
    if word in EARLIER:
        return f"truearm {word} is now truearm {EARLIER[word]}"
    subcommands = [path for path, _ in _commands(root) if path.endswith(f" {word}")]
    meant = subcommands or [name for name, words in MEANINGS.items() if word.lower() in words.split()]
    commands = " or ".join(f"truearm {path}" for path in meant)
    return f"truearm has no command {word!r}; use {commands}" if meant else None


def option_for(command: Any, path: str, word: str) -> str:
    """Return why the command at ``path`` has no option ``word``, and which one like it is used instead."""
    options = [name for option in command.params for name in option.opts]
    if (new_name := EARLIER.get(f"{path} {word}", EARLIER.get(word))) in options:
        return f"{word} is now {new_name}"
    if word in ("--install-completion", "--show-completion"):
        return f"{word} is now: source <(_TRUEARM_COMPLETE=bash_source truearm)"
    if alike := get_close_matches(word, options, cutoff=ALIKE):
        return f"No such option: {word}; did you mean {' or '.join(alike)}?"
    return f"No such option: {word}"


def _commands(group: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every command below a group by its name, such as "box config get"."""
    for name, command in getattr(group, "commands", {}).items():
        yield f"{path} {name}".strip(), command
        yield from _commands(command, f"{path} {name}".strip())
