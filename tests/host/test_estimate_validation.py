"""Predicted residuals of an identified robot, compared with robots and noise drawn at random."""

from dataclasses import replace

import numpy as np
import pytest
from tests.host import plan_bench as bench

from truearm.estimate.validation import expected, judge
from truearm.kinds.table_file import concatenate
from truearm.model.chain import point_forward
from truearm.model.rotation import rotation
from truearm.plan.ball_bar_plan import all_pairings
from truearm.plan.bar_paths import Pace
from truearm.plan.forecast import bar_table
from truearm.plan.line_plan import line_rows, plan_lines
from truearm.plan.options import LineOptions
from truearm.plan.shells import candidates
from truearm.types import Plan, Point

NAME = "irb120"
DRAWS = 100
POINT = (0.03, -0.02, 0.12)


@pytest.fixture(scope="module")
def rows():
    """Return chain, rig and error-free rows: 30 lengths with a chuck known to 0.2 mm, and two lines with devices at unknown poses."""
    known = bench.known(NAME)
    chucks = known.rig.chucks | {"c1": replace(known.rig.chucks["c1"], sigma=2e-4)}
    rig = replace(known.rig, chucks=chucks, targets={"ball": Point("ball", POINT)}, time_offset_sigma=0.0)
    known = replace(known, rig=rig)
    wanted = LineOptions(lines=2, length=0.3, points=8, speed=0.08, candidates=4)
    planned = plan_lines(bench.site(NAME), known, wanted, Pace(), target="ball")
    lines, _ = line_rows(known, planned.lines, ["plan1", "plan2"], "ball")
    bars = bar_table(known, candidates(bench.site(NAME), all_pairings(rig), 27))
    return known, planned.rig, bars, lines


def drawn(rows, sigma, rng):
    """Return the readings of a robot whose parameters deviate by sigma (p,), with noise and a displaced chuck."""
    known, rig, bars, lines = rows
    params = known.params + sigma * rng.normal(size=sigma.size)
    chuck = replace(rig.chucks["c1"], xyz=tuple(rig.chucks["c1"].xyz + 2e-4 * rng.normal(size=3)))
    true = replace(known, params=params, rig=replace(rig, chucks=rig.chucks | {"c1": chuck}))
    plan = Plan(bars.q, bars.shell, bars.bar, bars.chuck, bars.sphere)
    value = bar_table(true, plan).value + bench.SIGMA * rng.normal(size=len(bars))
    ends = [point_forward(known.chain, p, lines.q, np.array(POINT)) for p in (known.params, params)]
    xyz = lines.xyz + np.array(rig.line_sigma) * rng.normal(size=lines.xyz.shape)
    for name, device in rig.lines.items():
        mine = lines.line == name
        xyz[mine] += (ends[1] - ends[0])[mine] @ rotation(np.array(device.rotation))
    return concatenate([replace(bars, value=value), replace(lines, xyz=xyz)])


def test_errors_are_as_large_as_expected(rows):
    known, rig, bars, lines = rows
    sigma = np.array([{"m": 1e-4, "rad": 2e-4, "1": 1e-5}[p.unit] for p in known.chain.parameters]) * known.free
    exact, p = concatenate([bars, lines]), sigma.size
    due = expected(judge(known.chain, rig, exact, known.params), np.diag(sigma**2), np.zeros((p, 0)))["m"]
    assert (due.by_parameters > 0.0).all()
    assert not due.unseen.any()
    rng = np.random.default_rng(5)
    tables = [drawn(rows, sigma, rng) for _ in range(DRAWS)]
    square = np.mean([judge(known.chain, rig, t, known.params).error["m"] ** 2 for t in tables], axis=0)
    ratio = np.sqrt(square / (due.by_noise + due.by_parameters))
    # A mean of DRAWS squares of one normal residual scatters by 7 % in its root.
    assert np.abs(ratio - 1.0).max() < 0.28
    bar = exact.kind == "ball_bar"
    for mine in (bar, ~bar, bar & (exact.chuck == "c1"), exact.line == "plan1"):
        assert np.mean(ratio[mine]) == pytest.approx(1.0, abs=0.05)


def test_rows_that_hang_on_what_was_not_seen_are_told(rows):
    """A device that stands anywhere does not feel how the base stands; a bar from a chuck of known place does."""
    known, rig, bars, lines = rows
    p = len(known.chain.parameters)
    base = np.array([[float(name == "base.z")] for name in known.chain.parameter_names])
    due = expected(judge(known.chain, rig, concatenate([bars, lines]), known.params), np.zeros((p, p)), base)["m"]
    assert np.array_equal(due.unseen, np.arange(len(due.unseen)) < len(bars))
    assert np.all(due.by_parameters == 0.0)
