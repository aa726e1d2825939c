"""The rows and parameters that --hold-out, --free and --freeze choose."""

import numpy as np
import pytest
from tests.refusals import refused

from truearm.errors import InputError
from truearm.files.observation_table import concatenate, parse_table
from truearm.kinds.table import ObservationTable
from truearm.workflows.selection import free_parameters, held_out_rows

NAMES = ("joint1.offset", "joint1.gain", "link2.x", "link2.y")


def seats(place: str, n: int, socket: str = "0") -> ObservationTable:
    """Rows of different poses."""
    return parse_table(
        "kind,q1_rad,place,socket\n" + "".join(f"seat,{0.01 * i:.2f},{place},{socket}\n" for i in range(n)), "t.csv"
    )


TABLE = concatenate([seats("a", 3), seats("b", 5), seats("c", 2)])


def test_groups_are_held_out_by_name() -> None:
    assert held_out_rows(TABLE, [], 0) is None
    mask = held_out_rows(TABLE, ["place=b"], 0)
    assert mask is not None
    assert mask.tolist() == [False] * 3 + [True] * 5 + [False] * 2
    both = held_out_rows(TABLE, ["place=a", "place=c"], 0)
    assert both is not None
    assert both.sum() == 5


def test_only_some_groups_are_fitted() -> None:
    mask = held_out_rows(TABLE, [], 0, ["place=b"])
    assert mask is not None
    assert mask.tolist() == [True] * 3 + [False] * 5 + [True] * 2
    both = held_out_rows(TABLE, ["place=a"], 0, ["place=a", "place=b"])
    assert both is not None
    assert both.tolist() == [True] * 3 + [False] * 5 + [True] * 2
    with refused("nothing-left"):
        held_out_rows(TABLE, ["place=b"], 0, ["place=b"])
    assert held_out_rows(TABLE, [], 0, ["place=a", "place=b", "place=c"]) is None


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


@pytest.mark.parametrize("wanted", ["colour=a", "place=d", "d", "1.5"])
def test_a_wrong_group_to_fit_is_told_by_its_own_option(wanted: str) -> None:
    with pytest.raises(InputError) as told:
        held_out_rows(TABLE, [], 0, [wanted])
    assert "fit_only" in str(told.value)
    assert "hold_out" not in str(told.value)
    assert "fraction" not in str(told.value)


def test_patterns_choose_the_free_parameters() -> None:
    default = np.array([True, False, True, True])
    for free, freeze, expected in (
        ([], [], default),
        (["*"], [], [True] * 4),
        (["joint1.*"], [], [True, True, False, False]),
        ([], ["link2.?"], [True, False, False, False]),
        (["*"], ["*.gain", "link2.x"], [True, False, False, True]),
    ):
        assert free_parameters(NAMES, default, free, freeze).tolist() == list(expected)


def test_more_parameters_are_freed_beside_the_default() -> None:
    default = np.array([True, False, True, False])
    for free, also, freeze, expected in (
        ([], ["joint1.gain"], [], [True, True, True, False]),
        ([], ["*.gain, link2.y"], [], [True] * 4),
        ([], ["*.gain", "link2.y"], ["link2.*"], [True, True, False, False]),
        (["link2.x"], ["*.gain"], [], [False, True, True, False]),
    ):
        assert free_parameters(NAMES, default, free, freeze, also).tolist() == expected
    assert default.tolist() == [True, False, True, False]  # the robot's own mask is left alone
    comma = (*NAMES[:3], "left,2.y")  # as a URDF may name its joints
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


def test_a_robot_whose_file_has_no_gains_is_told_how_to_give_them() -> None:
    with pytest.raises(InputError, match=r"also_free \*\.gain: .* gain = \{ design"):
        free_parameters(["joint1.offset", "joint1.a"], np.ones(2, dtype=bool), [], [], ["*.gain"])


def test_patterns_that_match_nothing_or_leave_nothing_are_told() -> None:
    default = np.ones(4, dtype=bool)
    with pytest.raises(InputError, match=r"free joint1\.ofset: .* like joint1\.offset"):
        free_parameters(NAMES, default, ["joint1.ofset"], [])
    with pytest.raises(InputError, match=r"freeze link7\.\*: matches no parameter"):
        free_parameters(NAMES, default, [], ["link7.*"])
    with refused("nothing-left", what="parameters"):
        free_parameters(NAMES, default, [], ["*"])
