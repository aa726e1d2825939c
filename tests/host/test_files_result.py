"""result.json of any estimate is strict JSON and is read back as written."""

import json
import math
import random
import re
from dataclasses import replace
from pathlib import Path

import correct_bench
import msgspec
import mutations
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from puma_bench import RIG, SIGMA, random_table
from result_schema import signed

import truearm
from truearm.errors import InputError
from truearm.estimate.result_document import result_of
from truearm.estimate.result_file import (
    Covariance,
    Input,
    RobotFrames,
    input_of,
    parse_result,
    read_result,
    write_result,
)
from truearm.kinds.columns import ORIGINS, identifiers
from truearm.kinds.table_file import parse_table
from truearm.report.result_findings import result_findings
from truearm.results import Addition, Estimate, Figures, HeldOut, NullDirection, Observability, Unusable
from truearm.text import strict_json

RESULTS = Path(__file__).parents[1] / "data" / "results"
ROBOT = RobotFrames("arm", "base", "tip", ("rad",))
TABLE = parse_table("kind,q1_rad,place,socket\nseat,0,a,0\nseat,1,a,0\nseat,2,b,0\n", "t.csv")

numbers = st.floats(allow_nan=True, allow_infinity=True)
sizes = st.floats(0.0) | st.just(math.nan)
finite = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def estimates(draw: st.DrawFn) -> Estimate:
    p = draw(st.integers(1, 5))

    def vector(values: st.SearchStrategy[float]) -> np.ndarray:
        return np.array(draw(st.lists(values, min_size=p, max_size=p)))

    free = np.array(draw(st.lists(st.booleans(), min_size=p, max_size=p)))
    held_out = st.none() | st.builds(
        HeldOut,
        st.fixed_dictionaries({"m": st.builds(Figures, sizes, sizes, sizes, st.integers(1, 9))}),
        st.integers(1, 9),
    )
    return Estimate(
        status=draw(st.sampled_from(["converged", "max_iterations", "stalled"])),
        message=draw(st.text(max_size=20)),
        solver="lm",
        iterations=draw(st.integers(0, 50)),
        parameter_names=tuple(f"link{i}.x" for i in range(p)),
        units=tuple(draw(st.lists(st.sampled_from(["m", "rad", "1"]), min_size=p, max_size=p))),
        nominal=vector(finite),
        value=vector(numbers),
        sigma=vector(sizes),
        free=free,
        identifiable=free & np.array(draw(st.lists(st.booleans(), min_size=p, max_size=p))),
        covariance=np.square(np.diag(vector(st.floats(1e-9, 1e9)))),
        n_robot_parameters=draw(st.integers(0, p)),
        n_observations=2,
        rank=1,
        rank_gap=draw(sizes),
        null_space=(NullDirection(("link0.x",), (1.0,)),),
        rms_before={"m": draw(sizes)},
        rms_after={"m": draw(sizes)},
        rms_history={"m": (1.0, draw(sizes))},
        chi2_reduced=draw(sizes),
        held_out=draw(held_out),
        held_out_before=draw(held_out),
        residual={"m": np.zeros(3)},
        residual_before={"m": np.zeros(3)},
        fitted=np.array([True, True, False]),
        seconds=0.1,
        chi2_band=(draw(sizes), draw(sizes)),
        distance=np.array([draw(sizes), draw(sizes), math.nan]),
        weight=np.array([1.0, 0.0, math.nan]),
        suspect=np.array([*draw(st.tuples(st.booleans(), st.booleans())), False]),
        observability=draw(st.none() | st.builds(Observability, sizes, sizes, sizes, sizes)),
        suggested_free=np.zeros(0, dtype=bool),
        additions=(Addition("pairing", ("c0", "s1"), 2, ("link0.x",), "measure both"),),
    )


def refuse(constant: str) -> None:
    raise AssertionError(constant)


@settings(max_examples=80, deadline=None)
@given(estimates())
def test_any_estimate_is_strict_json_and_comes_back(estimate: Estimate) -> None:
    result = result_of(estimate, TABLE, ROBOT)
    text = strict_json(result.document)
    assert json.loads(text, parse_constant=refuse) == result.document
    assert parse_result(text, "r.json") == result
    assert result.robot == ROBOT
    assert result.column("name").tolist() == list(estimate.parameter_names)
    np.testing.assert_array_equal(result.column("nominal"), estimate.nominal)
    np.testing.assert_array_equal(
        result.column("value"), np.where(np.isfinite(estimate.value), estimate.value, math.nan)
    )
    shown = estimate.free & estimate.identifiable & np.isfinite(estimate.sigma)
    np.testing.assert_array_equal(result.column("sigma"), np.where(shown, estimate.sigma, math.nan))
    covariance = estimate.covariance[np.ix_(estimate.free, estimate.free)]
    np.testing.assert_allclose(result.covariance.matrix, covariance, rtol=1e-8)
    of_robot = np.arange(len(estimate.units)) < estimate.n_robot_parameters
    np.testing.assert_array_equal(result.column("of") == "robot", of_robot)


@settings(max_examples=20, deadline=None)
@given(estimates())
def test_rows_are_counted_by_kind(estimate: Estimate) -> None:
    estimate = replace(
        estimate,
        residual={"m": 1e-3 * np.array([3.0, -4.0, 7.0]), "rad": np.array([0.3, 0.4, np.nan])},
        residual_before={"m": np.array([1.0, np.nan, 2.0]), "rad": np.array([1.0, 1.0, np.nan])},
        rms_before={"m": 1.0, "rad": 1.0},
        rms_after={"m": 1.0, "rad": 1.0},
        weight=np.array([1.0, 0.5, math.nan]),
    )
    (counts,) = result_of(estimate, TABLE, ROBOT).observations
    found = {key: counts.pop(key) for key in list(counts) if key.startswith("rms_")}
    names = {f"{column}s": 0 for column in identifiers() if column not in ORIGINS} | {"places": 1, "sockets": 1}
    assert counts == {"rig": "", "kind": "seat", "fitted": 2, "held_out": 1, **names}
    assert found == {
        "rms_before_mm": 1000.0,  # of the rows that have a residual
        "rms_after_mm": pytest.approx(math.sqrt(12.5)),
        "rms_held_out_mm": pytest.approx(7.0),
        "rms_before_deg": pytest.approx(math.degrees(1.0)),
        "rms_after_deg": pytest.approx(math.degrees(math.sqrt(0.125))),
        "rms_held_out_deg": None,
    }
    (counts,) = result_of(replace(estimate, weight=np.array([1.0, 0.0, math.nan])), TABLE, ROBOT).observations
    assert counts["fitted"] == 1, "a row that was left out is not fitted"
    assert counts["rms_after_mm"] == pytest.approx(3.0)


json_values = st.recursive(
    st.none() | st.booleans() | finite | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
)


@given(json_values)
def test_the_layout_changes_nothing(value: object) -> None:
    assert json.loads(strict_json(value)) == value


def test_a_result_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    path.write_text("old")
    result = read_result(RESULTS / "version3.json")
    write_result(path, result)
    assert read_result(path) == result
    assert [p.name for p in tmp_path.iterdir()] == ["r.json"]
    with pytest.raises(InputError, match="cannot be written"):
        write_result(tmp_path / "none" / "r.json", result)


def test_inputs_are_known_by_name_and_hash(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(b"abc")
    # FIPS 180-2, B.1
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert input_of("observations", path) == Input("observations", "t.csv", digest)


@pytest.mark.parametrize("n", [150, pytest.param(1500, marks=pytest.mark.soak)])
def test_a_damaged_result_is_refused_or_the_same(tmp_path: Path, n: int) -> None:
    """Bits, bytes, lines, words and numbers changed: one clear line, or the very content that was written."""
    path = correct_bench.write(tmp_path / "result.json", correct_bench.identified())
    text = path.read_text()
    whole = read_result(path)
    rng, same = random.Random(n), 0
    for _ in range(n):
        path.write_bytes(mutations.text_changed(rng, text))
        try:
            found = read_result(path)
        except InputError as error:
            mutations.is_clear(error, str(path))
        else:
            assert json.loads(path.read_text()) == whole.document
            assert found == whole
            same += 1
    assert same < 0.1 * n


WRONG = {
    "a negative error": (("rms_after_mm",), -0.1, "rms_after_mm: expected float >= 0.0"),
    "a status that no solver has": (("status",), "fine", "status: invalid enum value 'fine'"),
    "an unknown unit": (("parameters", 0, "unit"), "furlong", "parameters[0].unit: expected str matching"),
    "a unit with a line's end": (("parameters", 0, "unit"), "m\n", "parameters[0].unit: expected str matching"),
    "a negative gap of the rank": (("rank_gap",), -2.0, "rank_gap: expected float >= 0.0"),
    "a direction without weights": (("null_space",), [{"names": ["link1.x"], "weights": []}], "null_space[0]: needs"),
    "a covariance of other parameters": (("covariance", "names", 0), "x", "parameters: their names"),
    "a part of the covariance": (("covariance", "upper"), "AAAAAAAA8D8=", "covariance: upper needs 666 numbers"),
    "a covariance in words": (("covariance", "upper"), "none", "covariance: upper needs 666 numbers for 36 names"),
    "a curve of one knot": (
        ("joint_laws",),
        {"laws": [{"term": "curve", "joint": 0, "first_rad": 0, "spacing_rad": 1, "count": 1, "periodic": False}]},
        "joint_laws.laws[0].count: expected int >= 4",
    ),
    "a law of an unknown term": (("joint_laws",), {"laws": [{"term": "magic"}]}, "laws[0].term: invalid value 'magic'"),
    "lists in lists in lists": (("suspect",), [{"a": [[[0.1]]]}], "suspect[0][...][0][0]: expected float, got array"),
    "a version that is a truth value": (("format_version",), True, "format_version: expected int, got bool"),
    "a range of one joint": (("joint_range", "lower"), [0.0], "joint_range: needs 6 numbers each"),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result.json of 90 lengths of the PUMA (seed 71)."""
    rows = random_table(90, np.random.default_rng(71), SIGMA)
    result = truearm.identify(truearm.load_robot("puma560"), rows, RIG)
    path = tmp_path_factory.mktemp("written") / "result.json"
    write_result(path, result.stored)
    return path


@pytest.mark.parametrize("what", WRONG)
def test_a_field_of_another_type_or_beyond_its_bounds_is_refused_though_the_checksum_is_right(what, written) -> None:
    """As from a program that edits results, and writes the checksum anew."""
    place, value, message = WRONG[what]
    document = json.loads(written.read_text())
    parent = document
    for key in place[:-1]:
        parent = parent[key]
    parent[place[-1]] = value
    with pytest.raises(InputError, match=re.escape(message)):
        parse_result(signed(document), "r.json")


def test_a_value_that_a_person_may_write_is_read(written) -> None:
    document = json.loads(written.read_text())
    document["parameters"][0]["value"] += 1e-4
    document["message"] = "link1.x was measured by hand"
    document["later"] = "a field that this version does not have"
    found = parse_result(signed(document), "r.json")
    assert found.parameters[0].value == document["parameters"][0]["value"]
    assert found.message == "link1.x was measured by hand"


@pytest.mark.parametrize("n", [0, 1, 2, 30])
def test_a_covariance_has_all_variances_though_it_is_nearly_singular(n: int) -> None:
    """Combinations that are known 1e5 times better than each parameter, in units that differ by 1e6."""
    random = np.random.default_rng(n)
    directions, units = np.linalg.qr(random.normal(size=(n, n)))[0], np.logspace(-3.0, 3.0, n)
    root = units[:, None] * directions * np.logspace(0.0, -5.0, n)
    names = [f"p{i}" for i in range(n)]
    packed = Covariance.of(names, names, root @ root.T)
    again = msgspec.json.decode(msgspec.json.encode(packed), type=Covariance)
    assert again == packed
    inverse = np.linalg.inv(root)
    np.testing.assert_allclose(inverse @ again.matrix @ inverse.T, np.eye(n), rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(np.diag(again.matrix), np.square(root).sum(axis=1), rtol=1e-8)


def test_packed_covariances_of_curves_and_unknown_sigmas():
    # Of 700 coefficients the readings determine 200; the others are as the prior has them.
    jacobian = np.random.default_rng(0).normal(size=(300, 200))
    matrix = np.eye(700)
    matrix[:200, :200] = np.linalg.inv(np.eye(200) + jacobian.T @ jacobian)
    names = [f"p{i}" for i in range(700)]
    packed = Covariance.of(names, names, matrix)
    assert len(msgspec.json.encode(packed)) < 700 * 701 // 2 * 8 // 8
    np.testing.assert_allclose(packed.matrix, matrix, rtol=0.0, atol=1e-8)
    packed = Covariance.of(["a", "b"], ["m", "m"], np.array([[4.0, math.nan], [math.nan, math.nan]]))
    assert packed.sigma == (2.0, None)
    np.testing.assert_array_equal(packed.matrix, [[4.0, math.nan], [math.nan, math.nan]])


@pytest.mark.parametrize("version", [1, 2, 3])
def test_results_of_earlier_versions_are_read_and_written_anew(version: int, tmp_path: Path) -> None:
    """Files that the programs of these versions wrote (tests/data/results)."""
    earlier = json.loads((RESULTS / f"version{version}.json").read_text())
    assert earlier["format_version"] == version
    found = read_result(RESULTS / f"version{version}.json")
    for name in ("name", "unit", "nominal", "value", "sigma", "free", "of"):
        assert [getattr(parameter, name) for parameter in found.parameters] == [p[name] for p in earlier["parameters"]]
    covariance = np.array(earlier["covariance"]["matrix"], dtype=float)
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.covariance.matrix, covariance, rtol=0.0, atol=1e-8 * np.outer(sigma, sigma).max())
    assert list(found.covariance.names) == earlier["covariance"]["names"]
    assert [list(direction.names) for direction in found.null_space] == [d["names"] for d in earlier["null_space"]]
    for name in set(earlier) & set(found.document) - {
        "format_version",
        "checksum",
        "covariance",
        "made_with",
        "prior",
        "explanations",
    }:
        assert found.document[name] == earlier[name], name
    assert all(finding.text() for finding in result_findings(found.document))
    write_result(tmp_path / "r.json", found)
    assert read_result(tmp_path / "r.json") == found
    assert json.loads((tmp_path / "r.json").read_text())["format_version"] == 4


def test_earlier_results_are_read_in_todays_words():
    earlier = json.loads((RESULTS / "version2.json").read_text())
    assert parse_result(json.dumps(earlier), "r.json").unusable_because is None
    earlier |= {"status": "stalled", "prior": "default", "made_with": {"prior": "default"}}
    found = parse_result(json.dumps(earlier), "r.json")
    assert (found.usable, found.unusable_because) == (False, Unusable.NOT_CONVERGED)
    assert (found.prior, found.made_with) == ("where-needed", {"prior": "where-needed"})
    earlier = json.loads((RESULTS / "version2.json").read_text())
    earlier["pose_error"] = {"sigma_mm": 0.1, "row_variance": 1.5, "n": 40}
    found = parse_result(json.dumps(earlier), "r.json")
    assert found.document["pose_error"] == {"shared_mm": 0.1, "factor": 1.5, "n": 40}
    ((term,),) = (f.values["terms"] for f in result_findings(found.document) if f.code == "pose-error")
    assert term.startswith("0.1 mm ")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["matrix"].pop(), "covariance: needs"),
        (lambda c: c["matrix"][0].pop(), "covariance: needs"),
        (lambda c: c["units"].pop(), "covariance: needs 18 units"),
        (lambda c: c["matrix"][0].__setitem__(0, "1"), "covariance.matrix[0][0]: expected float | null, got str"),
        (lambda c: c.pop("matrix"), "covariance: object missing required field matrix"),
    ],
)
def test_damaged_results_of_earlier_versions_are_one_line(change, message) -> None:
    earlier = json.loads((RESULTS / "version2.json").read_text())
    change(earlier["covariance"])
    with pytest.raises(InputError, match=re.escape(message)):
        parse_result(json.dumps(earlier), "r.json")
