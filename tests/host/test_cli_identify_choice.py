"""The rows and parameters that --hold-out, --free and --freeze choose."""

import numpy as np
import pytest
from tests.refusals import refused

from truearm.errors import InputError
from truearm.kinds.table import ObservationTable
from truearm.kinds.table_file import concatenate, parse_table
from truearm.workflows.selection import free_parameters, held_out_fraction, held_out_rows

NAMES = ("joint1.offset", "joint1.gain", "link2.x", "link2.y")


def seats(place: str, n: int, socket: str = "0") -> ObservationTable:
    """Rows of different poses."""
    return parse_table(
        "kind,q1_rad,place,socket\n" + "".join(f"seat,{0.01 * i:.2f},{place},{socket}\n" for i in range(n)), "t.csv"
    )


TABLE = concatenate([seats("a", 3), seats("b", 5), seats("c", 2)])


@pytest.mark.parametrize(
    ("groups", "fit_only", "held"),
    [
        ([], [], None),
        (["place=b"], [], "b"),
        (["place=a", "place=c"], [], "ac"),
        ([], ["place=b"], "ac"),
        (["place=a"], ["place=a", "place=b"], "ac"),
        ([], ["place=a", "place=b", "place=c"], None),
    ],
)
def test_groups_are_held_out_or_fitted_by_name(groups, fit_only, held) -> None:
    mask = held_out_rows(TABLE, groups, 0, fit_only)
    assert (mask is None) == (held is None)
    assert held is None or mask.tolist() == [place in held for place in TABLE.place]


@pytest.mark.parametrize("seed", range(20))
def test_a_fraction_takes_its_share_of_every_group(seed: int) -> None:
    table = concatenate([seats("a", 40), seats("a", 20, "1"), seats("b", 10)])
    mask = held_out_rows(table, ["0.2"], seed)
    assert mask is not None
    assert mask.sum() == 14
    for place, socket, expected in (("a", "0", 8), ("a", "1", 4), ("b", "0", 2)):
        count = int(mask[(table.place == place) & (table.socket == socket)].sum())
        assert abs(count - expected) <= 1


def test_the_seed_decides_the_draw() -> None:
    table = seats("a", 100)
    draws = [held_out_rows(table, ["0.3"], seed) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(draws[0], draws[1])
    assert not np.array_equal(draws[0], draws[2])  # equal by chance: 1 in C(100, 30) = 3e25


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        (["place=d"], "no row"),
        (["d"], "the table has place=a"),
        (["shell=s61"], "observations have no shell column"),
        (["colour=a"], "'colour'"),
        (["place="], "no row"),
        ([""], "the table has place=a"),
        (["0.2", "place=a"], "hold_out"),
        (["0.2", "0.3"], "hold_out"),
        (["1.5"], "between 0 and 1"),
        (["nan"], "between 0 and 1"),
        (["0.01"], "less than one row"),
        (["0.99"], "no observations"),
        (["place=a", "place=b", "place=c"], "no observations"),
    ],
)
def test_wrong_groups_are_told(wanted: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        held_out_rows(TABLE, wanted, 0)
    if not held_out_fraction(wanted[0]) and message not in ("hold_out", "no observations"):
        with pytest.raises(InputError, match=r"^fit_only (?!.*(hold_out|fraction))"):
            held_out_rows(TABLE, [], 0, wanted[:1])


@pytest.mark.parametrize(
    ("free", "also", "freeze", "expected"),
    [
        ([], [], [], [True, False, True, True]),
        (["*"], [], [], [True] * 4),
        (["joint1.*"], [], [], [True, True, False, False]),
        ([], [], ["link2.?"], [True, False, False, False]),
        (["*"], [], ["*.gain", "link2.x"], [True, False, False, True]),
        ([], ["joint1.gain"], [], [True] * 4),
        ([], ["*.gain", "link2.y"], ["link2.*"], [True, True, False, False]),
        (["link2.x"], ["*.gain, link2.y"], [], [False, True, True, True]),
    ],
)
def test_patterns_choose_the_free_parameters(free, also, freeze, expected) -> None:
    default = np.array([True, False, True, True])
    assert free_parameters(NAMES, default, free, freeze, also).tolist() == expected
    assert default.tolist() == [True, False, True, True]  # the robot's own mask is left alone


def test_a_joint_of_a_urdf_may_have_a_comma_in_its_name() -> None:
    comma, default = (*NAMES[:3], "left,2.y"), np.array([True, False, True, False])
    assert free_parameters(comma, default, [], [], ["left,2.y"]).tolist() == [True, False, True, True]


@pytest.mark.parametrize(
    ("pattern", "near"),
    [
        ("joint1.gian", r"like joint1\.gain"),
        ("gain", r"like .*\*\.gain"),
        ("*.gain,joint9.offset", r"joint9\.offset: .* like joint1\.offset"),
        ("zzz", r"like joint1\.offset, joint1\.gain, \*\.offset, \*\.gain, \*\.x, \*\.y"),
        ("", "matches no parameter"),
        ("x" * 100_000, "matches no parameter"),
    ],
)
def test_a_misspelt_parameter_is_answered_with_near_names(pattern: str, near: str) -> None:
    with pytest.raises(InputError, match="also_free .*" + near):
        free_parameters(NAMES, np.ones(4, dtype=bool), [], [], [pattern])


def test_patterns_and_gains_that_are_not_there_are_told():
    with pytest.raises(InputError, match=r"also_free \*\.gain: .* gain = \{ design"):
        free_parameters(["joint1.offset", "joint1.a"], np.ones(2, dtype=bool), [], [], ["*.gain"])
    default = np.ones(4, dtype=bool)
    with pytest.raises(InputError, match=r"free joint1\.ofset: .* like joint1\.offset"):
        free_parameters(NAMES, default, ["joint1.ofset"], [])
    with pytest.raises(InputError, match=r"freeze link7\.\*: matches no parameter"):
        free_parameters(NAMES, default, [], ["link7.*"])
    with refused("nothing-left", what="parameters"):
        free_parameters(NAMES, default, [], ["*"])
