"""figaroh as its examples do it: URDF, configuration, CSV, base and tip frames unknown, its own choice of parameters."""

import tempfile
from pathlib import Path

import pandas as pd
from figaroh.calibration.calibration_tools import calc_updated_fkm
from figaroh.tools.load_robot import load_robot
from method import run
from run_figaroh import CONFIG, Calibration, urdf


def fit(data):
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
    found, _ = calibration.solve_optimisation()

    def predict(q):
        config = dict(calibration.calib_config, NbSample=len(q))
        return calc_updated_fkm(calibration.model, calibration.data, found.x, q, config).reshape(3, -1).T

    return predict


run("figaroh", fit)
