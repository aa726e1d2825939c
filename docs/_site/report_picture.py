"""The picture of README.md: the 3-D view in the report of a real arm, photographed with Chromium.

The arm is the UR10 of Fraunhofer IPA (series C, a laser tracker), fitted as docs/explanation/real-arms.md has it.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image

import truearm
from truearm.model.chain import joint_frames
from truearm.report.page import html_page
from truearm.workflows import scene as scene_of

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "images" / "arm.png"
WIDTH, HEIGHT = 1000, 938  # px: the view with its controls and colours
COLOURS = 256
POINTS = 250  # more hide the arm


def main() -> None:
    """Write the picture; without a browser, print that and keep the old one."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        sys.exit(f"{PICTURE.name} stays as it is: it needs chromium")
    sys.path.insert(0, str(ROOT / "bench"))
    import real_arms

    robot, table = real_arms.ur10("c")
    robot = replace(robot, capsules=truearm.load_robot("ur10e").capsules)  # the links of its successor
    elbow = joint_frames(robot.chain, robot.chain.params_nominal, table.q)[:, 2, 2, 3]
    elbow[0] = -np.inf  # the home position, straight up
    order = np.roll(np.arange(len(table)), -np.argmax(elbow))  # the arm is shown at the first row
    table, held_out = table.select(order), real_arms.some(len(table), 0.2, 0)[order]
    found = truearm.identify(robot, table, real_arms.TRACKER, hold_out=held_out)
    with TemporaryDirectory() as folder:
        page, shot = Path(folder) / "page.html", Path(folder) / "shot.png"
        scene_of.MOST_POINTS = POINTS
        scene, error = scene_of.calibration_scene(found), found.estimate.held_out.figures["m"]
        subtitle = f"Mean error of {error.n} points that were not fitted: {1e3 * error.mean:.3f} mm"
        page.write_text(html_page("truearm", "UR10, 2773 points of a laser tracker", subtitle, [], scene=scene))
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        command += [f"--user-data-dir={folder}/profile", f"--window-size={WIDTH},{HEIGHT}", f"--screenshot={shot}"]
        subprocess.run([*command, page.as_uri()], check=True, capture_output=True, timeout=120)
        with Image.open(shot) as image:
            image.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(PICTURE, optimize=True)


if __name__ == "__main__":
    main()
