"""The numbers of docs/how-to/rig.md, recomputed by truearm's own forecast for the demo's rig."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from tests.host import plan_bench as bench

from truearm.model.chain import point_forward
from truearm.model.robot_file import builtin_robot
from truearm.plan.forecast import Aim, bar_table, forecast
from truearm.plan.measurement_limits import around, poses_in
from truearm.types import Plan
from truearm_sim.world import standard_plan

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "rig.md"
ROW = re.compile(r"^\| ([^|]+?) +\| +([\d.]+)(\*?) +\|", re.M)
RIG = bench.RIGS["puma560"]


@cache
def plan():
    """Return 200 poses per bar of the demo's plan."""
    return standard_plan(200)


@cache
def aim():
    """Return the plan's sphere positions; all three spheres count."""
    known, spheres = bench.known("puma560"), [RIG.spheres[name].xyz for name in plan().sphere]
    region = around(point_forward(known.chain, known.params, plan().q, np.array(spheres)))
    return Aim(poses_in(bench.site("puma560"), region, np.array([0.0, 0.0, 0.04])), tuple(RIG.spheres))


def points(what, sigma):
    return {what: {name: replace(p, sigma=sigma) for name, p in getattr(RIG, what).items()}}


def changed(only=None, **change):
    return {"bars": {n: replace(b, **(change if only in (None, n) else {})) for n, b in RIG.bars.items()}}


@cache
def only46() -> Plan:
    """Return the same number of poses, all with the short bar."""
    both = standard_plan(400)
    return both.select(both.bar == "bar46")


CASES = {
    "everything known exactly": {},
    "zero of both bars known to 0.02 mm": changed(zero_sigma=2e-5),
    "zero of both bars known to 0.1 mm": changed(zero_sigma=1e-4),
    "zero of both bars known to 1 mm": changed(zero_sigma=1e-3),
    "zero of bar46 known, zero of bar61 to 1 mm": changed("bar61", zero_sigma=1e-3),
    "gain of both bars known to 0.1 %": changed(gain_sigma=1e-3),
    "gain of both bars known to 1 %": changed(gain_sigma=1e-2),
    "zero to 1 mm and gain to 1 %": changed(zero_sigma=1e-3, gain_sigma=1e-2),
    "chucks known to 0.02 mm": points("chucks", 2e-5),
    "chucks known to 0.1 mm": points("chucks", 1e-4),
    "chucks known to 1 mm": points("chucks", 1e-3),
    "chucks not known at all": points("chucks", None),
    "spheres known to 0.02 mm": points("spheres", 2e-5),
    "spheres known to 0.1 mm": points("spheres", 1e-4),
    "spheres known to 1 mm": points("spheres", 1e-3),
    "spheres not known at all": points("spheres", None),
    "chucks and spheres not known at all": points("chucks", None) | points("spheres", None),
    "chucks and spheres not known at all, zero to 1 mm": points("chucks", None)
    | points("spheres", None)
    | changed(zero_sigma=1e-3),
}


def told(change, some=None):
    """Return the forecast at the paper's identified values, whose lengths deviate from mid-travel as a true robot's do."""
    known = bench.known("puma560")
    truth = builtin_robot("puma560").parameter_sets["optimised"]
    known = replace(known, rig=replace(RIG, **change), params=truth)
    return forecast(known, bar_table(known, plan() if some is None else some), aim())


def numbers():
    return {case: (value, star) for case, value, star in ROW.findall(PAGE.read_text(encoding="utf-8"))}


def test_the_page_has_all_cases_and_no_others():
    assert set(numbers()) == {*CASES, *(f"{case}, bar46 alone" for case in ONE_BAR)}


@pytest.mark.parametrize("case", CASES)
def test_numbers(case):
    check(case, told(CASES[case]))


ONE_BAR = ("everything known exactly", "zero to 1 mm and gain to 1 %")


@pytest.mark.parametrize("case", ONE_BAR)
def test_numbers_of_one_bar(case):
    """The same number of poses, all with bar46."""
    check(f"{case}, bar46 alone", told(CASES[case], only46()))


def check(case, result):
    """The page's number equals the forecast to its last digit; a star means that the base's pose is left out."""
    value, star = numbers()[case]
    half_digit = 0.5 * 10.0 ** -len(value.partition(".")[2])
    assert abs(1e3 * result.cartesian_rms - float(value)) <= half_digit * 1.02, f"{1e3 * result.cartesian_rms:.4f}"
    assert result.relative == (star == "*")


def test_names_in_the_text_are_keys_of_the_rig_file():
    text = PAGE.read_text(encoding="utf-8")
    for key in ("zero_sigma_mm", "gain_sigma", "sigma_mm", '"unknown"'):
        assert key in text
    table = (PAGE.parents[1] / "reference" / "table-format.md").read_text(encoding="utf-8")
    for key in ("zero_sigma_mm", "gain_sigma", "sigma_mm"):
        assert key in table
