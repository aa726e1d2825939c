"""Count the moves of public robot programs that can be corrected, and why the others cannot: programs_corpus.py [FOLDER]

programs_corpus.csv lists the repositories, their commits and the number of their program files. FOLDER (build/programs) holds copies
as LANGUAGE/OWNER+NAME/…; what is not there is left out. All files of a KUKA controller are one program, each other file is
one of its own. Numbered tools and frames are taken to be known. No robot is needed: configurations and reach do not count.
"""

from __future__ import annotations

import argparse
import csv
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from truearm.correct.programs.census import Census
from truearm.correct.programs.corrected_text import target_poses
from truearm.correct.programs.languages import SUFFIXES, ProgramLanguage, read_programs
from truearm.correct.programs.program import Goal, Surroundings
from truearm.correct.programs.tokens import Source
from truearm.model.transforms import frame_of, inverted
from truearm.types import Floats

NAMES = ("ut", "uf", "tool_data", "base_data")
GIVEN = Surroundings(frames={f"{name}{number}": np.eye(4) for name in NAMES for number in range(33)})


def erroneous(goal: Goal, pose: Floats) -> Floats:
    """Return a target (4, 4) for an arm with errors of up to 0.7 mm and 1 mrad that change with the place."""
    flange = goal.frame @ pose @ inverted(goal.tool)
    x, y, z = flange[:3, 3]
    shift = 0.5e-3 * np.sin(3.0 * x + 1.0), 0.4e-3 * np.cos(2.0 * y), 0.6e-3 * z
    turned = frame_of((0.0, 0.0, 0.0, 1e-3 * x, -1e-3 * y, 5e-4))[:3, :3] @ flange[:3, :3]
    flange[:3, :3], flange[:3, 3] = turned, flange[:3, 3] + shift
    return np.asarray(inverted(goal.frame) @ flange @ goal.tool)


def counts(language: ProgramLanguage, files: list[Source]) -> Counter[str]:
    """Return the number of moves that are corrected ("") and refused, by codes."""
    codes: Counter[str] = Counter()
    for program in read_programs(language, files, GIVEN):
        goals = [goal for move in program.moves for goal in move.goals if not goal.is_joints]
        census = Census(program, True)
        census.settle({g: erroneous(g, pose) for g, pose in zip(goals, target_poses(goals), strict=True)})
        codes.update("" if move.reason is None else move.reason.name for move in program.moves)
    return codes


def groups(language: ProgramLanguage, folder: Path) -> Iterator[list[Source]]:
    """Yield the files of a repository that run together."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.suffix.lower() in SUFFIXES[language]]
    sources = [Source(path.relative_to(folder).as_posix(), path.read_bytes()) for path in paths]
    yield from ([sources] if language == "krl" else [[source] for source in sources])


def main(folder: Path) -> None:
    """Print a line for each language."""
    with Path(__file__).with_suffix(".csv").open() as file:
        repositories = [(row["language"], row["repository"].replace("/", "+")) for row in csv.DictReader(file)]
    for language in SUFFIXES:
        folders = [folder / kind / name for kind, name in repositories if kind == language]
        programs = [files for path in folders for files in groups(language, path) if files]
        if not programs:
            print(f"{language}: no programs in {folder}; copy repositories of {Path(__file__).stem}.csv there")
            continue
        codes = [counts(language, files) for files in programs]
        total = sum(codes, Counter[str]())
        whole = sum(count.keys() == {""} for count in codes)
        print(f"{language}: {sum(map(len, programs))} files, {len(programs)} programs, {whole} of them whole")
        print(f"  {total.total()} moves, {total.pop('', 0)} corrected")
        print(f"  refused: {', '.join(f'{code} {number}' for code, number in total.most_common())}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=Path(__file__).parents[1] / "build/programs")
    main(parser.parse_args().folder)
