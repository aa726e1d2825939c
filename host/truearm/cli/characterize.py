"""``truearm characterize``: how well a robot repeats, and the noise file that ``truearm identify`` uses."""

from __future__ import annotations

from typing import Annotated

from truearm.bounds import Within
from truearm.cli.command import Answer, command
from truearm.units import MM
from truearm.workflows.requests import CharacterizeFiles

BANDS_MM = (0.02, 0.05, 0.1)


@command()
def characterize(
    files: CharacterizeFiles, *, within_mm: Annotated[tuple[float, ...], Within(0.0001, 100.0)] = ()
) -> Answer:
    """Measure how well a robot repeats: spread, backlash, settling time, noise of joints and sensor, each with its 95 % interval.

    The session is a recording of a plan of truearm plan characterize; files that continue it (truearm record
    --resume) are read with it. The nominal robot is sufficient. Give --plan if the session contains no plan.

    Example:
      truearm characterize approaches.mcap --model puma560 --out noise.toml

    Options
    -------
    within_mm : MM
        Count the arm as settled once the length stays within this distance of its final value (repeatable). Default:
        0.02, 0.05, 0.1.
    out : FILE
        File to write: the noise file for truearm identify --noise (.toml).
    details
        Print how the arm settles, the noise of joints and sensor, and a table of the joints. Difference: the mean reading
        of a joint that comes from below, minus from above. Scatter: the sigma of its readings from one side.
    """
    from truearm.report.repeatability_findings import joint_table
    from truearm.workflows.characterize import characterize_files

    bands = sorted({MM.to_si(mm) for mm in within_mm or BANDS_MM})
    document = characterize_files(files, bands)
    return Answer(document, tables=[joint_table(document)], written=[files.out])
