"""Why a move is not corrected: the texts of the codes, and the arguments of truearm that would resolve them."""

from __future__ import annotations

from truearm.findings import Finding

TEXTS = {
    "absent-routine": "{name} is in none of the files and may change data or displace the program",
    "aimless": "it has no target in the program",
    "ambiguous": "{name} is declared in several modules, such as in {where}",
    "argument": "{name} is an argument of {function} in {where}, which may change it",
    "arguments": "arguments are missing",
    "assigned": "{name} is assigned in {where}",
    "axis": "its external axis {name} may move the robot's base",
    "by-name": "{name} in {where} changes data by their names",
    "configuration": "nothing determines in which of its configurations the arm reaches this target, and each needs another correction",
    "deep": "it is nested too deeply, or a name leads to itself",
    "displaced": "{name} in {where} displaces the program at run time",
    "element": "{name} has no such element",
    "fixed-tool": "the robot does not hold its tool",
    "frames": "its tool and base are not set in plain steps before it",
    "held-object": "the robot holds its work object",
    "joints": "its joint readings are computed, not written as six plain numbers",
    "locked-axis": "SingArea\\LockAxis4 turns the tool away from its target",
    "many": "it may go to more than {most} targets",
    "method": "{name} may be changed by a method in {where}",
    "moved-object": "a mechanical unit moves its work object",
    "no-value": "{name} is declared without a value",
    "not-written": "its numbers are not all written in one place",
    "other-configuration": "the arm reaches its target in several configurations, which need different numbers",
    "other-numbers": "it needs other numbers in {where} than another move",
    "other-task": "{name}, declared in {where}, is assigned or has another value in another task",
    "parameter": "{name} is a {kind} of a routine",
    "partial": "it does not give all components, so the others keep their last values",
    "path": "its path is corrected at run time",
    "quaternion": "its orientation is no unit quaternion: its norm is {norm:.4g}",
    "range": "its number {number:g} is beyond the reach of any robot",
    "redeclared": "{name} is declared again in {where}",
    "redefined": "{name} is a function of the language, and the program defines it again",
    "register": "it goes to a position register, or to a point by a computed number",
    "relative": "it is relative to where the robot is",
    "run-time": "it is computed at run time",
    "several": "{name} has several values",
    "several-tools": "it may run with several tools",
    "shared-use": "{name} is also used in {where}, which needs its numbers as they are",
    "solution": "{problem}",
    "tool": "no tool is set before it",
    "turns": "its configuration data do not fit the joints with which the arm arrives",
    "type": "it is no {type}",
    "undeclared": "{name} is declared in none of the files",
}
REMEDIES = {
    "absent-routine": "unchanged",
    "argument": "unchanged",
    "axis": "unchanged",
    "configuration": "home",
    "tool": "tool",
    "turns": "home",
}


def reason_text(finding: Finding) -> str:
    """Return the text of a reason; ``subject`` among its values names what it is about, such as the tool."""
    text = TEXTS[finding.code].format_map(finding.values)
    subject = finding.values.get("subject")
    return f"its {subject}: {text}" if subject else text


def remedy_of(finding: Finding) -> str:
    """Return the argument of truearm that would resolve a reason, or ""."""
    subject = finding.values.get("subject")
    if finding.code == "undeclared" and subject:
        return "tools" if subject == "tool" else "works"
    if finding.code == "argument" and not finding.values.get("outside"):
        return ""
    return REMEDIES.get(finding.code, "")
