"""``truearm robot``: what the robot's controller computes with."""

from __future__ import annotations

from pathlib import Path

from truearm.cli.command import Answer, command
from truearm.cli.project import CommandGroup
from truearm.findings import entries

app = CommandGroup(
    "robot",
    help="Read the model that a robot's controller computes with.",
    epilog="Example: truearm robot read rtde://192.168.0.2 --model ur5e",
)


@command(app)
def read(address: str, *, robot: str, out: Path = Path("robot.toml"), force: bool = False) -> Answer:
    """Read the factory calibration of a Universal Robots controller into a robot file.

    The controller computes with these kinematics, not with the drawing. Give the file as --model, or as model in truearm.toml, so that
    truearm identifies and corrects against them. truearm init reads them too. Nothing is sent to the controller.

    Example:
      truearm robot read rtde://192.168.0.2 --model ur5e
      truearm robot read calibration.conf --model ur5e --out robot.toml

    Arguments
    ---------
    address : SOURCE
        Controller (rtde://192.168.0.2, port 30001), its calibration.conf, or a file of ur_calibration (.yaml).

    Options
    -------
    model : ROBOT
        Built-in robot or robot file (.toml) with the values of the drawing.
    out : FILE
        File to write: the robot (.toml).
    """
    from truearm.workflows.controller_model import read_controller

    finding = read_controller(address, robot, out, force)
    return Answer({"findings": entries([finding]), "written": [str(out)]})
