"""Schemas: values are read back bit for bit; anything else in a file is refused in one line that names the key."""

import math
import subprocess
import sys
import time
import tomllib
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from truearm.box.configuration import with_file
from truearm.errors import ConfigError, RigError, RobotError
from truearm.kinds.rig_file import parse_rig
from truearm.model.robot import parse_robot
from truearm.schema import (
    IDENTIFIER,
    MAX_ENTRIES,
    Choice,
    Covariance,
    Entries,
    Key,
    List,
    Number,
    SchemaError,
    Sigmas,
    Table,
    Text,
    Whole,
    load_toml,
    read,
    sigma,
)
from truearm.units import SUFFIXES, UNITS


@dataclass(frozen=True)
class Thing:
    name: str
    length: float
    angle: float = 0.5
    spread: float | None = None
    place: tuple[float, ...] | None = None
    cov: tuple[tuple[float, ...], ...] = ()
    mode: Any = 2
    on: bool = True
    note: str = ""
    count: int = 0


@dataclass(frozen=True)
class Document:
    time: float = 0.25
    things: dict[str, Thing] | None = None
    pairs: tuple[tuple[str, ...], ...] = ()


def _thing(**values: Any) -> Thing:
    if values["length"] == 1.5:
        raise SchemaError("nothing is that long")
    return Thing(**values)


THING = Table(
    (
        Key("name", IDENTIFIER),
        Key("length", Number("m", positive=True)),
        Key("angle", Number("rad", least=-1.0, most=1.0), optional=True),
        Key("spread", sigma("s", unknown=True), optional=True),
        Key("xyz", List(Number("m"), 3), optional=True, field="place"),
        Key("cov_si", Covariance(singular=True), optional=True, field="cov"),
        Key("sigma", Sigmas(sigma("m")), optional=True, field="cov"),
        Key("mode", Choice((2, 4, "auto")), optional=True),
        Key("on", Choice((True, False)), optional=True),
        Key("note", Text(20), optional=True),
        Key("count", Whole(-5, 5), optional=True),
    ),
    _thing,
)
PAIR = Table((Key("ends", List(IDENTIFIER, 2)),), lambda ends: ends, lambda pair: {"ends": pair})
DOCUMENT = Table(
    (Key("time", Number("s"), optional=True),),
    Document,
    lambda document: {**vars(document), "things": document.things or {}},
    (Entries("thing", THING, "things", lambda thing: thing.name), Entries("pair", PAIR, "pairs")),
)

names = st.from_regex(r"[\w-]{1,64}", fullmatch=True)
things = st.builds(
    Thing,
    names,
    st.floats(1e-9, 100.0).filter(lambda length: length != 1.5),
    st.floats(-1.0, 1.0),
    st.none() | st.just(0.0) | st.floats(1e-9, 100.0),
    st.none() | st.tuples(*[st.floats(-100.0, 100.0)] * 3),
    st.just(()) | st.tuples(st.tuples(st.floats(0.0, 1e4))),
    st.sampled_from((2, 4, "auto")),
    st.booleans(),
    st.text(st.characters(exclude_categories=["Cs"]), max_size=20),
    st.integers(-5, 5),
)
documents = st.builds(
    Document,
    st.floats(-100.0, 100.0),
    st.lists(things, min_size=1, max_size=3).map(lambda some: {thing.name: thing for thing in some}),
    st.lists(st.tuples(names, names), max_size=3).map(tuple),
)


def parsed(text: str) -> Document:
    return read(DOCUMENT, tomllib.loads(text), "d.toml", RigError)


@settings(max_examples=60, deadline=None)
@given(documents)
def test_what_is_written_comes_back_bit_for_bit(document: Document) -> None:
    text = DOCUMENT.format(document)
    assert parsed(text) == document
    assert DOCUMENT.format(parsed(text)) == text


@given(st.sampled_from(sorted(set(SUFFIXES) - {""})), st.floats(-1.0, 1.0))
def test_every_suffix_is_read_as_units_has_it(suffix: str, number: float) -> None:
    scale = SUFFIXES[suffix]
    key = Key("x", Number(scale.si, most=1e9, spelled=(suffix,)))
    assert list(key.spellings) == [f"x_{suffix}"]
    assert key.parse(number, f"x_{suffix}") == number * scale.scale


@pytest.mark.parametrize("si", sorted(UNITS))
def test_bounds_are_the_units(si: str) -> None:
    number, most = Number(si), UNITS[si].largest
    own = number.suffixes[0]
    assert number.parse(most, own) == most
    assert number.parse(-most, own) == -most
    with pytest.raises(SchemaError, match="unit right"):
        number.parse(math.nextafter(most, math.inf), own)
    with pytest.raises(SchemaError, match="between 0 and"):
        sigma(si).parse(-1e-9, own)


GOOD = '[[thing]]\nname = "a"\nlength_m = 1\n'
WRONG = {
    "unknown key": ("tmie_s = 1\n", "d.toml: unknown key 'tmie_s'|time_s or time_ms"),
    "unknown suffix": ("time_us = 1\n", "d.toml: unknown key 'time_us'|time_s or time_ms"),
    "unknown key in an entry": (GOOD + "lenght_mm = 1\n", "[[thing]] 1: unknown key 'lenght_mm'|length_m or length_mm"),
    "a long key": ("x" * 5000 + " = 1\n", "unknown key '" + "x" * 40 + "'"),
    "two units": ("time_s = 1\ntime_ms = 1000\n", "time_s and time_ms"),
    "two keys of one field": (GOOD + "cov_si = [[1]]\nsigma_mm = [1]\n", "both cov_si and sigma_mm"),
    "missing": ('[[thing]]\nname = "a"\n', "d.toml: [[thing]] 1: needs length_m (or length_mm)"),
    "text": (GOOD + 'angle_deg = "abc"\n', "d.toml: [[thing]] 1: angle_deg: 'abc'"),
    "truth": (GOOD + "angle_deg = true\n", "angle_deg: true"),
    "unknown where it may not be": (GOOD + 'angle_deg = "unknown"\n', "angle_deg: 'unknown'"),
    "another word than unknown": (GOOD + 'spread_s = "unkown"\n', 'number (or "unknown")'),
    "NaN": (GOOD + "angle_rad = nan\n", "angle_rad:"),
    "a thousand digits": (GOOD + "angle_rad = 0x" + "f" * 1000 + "\n", "angle_rad:"),
    "too large": (GOOD + "angle_deg = 60\n", "angle_deg: 60 deg"),
    "negative sigma": (GOOD + "spread_ms = -1\n", "spread_ms: -1 ms"),
    "not positive": ('[[thing]]\nname = "a"\nlength_mm = 0\n', "length_mm: 0 mm"),
    "no list": (GOOD + "xyz_m = 1\n", "xyz_m: needs"),
    "a wrong item": (GOOD + 'xyz_m = [1, "2", 3]\n', "xyz_m: item 2: '2'"),
    "an empty list": (GOOD + "sigma_m = []\n", "sigma_m: needs"),
    "ragged": (GOOD + "cov_si = [[1, 0], [0]]\n", "square: 2 rows need 2 values each"),
    "deep matrix": (GOOD + "cov_si = " + "[" * 90 + "]" * 90 + "\n", "cov_si: item 1: item 1:"),
    "not symmetric": (GOOD + "cov_si = [[1, 1], [0, 1]]\n", "cov_si: must be symmetric"),
    "no choice": (GOOD + "mode = 3\n", "mode: 3"),
    "a choice of another type": (GOOD + "mode = 2.0\n", "mode: 2"),
    "no flag": (GOOD + "on = 0\n", "on: 0"),
    "no whole number": (GOOD + "count = 1.0\n", "count: 1"),
    "too large a count": (GOOD + "count = 0x" + "f" * 999 + "\n", "whole number"),
    "too long a text": (GOOD + f'note = "{"n" * 21}"\n', "at most 20 characters"),
    "an odd name": ('[[thing]]\nname = "a b"\nlength_m = 1\n', "name: 'a b'"),
    "a key at the wrong level": (GOOD + "[thing.deep]\nx = 1\n", "[[thing]] 1: unknown key 'deep'"),
    "no entries": ('[thing]\nname = "a"\n', "d.toml: thing must be written as [[thing]] entries"),
    "twice": (GOOD + GOOD, "d.toml: [[thing]] 2: 'a'"),
    "what does not go together": ('[[thing]]\nname = "a"\nlength_m = 1.5\n', "[[thing]] 1: nothing is that long"),
}


@pytest.mark.parametrize(("text", "message"), WRONG.values(), ids=WRONG.keys())
def test_what_is_wrong_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(RigError) as refused:
        parsed(text)
    assert all(part in str(refused.value) for part in message.split("|"))
    assert str(refused.value).startswith("d.toml: ")
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 250


def test_errors_are_the_callers_and_entries_bounded():
    with pytest.raises(RobotError, match=r"r\.toml: unknown key 'x'"):
        read(DOCUMENT, {"x": 1}, "r.toml", RobotError)
    with pytest.raises(RigError, match=f"{MAX_ENTRIES + 1} .*{MAX_ENTRIES}"):
        read(DOCUMENT, {"pair": [{}] * (MAX_ENTRIES + 1)}, "d.toml", RigError)


toml_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=50),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
things_wild = st.dictionaries(st.sampled_from([s for key in THING.keys for s in key.spellings]), toml_values)


documents = st.dictionaries(
    st.sampled_from(["time_s", "time_ms", "thing", "pair", "x"]), toml_values | st.lists(things_wild)
)


@settings(max_examples=30, deadline=None)
@given(documents)
def test_any_document_is_read_or_refused_in_one_line(document: dict[str, Any]) -> None:
    text = ""
    try:
        read(DOCUMENT, document, "d.toml", RigError)
    except RigError as exc:
        text = str(exc)
    assert text.isprintable()
    assert len(text) < 250


def test_declarations_cost_no_numerics() -> None:
    """What ``--help`` lists may declare its keys: importing the schema imports neither numpy nor scipy."""
    code = "import sys, truearm.schema; print(*{'numpy', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


@pytest.mark.parametrize(
    "text", ["a." * 40_000 + "b = 1", "[" + "a . " * 40_000 + "b]", "x = {" + '"a".' * 20_000 + "b = 1}"]
)
def test_a_long_dotted_key_is_refused_at_once(text):
    """tomllib took 19 s for 80 kB, and four times as long for twice as many."""
    for parse, error in (
        (lambda: parse_rig(text, "rig.toml"), RigError),
        (lambda: parse_robot(text), RobotError),
        (lambda: with_file({}, text, "box.toml"), ConfigError),
    ):
        begin = time.process_time()
        with pytest.raises(error, match="more than 32 parts in line 1"):
            parse()
        assert time.process_time() - begin < 0.5


def test_dots_that_are_no_long_key():
    text = f"note = '{'1.5 ' * 1000}{'...' * 1000}'\n" + "\n".join(f"a{k}.b.c.d = 127.0" for k in range(2000))
    assert load_toml(text)["a1999"] == {"b": {"c": {"d": 127.0}}}
