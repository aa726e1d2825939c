"""``truearm map``: the section, its numbers against a direct computation, its uncertainty, the best region; bad input."""

import csv
import json
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import correct_bench
import numpy as np
import pytest
from puma_bench import CHAIN, DESIGN, TRUTH

from truearm.correct.correction import ModelPair
from truearm.correct.error_map import ErrorMap, best_region, error_map
from truearm.estimate.result_file import read_result
from truearm.findings import Finding
from truearm.model.chain import forward, joint_frames
from truearm.model.robot_file import builtin_robot
from truearm.workflows.calibration import NEAR_OBSERVED, read_calibration, unseen_within
from truearm.workflows.map import Section, map_findings, mapped

P = len(CHAIN.parameters)
NONE = np.zeros((P, 0))


@pytest.fixture(scope="module")
def estimate():
    return correct_bench.identified()


@pytest.fixture(scope="module")
def result(tmp_path_factory, estimate):
    return correct_bench.write(tmp_path_factory.mktemp("map") / "result.json", estimate)


def test_cells_hold_what_the_formula_says(result, tmp_path, printed):
    """(31) at the joints of every row, the end in its cell, in the plane, elbow up."""
    out, picture = tmp_path / "map.csv", tmp_path / "map.svg"
    section = ["map", result, "--at", "0,0,0,0,0,0", "--cell-mm", 40, "--task", "300x200"]
    page = tmp_path / "map.html"
    said = printed(*section, "--out", out, "--picture-out", picture, "--report", page)
    rows = list(csv.DictReader(out.open()))
    assert len(rows) > 300
    q = np.radians([[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows])
    stored = read_result(result)
    nominal, identified = (
        forward(CHAIN, p, q)[:, :3, 3] for p in (DESIGN, stored.column("value")[stored.column("of") == "robot"])
    )
    error = 1e3 * np.linalg.norm(identified - nominal, axis=1)
    # written to 1e-5 deg of a joint: 0.2 µm of the end, of which the error's own derivative is some percent
    np.testing.assert_allclose([float(row["error_mm"]) for row in rows], error, atol=1e-4)
    place = np.array([[float(row[k]) for k in ("x_mm", "y_mm", "z_mm")] for row in rows])
    np.testing.assert_allclose(place, 1e3 * nominal, atol=2e-3)
    np.testing.assert_allclose(place[:, 1], place[0, 1], atol=1e-3)
    cell = np.array([[float(row[k]) for k in ("u_mm", "v_mm")] for row in rows])
    assert np.abs(cell - place[:, [0, 2]]).max() <= 20.0 + 1e-2
    assert len({tuple(row) for row in cell}) == len(rows)
    root = ElementTree.fromstring(picture.read_text())
    squares = [e for e in root.iter("{http://www.w3.org/2000/svg}rect") if e.get("style")]
    assert len(squares) == len(rows) + 60  # and the scale
    (cloud,) = json.loads(re.search(r'id="scene">(.*?)</script>', page.read_text())[1])["clouds"]
    assert len(cloud["points"]) == min(len(rows), 2000)
    lengths = np.linalg.norm(cloud["vectors"][0]["mm"], axis=1)
    np.testing.assert_allclose(lengths, error, atol=1e-3)
    assert "Best place for" in said
    document = json.loads(printed(*section, "--json"))
    errors = np.array([float(row["error_mm"]) for row in rows])
    values = {finding["code"]: finding["values"] for finding in document["findings"]}["map-error"]
    assert (values["cells"], values["cell"], document["written"]) == (len(rows), {"mm": 40.0}, [])
    told = [values[name]["mm"] for name in ("least", "most", "rms")]
    np.testing.assert_allclose(told, [errors.min(), errors.max(), np.sqrt(np.mean(errors**2))], atol=1e-4)  # as written
    assert [round(u) for u in np.diff(document["best_region"]["u_mm"])] >= [300]


def test_the_elbow_is_as_at_the_readings_or_up():
    pair = ModelPair(CHAIN, DESIGN, TRUTH)
    readings = np.zeros((3, 6))
    readings[:, 2] = 1.6123 + np.array([0.0, -0.5, 0.5])  # stretched, and bent to both sides
    maps = [error_map(pair, q, (1, 2), 0.05, np.zeros((P, P)), NONE) for q in readings]
    heights = []
    for found in maps:
        reached = ~np.isnan(found.error)
        frames = joint_frames(CHAIN, DESIGN, found.q[reached])
        middle = 0.5 * (frames[:, 1, 2, 3] + found.point[reached][:, 2])
        heights.append(float((frames[:, 2, 2, 3] - middle).mean()))
    assert heights[0] == max(heights) > min(heights)


def test_the_uncertainty_is_that_of_the_covariance(estimate):
    """σ of a cell against the spread of the end over robots drawn from the covariance (200 draws: 5 %, in 3D 3 %)."""
    params, covariance = estimate.value[:P], estimate.covariance[:P, :P]
    pair = ModelPair(CHAIN, DESIGN, params)
    found = error_map(pair, np.zeros(6), (1, 2), 0.2, covariance, NONE)
    reached = ~np.isnan(found.error)
    q = found.q[reached]
    rng = np.random.default_rng(4)
    drawn = rng.multivariate_normal(params, covariance, 200, method="svd")
    spread = np.stack([forward(CHAIN, one, q)[:, :3, 3] for one in drawn]) - forward(CHAIN, params, q)[:, :3, 3]
    sigma = np.sqrt(np.mean(np.sum(spread**2, axis=2), axis=0))
    np.testing.assert_allclose(found.sigma[reached], sigma, rtol=0.25)
    assert np.mean(found.sigma[reached] / sigma) == pytest.approx(1.0, abs=0.06)


def test_what_is_unseen_or_unmeasured_is_said(result, tmp_path, run):
    pair = ModelPair(CHAIN, DESIGN, TRUTH)
    moving = np.array([[float(name == "link4.x")] for name in CHAIN.parameter_names])
    found = error_map(pair, np.zeros(6), (1, 2), 0.2, np.eye(P), moving)
    assert np.isnan(found.sigma).all()
    assert np.isfinite(found.error).any()
    cells = int(np.isfinite(found.error).sum())
    assert Finding("map-sigma-unknown", {"n": cells, "cells": cells}) in map_findings(
        read_calibration(result), Section(cell=0.2), found
    )
    # Without --at, the other joints are in the middle of the readings, and the elbow is as there.
    assert run("map", result, "--cell-mm", 40, "--out", tmp_path / "map.csv").code == 0
    rows = list(csv.DictReader((tmp_path / "map.csv").open()))
    q = np.radians([[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows])
    seen = read_result(result).joint_range
    lower, upper = np.array(seen.lower), np.array(seen.upper)
    others = [0, 3, 4, 5]
    np.testing.assert_allclose(q[:, others], np.tile(0.5 * (lower + upper)[others], (len(q), 1)), atol=1e-6)
    assert len(rows) > 100
    assert (np.abs(q - 0.5 * (lower + upper)) <= 0.5 * (upper - lower) + NEAR_OBSERVED + 1e-6).all()
    assert {row["covered"] for row in rows} == {"1"}


@pytest.mark.parametrize(("name", "relative"), [("link1.x", ("base",)), ("link7.x", ("tool",)), ("link4.x", ())])
def test_a_direction_that_only_places_base_or_tool_leaves_relative_errors(result, name, relative):
    """Their standard deviation is known, that of any other direction is not."""
    calibration = read_calibration(result)
    names = np.array(CHAIN.parameter_names)
    seen, unseen = replace(calibration, unseen=np.zeros((P, 0))), (names == name)[:, None].astype(float)
    assert unseen.any()
    section = Section(cell=0.2)
    left_out, within = replace(seen, unseen=unseen), mapped(seen, section)
    assert unseen_within(left_out)[1] == relative
    sigma = mapped(left_out, section).sigma
    assert np.isnan(sigma).all() if not relative else np.array_equal(sigma, within.sigma, equal_nan=True)
    (spread,) = (of.values for of in map_findings(left_out, section, within) if of.code == "map-sigma")
    assert spread["relative_to"] == list(relative)


def test_the_best_region_is_found_by_hand_too():
    error = np.array([[1.0, 5.0, 2.0, 2.0], [3.0, np.nan, 2.0, 1.0], [1.0, 1.0, 9.0, 2.0]])
    shape = (*error.shape, 1)
    grid = ErrorMap(
        np.arange(4) + 0.5, np.arange(3) + 0.5, np.eye(3)[:2], np.zeros(shape), np.zeros(shape), error, error
    )
    found = best_region(grid, 2.0, 2.0)
    assert found[:3] == ((2.0, 4.0), (0.0, 2.0), 2.0)
    assert found.rms == pytest.approx(np.sqrt(13 / 4))
    assert best_region(grid, 2.0, 0.5).largest == 1.0
    assert best_region(grid, 4.0, 3.0) is None  # a cell is out of reach
    assert best_region(grid, 5.0, 1.0) is None
    assert best_region(grid, 1.0, 1.0, (0.0, 4.0, 0.0, 2.0))[:3] == ((0.0, 1.0), (0.0, 1.0), 1.0)
    assert best_region(grid, 1.0, 1.0, (1.0, 3.5, 0.0, 3.0))[:3] == ((1.0, 2.0), (2.0, 3.0), 1.0)
    assert best_region(grid, 1.0, 1.0, (1.0, 3.0, 0.0, 2.0)).largest == 2.0
    assert best_region(grid, 3.0, 1.0, (1.0, 3.0, 0.0, 2.0)) is None


def test_a_section_of_an_arm_whose_controller_has_its_own_calibration():
    """Its axes are parallel to a milliradian only; the cells are where the drawing's section has them."""
    chain = builtin_robot("ur5e").chain
    n = len(chain.parameters)
    turned = [
        name.startswith(("joint2.", "joint3.")) and chain.parameters[i].unit == "rad"
        for i, name in enumerate(chain.parameter_names)
    ]
    nominal = chain.params_nominal + 1e-3 * np.array(turned)
    found = error_map(ModelPair(chain, nominal, nominal), np.zeros(6), (1, 2), 0.1, np.zeros((n, n)), np.zeros((n, 0)))
    reached = ~np.isnan(found.error)
    middles = np.stack(np.meshgrid(found.u, found.v), axis=-1)
    off = np.abs((found.point @ found.axes.T)[reached] - middles[reached])
    assert off.max() < 0.5 * 0.1 + 1e-9  # in its cell
    assert np.median(off) < 1e-6


@pytest.mark.parametrize("cell", [0.012, 0.05])
def test_a_map_has_no_holes_and_its_cells_are_at_their_middles(cell):
    """An empty cell between four full ones would be one that the search has missed."""
    found = error_map(ModelPair(CHAIN, DESIGN, TRUTH), np.zeros(6), (1, 2), cell, np.zeros((P, P)), NONE)
    full = ~np.isnan(found.error)
    inner = full[:-2, 1:-1] & full[2:, 1:-1] & full[1:-1, :-2] & full[1:-1, 2:]
    assert inner.sum() > 500
    assert full[1:-1, 1:-1][inner].all()
    off = (
        found.point[1:-1, 1:-1][inner] @ found.axes.T
        - np.stack(np.meshgrid(found.u, found.v), axis=-1)[1:-1, 1:-1][inner]
    )
    assert np.mean(np.abs(off).max(axis=1) < 2e-3 * cell) > 0.99  # at the rim a middle may be out of reach
    lower, upper = (np.array([getattr(joint, end) for joint in CHAIN.joints]) for end in ("lower", "upper"))
    assert ((found.q[full] >= lower) & (found.q[full] <= upper)).all()


def test_a_section_over_a_whole_turn_has_no_holes():
    """Joint 2 of a UR turns once, and both its ends are one posture: a solution may lie beyond the nearer one."""
    chain = builtin_robot("ur10e").chain
    nominal, q = chain.params_nominal, np.radians([0.0, -90.0, 90.0, 0.0, 90.0, 0.0])
    p = nominal.size
    found = error_map(ModelPair(chain, nominal, nominal), q, (1, 2), 0.025, np.zeros((p, p)), np.zeros((p, 0)))
    full = ~np.isnan(found.error)
    inner = full[:-2, 1:-1] & full[2:, 1:-1] & full[1:-1, :-2] & full[1:-1, 2:]
    assert inner.sum() > 5000
    assert full[1:-1, 1:-1][inner].all()


def test_a_page_of_many_cells_stays_small(result, tmp_path, run):
    table, page = tmp_path / "map.csv", tmp_path / "map.html"
    assert run("map", result, "--cell-mm", 12, "--out", table, "--report", page).code == 0
    with table.open() as file:
        cells = len(list(file)) - 1
    text = page.read_text()
    assert cells > 6000
    assert len(text) < 1.3e6
    squares, step = text.count("<title>") - 1, int(re.search(r"(\d+)² cells", text)[1])
    assert squares == pytest.approx(cells / step**2, rel=0.1)
