"""Parse the user's selections: the rows to hold out and the parameters to identify.

Propose a hold-out that leaves enough of everything, and refuse rows that cannot identify a robot.
"""

from __future__ import annotations

import difflib
import itertools
import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from truearm.errors import Argument, InputError, ProblemError
from truearm.estimate.circumstances import first_alike, poses
from truearm.estimate.solvers import SOLVERS, Prior
from truearm.kinds.columns import ANYWHERE, GROUPS, POINT, Quantity, identifiers, is_label
from truearm.kinds.registry import drawn_from, kinds
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import column_of_title
from truearm.model.chain import Chain, forward
from truearm.model.joint_terms.term import Gain
from truearm.model.robot import Robot
from truearm.results import DriftWith, Effect
from truearm.text import listed
from truearm.types import Floats, Mask, Plan

FOLDS, MOST_FOLDS = "folds", 100
HOLD_OUT, FIT_ONLY, APPLY, LEAVE_OUT = (Argument(name) for name in ("hold_out", "fit_only", "apply", "leave_out"))


def held_out_rows(
    table: ObservationTable, groups: Sequence[str] | Mask, seed: int, fit_only: Sequence[str] = ()
) -> Mask | None:
    """Return a mask (n,) of the rows to hold out, None if none are named.

    ``groups``: such as "shell=s61", "place=front", or one fraction such as "0.2": that share of the poses, drawn by
    ``seed`` equally from every group; or a mask (n,). ``fit_only``: groups to fit; all others are held out. Raises
    InputError for an unknown group, or if nothing would be left to fit.
    """
    if fit_only:
        not_fitted: Mask = ~np.any([_group_rows(table, group, FIT_ONLY) for group in fit_only], axis=0)
        by_groups = held_out_rows(table, groups, seed)
        held = not_fitted if by_groups is None else not_fitted | by_groups
        if held.all():
            raise InputError("nothing-left", what="observations", place=FIT_ONLY)
        return held if held.any() else None
    if isinstance(groups, np.ndarray):
        return groups
    if not groups:
        return None
    fractions = [value for value in map(held_out_fraction, groups) if value is not None]
    if fractions and len(groups) > 1:
        raise InputError(HOLD_OUT, " takes one fraction or any number of groups, not both")
    if fractions:
        rank = _pose_ranks(table, seed)
        mask = np.asarray(rank < round(fractions[0] * (int(rank.max()) + 1)))
    else:
        mask = np.any([_group_rows(table, group, HOLD_OUT) for group in groups], axis=0)
    if mask.all():
        raise InputError("nothing-left", what="observations", place=HOLD_OUT)
    if not mask.any():
        raise InputError(HOLD_OUT, f" {groups[0]} is less than one row of {len(table)}; take a larger fraction")
    return mask


def folds_of(table: ObservationTable, groups: Sequence[str] | Mask, seed: int) -> list[tuple[str, Mask]]:
    """Return the rows (n,) to hold out in turn, with what the folds are called; [] unless ``groups`` ask for folds.

    ``folds=5``: the poses in five shares, drawn by ``seed``. ``place=*``: the rows of each place. Raises InputError.
    """
    column, _, value = ("", "", "") if isinstance(groups, np.ndarray) or not groups else groups[0].partition("=")
    if column != FOLDS and value != "*":
        return []
    if len(groups) > 1:
        raise InputError(HOLD_OUT, f" {groups[0]}: folds cannot be combined with other rows to hold out")
    if value == "*":
        names = [name for name in np.unique(table[column]) if name] if _has_names(column) else []
        masks = [(f"{column}={name}", _group_rows(table, f"{column}={name}", HOLD_OUT)) for name in names]
    else:
        rank = _pose_ranks(table, seed)
        count = min(int(value), rank.max() + 1) if value.isascii() and value.isdecimal() and len(value) < 10 else 0
        numbers = (rank * count / (rank.max() + 1)).astype(np.intp)
        masks = [(f"fold {number + 1}", numbers == number) for number in range(count)]
    if not 2 <= len(masks) <= MOST_FOLDS:
        advice = f"2 to {MOST_FOLDS} are needed; write {FOLDS}=5, or place=* for each place"
        raise InputError(HOLD_OUT, f" {groups[0]}: gives {len(masks)} folds, and {advice}")
    return masks


def held_out_fraction(text: str) -> float | None:
    """Return the fraction of the rows that ``text`` holds out, None if it names a group."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0.0 < value < 1.0 else None


def is_drawn(text: str) -> bool:
    """Return whether poses are drawn to be held out: a fraction, or folds."""
    return held_out_fraction(text) is not None or text.startswith(f"{FOLDS}=")


def _group_rows(table: ObservationTable, group: str, argument: Argument) -> Mask:
    column, equals, identifier = group.partition("=")
    fraction = ", or a fraction between 0 and 1" if argument is HOLD_OUT else ""
    if not equals:
        groups = [f"{column}={name}" for column in GROUPS for name in np.unique(table[column]) if name]
        raise InputError(argument, f" {group}: is not COLUMN=VALUE{fraction}; {_listed('group', groups, 'the table')}")
    numbers = None if column in identifiers() else column_of_title(table, column)
    if numbers is not None:
        return _rows_between(numbers, identifier, group, argument)
    if not _has_names(column):
        raise InputError(
            argument, f" {group}: {column!r} is not a group; use one of {', '.join(identifiers())}{fraction}"
        )
    rows: Mask = table[column] == identifier
    if not identifier or not rows.any():
        names = [name for name in np.unique(table[column]) if name]
        raise InputError(argument, f" {group}: the table has no row with that {column}; {_listed(column, names)}")
    return rows


def _has_names(column: str) -> bool:
    return column in identifiers() or is_label(column)


def _rows_between(numbers: Floats, span: str, group: str, argument: Argument) -> Mask:
    """Return the rows whose number (n,) is VALUE, or from LOW to HIGH of LOW:HIGH."""
    try:
        low, high = (float(end) for end in (span.split(":") * 2)[:2])
    except ValueError:
        raise InputError(argument, f" {group}: is not COLUMN=VALUE or COLUMN=LOW:HIGH") from None
    tolerance = 1e-9 * max(abs(low), abs(high), 1.0)
    rows: Mask = (numbers >= low - tolerance) & (numbers <= high + tolerance)
    if not rows.any():
        shown = f"{np.nanmin(numbers):g} to {np.nanmax(numbers):g}" if np.isfinite(numbers).any() else "none"
        raise InputError(argument, f" {group}: no row has such a value; the column has {shown}")
    return rows


def _listed(noun: str, names: Sequence[str], owner: str = "it") -> str:
    return f"{owner} has {listed(names)}" if names else f"the observations have no {noun} column"


def _pose_ranks(table: ObservationTable, seed: int) -> NDArray[np.intp]:
    """Return the number (n,) of each row's pose in a random order in which all groups are mixed evenly.

    Every pose gets its position in a random order of its own group, as a share of the group, and poses are sorted by
    it. Rows of one pose (the same joint readings, for example with several reflectors) have common errors, so they are
    held out together or not at all.
    """
    rng = np.random.default_rng(seed)
    group = first_alike([table.kind, *(table[column] for column in drawn_from())])[1]
    first, pose = first_alike([poses(table), group])
    pose_group = group[first]
    share = np.empty(first.size)
    for index in range(int(group.max()) + 1):
        members = np.flatnonzero(pose_group == index)
        # The random start lets small groups round up in one draw and down in another.
        share[members] = (rng.permutation(members.size) + rng.random()) / max(members.size, 1)
    rank = np.empty(first.size, dtype=np.intp)
    rank[np.argsort(share, kind="stable")] = np.arange(first.size)
    return np.asarray(rank[pose])


def free_parameters(
    names: Sequence[str], default: Mask, free: Sequence[str], freeze: Sequence[str], also: Sequence[str] = ()
) -> Mask:
    """Return a mask (p,) of the parameters to identify.

    These are the parameters that match a pattern of ``free`` (``default`` if there is none) or of ``also``, and none of
    ``freeze``. Patterns use shell wildcards (``joint*.offset``); several patterns are separated by commas.

    Raises InputError for a pattern that matches nothing, or if no parameter is left.
    """
    chosen = (matching(names, "free", free) if free else default) | matching(names, "also_free", also)
    mask: Mask = chosen & ~matching(names, "freeze", freeze)
    if not mask.any():
        raise InputError("nothing-left", what="parameters")
    return mask


def matching(names: Sequence[str], argument: str, patterns: Sequence[str]) -> Mask:
    """Return a mask (p,) of the names that match one of an argument's patterns.

    Raises InputError if a pattern matches nothing.
    """
    mask = np.zeros(len(names), dtype=bool)
    # a joint of a URDF may have a comma in its name
    for pattern in (pattern.strip() for text in patterns for pattern in ([text] if text in names else text.split(","))):
        matches = np.array([fnmatchcase(name, pattern) for name in names])
        if not matches.any():
            raise InputError(
                Argument(argument), f" {pattern}: matches no parameter of the robot; {_near(pattern, names)}"
            )
        mask |= matches
    return mask


def _near(pattern: str, names: Sequence[str]) -> str:
    """Return suggestions: names or kinds of parameters similar to the pattern, else some of both."""
    kinds = list(dict.fromkeys(f"*.{name.rpartition('.')[2]}" for name in names))
    if pattern.rpartition(".")[2] == Gain.name and f"*.{Gain.name}" not in kinds:
        return "its file gives no gains; add them to its joints, such as gain = { design = 1.0, held = true }"
    close = difflib.get_close_matches(pattern[:80], [*names, *kinds], n=3)
    return f"names are like {', '.join(close or [*names[:2], *kinds])}"


def parse_effect(text: str) -> Effect:
    """Parse a fault such as ``chuck.c2@183`` (``Effect``). Raises InputError."""
    endings = {drift.ending: drift for drift in DriftWith}
    match = re.fullmatch(rf"(.+?)({'|'.join(map(re.escape, endings))})?(?:@([0-9]{{1,9}})(?::([0-9]{{1,9}}))?)?", text)
    first = int(match[3] or 1) if match else 0
    last = int(match[4]) if match and match[4] else None
    if match is not None and last is not None and 1 <= last < first:
        raise InputError(APPLY, f" {text!r}: row {first} comes after row {last}; give the lower row first")
    if match is None or first < 1 or last == 0:
        raise InputError(
            APPLY,
            f" {text!r} is not NAME, NAME.drift, NAME.thermal_drift, JOINT.backlash, JOINT.settling or one of these followed by @FIRST or @FIRST:LAST, rows counted from 1",
        )
    return Effect(match[1], first - 1, last, endings.get(match[2]))


def rows_named(text: str, sources: NDArray[np.str_]) -> Mask:
    """Return a mask (n,) of the rows that a text names.

    ``120:140`` counts the rows of all inputs from 1. ``poses.csv row 100`` and ``poses.csv row 100:120`` name rows as
    messages do (``sources``, (n,)). Raises InputError.
    """
    match = re.fullmatch(r"(?:(.+) )?([0-9]{1,9})(?::([0-9]{1,9}))?", text)
    first, last = (int(match[2]), int(match[3] or match[2])) if match else (0, 0)
    if match is None or first < 1:
        raise InputError(
            LEAVE_OUT, f" {text!r} is not FIRST:LAST, rows counted from 1 over all inputs, or a row as messages name it"
        )
    if last < first:
        raise InputError(LEAVE_OUT, f" {text!r}: row {first} comes after row {last}; give the lower row first")
    names, _, numbers = np.array([source.rpartition(" ") for source in sources.tolist()]).T
    if match[1] is None:
        if last > sources.size:
            raise InputError(
                LEAVE_OUT,
                f" {text!r}: rows {first} to {last} cannot be left out: the inputs have rows 1 to {sources.size}",
            )
        return (np.arange(sources.size) >= first - 1) & (np.arange(sources.size) < last)
    rows: Mask = np.array(
        [
            match[1] in (name, Path(name).name) and number.isdigit() and first <= int(number) <= last
            for name, number in zip(names.tolist(), numbers.tolist(), strict=True)
        ]
    )
    if not rows.any():
        raise InputError(LEAVE_OUT, f" {text!r} names no row of the inputs; the first is {Path(str(sources[0])).name}")
    if len(files := set(names[rows])) > 1:
        raise InputError(LEAVE_OUT, f" {text!r} names rows of {len(files)} files of this name; give the path too")
    return rows


FRACTIONS = (0.2, 0.1)
SEEDS = 8  # number of seeds tried
LEFT = 0.5  # at least this share of the rows of each combination


def proposed_hold_out(table: ObservationTable, unused: Mask | None = None) -> dict[str, Any] | None:
    """Return the first share of the rows that leaves enough of everything to fit, as JSON.

    None if there are too few poses.

    It is drawn by ``seed``, holds out ``rows`` rows, and leaves at least half of each of the ``combinations`` of names.
    ``unused`` (n,) are rows that are not judged, such as copies.
    """
    combination = _combinations(table)
    size, n_poses = np.bincount(combination), int(poses(table).max(initial=-1)) + 1
    for fraction, seed in itertools.product(FRACTIONS, range(SEEDS)):
        if round(fraction * n_poses) < 1:  # poses are drawn, not rows
            break
        held = held_out_rows(table, [str(fraction)], seed)
        if held is not None and np.all(np.bincount(combination[~held], minlength=size.size) >= LEFT * size):
            judged = held if unused is None else held & ~unused
            return {"fraction": fraction, "seed": seed, "rows": int(judged.sum()), "combinations": size.size}
    return None


def last_of_each(plan: Plan) -> list[str]:
    """Return the last bar and line of a plan, to hold out; a fifth of the poses if it has one of each at most."""
    names = {column: [name for name in np.unique(getattr(plan, column)).tolist() if name] for column in ("bar", "line")}
    return [f"{column}={names[-1]}" for column, names in names.items() if len(names) > 1] or ["0.2"]


def named_columns(table: ObservationTable) -> list[str]:
    """Return the filled columns that name what is mounted: bar, chuck, sphere, or socket, target."""
    return [name for name in identifiers() if name not in ANYWHERE[1:] and np.any(table[name] != "")]


def all_held_out(table: ObservationTable, held: Mask) -> list[str]:
    """Return the names without any row left in the fit: ``sphere=s1``."""
    columns = {column: table[column] for column in named_columns(table)}
    lost_names = ((column, np.setdiff1d(names[held], names[~held])) for column, names in columns.items())
    return [f"{column}={name}" for column, names in lost_names for name in names.tolist() if name]


def _combinations(table: ObservationTable) -> NDArray[np.intp]:
    """Return (n,) the number of each row's combination of kind, names and rig."""
    return first_alike([table.kind, *(table[name] for name in (*named_columns(table), "rig"))])[1]


IN_SPACE = 0.01  # m, standard deviation in the direction of least motion
LEAST_ROWS = 5  # of a kind, which must not all be equal


def check_rows(chain: Chain, table: ObservationTable, rows: Mask) -> None:
    """Raise ProblemError for ``rows`` (n,) without information: one row, or the same readings though the robot moves.

    A single coordinate of a point may stay the same while the end moves in a plane, but not while it moves in space.
    """
    if rows.sum() == 1:
        advice = "measure more poses" if len(table) == 1 else f"hold out or leave out fewer of the {len(table)}"
        raise ProblemError(f"{table.source[int(np.argmax(rows))]}: 1 row cannot identify a robot; {advice}")
    for name, kind in kinds().items():
        kind_rows = table.select(rows & (table.kind == name))
        if len(kind_rows) < LEAST_ROWS or not np.ptp(kind_rows.q, axis=0).max() > 0.0:
            continue
        for quantity in (column for column in kind.needs if isinstance(column, Quantity)):
            values = kind_rows[quantity.field].reshape(len(kind_rows), -1)
            moving = f"in all {len(kind_rows)} {name} rows though the joints move"
            if not np.ptp(values, axis=0).any():
                are = "are" if " and " in quantity.words else "is"
                text = f"{quantity.words} {are} the same {moving}; check that the sensor was read"
                raise ProblemError(f"{kind_rows.source[0]}: {text}")
            spans = zip(quantity.columns, np.ptp(values, axis=0), strict=False)
            constant = [title for title, span in spans if not span]
            if quantity == POINT and constant and _moves_in_space(chain, kind_rows.q):
                are, plural = ("are", "s") if len(constant) > 1 else ("is", "")
                titles = " and ".join(constant)
                text = f"{titles} {are} the same {moving} the end in space; check what the device wrote to the column"
                raise ProblemError(f"{kind_rows.source[0]}: {text}{plural} of {titles}")


def _moves_in_space(chain: Chain, q: Floats) -> bool:
    """Return whether the nominal end moves in all three directions, at readings q (n, j)."""
    if q.shape[1] != len(chain.joints) or not np.isfinite(q).all():
        return False  # ``build_problem`` names these errors
    points = forward(chain, chain.params_nominal, q)[:, :3, 3]
    return bool(np.sqrt(np.linalg.eigvalsh(np.cov(points.T))[0]) > IN_SPACE)


def default_prior(robot: Robot, solver: str) -> Prior:
    """Return the prior that robot or solver needs: the weak one resolves the redundant constants of a URDF."""
    needed = SOLVERS[solver].prior
    return Prior.NONE if needed is None else Prior.WEAK if robot.is_urdf else needed
