"""Options of ``truearm simulate`` and ``truearm demo``: the simulated robot and its hidden truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from truearm.bounds import REPEATABILITY
from truearm.cli.options import bounded, completed, numbers_of
from truearm.errors import InputError
from truearm.model.builtin import builtin_names
from truearm.units import DEG, MM, MRAD

if TYPE_CHECKING:
    from truearm.workflows.simulated_robot import TruthOptions

ModelOption = Annotated[
    str,
    typer.Option(
        "--model",
        metavar="ROBOT",
        autocompletion=completed(builtin_names()),
        help=f"The robot to simulate: built-in ({', '.join(builtin_names())}), robot file (.toml) or URDF (.urdf).",
    ),
]
ToleranceOption = Annotated[
    str | None,
    typer.Option(
        "--tolerance",
        metavar="MM,DEG",
        help="Standard deviations of the true lengths and angles about the nominal ones. Default: 0.5,0.1146; for the PUMA 560, "
        "Goswami's Table II instead.",
    ),
]
GearErrorOption = Annotated[
    float,
    typer.Option("--gear-error-mrad", min=0.0, metavar="MRAD", help="Amplitude of the gear error at each period."),
]
GearPeriodsOption = Annotated[
    str, typer.Option("--gear-periods-deg", metavar="DEG,…", help="Periods of the gear error, in joint angle.")
]
MassesOption = Annotated[
    str | None,
    typer.Option(
        "--masses-kg",
        metavar="KG,…",
        help="Masses of the links, one per joint: the joints sag under them. Default: no sag.",
    ),
]
StiffnessOption = Annotated[
    float, typer.Option("--stiffness-nm-rad", min=1.0, metavar="NM/RAD", help="Stiffness of each joint that sags.")
]
RepeatabilityOption = Annotated[
    float | None,
    typer.Option(
        "--repeatability-mm",
        metavar="MM",
        help="Repeatability of the bars, which the rig declares too. Default: 0.084.",
        **bounded(REPEATABILITY, MM),
    ),
]
TruthOutOption = Annotated[
    Path | None, typer.Option("--truth-out", metavar="FILE", help="Write the hidden truth (.json).")
]
TruthForceOption = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Overwrite the file of --truth-out if truearm wrote it. Files of the same command in the folder of --out are overwritten in any case.",
    ),
]
TruthSeedOption = Annotated[
    int | None,
    typer.Option(
        "--truth-seed",
        min=0,
        metavar="N",
        help="Random seed of the hidden truth. The same value with another --seed is the same arm on another day. Default: --seed.",
    ),
]
WornOption = Annotated[
    bool, typer.Option("--worn", help="Simulate a worn arm: backlash, slow settling, oscillation, noisy readings.")
]

DEFAULT_MODEL, DEFAULT_PERIODS, DEFAULT_STIFFNESS = "puma560", "180,90", 5e4


def truth_of(
    tolerance: str | None,
    gear_error_mrad: float,
    gear_periods_deg: str,
    masses_kg: str | None,
    stiffness: float,
    repeatability_mm: float | None,
    worn: bool,
    truth_seed: int | None,
) -> TruthOptions:
    """Return the options of the hidden truth in SI units. Raises InputError."""
    from truearm.workflows.simulated_robot import TruthOptions

    drawn, masses = numbers_of("--tolerance", tolerance, 2), numbers_of("--masses-kg", masses_kg)
    periods = numbers_of("--gear-periods-deg", gear_periods_deg) or ()
    if drawn is not None and min(drawn) < 0.0:
        raise InputError(f"--tolerance {tolerance}: a standard deviation cannot be negative")
    if not all(0.1 <= period <= 3600.0 for period in periods):
        raise InputError(f"--gear-periods-deg {gear_periods_deg[:60]}: a period is from 0.1 to 3600 deg")
    if masses is not None and not all(0.0 <= mass <= 1e4 for mass in masses):
        raise InputError(f"--masses-kg {(masses_kg or '')[:60]}: a mass is from 0 to 10000 kg")
    return TruthOptions(
        tolerance=None if drawn is None else (MM.to_si(drawn[0]), DEG.to_si(drawn[1])),
        gear_error=MRAD.to_si(gear_error_mrad),
        gear_periods=tuple(map(DEG.to_si, periods)),
        masses=masses,
        stiffness=stiffness,
        repeatability=None if repeatability_mm is None else MM.to_si(repeatability_mm),
        worn=worn,
        seed=truth_seed,
    )
