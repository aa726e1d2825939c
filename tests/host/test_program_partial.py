"""A target that cannot be corrected is named at every move that goes to it, not at the first one alone."""

import pytest
from tests.host.test_program_corrections import (
    POSES,
    Q,
    flipped,
    misses,
    outcome,
    program,
    six,
    written,
)

FAR = POSES[1].copy()
FAR[0, 3] += 5.0
SHARED = {
    "out of reach": (["W = " + six(FAR), "movej(W)", "movel(W)"], {3, 4}, {}),
    "joints beyond the arm's": ([f"q = {written(Q[1] + 9.0)}", "movej(q)", "movej(q)"], {3, 4}, {}),
    "depend on each other": (["A = " + six(POSES[2]), "B = p[0, 0.01, 0, 0, 0, 0.02]", "movej(pose_trans(A, B))", "movel(pose_trans(B, A))", "movel(pose_trans(A, B))"], {4, 5, 6}, {}),
    "two moves with the other wrist": (
        [f"W = {six(POSES[1])}", f"movej({written(Q[2])})", "movel(W)", f"movej({written(flipped(Q[2]))})", "movel(W)", f"movej({written(flipped(Q[2]))})", "movel(W)"],
        {6, 8},
        {"home": Q[1]},
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", SHARED)
def test_each_move_to_it_is_named(tmp_path, what):
    lines, wrong, options = SHARED[what]
    text = program(*lines, f"movej({written(Q[4])})", f"movel({six(POSES[5])})")
    found = outcome(tmp_path, text, partial=True, **options)
    assert {one.line for one in found.refused} == wrong
    if what == "two moves with the other wrist":
        done = misses(text, found.text.decode("latin-1"))[:, 0]
        assert (done < 1e-6).tolist() == [True, True, True, False, True, False, True, True]
