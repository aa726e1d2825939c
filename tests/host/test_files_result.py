"""result.json of any estimate is strict JSON and is read back as written."""

import json
import math
import random
import re
from dataclasses import replace
from pathlib import Path

import correct_bench
import mutations
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from puma_bench import RIG, SIGMA, random_table

import truearm
from truearm.errors import InputError
from truearm.files.observation_table import parse_table
from truearm.files.result_document import document_of
from truearm.files.result_file import RobotFrames, format_document, input_of, with_checksum, write_result
from truearm.files.stored_result import read_result, stored_result
from truearm.kinds.registry import ORIGINS, identifiers
from truearm.results import Addition, Estimate, Figures, HeldOut, NullDirection, Observability, Relabelling

ROBOT = RobotFrames("arm", "base", "tip", ("rad",))
TABLE = parse_table("kind,q1_rad,place,socket\nseat,0,a,0\nseat,1,a,0\nseat,2,b,0\n", "t.csv")

numbers = st.floats(allow_nan=True, allow_infinity=True)
finite = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def estimates(draw: st.DrawFn) -> Estimate:
    p = draw(st.integers(1, 5))

    def vector(values: st.SearchStrategy[float]) -> np.ndarray:
        return np.array(draw(st.lists(values, min_size=p, max_size=p)))

    free = np.array(draw(st.lists(st.booleans(), min_size=p, max_size=p)))
    held_out = st.none() | st.builds(
        HeldOut,
        st.fixed_dictionaries({"m": st.builds(Figures, numbers, numbers, numbers, st.integers(1, 9))}),
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
        sigma=vector(numbers),
        free=free,
        identifiable=free & np.array(draw(st.lists(st.booleans(), min_size=p, max_size=p))),
        covariance=np.outer(vector(finite), np.ones(p)),
        n_robot_parameters=draw(st.integers(0, p)),
        n_observations=2,
        rank=1,
        rank_gap=draw(numbers),
        null_space=(NullDirection(("link0.x",), (1.0,)),),
        rms_before={"m": draw(numbers)},
        rms_after={"m": draw(numbers)},
        rms_history={"m": (1.0, draw(numbers))},
        chi2_reduced=draw(numbers),
        held_out=draw(held_out),
        held_out_before=draw(held_out),
        residual={"m": np.zeros(3)},
        residual_before={"m": np.zeros(3)},
        fitted=np.array([True, True, False]),
        seconds=0.1,
        chi2_band=(draw(numbers), draw(numbers)),
        distance=np.array([draw(numbers), draw(numbers), math.nan]),
        weight=np.array([1.0, 0.0, math.nan]),
        suspect=np.array([*draw(st.tuples(st.booleans(), st.booleans())), False]),
        observability=draw(st.none() | st.builds(Observability, numbers, numbers, numbers, numbers)),
        suggested_free=np.zeros(0, dtype=bool),
        additions=(Addition("pairing", ("c0", "s1"), 2, ("link0.x",), "measure both"),),
        relabellings=(
            Relabelling((0, 2), ("chuck", "sphere"), ("c0", "s0"), ("c1", "s0"), draw(numbers), draw(numbers)),
        ),
    )


def refuse(constant: str) -> None:
    raise AssertionError(constant)


@settings(max_examples=80, deadline=None)
@given(estimates())
def test_any_estimate_is_strict_json_and_comes_back(estimate: Estimate) -> None:
    text = format_document(document_of(estimate, TABLE, ROBOT, []))
    stored = stored_result(json.loads(text, parse_constant=refuse))  # not checked: its numbers are drawn independently
    assert stored.robot == ROBOT
    assert stored.parameter_names == estimate.parameter_names
    np.testing.assert_array_equal(stored.nominal, estimate.nominal)
    np.testing.assert_array_equal(stored.value, np.where(np.isfinite(estimate.value), estimate.value, math.nan))
    shown = estimate.free & estimate.identifiable & np.isfinite(estimate.sigma)
    np.testing.assert_array_equal(stored.sigma, np.where(shown, estimate.sigma, math.nan))
    np.testing.assert_array_equal(stored.covariance, estimate.covariance[np.ix_(estimate.free, estimate.free)])
    np.testing.assert_array_equal(stored.of_robot, np.arange(len(estimate.units)) < estimate.n_robot_parameters)


@settings(max_examples=20, deadline=None)
@given(estimates())
def test_rows_are_named_by_their_source(estimate: Estimate) -> None:
    document = document_of(estimate, TABLE, ROBOT, [])
    assert document["relabellings"][0]["rows"] == ["t.csv row 2", "t.csv row 4"]
    addition = {"kind": "pairing", "names": ["c0", "s1"], "rank": 2, "parameters": ["link0.x"], "text": "measure both"}
    assert document["additions"] == [addition]
    named = {f"t.csv row {row + 2}" for row in np.flatnonzero(estimate.suspect)}
    assert {entry["source"] for entry in document["suspect"]} == named
    far = [entry["distance"] for entry in document["suspect"]]
    assert None in far or far == sorted(far, reverse=True)


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
    (counts,) = document_of(estimate, TABLE, ROBOT, [])["observations"]
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
    (counts,) = document_of(replace(estimate, weight=np.array([1.0, 0.0, math.nan])), TABLE, ROBOT, [])["observations"]
    assert counts["fitted"] == 1, "a row that was left out is not fitted"
    assert counts["rms_after_mm"] == pytest.approx(3.0)


json_values = st.recursive(
    st.none() | st.booleans() | finite | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
)


@given(json_values)
def test_the_layout_changes_nothing(value: object) -> None:
    assert json.loads(format_document(value)) == value


def test_a_result_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    path.write_text("old")
    with pytest.raises(ValueError, match="JSON"):
        write_result(path, {"before": [[1.0], [2.0]], "a": math.nan})
    assert path.read_text() == "old"
    assert [of.name for of in tmp_path.iterdir()] == ["r.json"], "nothing is left of a file that was not completed"
    write_result(path, {"a": 1.5})
    assert json.loads(path.read_text()) == {"a": 1.5}
    assert [p.name for p in tmp_path.iterdir()] == ["r.json"]
    with pytest.raises(InputError, match="cannot be written"):
        write_result(tmp_path / "none" / "r.json", {})


def test_inputs_are_known_by_name_and_hash(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(b"abc")
    # FIPS 180-2, B.1
    digest = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert input_of("observations", path) == ("observations", "t.csv", digest)


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
            assert json.loads(path.read_text()) == whole.document == found.document
            np.testing.assert_array_equal(found.value, whole.value)
            np.testing.assert_array_equal(found.covariance, whole.covariance)
            same += 1
    assert same < 0.1 * n


FINDING = {"form": "offset", "rows": [3, 9], "first_within": [3, 3], "last_within": [9, 9], "unit": "m", "chance": 1e-9}
IMPOSSIBLE = {
    "a negative error": (("rms_after_mm",), -0.1, "rms_after_mm: '-0.1' is not a size"),
    "an error in words": (("rms_after_mm",), "small", "rms_after_mm: 'small' is not a size"),
    "an error that overflows": (("chi2_reduced",), 1e300, "chi2_reduced: is too large for a number of a result"),
    "a parameter that overflows": (("parameters", 0, "value"), 1e300, "parameter link1.x: is larger than any"),
    "a variance that overflows": (("covariance", "matrix", 0, 0), 1e300, "parameter link1.x: its sigma is not that"),
    "a status that no solver has": (("status",), "fine", "status: 'fine' is not one of 'converged'"),
    "a solver that does not exist": (("solver",), "magic", 'solver: \'magic\' is not one of "lm", "map"'),
    "a loss that does not exist": (("loss",), "tukey", 'loss: \'tukey\' is not one of "linear", "huber"'),
    "a prior that does not exist": (("prior",), "strong", "prior: 'strong' is not one of \"none\""),
    "a verdict that is no truth value": (("usable",), "maybe", "usable: 'maybe' is not one of true, false"),
    "a verdict that is a number": (("usable",), 1, "usable: 1 is not one of true, false"),
    "a list of solvers": (("solver",), ["lm"], "solver: a list is not one of"),
    "a reason that does not exist": (("unusable_because",), "luck", "unusable_because: 'luck' is not one of null"),
    "a usable fit with a reason why it is not": (("unusable_because",), "residuals", "usable: contradicts unusable_"),
    "half an observation": (("n_observations",), 88.5, "n_observations: '88.5' is not a count"),
    "a parameter that is free in one list only": (("parameters", 0, "free"), False, "free: is not the list"),
    "an unknown unit": (("parameters", 0, "unit"), "furlong", "parameter link1.x: its unit is not known"),
    "a suggestion to free what the robot does not have": (("suggested_free", 0), "link9.x", "suggested_free: names"),
    "a suggestion that is a number": (("suggested_free",), 7, "suggested_free: needs a list"),
    "a suggestion in a list of its own": (("suggested_free", 0), ["link1.x"], "suggested_free: item 1: a list is not"),
    "an error held out that is a number": (("held_out",), 0.1, "held_out: "),
    "an unexplained part that is a list": (("unexplained",), [0.1], "unexplained: "),
    "a band that is a number": (("chi2_band",), 1.0, "chi2_band: needs a list of 2 values"),
    "systematic errors that are none": (("systematic",), None, "systematic: needs a list"),
    "a systematic error that is a number": (("systematic",), [1], "systematic: item 1: "),
    "a systematic error without rows": (("systematic",), [{"form": "offset"}], "systematic: item 1: "),
    "an explanation in a word": (("explanations",), ["units"], "explanations: item 1: "),
    "a rank in words": (("rank",), "full", "rank: 'full' is not a count"),
    "a rank that is a truth value": (("rank",), True, "rank: 'True' is not a count"),
    "more independent parameters than are free": (("rank",), 37, "rank: is larger than n_free"),
    "a negative gap of the rank": (("rank_gap",), -2.0, "rank_gap: is negative"),
    "a gap in words": (("rank_gap",), "wide", "rank_gap: 'wide' is of another type"),
    "half an iteration": (("iterations",), 4.5, "iterations: '4.5' is not a count"),
    "iterations that are missing": (("iterations",), None, "iterations: null is of another type"),
    "a list of free parameters as their number": (("n_free",), ["link1.x"], "n_free: "),
    "a χ² that is a truth value": (("chi2_reduced",), True, "chi2_reduced: 'True' is not a size"),
    "a message that is a number": (("message",), 3, "message: 3 is of another type"),
    "a search that is none": (("relabelling_search",), False, "relabelling_search: false is of another type"),
    "a band from its end to its beginning": (("chi2_band",), [1.1, 0.9], "chi2_band: are not in order"),
    "a mean beyond its range": (
        ("unexplained",),
        {"by": "held out", "mean_mm": 0.5, "low_mm": 0.1, "high_mm": 0.4, "n_mm": 9},
        "mean_mm, high_mm: are not in order",
    ),
    "an RMS beyond the largest error": (
        ("held_out",),
        {"rms_mm": 2.0, "max_mm": 1.0, "n": 3},
        "rms_mm, max_mm: are not",
    ),
    "a systematic error from its last row to its first": (
        ("systematic",),
        [FINDING | {"rows": [9, 3]}],
        "systematic: item 1: rows: are not in order",
    ),
    "a systematic error of no form": (
        ("systematic",),
        [FINDING | {"form": "jump"}],
        "systematic: item 1: its form or unit is not known",
    ),
    "a chance beyond certainty": (
        ("systematic",),
        [FINDING | {"chance": 1.5}],
        "systematic: item 1: chance: is larger",
    ),
    "an explanation that is not known": (("explanations",), [{"what": "luck"}], "explanations: item 1: what: 'luck'"),
    "a negative variance": (("covariance", "matrix", 0, 0), -1e-9, "covariance: exceeds its variances"),
    "a sigma of another covariance": (("parameters", 0, "sigma"), 1.0, "parameter link1.x: its sigma is not that"),
    "options that are a number": (("made_with",), 7, "made_with: allow: is not a list of texts"),
    "an allowed error that is no text": (("made_with", "allow"), {"a": 1}, "made_with: allow: is not a list of texts"),
    "a range from the end to the beginning": (
        ("joint_range", "lower", 0),
        9.0,
        "joint_range: joint 1: are not in order",
    ),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result.json of 90 lengths of the PUMA (seed 71)."""
    rows = random_table(90, np.random.default_rng(71), SIGMA)
    result = truearm.identify(truearm.load_robot("puma560"), rows, RIG)
    path = tmp_path_factory.mktemp("written") / "result.json"
    write_result(path, result.document)
    return path


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_numbers_that_no_result_can_have_are_refused_though_the_checksum_is_right(what, written, tmp_path) -> None:
    """As from a program that edits results, and writes the checksum anew."""
    place, value, message = IMPOSSIBLE[what]
    document = json.loads(written.read_text())
    at = document
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = value
    path = tmp_path / "r.json"
    path.write_text(json.dumps(with_checksum(document)))
    with pytest.raises(InputError, match=re.escape(message)):
        read_result(path)


def test_a_value_that_a_person_may_write_is_read(written, tmp_path) -> None:
    document = json.loads(written.read_text())
    document["parameters"][0]["value"] += 1e-4
    document["message"] = "link1.x was measured by hand"
    path = tmp_path / "r.json"
    path.write_text(json.dumps(with_checksum(document)))
    assert read_result(path).value[0] == document["parameters"][0]["value"]
