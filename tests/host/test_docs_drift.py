"""The table of simulated faults in docs/how-to/rig.md, recomputed: what is named, and how far off the tool is."""

import re
from functools import partial
from pathlib import Path

import fault_worlds as worlds
import numpy as np
import pytest
from puma_bench import CHAIN, FREE

from truearm.checks.examination import examined
from truearm.checks.labels import relabelled
from truearm.checks.trial import Alternative

pytestmark = pytest.mark.soak

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "rig.md"
CELL = r" ([^|]*) \|"
NO_CHECKS, TWICE = "`--check-poses 0`", "`--visits 2`"
PLANS = {"check poses": (1, 10), NO_CHECKS: (1, 0), TWICE: (2, 0)}
BAR = "bar.bar46.zero"


def slipped(plan, rng):
    table, (chuck, _) = worlds.slipped(plan, rng)
    return table, f"chuck.{chuck}.step"


def joint_off(plan, rng):
    table, joint = worlds.encoder_off(plan, rng)
    return table, f"joint{joint + 1}.run"


def drift(size):
    return lambda plan, rng: (worlds.drifting(plan, rng, size), f"{BAR}.drift")


# Each fault gives a table and the right name.
FAULTS = {
    "none": lambda plan, rng: (worlds.clean(plan, rng), ""),
    "a chuck slips by 0.3 mm": slipped,
    "bar 0.3 mm wrong": lambda plan, rng: (worlds.wrong_bar(plan, rng), f"{BAR}.offset"),
    "zero drifts by 0.2 mm": drift(0.2e-3),
    "zero drifts by 0.1 mm": drift(0.1e-3),
    "a joint is 0.3 mrad off in the middle half of the rows": joint_off,
}
CASES = [
    *(("none", plan, 100) for plan in ("check poses", TWICE)),
    ("a chuck slips by 0.3 mm", "check poses", 40),
    ("bar 0.3 mm wrong", "check poses", 40),
    *(("zero drifts by 0.2 mm", plan, 40) for plan in ("check poses", NO_CHECKS)),
    *(("zero drifts by 0.1 mm", plan, 40) for plan in PLANS),
    *(("a joint is 0.3 mrad off in the middle half of the rows", plan, 40) for plan in ("check poses", TWICE)),
]
MISLABELLED = "half of a mount was measured with another sphere"


def session(make, plan, seed):
    """Return whether the fault is named, whether something else is, and the tool's errors [m] as fitted and applied."""
    table, name = make(plan, np.random.default_rng(seed))
    estimate = worlds.identified(table)
    result = examined(CHAIN, worlds.RIG, table, estimate)
    names = [[rival.name for rival in fault.rivals] for fault in result.faults]
    before = worlds.tool_error(estimate, plan)
    estimate.value[:] += result.applied(["mean"] if names else [])[0]
    wrong = any(name not in rivals for rivals in names)
    return any(name in rivals for rivals in names), wrong, before, worlds.tool_error(estimate, plan)


def restored(plan, seed):
    """Return the same for rows with a wrong label, which is restored."""
    table, (first, last) = worlds.mislabelled(plan, np.random.default_rng(seed))
    after, runs = relabelled(Alternative(CHAIN, worlds.RIG, table, FREE, np.arange(len(table))))
    right = [(run.first, run.last) for run in runs] == [(first, last)] and (after.table.sphere == plan.sphere).all()
    errors = [worlds.tool_error(worlds.identified(rows), plan) for rows in (table, after.table)]
    return right, bool(runs) and not right, *errors


def row(fault, plan, n):
    """Return the cells of a row of the table."""
    order = worlds.plan(*PLANS[plan])
    judge = restored if fault == MISLABELLED else partial(session, FAULTS[fault])
    named, wrong, *errors = np.mean([judge(order, seed) for seed in range(n)], axis=0)
    errors = [f"{1e3 * e:.0f} mm" if e > 1e-2 else f"{1e6 * e:.0f} µm" for e in errors]
    return fault, plan, *(f"{round(share * n)} of {n}" for share in (named, wrong)), *errors


@pytest.mark.parametrize(("fault", "plan", "n"), [*CASES, (MISLABELLED, "check poses", 20)])
def test_a_row_of_the_table(fault, plan, n):
    """Counts and errors are the page's within a twentieth, because single sessions are near the threshold."""
    cells = row(fault, plan, n)
    print("| " + " | ".join(cells) + " |")
    rows = re.findall(rf"^\|{CELL * 6}$", PAGE.read_text(encoding="utf-8"), re.M)
    (of_page,) = [of_page for of_page in rows if of_page[:2] == cells[:2]]
    values, expected = ([float(cell.split()[0]) for cell in of_row[2:]] for of_row in (cells, of_page))
    assert values == pytest.approx(expected, rel=0.05, abs=1.0)
