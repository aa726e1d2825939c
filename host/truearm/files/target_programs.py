"""Robot programs as text: RAPID ``robtarget`` and URScript ``p[…]`` targets are read, and only their numbers changed.

The text is bytes, one character each (Latin-1): whatever encoding, line ends and comments a program has, every byte that
is not part of a target's numbers stays. Strings and comments are passed over.

*RAPID*. A robtarget is ``[[x, y, z], [q1, q2, q3, q4], [cf1, cf4, cf6, cfx], [six numbers]]`` of plain numbers: mm, a unit
quaternion with its scalar first, the configuration, external axes. Wherever a nest of brackets has that form it is one.
One that has the form but holds expressions cannot be corrected and is refused.

*URScript*. ``p[x, y, z, rx, ry, rz]`` (m, a rotation vector in rad) is also written for tools, features and offsets. A
target is one that stands as an argument of movej, movel, movep, movec or servoc, or is assigned to a name that does.
Others are left as they are, and said. A target with expressions is refused.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.errors import ProgramError
from truearm.files.disk import read_bytes
from truearm.model.poses import pose_of
from truearm.types import Floats
from truearm.units import MM, UNITS

MAX_BYTES = 4 * 2**20
MAX_TARGETS = 20_000
MAX_DEPTH = 200
RAPID_SUFFIXES = (".mod", ".prg", ".modx", ".sys")
SCRIPT_SUFFIXES = (".script", ".urscript")
UNIT_QUATERNION = 1e-3  # how far from 1 the norm of a quaternion may be that was written with few digits

_NUMBER = r"(?:[0-9]{1,40}(?:\.[0-9]{0,40})?|\.[0-9]{1,40})(?:[eE][+-]?[0-9]{1,4})?"
_WORD = r"[A-Za-z_][A-Za-z0-9_]*"
_TOKENS = {
    "rapid": re.compile(
        rf'(?P<skip>"[^"\n]*"|![^\n]*|\s+)|(?P<number>{_NUMBER})|(?P<word>{_WORD})|(?P<sign>.)', re.DOTALL
    ),
    "urscript": re.compile(
        rf"""(?P<skip>"[^"\n]*"|'[^'\n]*'|\#[^\n]*|\s+)|(?P<number>{_NUMBER})|(?P<word>{_WORD})|(?P<sign>.)""",
        re.DOTALL,
    ),
}
MOVES = ("movej", "movel", "movep", "movec", "servoc")
FORM = (3, 4, 4, 6)  # of a robtarget
LONGEST = 200  # tokens of a target; plain numbers make 58 at most


class Number(NamedTuple):
    """A number with its sign, and where it stands."""

    value: float
    start: int
    end: int


class Found(NamedTuple):
    """A target of a program: its line, its numbers that are the pose, and a robtarget's configuration."""

    line: int
    numbers: tuple[Number, ...]
    configuration: tuple[float, ...] = ()


class Program(NamedTuple):
    """A program, its targets in order, and the lines of poses that are none."""

    kind: str  # "rapid" | "urscript"
    text: str
    targets: tuple[Found, ...]
    left: tuple[int, ...]


class _Token(NamedTuple):
    kind: str
    text: str
    start: int


def is_program(path: Path) -> bool:
    return path.suffix.lower() in (*RAPID_SUFFIXES, *SCRIPT_SUFFIXES)


def read_program(path: Path) -> Program:
    """Read a program; its suffix says which language. Raises ProgramError with file and line."""
    kind = "urscript" if path.suffix.lower() in SCRIPT_SUFFIXES else "rapid"
    return parse_program(read_bytes(path, MAX_BYTES, ProgramError).decode("latin-1"), kind, str(path))


def parse_program(text: str, kind: str, name: str = "program") -> Program:
    """Find the targets of a program. Raises ProgramError."""
    lines = [match.start() for match in re.finditer("\n", text)]
    if "\0" in text:
        raise ProgramError(f"{name} line {_line(lines, text.index(chr(0)))}: holds a NUL byte, so it is no program")
    tokens = [
        _Token(match.lastgroup or "", match[0], match.start())
        for match in _TOKENS[kind].finditer(text)
        if match.lastgroup != "skip"
    ]
    found, left = (_robtargets if kind == "rapid" else _script_targets)(tokens, lines, name)
    if not found:
        what = "robtarget" if kind == "rapid" else "p[…] in a move"
        raise ProgramError(f"{name}: has no {what} of plain numbers; there is nothing to correct")
    if len(found) > MAX_TARGETS:
        raise ProgramError(f"{name}: has {len(found)} targets, the most is {MAX_TARGETS}; split it")
    return Program(kind, text, tuple(found), tuple(left))


def _line(lines: list[int], at: int) -> int:
    """The line, from 1, of a place in a text whose line feeds are at ``lines``."""
    return bisect_left(lines, at) + 1


def _pairs(tokens: list[_Token], lines: list[int], name: str) -> dict[int, int]:
    """Index of the closing bracket of every opening one."""
    closing, stack = {}, []
    for i, token in enumerate(tokens):
        if token.kind != "sign" or token.text not in "[]":
            continue
        if token.text == "[":
            stack.append(i)
            if len(stack) > MAX_DEPTH:
                raise ProgramError(f"{name} line {_line(lines, token.start)}: brackets are nested too deeply")
        elif stack:
            closing[stack.pop()] = i
        else:
            raise ProgramError(f"{name} line {_line(lines, token.start)}: a bracket ] that nothing opened")
    if stack:
        raise ProgramError(f"{name} line {_line(lines, tokens[stack[-1]].start)}: a bracket [ is not closed")
    return closing


def _items(tokens: list[_Token], first: int, last: int) -> list[tuple[int, int]]:
    """The stretches between the commas of a list whose brackets are tokens first and last."""
    items, start, depth = [], first + 1, 0
    for i in range(first + 1, last):
        sign = tokens[i].text if tokens[i].kind == "sign" else ""
        depth += (sign in ("[", "(")) - (sign in ("]", ")"))
        if sign == "," and depth == 0:
            items.append((start, i))
            start = i + 1
    return [*items, (start, last)]


def _number(tokens: list[_Token], item: tuple[int, int]) -> Number | None:
    """An item that is one number with at most one sign."""
    part = tokens[slice(*item)]
    sign = len(part) == 2 and part[0].text in ("+", "-")
    if not part or len(part) != 1 + sign or part[-1].kind != "number":
        return None
    value = float(part[-1].text) * (-1.0 if part[0].text == "-" else 1.0)
    return Number(value, part[0].start, part[-1].start + len(part[-1].text))


def _robtargets(tokens: list[_Token], lines: list[int], name: str) -> tuple[list[Found], list[int]]:
    closing, found = _pairs(tokens, lines, name), []
    for first, last in sorted(closing.items()):
        if tokens[first + 1].text != "[" or last - first > LONGEST:
            continue
        items = _items(tokens, first, last)
        if len(items) != len(FORM) or any(tokens[a].text != "[" or closing.get(a) != b - 1 for a, b in items):
            continue
        lists = [_items(tokens, a, b - 1) for a, b in items]
        if tuple(map(len, lists)) != FORM:
            continue
        read = [[_number(tokens, item) for item in items] for items in lists]
        line = _line(lines, tokens[first].start)
        if any(number is None for numbers in read for number in numbers):
            raise ProgramError(
                f"{name} line {line}: a robtarget with expressions cannot be corrected; write plain numbers"
            )
        plain = [[number for number in numbers if number is not None] for numbers in read]
        configuration = tuple(number.value for number in plain[2])
        found.append(Found(line, (*plain[0], *plain[1]), configuration))
        _check(found[-1], MM.of(UNITS["m"].largest), name)
        norm = math.hypot(*(number.value for number in plain[1]))
        if not abs(norm - 1.0) <= UNIT_QUATERNION:
            raise ProgramError(f"{name} line {line}: the orientation is no unit quaternion, its norm is {norm:.4g}")
    return found, []


def _script_targets(tokens: list[_Token], lines: list[int], name: str) -> tuple[list[Found], list[int]]:
    closing = _pairs(tokens, lines, name)
    moved, direct = _arguments(tokens)
    found, left = [], []
    for first, last in sorted(closing.items()):
        if first == 0 or tokens[first - 1].text != "p":
            continue
        line = _line(lines, tokens[first].start)
        if not (first - 1 in direct or _assigned(tokens, first - 1, last) in moved):
            left.append(line)
            continue
        numbers = [_number(tokens, item) for item in _items(tokens, first, last)] if last - first <= LONGEST else []
        plain = tuple(number for number in numbers if number is not None)
        if len(plain) != 6:
            raise ProgramError(f"{name} line {line}: a target p[…] must be six plain numbers to be corrected")
        found.append(Found(line, plain))
        _check(found[-1], UNITS["m"].largest, name)
    return found, left


def _arguments(tokens: list[_Token]) -> tuple[set[str], set[int]]:
    """What stands as an argument of a move by itself: names, and indices of the p before a bracket."""
    names: set[str] = set()
    direct: set[int] = set()
    for i, token in enumerate(tokens[:-1]):
        if token.text not in MOVES or tokens[i + 1].text != "(":
            continue
        depth = 0
        for k in range(i + 1, min(i + 400, len(tokens) - 1)):
            sign = tokens[k].text if tokens[k].kind == "sign" else ""
            depth += (sign in ("(", "[")) - (sign in (")", "]"))
            if depth == 0:
                break
            if depth == 1 and sign in ("(", ",") and tokens[k + 1].kind == "word":
                if tokens[k + 1].text == "p" and k + 2 < len(tokens) and tokens[k + 2].text == "[":
                    direct.add(k + 1)
                elif k + 2 < len(tokens) and tokens[k + 2].text in (",", ")"):
                    names.add(tokens[k + 1].text)
    return names, direct


def _assigned(tokens: list[_Token], p: int, last: int) -> str:
    """The name that p[…] alone is assigned to, or ""."""
    ends = last + 1 == len(tokens) or tokens[last + 1].kind == "word"  # an operator would make it part of a sum
    assigned = p >= 2 and tokens[p - 1].text == "=" and tokens[p - 2].kind == "word"
    return tokens[p - 2].text if assigned and ends else ""


def _check(found: Found, largest: float, name: str) -> None:
    for number in found.numbers:
        if not abs(number.value) <= largest:
            raise ProgramError(f"{name} line {found.line}: {number.value:g} is not a place that a robot reaches")


def poses_of(program: Program) -> Floats:
    """(n, 4, 4) the targets in m."""
    numbers = np.array([[number.value for number in target.numbers] for target in program.targets])
    if program.kind == "urscript":
        return pose_of(numbers[:, :3], numbers[:, 3:])
    turn = Rotation.from_quat(numbers[:, [4, 5, 6, 3]]).as_rotvec()  # scipy has the scalar last
    return pose_of(MM.to_si(numbers[:, :3]), turn)


def with_poses(program: Program, poses: Floats) -> bytes:
    """The program with other poses (n, 4, 4) in its targets; every other byte is as it was."""
    pieces, at = [], 0
    for target, values in zip(program.targets, _written(program, poses), strict=True):
        for number, value in zip(target.numbers, values, strict=True):
            pieces += [program.text[at : number.start], value]
            at = number.end
    return "".join([*pieces, program.text[at:]]).encode("latin-1")


def _written(program: Program, poses: Floats) -> list[list[str]]:
    """The numbers as text: 10 nm and 1e-9 of a turn, finer than a controller's arithmetic."""
    rotation = Rotation.from_matrix(poses[:, :3, :3])
    if program.kind == "urscript":
        six = np.concatenate([poses[:, :3, 3], _near(rotation.as_rotvec(), program)], axis=1)
        return [[_plain(value, 9) for value in row] for row in six]
    quaternion = rotation.as_quat()[:, [3, 0, 1, 2]]
    old = np.array([[number.value for number in target.numbers[3:]] for target in program.targets])
    quaternion *= np.where((quaternion * old).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]  # q and −q are one turn
    places = [[_plain(value, 5) for value in row] for row in MM.of(poses[:, :3, 3])]
    return [[*place, *(_plain(v, 10) for v in turn)] for place, turn in zip(places, quaternion, strict=True)]


def _near(turn: Floats, program: Program) -> Floats:
    """Rotation vectors with whole turns added so that they are near the old ones: p[…, 0, 3.2, 0] is no −3.083."""
    old = np.array([[number.value for number in target.numbers[3:]] for target in program.targets])
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    axis = turn / np.maximum(angle, 1e-12)
    choices = np.stack([axis * (angle + 2.0 * math.pi * k) for k in (-2, -1, 0, 1, 2)])
    best = np.linalg.norm(choices - old, axis=2).argmin(axis=0)
    near = choices[best, np.arange(len(turn))]
    return np.asarray(np.where(angle < 1e-9, turn, near))


def _plain(value: float, decimals: int) -> str:
    """Without an exponent, trailing zeros or a negative zero."""
    text = f"{value:.{decimals}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def quadrants_of(program: Program, n_joints: int) -> Floats | None:
    """(n, j) the quarter turns of axes 1, 4 and 6 by a RAPID program's configurations, NaN elsewhere; None without."""
    if program.kind != "rapid" or n_joints != 6:
        return None
    out = np.full((len(program.targets), n_joints), np.nan)
    out[:, [0, 3, 5]] = [target.configuration[:3] for target in program.targets]
    return out
