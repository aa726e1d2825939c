"""Randomly damaged tables, plans and rig files: one clear error, or a table of valid numbers, in bounded time and memory."""

import random
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mutations import bounded, is_clear, text_changed
from test_files_plan import MOVING
from test_files_rig import FULL

from truearm.correct.target_table import read_targets
from truearm.errors import TruearmError
from truearm.kinds.rig_file import read_rig
from truearm.kinds.table_file import read_table
from truearm.plan.plan_file import read_plan
from truearm.units import UNITS

DATA = Path(__file__).parents[1] / "data" / "mukca"
TABLE = "kind,q1_deg,q2_mm,length_mm,sigma_mm,bar,chuck,sphere,place,socket\n" + "".join(
    f"ball_bar,{10.5 * k},{k},{460 + k / 7},0.08,b46,c1,s{k % 3},,\nseat,{-k},0.{k},,,,,,p{k},k1\n" for k in range(8)
)
TARGETS = "x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n" + "".join(f"{500 + k},{k},{-k},0,90,{k}\n" for k in range(9))


def sane_table(table):
    assert np.all(np.isfinite(table.q))
    assert not np.any(np.abs(table.value) > UNITS["m"].largest)
    assert not np.any(table.sigma <= 0.0)


def sane_plan(plan):
    assert np.all(np.isfinite(plan.q))


def sane_rig(rig):
    points = [*rig.chucks.values(), *rig.spheres.values(), *rig.targets.values(), *rig.sockets.values()]
    assert np.all(np.isfinite([point.xyz for point in points])) or not points
    assert all(bar.zero > bar.travel / 2 > 0 and bar.sigma > 0 for bar in rig.bars.values())


def sane_targets(targets):
    assert np.all(np.isfinite(targets.pose))


KINDS = {
    "table": ("odd.csv", TABLE, read_table, sane_table),
    "real table": ("odd.csv", "\n".join((DATA / "panda_3.csv").read_text().split("\n")[:40]), read_table, sane_table),
    "plan": ("odd.csv", MOVING, read_plan, sane_plan),
    "rig": ("odd.toml", FULL, read_rig, sane_rig),
    "real rig": ("odd.toml", (DATA / "rig.toml").read_text(), read_rig, sane_rig),
    "targets": ("odd.csv", TARGETS, lambda path: read_targets(path, ("rad",) * 6), sane_targets),
}


def judge(kind, folder, data):
    name, _, read, sane = KINDS[kind]
    path = folder / name
    path.write_bytes(data)
    try:
        found = read(path)
    except TruearmError as exc:
        is_clear(exc, str(path))
        return "refused"
    sane(found)
    return "read"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [100, pytest.param(10_000, marks=pytest.mark.soak)])
def test_damaged(tmp_path, kind, n):
    outcomes = Counter()
    assert judge(kind, tmp_path, KINDS[kind][1].encode()) == "read"
    for seed in range(n):
        data = text_changed(random.Random(seed), KINDS[kind][1])
        with bounded():
            outcomes[judge(kind, tmp_path, data)] += 1
    assert min(outcomes["read"], outcomes["refused"]) > n / 50
