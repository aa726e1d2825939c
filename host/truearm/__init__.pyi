# The public names of truearm, by the modules that they are imported from on first use (__init__.py).
from typing import Final

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
from truearm.estimate.result_file import ParameterEstimate as ParameterEstimate
from truearm.findings import Finding as Finding
from truearm.kinds.table import ObservationTable as ObservationTable
from truearm.model.robot import Robot as Robot
from truearm.plan.ball_bar_plan import BallBarPlan as BallBarPlan
from truearm.plan.measurement_limits import Region as Region
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
from truearm.workflows.export import ExportedRobot as ExportedRobot
from truearm.workflows.identify import IdentifyOptions as IdentifyOptions
from truearm.workflows.plan import BallBarOptions as BallBarOptions
from truearm.workflows.validate import Validation as Validation
from truearm.workflows.validate import ValidationRegion as ValidationRegion

__version__: Final[str]
__all__: list[str]
