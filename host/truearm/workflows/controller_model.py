"""The model of a Universal Robots controller as a robot file (``truearm robot read``, ``truearm init``).

The file is the one of the drawing with a further set of values, CONTROLLER, which becomes the nominal one. The rows
with d of hundreds of metres become rows with Hayati's β (``export.toml_tables``), which can be identified.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from truearm.disk import check_writable, read_text, write_atomic
from truearm.errors import Argument, InputError, LinkError, RobotError
from truearm.export.toml_tables import dh_rows
from truearm.export.writing import link_frames
from truearm.findings import Finding
from truearm.model import controller_kinematics
from truearm.model.chain import forward
from truearm.model.controller_kinematics import JOINTS, ControllerKinematics
from truearm.model.robot import CONTROLLER, Robot, parse_robot
from truearm.model.robot_file import MAX_BYTES, RobotChoice, builtin_text, is_urdf, load_robot, robot_file
from truearm.model.robot_tables import SIX
from truearm.model.transforms import apart, six_of
from truearm.progress import step
from truearm.record.robots.rtde import kinematics_info
from truearm.record.robots.sources import RTDE
from truearm.schema import load_toml, toml_text
from truearm.types import Floats, rms
from truearm.units import DEG, MM, SUFFIXES

ROBOT_FILE = "robot.toml"
OTHER_ARM_M, OTHER_ARM_RAD = 0.05, 0.2  # the calibration of an arm differs from its drawing by less, other arms by more
EXACT = 1e-9  # m, and of a rotation matrix
N_POSES = 600


@step("reading the controller's kinematics")
def read_controller(source: str, model: str, out: Path, force: bool = False) -> Finding:
    """Write the robot file of a controller and return how it differs from the drawing.

    ``source``: an address rtde://HOST, a calibration.conf or a file of ur_calibration. ``model``: the built-in robot or
    the robot file with the drawing. Raises InputError, LinkError, and then writes nothing.
    """
    inputs = [path for path in (None if _is_live(source) else Path(source), robot_file(model)) if path is not None]
    check_writable(out, force, inputs=inputs, kind="robot", suffixes=[".toml"])
    text = drawing_text(model)
    drawing = parse_robot(text)
    kinematics = _kinematics(source, drawing)
    written, differences = controller_text(text, drawing, kinematics)
    write_atomic(out, written)
    checksums = as_hex(kinematics.checksums)
    values: dict[str, Any] = {"place": source, "model": drawing.chain.name, "n": N_POSES, "checksums": checksums}
    distances, turns = (np.linalg.norm(vectors, axis=1) for vectors in (differences[:, :3], differences[:, 3:]))
    values |= {"rms": {"mm": float(MM.of(rms(distances)))}, "largest": {"mm": float(MM.of(distances.max()))}}
    values |= {"turn": {"deg": float(DEG.of(turns.max()))}, "as_drawn": bool(np.abs(differences).max() < EXACT)}
    return Finding("controller-read", values)


def as_hex(checksums: tuple[int, ...]) -> list[str]:
    """Return checksums as the controller's files have them, without 0x."""
    return [f"{checksum:08x}" for checksum in checksums]


def _is_live(source: str) -> bool:
    return source.startswith(f"{RTDE}://")


def _kinematics(source: str, drawing: Robot) -> ControllerKinematics:
    """Return the kinematics of the controller at ``rtde://host``, or in a file.

    Raises LinkError, InputError, which names the source.
    """
    try:
        if _is_live(source):
            return controller_kinematics.kinematics_of_info(kinematics_info(source))
        content = read_text(Path(source), MAX_BYTES, InputError)
        if "delta_theta" in content:
            return controller_kinematics.kinematics_of_conf(content, _drawn_rows(drawing))
        return controller_kinematics.kinematics_of_yaml(content)
    except RobotError as exc:
        raise exc.within(source) from exc


def drawing_text(model: str) -> str:
    """Return the text of a built-in robot or a robot file. Raises RobotError for a URDF."""
    path = robot_file(model)
    if path is not None and is_urdf(model):
        raise RobotError(f"{path}: is a URDF; give a built-in robot or a robot file (.toml) with the drawing's values")
    return builtin_text(model) if path is None else read_text(path, MAX_BYTES, RobotError)


def controller_text(text: str, drawing: Robot, kinematics: ControllerKinematics) -> tuple[str, Floats]:
    """Return a robot file with the controller's values, and how far (n, 6) [m, rad] these are from the drawing.

    Raises RobotError if the controller is that of another arm, or if the file's convention cannot hold its kinematics.
    """
    chain = drawing.chain
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (N_POSES, JOINTS))
    if [joint.kind for joint in chain.joints] != ["revolute"] * JOINTS:
        reason = "a controller of Universal Robots has six revolute joints"
        raise RobotError("unsuited-robot", place=f"robot {chain.name}", reason=reason)
    design = _design(drawing)
    ends = kinematics.forward(q)
    differences = apart(ends, forward(chain, design, q))
    distance, turn = (float(np.linalg.norm(vectors, axis=1).max()) for vectors in np.split(differences, 2, axis=1))
    if distance > OTHER_ARM_M or turn > OTHER_ARM_RAD:
        apart_by = f"{MM.text(distance, '.0f')} and {DEG.text(turn, '.0f')}"
        text = f"the controller's arm differs from {chain.name} by up to {apart_by}; give its own drawing as "
        raise RobotError(text, Argument("robot"))
    described = link_frames(chain, design, design)
    rows = dh_rows(described._replace(links=kinematics.links), described, hayati=True)
    columns = {"offset": rows.theta, "d": rows.d, "a": rows.a, "alpha": rows.alpha, "beta": rows.beta}
    values = {f"joint{i + 1}.{key}": column[i] for key, column in columns.items() for i in range(JOINTS)}
    for table, pose in (("base", rows.base), ("tool", rows.tool)):
        values |= {f"{table}.{key}": value for (key, _), value in zip(SIX, six_of(pose), strict=True)}
    usual = dict(zip(chain.parameter_names, design, strict=True))
    written = _with_set(
        text, {key: float(values.get(key, value)) for key, value in usual.items()}, kinematics.checksums
    )
    again = parse_robot(written).chain
    if np.abs(forward(again, again.params_nominal, q) - ends).max() > EXACT:
        reason = "its rows cannot hold the controller's; give a robot file like the built-in ur5e: dh, with beta at parallel axes"
        raise RobotError("unsuited-robot", place=f"robot {chain.name}", reason=reason)
    return written, differences


def _with_set(text: str, values: dict[str, float], checksums: tuple[int, ...]) -> str:
    """Return the text of a robot file whose parameters have the values [SI] as nominal ones."""
    document = {**load_toml(text), "nominal": CONTROLLER, "checksums": list(checksums)}
    if not checksums:
        del document["checksums"]
    for table, entries in ((table, entries) for table, entries in document.items() if isinstance(entries, dict)):
        for title, sets in entries.items():
            key, _, unit = title.rpartition("_")
            key, unit = (key, unit) if unit in SUFFIXES else (title, "")
            if isinstance(sets, dict) and f"{table}.{key}" in values:
                sets[CONTROLLER] = SUFFIXES[unit].of(values[f"{table}.{key}"]) + 0.0
    return toml_text(document)


def _design(drawing: Robot) -> Floats:
    """Return the parameters of the drawing, also of a robot whose nominal ones are a controller's."""
    return drawing.chain.params_nominal if drawing.drawing is None else drawing.drawing


def _drawn_rows(drawing: Robot) -> Floats:
    """Return θ, a, d, α (4, 6) of the drawing."""
    values = dict(zip(drawing.chain.parameter_names, _design(drawing).tolist(), strict=True))
    keys = ("offset", "a", "d", "alpha")
    return np.array([[values.get(f"joint{i + 1}.{key}", 0.0) for i in range(JOINTS)] for key in keys])


def controller_state(address: str | None, model: str) -> tuple[tuple[int, ...], tuple[Finding, ...]]:
    """Return a controller's checksums if the robot file ``model`` has some, and whether they differ or were not read.

    The checksums are () if they were not read.
    """
    if not _is_live(address or "") or not Path(model).is_file() or is_urdf(model):
        return (), ()
    robot = load_robot(model)
    stored = robot.checksums
    if not stored:
        return (), ()
    try:
        checksums = _kinematics(address or "", robot).checksums
    except (LinkError, RobotError) as exc:
        unread = Finding("controller-unread", {"model": model, "reason": str(exc), "stored": True})
        return (), (unread,)
    changed = [str(i + 1) for i in range(JOINTS) if checksums[i] != stored[i]]
    differs = Finding("controller-changed", {"place": address, "model": model, "joints": changed})
    return checksums, (differs,) * bool(changed)


def controller_choice(model: str, address: str, folder: Path) -> tuple[RobotChoice | None, Finding | None]:
    """Return the robot of the controller, written into a folder, and what was read; None without such a controller.

    Raises RobotError for a controller of another arm.
    """
    if not _is_live(address) or is_urdf(model):
        return None, None
    out = folder / ROBOT_FILE
    try:
        finding = read_controller(address, model, out)
    except LinkError as exc:
        return None, Finding("controller-unread", {"model": model, "reason": str(exc)})
    return RobotChoice(str(out)), finding
