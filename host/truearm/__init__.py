"""truearm: measure where a robot arm really is, identify its kinematic parameters, correct it.

The names below are the public interface (docs/reference/api.md). They are imported on first use, so ``import truearm``
is cheap.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from truearm.version import VERSION as __version__

if TYPE_CHECKING:
    from truearm.api import SessionObservations as SessionObservations
    from truearm.api import builtin_robots as builtin_robots
    from truearm.api import correct_poses as correct_poses
    from truearm.api import error_map as error_map
    from truearm.api import export_robot as export_robot
    from truearm.api import identify as identify
    from truearm.api import load_robot as load_robot
    from truearm.api import plan_ball_bar as plan_ball_bar
    from truearm.api import read_result as read_result
    from truearm.api import read_rig as read_rig
    from truearm.api import read_session as read_session
    from truearm.api import read_table as read_table
    from truearm.api import validate as validate
    from truearm.api import write_result as write_result
    from truearm.api import write_table as write_table
    from truearm.correct.correction import Correction as Correction
    from truearm.correct.error_map import ErrorMap as ErrorMap
    from truearm.errors import InputError as InputError
    from truearm.errors import MissingFileError as MissingFileError
    from truearm.errors import PlanError as PlanError
    from truearm.errors import ProblemError as ProblemError
    from truearm.errors import RigError as RigError
    from truearm.errors import RobotError as RobotError
    from truearm.errors import SessionError as SessionError
    from truearm.errors import TableError as TableError
    from truearm.errors import TargetError as TargetError
    from truearm.errors import TruearmError as TruearmError
    from truearm.kinds.table import ObservationTable as ObservationTable
    from truearm.model.robot import Robot as Robot
    from truearm.plan.ball_bar_plan import BallBarPlan as BallBarPlan
    from truearm.plan.region import Region as Region
    from truearm.results import Estimate as Estimate
    from truearm.results import Figures as Figures
    from truearm.results import HeldOut as HeldOut
    from truearm.types import BallBar as BallBar
    from truearm.types import Device as Device
    from truearm.types import Plane as Plane
    from truearm.types import Point as Point
    from truearm.types import Rig as Rig
    from truearm.types import SocketDistance as SocketDistance
    from truearm.workflows.calibration import Calibration as Calibration
    from truearm.workflows.calibration import Identification as Identification
    from truearm.workflows.calibration import ParameterEstimate as ParameterEstimate
    from truearm.workflows.export import ExportedRobot as ExportedRobot
    from truearm.workflows.identify import IdentifyOptions as IdentifyOptions
    from truearm.workflows.plan import BallBarOptions as BallBarOptions
    from truearm.workflows.validate import Validation as Validation
    from truearm.workflows.validate import ValidationRegion as ValidationRegion

# The modules of the public names, for the imports at run time; those above are for type checkers.
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
    "Identification": "workflows.calibration",
    "IdentifyOptions": "workflows.identify",
    "InputError": "errors",
    "MissingFileError": "errors",
    "ObservationTable": "kinds.table",
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
    "SessionObservations": "api",
    "SocketDistance": "types",
    "TableError": "errors",
    "TargetError": "errors",
    "TruearmError": "errors",
    "Validation": "workflows.validate",
    "ValidationRegion": "workflows.validate",
    "builtin_robots": "api",
    "correct_poses": "api",
    "error_map": "api",
    "export_robot": "api",
    "identify": "api",
    "load_robot": "api",
    "plan_ball_bar": "api",
    "read_result": "api",
    "read_rig": "api",
    "read_session": "api",
    "read_table": "api",
    "validate": "api",
    "write_result": "api",
    "write_table": "api",
}
__all__ = [*_MODULES, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"truearm.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
