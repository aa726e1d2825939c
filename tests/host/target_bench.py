"""Targets as tables, RAPID and URScript, and how controllers execute the programs."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from tests.host.controllers import Controller
from tests.host.puma_bench import CHAIN, DESIGN
from tests.host.rapid_machine import run_rapid
from tests.host.urscript_machine import run_urscript


def table(targets, q=None):
    """Return a table of targets, with start joints if given."""
    turn = Rotation.from_matrix(targets[:, :3, :3]).as_rotvec()
    columns = [1e3 * targets[:, :3, 3], np.rad2deg(turn)] + ([np.rad2deg(q)] if q is not None else [])
    titles = ["x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg", *(f"q{i}_deg" for i in range(1, 7))]
    rows = np.concatenate(columns, axis=1)
    return "\n".join([",".join(titles[: rows.shape[1]]), *(",".join(map(repr, row)) for row in rows.tolist())])


def rapid(targets, q):
    """Return a module that goes to every target, declared or in the move, by joints and the last time straight."""
    quaternion = Rotation.from_matrix(targets[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    quarters = np.floor(q / (0.5 * np.pi)).astype(int)
    poses = [
        f"[[{','.join(f'{v:.6f}' for v in place)}],[{','.join(f'{v:.10f}' for v in turn)}],"
        f"[{at[0]},{at[3]},{at[5]},0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
        for place, turn, at in zip(1e3 * targets[:, :3, 3], quaternion, quarters, strict=True)
    ]
    half = len(poses) // 2
    lines = ["MODULE Work ! Caf\xe9 [[1]]"]
    lines += [f"  CONST robtarget p{i}:={pose};" for i, pose in enumerate(poses[:half])]
    lines += ["  PROC main()"]
    lines += [f"    MoveJ p{i},v100,fine,tool0;" for i in range(half)]
    lines += [f"    MoveJ {pose},v100,fine,tool0; ! [[1]]" for pose in poses[half:]]
    lines += [f"    MoveL {poses[-1]},v100,fine,tool0;", "    WaitTime 0.5;", "  ENDPROC", "ENDMODULE"]
    return "\r\n".join(lines).encode("latin-1")


def script(targets):
    six = np.concatenate([targets[:, :3, 3], Rotation.from_matrix(targets[:, :3, :3]).as_rotvec()], axis=1)
    poses = [f"p[{', '.join(f'{v:.9f}' for v in row)}]" for row in six]
    moves = [f"  movej({pose}, a=1.2, v=0.25)  # caf\xe9" for pose in poses[:-1]]
    last = [f"  there = {poses[-1]}", "  movej(there)", "  movel(there, a=1.2, v=0.25)", "  sleep(0.5)"]
    return "\n".join(["def work():", *moves, *last, "end", ""])


def driven(text, name, q, chain=CHAIN, params=DESIGN):
    """Return joints (n, 6) at the ends of a program's moves, on a controller with this model that begins at q (6,)."""
    machine = Controller(chain, params, q)
    {".mod": run_rapid, ".script": run_urscript}[Path(name).suffix](text, machine)
    return np.array([move.q for move in machine.moves])


def miss(poses, targets):
    return float(np.sqrt(np.mean(np.sum((poses - targets)[:, :3, 3] ** 2, axis=1))))
