"""truearm: measure where a robot arm really is, identify its kinematic parameters, correct it.

The names below are the public interface (docs/api.md). They are imported when they are first used, so that ``import truearm``
costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from truearm_wire.version import VERSION as __version__

if TYPE_CHECKING:
    from truearm.api import (
        SessionObservations,
        builtin_robots,
        correct_poses,
        error_map,
        export_robot,
        identify,
        load_robot,
        plan_ball_bar,
        read_result,
        read_rig,
        read_session,
        read_table,
        validate,
        write_result,
        write_table,
    )
    from truearm.errors import InputError, TruearmError
    from truearm.model.robot import Robot
    from truearm.plan.region import Region
    from truearm.types import Estimate, ObservationTable, Rig
    from truearm.workflows.calibration import Calibration
    from truearm.workflows.identify import Identification, IdentifyOptions
    from truearm.workflows.plan import BallBarOptions
    from truearm.workflows.validate import Validation

__all__ = [
    "BallBarOptions",
    "Calibration",
    "Estimate",
    "Identification",
    "IdentifyOptions",
    "InputError",
    "ObservationTable",
    "Region",
    "Rig",
    "Robot",
    "SessionObservations",
    "TruearmError",
    "Validation",
    "__version__",
    "builtin_robots",
    "correct_poses",
    "error_map",
    "export_robot",
    "identify",
    "load_robot",
    "plan_ball_bar",
    "read_result",
    "read_rig",
    "read_session",
    "read_table",
    "validate",
    "write_result",
    "write_table",
]

# where the names are that truearm.api does not define
_MODULES = {
    "BallBarOptions": "workflows.plan",
    "Calibration": "workflows.calibration",
    "Estimate": "types",
    "Identification": "workflows.identify",
    "IdentifyOptions": "workflows.identify",
    "InputError": "errors",
    "ObservationTable": "types",
    "Region": "plan.region",
    "Rig": "types",
    "Robot": "model.robot",
    "TruearmError": "errors",
    "Validation": "workflows.validate",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"truearm.{_MODULES.get(name, 'api')}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
