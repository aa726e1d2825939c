"""Names of commands and options: the new one of an earlier name, and the command that a wrong word means."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

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
    "--picture": "--picture-out",
    "--program": "--program-out",
    "--curves": "--curves-out",
    "--duration": "--duration-s",
    "--patience": "--patience-s",
    "--timeout": "--timeout-s",
    "--seconds": "--sample-s",
    "--long-s": "--long-dwell-s",
    "--zero": "--zero-s",
    "--cell": "--cell-mm",
    "--known-mm": "--measured-with",
}
REMOVED = {
    **{
        f"--{word}": f"write {word} = … into truearm.toml"
        for word in ("name", "serial", "operator", "controller", "customer")
    },
    "--experiment": "give --lines 5 for lines along a line device; without it, a ball-bar measures the robot",
    "--all-free": "give --free '*'",
    "--residuals-out": "the corrected table and --json have the error of every target",
    "--zero-sigma-mm": "give --measured-with, or write zero_sigma_mm of the bar into rig.toml",
    "--split": "moves that need different numbers of one target always get their own; leave it out",
    "--undo": "delete the NAME.labels.json that session relabel wrote",
    "--harmless": "routines in none of the files are taken to be harmless, unless --strict is given; for data or an axis "
    "that nothing outside changes, give --unchanged NAME",
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
    subcommands = [path for path in _paths(root) if path.endswith(f" {word}")]
    meant = subcommands or [name for name, words in MEANINGS.items() if word.lower() in words.split()]
    commands = " or ".join(f"truearm {path}" for path in meant)
    return f"truearm has no command {word!r}; use {commands}" if meant else None


def option_for(command: Any, path: str, word: str) -> str | None:
    """Return what is used instead of an earlier option ``word`` of the command at ``path``, None if nothing is."""
    if word in REMOVED:
        return f"{word}: {REMOVED[word]}"
    now = EARLIER.get(f"{path} {word}", EARLIER.get(word))
    return f"{word} is now {now}" if any(now in option.opts for option in command.params) else None


def _paths(group: Any, path: str = "") -> Iterator[str]:
    """Yield every command below a group, such as "box config get"."""
    for name, command in getattr(group, "commands", {}).items():
        yield f"{path} {name}".strip()
        yield from _paths(command, f"{path} {name}".strip())
