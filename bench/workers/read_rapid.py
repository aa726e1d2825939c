"""Read a RAPID module, and write it with the same targets: what a correction does to its text alone.

.venv/bin/python bench/workers/read_rapid.py MODULE OUT
"""

from __future__ import annotations

import sys
from pathlib import Path

from truearm.correct.programs.census import Census
from truearm.correct.programs.corrected_text import changed_files, changes_of, target_poses
from truearm.correct.programs.languages import read_programs
from truearm.correct.programs.program import Surroundings
from truearm.correct.programs.tokens import Source


def rewrite(module: Path, out: Path) -> None:
    (program,) = read_programs("rapid", [Source(module.name, module.read_bytes())], Surroundings())
    census = Census(program, True)
    goals = [goal for move in program.moves for goal in move.goals]
    census.settle(poses := dict(zip(goals, target_poses(goals), strict=True)))
    out.write_bytes(changed_files(program, changes_of(census, poses, {}, True))[0])


if __name__ == "__main__":
    rewrite(Path(sys.argv[1]), Path(sys.argv[2]))
