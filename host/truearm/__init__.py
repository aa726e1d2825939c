"""truearm: measure where a robot arm really is, identify its kinematic parameters, correct it.

The names below are the public interface (docs/reference/api.md). They are imported on first use, so ``import truearm``
is cheap.
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
    from truearm.correct.correction import Correction
    from truearm.correct.error_map import ErrorMap
    from truearm.errors import (
        InputError,
        PlanError,
        ProblemError,
        RigError,
        RobotError,
        SessionError,
        TableError,
        TargetError,
        TruearmError,
    )
    from truearm.model.robot import Robot
    from truearm.plan.ball_bar_plan import BallBarPlan
    from truearm.plan.region import Region
    from truearm.results import Estimate, Figures, HeldOut
    from truearm.types import BallBar, Device, ObservationTable, Plane, Point, Rig, SocketDistance
    from truearm.workflows.calibration import Calibration, ParameterEstimate
    from truearm.workflows.export import ExportedRobot
    from truearm.workflows.identify import Identification, IdentifyOptions
    from truearm.workflows.plan import BallBarOptions
    from truearm.workflows.validate import Validation, ValidationRegion

__all__ = [
    "BallBar",
    "BallBarOptions",
    "BallBarPlan",
    "Calibration",
    "Correction",
    "Device",
    "ErrorMap",
    "Estimate",
    "ExportedRobot",
    "Figures",
    "HeldOut",
    "Identification",
    "IdentifyOptions",
    "InputError",
    "ObservationTable",
    "ParameterEstimate",
    "PlanError",
    "Plane",
    "Point",
    "ProblemError",
    "Region",
    "Rig",
    "RigError",
    "Robot",
    "RobotError",
    "SessionError",
    "SessionObservations",
    "SocketDistance",
    "TableError",
    "TargetError",
    "TruearmError",
    "Validation",
    "ValidationRegion",
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

# modules of the names that truearm.api does not define
_MODULES = {
    "BallBar": "types",
    "BallBarOptions": "workflows.plan",
    "BallBarPlan": "plan.ball_bar_plan",
    "Calibration": "workflows.calibration",
    "Correction": "correct.correction",
    "Device": "types",
    "ErrorMap": "correct.error_map",
    "Estimate": "results",
    "ExportedRobot": "workflows.export",
    "Figures": "results",
    "HeldOut": "results",
    "Identification": "workflows.identify",
    "IdentifyOptions": "workflows.identify",
    "InputError": "errors",
    "ObservationTable": "types",
    "ParameterEstimate": "workflows.calibration",
    "PlanError": "errors",
    "Plane": "types",
    "Point": "types",
    "ProblemError": "errors",
    "Region": "plan.region",
    "Rig": "types",
    "RigError": "errors",
    "Robot": "model.robot",
    "RobotError": "errors",
    "SessionError": "errors",
    "SocketDistance": "types",
    "TableError": "errors",
    "TargetError": "errors",
    "TruearmError": "errors",
    "Validation": "workflows.validate",
    "ValidationRegion": "workflows.validate",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"truearm.{_MODULES.get(name, 'api')}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
