"""What an identification reads: its files named, checked, read as one table, and hashed."""

from __future__ import annotations

import re
from pathlib import Path

from truearm.commands.session import attached_rig, is_session, observations_of_session
from truearm.errors import InputError
from truearm.files.disk import check_writable, same_file
from truearm.files.result import Input, input_of, looks_like_result
from truearm.files.rig import read_rig
from truearm.files.robot import robot_file
from truearm.files.table import check_against_rig, concatenate, looks_like_table, read_table
from truearm.types import ObservationTable, Rig


def rig_files(given: list[str]) -> dict[str, Path]:
    """The files of ``--rig`` by rig name, "" for one without a name; ./a=b.toml has none.

    Raises InputError where names do not tell the rigs apart.
    """
    files: dict[str, Path] = {}
    for text in given:
        name, equals, file = text.partition("=")
        named = bool(equals) and re.fullmatch(r"[\w-]{1,64}", name, re.ASCII) is not None
        name, path = (name, Path(file)) if named else ("", Path(text))
        if name in files:
            which = f"rig {name} is given twice" if name else "several rigs need names, --rig NAME=FILE"
            raise InputError(f"--rig {text}: {which}")
        files[name] = path
    if "" in files and len(files) > 1:
        raise InputError(f"--rig {files['']}: several rigs need names, --rig NAME=FILE")
    return files


def check_files(
    inputs: list[Path], robot: str, rigs: dict[str, Path], out: Path | None, save_table: Path | None
) -> None:
    """No input twice (its sigmas would shrink), no output over an input or a stranger's file. Raises InputError."""
    for i, path in enumerate(inputs):
        if any(same_file(path, other) for other in inputs[:i]):
            raise InputError(f"{path}: is given twice; its observations would count twice")
    read = [*inputs, *rigs.values(), *filter(None, [robot_file(robot)])]
    if out is not None:
        check_writable(out, inputs=read, ours=looks_like_result)
    if save_table is not None:
        check_writable(save_table, inputs=[*read, *filter(None, [out])], ours=looks_like_table)


def observed(
    inputs: list[Path], files: dict[str, Path], joint_units: tuple[str, ...], allow_damaged: bool
) -> tuple[Rig | dict[str, Rig], ObservationTable]:
    """The rig, or the rigs by name, and the observations, held against each other."""
    rigs = {name: read_rig(path) for name, path in files.items()}
    one = rigs.get("") or (None if rigs else rig_of_sessions(inputs)) or Rig()
    if "" in rigs or not rigs:
        table = read_inputs(inputs, joint_units, one, allow_damaged)
        check_against_rig(table, one)
        return one, table
    if any(is_session(path) for path in inputs):
        raise InputError(
            "rigs with names go with tables; --save-table makes one of a session, to be given a column rig"
        )
    table = read_inputs(inputs, joint_units, one)
    for name, rig in rigs.items():
        rows = table.rig == name
        if not rows.any():
            raise InputError(f"--rig {name}={files[name]}: no row has that name in its column rig")
        check_against_rig(table.select(rows), rig)
    return rigs, table


def read_inputs(
    paths: list[Path], joint_units: tuple[str, ...], rig: Rig, allow_damaged: bool = False
) -> ObservationTable:
    """The observations of all inputs, one after the other."""
    return concatenate([_read_input(path, joint_units, rig, allow_damaged) for path in paths])


def _read_input(path: Path, joint_units: tuple[str, ...], rig: Rig, allow_damaged: bool) -> ObservationTable:
    if not is_session(path):
        return read_table(path, joint_units)
    table = observations_of_session(path, rig, allow_damaged).table
    if table.q.shape[1] != len(joint_units):
        raise InputError(f"{path}: its robot has {table.q.shape[1]} joints, the robot given has {len(joint_units)}")
    return table


def rig_of_sessions(paths: list[Path]) -> Rig | None:
    """The rig that all sessions among the inputs were recorded with. Raises InputError if they differ."""
    from truearm.record.session import open_session

    rigs = [attached_rig(open_session(path, allow_damaged=True), path) for path in paths if is_session(path)]
    if any(rig != rigs[0] for rig in rigs):
        raise InputError("the sessions were recorded with different rigs; say with --rig which one holds")
    return rigs[0] if rigs else None


def hashed_inputs(inputs: list[Path], robot: str, *rigs: Path) -> list[Input]:
    """Name and SHA-256 of every file that an identification read."""
    file = robot_file(robot)
    return [
        *(input_of("observations", path) for path in inputs),
        *(input_of("rig", rig) for rig in rigs),
        *([input_of("robot", file)] if file else []),
    ]
