"""units.py: every entry is consistent, conversions are exact inverses, texts carry their symbol."""

import ast
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from truearm import units


@pytest.mark.parametrize("name", units.SUFFIXES)
def test_a_scale_is_filed_under_its_suffix_and_its_factor_undoes_it(name):
    scale = units.SUFFIXES[name]
    assert scale.suffix == name
    assert scale.si in units.UNITS
    assert scale.factor * scale.scale == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("si", units.UNITS)
def test_a_unit_is_shown_in_a_scale_of_its_own(si):
    unit = units.UNITS[si]
    assert unit.si == si == unit.scale.si
    assert unit.scale is units.SUFFIXES[unit.scale.suffix]
    assert unit.factor * units.suffixes(si, units.SUFFIXES)[unit.scale.suffix] == pytest.approx(1.0, abs=1e-15)
    assert unit.largest > 0.0
    assert units.SUFFIXES[next(iter(units.suffixes(si)))].scale == 1.0  # SI's own comes first


def test_scales_symbols_and_suffixes_belong_to_units():
    assert {one.suffix: one for one in vars(units).values() if isinstance(one, units.Scale)} == units.SUFFIXES
    scales = units.SUFFIXES.values()
    assert len({s.symbol for s in scales}) == len({s.suffix for s in scales}) == len(scales)


@given(st.sampled_from(sorted(units.UNITS)), st.floats(-1e3, 1e3))
def test_a_number_is_rounded_to_its_units_digits(si, value):
    number = float(units.number(value, si))
    assert math.isclose(number, units.shown(value, si), rel_tol=0.0, abs_tol=0.51 * 10.0 ** -units.UNITS[si].decimals)


@pytest.mark.parametrize("name", ["cm", "mm", "um", "ms", "us", "ns", "mrad", "urad", "ppm"])
def test_powers_of_ten_are_exact_both_ways(name):
    """1/1e-9 is 999999999.9999999: a second would not be a whole number of nanoseconds."""
    scale = units.SUFFIXES[name]
    assert scale.factor == round(scale.factor)
    assert scale.scale == 1.0 / scale.factor
    assert scale.of(1.0) == scale.factor


def test_texts_suffixes_and_lengths():
    assert units.number(85.5e-6, "m") == "0.0855"
    assert units.number(math.pi, "rad", 1) == "180.0"
    assert units.number(0.5, "1", 2) == "0.50"
    assert units.number(math.nan, "m") == "-"
    assert units.UM.text(2e-6, ".1f") == "2.0 µm"
    assert units.micro("V").text(2e-6, ".1f") == "2.0 µV"
    assert units.MRAD.text(0.005) == "5 mrad"
    assert units.ONE.text(0.5) == "0.5"
    assert [units.title("error", si) for si in ("m", "rad", "1")] == ["error [mm]", "error [deg]", "error"]
    assert [units.key("rms", si) for si in ("m", "rad", "1", "rad/s")] == ["rms_mm", "rms_deg", "rms", "rms_deg_s"]
    assert units.suffixes("m") == {"m": 1.0, "mm": 1e-3}
    assert units.suffixes("rad") == {"rad": 1.0, "deg": math.pi / 180.0}
    assert units.suffixes("m", ("mm", "um", "deg")) == {"mm": 1e-3, "um": 1e-6}
    assert units.length("um") is units.length("µm") is units.UM
    assert units.length("mm") is units.MM
    assert units.length("deg") is units.length("") is units.length("V") is None


# --- nobody else keeps units

HOST = Path(units.__file__).parent
OF_TEN = {1e3, 1e-3, 1e6, 1e-6}
TO_DEGREES = {"degrees", "rad2deg"}
# files in which such a factor is not a unit that a person sees
PHYSICAL = {
    "session/clock.py": "a drift of ppm a minute; µs of the box's timer as ns of the host's",
    "session/streams.py": "µs and ns as in clock",
    "correct/error_map.py": "a share of a cell's width",
    "report/figures.py": "a share of the largest residual",
    "box/gauge.py": "a share of the readings' span",
}


def names_of_units() -> set[str]:
    return {name for s in units.SUFFIXES.values() for name in (s.suffix, s.symbol, s.si)} - {"", "1"}


def own_units(tree: ast.AST) -> list[str]:
    """Where a module converts units by itself: tables of factors, degrees, powers of ten that numbers are multiplied by."""
    found = []
    for node in ast.walk(tree):
        match node:
            case ast.Dict(keys=keys, values=values) if len(keys) > 1:
                named = {key.value for key in keys if isinstance(key, ast.Constant)}
                numbers = any(isinstance(v, ast.Constant) and isinstance(v.value, float) for v in values)
                if numbers and len(named) == len(keys) and named <= names_of_units():
                    found.append(f"line {node.lineno}: a table of units")
            case ast.Call(func=ast.Attribute(attr=name)) if name in TO_DEGREES:
                found.append(f"line {node.lineno}: {name}()")
            case ast.BinOp(op=ast.Mult() | ast.Div(), left=left, right=right):
                constants = [side.value for side in (left, right) if isinstance(side, ast.Constant)]
                if any(type(value) is float and value in OF_TEN for value in constants):
                    found.append(f"line {node.lineno}: a factor {constants}")
    return found


def test_units_are_converted_here_alone():
    found = {
        path.relative_to(HOST).as_posix(): own_units(ast.parse(path.read_text(encoding="utf-8")))
        for path in HOST.rglob("*.py")
    }
    del found["units.py"]
    assert {name: own for name, own in found.items() if own and name not in PHYSICAL} == {}
    assert all(found[name] for name in PHYSICAL)
    source = 'A = {"m": 1.0, "mm": 1e-3}\nb = f"{1e3 * x:.3f} mm"\nc = math.degrees(x)\nd = x / 1e6\n'
    assert {line.split(":")[0] for line in own_units(ast.parse(source))} == {"line 1", "line 2", "line 3", "line 4"}
    assert not own_units(ast.parse('A = {"m": "position", "rad": "rotation"}\nb = np.deg2rad(2.0)\nc = 2.0 * x\n'))
