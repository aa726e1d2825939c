"""What an identification reads: its files named, checked, read as one table, and hashed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from truearm.errors import InputError
from truearm.files.disk import check_writable, same_file
from truearm.files.noise_file import NoiseFile, check_against_rigs, with_noise
from truearm.files.observation_table import check_against_rig, concatenate, looks_like_table, read_table
from truearm.files.result_file import Input, input_of, looks_like_result
from truearm.files.rig_file import read_rig
from truearm.files.robot_file import robot_file
from truearm.types import ObservationTable, Rig
from truearm.workflows.session_observations import observations_of_session
from truearm.workflows.session_parts import is_part
from truearm.workflows.session_rigs import Assigned, session_rigs


def check_files(
    inputs: list[Path],
    robot: str,
    rigs: dict[str, Path],
    out: Path | None,
    save_table: Path | None,
    report: Path | None = None,
) -> None:
    """No input twice (its sigmas would shrink), no output over an input, another or a stranger's file. Raises InputError."""
    if Path("-") in inputs:
        raise InputError("-: standard input is not read; save the data to a file first")
    if Path("-") in (out, save_table, report):
        raise InputError("-: is no file name; --json prints the result to standard output")
    for i, path in enumerate(inputs):
        if any(same_file(path, other) for other in inputs[:i]):
            raise InputError(f"{path}: is given twice; its observations would count twice")
    outputs = [path for path in (out, save_table, report) if path is not None]
    for i, path in enumerate(outputs):
        if any(same_file(path, other) for other in outputs[:i]):
            raise InputError(f"{path}: would be two outputs in one file; give each its own")
    read = [*inputs, *rigs.values(), *filter(None, [robot_file(robot)])]
    if out is not None:
        check_writable(out, inputs=read, ours=looks_like_result)
    if save_table is not None:
        check_writable(save_table, inputs=read, ours=looks_like_table)
    if report is not None:
        from truearm.report.calibration_page import looks_like_page

        check_writable(report, inputs=read, ours=looks_like_page)


def observed(
    inputs: list[Path],
    files: dict[str, Path],
    joint_units: tuple[str, ...],
    allow_damaged: bool,
    noise: NoiseFile | None = None,
    line_points: int | None = None,
) -> tuple[Rig | dict[str, Rig], ObservationTable]:
    """The rig, or the rigs by name, and the observations, held against each other.

    ``noise`` stands in for the rigs' own, ``line_points`` are of each pass along a line at most.
    """
    given = {name: with_noise(read_rig(path), noise) for name, path in files.items()}
    of_session = {path: (name, with_noise(rig, noise)) for path, (name, rig) in session_rigs(inputs, given).items()}
    tables = {
        path: _read_input(path, joint_units, of_session.get(path), allow_damaged, is_part(path, inputs), line_points)
        for path in inputs
    }
    table = concatenate([part for part in tables.values() if len(part)] or list(tables.values()))
    if not len(table):
        raise InputError(f"{inputs[0]}: no dwell and no line gave an observation; see truearm inspect {inputs[0]}")
    rigs = given | dict(of_session.values())
    if noise is not None:
        check_against_rigs(noise, rigs)
    if "" in rigs or not rigs:
        one = rigs.get("", with_noise(Rig(), noise))
        check_against_rig(table, one)
        return one, table
    _check_names(table, rigs, files)
    for name, rig in rigs.items():
        check_against_rig(table.select(table.rig == name), rig)
    return rigs, table


def _check_names(table: ObservationTable, rigs: dict[str, Rig], files: dict[str, Path]) -> None:
    """Every row names one of the rigs, and every rig that was given is named. Raises InputError."""
    for name, file in files.items():
        if not (table.rig == name).any():
            raise InputError(
                f"--rig {name}={file}: no row has that name in its column rig, and no session is called so"
            )
    for name, source in zip(table.rig, table.source, strict=True):
        if name not in rigs:
            whose = f"belongs to rig {str(name)!r}" if name else "names no rig in its column rig"
            raise InputError(f"{source}: {whose}; given: {', '.join(sorted(rigs))}")


def _read_input(
    path: Path,
    joint_units: tuple[str, ...],
    assigned: Assigned | None,
    allow_damaged: bool,
    part: bool,
    line_points: int | None,
) -> ObservationTable:
    if assigned is None:
        return read_table(path, joint_units)
    name, rig = assigned
    table = observations_of_session(path, rig, allow_damaged, part, line_points).table
    if len(table) and table.q.shape[1] != len(joint_units):
        raise InputError(f"{path}: its robot has {table.q.shape[1]} joints, the robot given has {len(joint_units)}")
    return replace(table, rig=np.full(len(table), name))


def hashed_inputs(inputs: list[Path], robot: str, *rigs: Path, noise: Path | None = None) -> list[Input]:
    """Name and SHA-256 of every file that an identification read."""
    file = robot_file(robot)
    return [
        *(input_of("observations", path) for path in inputs),
        *(input_of("rig", rig) for rig in rigs),
        *([input_of("noise", noise)] if noise else []),
        *([input_of("robot", file)] if file else []),
    ]
