"""Options of ``truearm simulate`` and ``truearm demo``: the simulated robot and its hidden truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from truearm.cli.command import fill
from truearm.cli.options import numbers_of
from truearm.errors import InputError
from truearm.units import DEG, MM

if TYPE_CHECKING:
    from truearm.workflows.simulated_robot import TruthOptions

DEFAULT_MODEL, DEFAULT_PERIODS, DEFAULT_STIFFNESS = "puma560", "180,90", 5e4


def truth_of(given: Mapping[str, Any]) -> TruthOptions:
    """Return the options of the hidden truth from a command's parameters, in SI units. Raises InputError."""
    from truearm.workflows.simulated_robot import TruthOptions

    tolerance, masses = numbers_of("--tolerance", given["tolerance"], 2), numbers_of("--masses-kg", given["masses_kg"])
    periods = numbers_of("--gear-periods-deg", given["gear_periods_deg"]) or ()
    if tolerance is not None and min(tolerance) < 0.0:
        raise InputError(f"--tolerance {given['tolerance']}: a standard deviation cannot be negative")
    if not all(0.1 <= period <= 3600.0 for period in periods):
        raise InputError(f"--gear-periods-deg {given['gear_periods_deg'][:60]}: a period is from 0.1 to 3600 deg")
    if masses is not None and not all(0.0 <= mass <= 1e4 for mass in masses):
        raise InputError(f"--masses-kg {given['masses_kg'][:60]}: a mass is from 0 to 10000 kg")
    return fill(
        TruthOptions,
        given,
        tolerance=None if tolerance is None else (MM.to_si(tolerance[0]), DEG.to_si(tolerance[1])),
        gear_periods=tuple(map(DEG.to_si, periods)),
        masses=masses,
        stiffness=given["stiffness_nm_rad"],
        seed=given["truth_seed"],
    )
