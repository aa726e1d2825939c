"""figaroh on the position problem, the way its examples do it: URDF, configuration, CSV, a subclass of BaseCalibration.

    build/bench-venv/figaroh/bin/python bench/workers/run_figaroh.py fit position FILE RUNS

Full parameters, base and tip frames unknown, its own choice of what is free, its own start and solver ("lm"). Timed is
``solve_optimisation`` alone, the fit; loading the files and choosing the parameters are not counted.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from figaroh.calibration.base_calibration import BaseCalibration
from figaroh.calibration.calibration_tools import calc_updated_fkm
from figaroh.tools.load_robot import load_robot
from measure import tell, timed

CONFIG = """
meta: {{schema_version: "2.0"}}
robot:
  name: ur10e
  properties: {{joints: {{active_joints: [j1, j2, j3, j4, j5, j6]}}}}
tasks:
  calibration:
    type: kinematic_calibration
    kinematics: {{base_frame: universe, tool_frame: flange}}
    parameters: {{calibration_level: full_params}}
    measurements:
      markers: [{{measurable_dof: [true, true, true, false, false, false]}}]
    data: {{number_of_samples: {n}, source_file: {csv}}}
"""
LINK = '<link name="{0}"/>'
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/><limit lower="-3.2" upper="3.2" effort="1" velocity="1"/></joint>"""


def urdf(dh: np.ndarray) -> str:
    """(6, 4) offset, d, a, alpha: joint i stands where row i − 1 ends; the last row ends at the flange."""
    before = np.concatenate([np.zeros((1, 4)), dh])
    parts = [LINK.format(name) for name in ("base", *(f"l{i}" for i in range(1, 7)), "flange")]
    for i, (offset, d, a, alpha) in enumerate(before):
        own = dh[i, 0] if i < 6 else 0.0
        if offset or own:
            raise ValueError("this writer knows no joint offsets; the UR10e has none")
        name, kind = (f"j{i + 1}", "revolute") if i < 6 else ("to_flange", "fixed")
        parent, child = "base" if i == 0 else f"l{i}", f"l{i + 1}" if i < 6 else "flange"
        parts.append(
            JOINT.format(name=name, kind=kind, parent=parent, child=child, xyz=f"{a!r} 0 {d!r}", rpy=f"{alpha!r} 0 0")
        )
    return f'<robot name="ur10e">{"".join(parts)}</robot>'.replace("np.float64(", "").replace(")", "")


class Calibration(BaseCalibration):
    def __init__(self, robot, config: str) -> None:
        super().__init__(robot, config)
        self.calib_config["known_baseframe"] = False
        self.calib_config["known_tipframe"] = False

    def cost_function(self, var):
        return self.PEE_measured - calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)


def main(_: str, kind: str, path: str, runs: int) -> None:
    data = dict(np.load(path))
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        columns = {f"{k}1": data["y"][:, i] for i, k in enumerate("xyz")}
        columns |= {f"j{i + 1}": data["q"][:, i] for i in range(6)}
        pd.DataFrame(columns).to_csv(place / "data.csv", index=False)
        (place / "robot.urdf").write_text(urdf(data["dh"]))
        (place / "config.yaml").write_text(CONFIG.format(n=len(data["q"]), csv=place / "data.csv"))
        calibration = Calibration(
            load_robot(str(place / "robot.urdf"), package_dirs=folder), str(place / "config.yaml")
        )
        calibration.initialize()
    (found, _), seconds = timed(calibration.solve_optimisation, runs)
    config = dict(calibration.calib_config, NbSample=len(data["q_held"]))
    predicted = calc_updated_fkm(calibration.model, calibration.data, found.x, data["q_held"], config)
    error = np.sqrt(((predicted.reshape(3, -1).T - data["y_held"]) ** 2).sum(axis=1).mean())
    tell(seconds=seconds, held_out_mm=1e3 * float(error), iterations=found.nfev, status=found.message)


if __name__ == "__main__":
    what, kind, path, runs = sys.argv[1:]
    main(what, kind, path, int(runs))
