"""The chapters of ``truearm reproduce goswami``: the results of ``goswami`` compared with the paper."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Protocol

import numpy as np

from truearm.report import svg
from truearm.report.figures import by_longitude, convergences, drawn, histogram
from truearm.report.page_text import figures, number
from truearm.report.reproduce_page import Chapter, Claim, PageTable, left_out
from truearm.report.residual_rows import rows_by_kind
from truearm.reproduce import goswami
from truearm.reproduce.goswami import NOISE, Bench, FitErrors
from truearm.results import Estimate
from truearm.types import Floats, rms
from truearm.units import MM, UNITS

TITLE = "Ball-bar calibration of a PUMA 560"
SOURCE = (
    "A. Goswami, A. Quaid, M. Peshkin: Identifying Robot Parameters Using Partial Pose Information. "
    "IEEE Control Systems 13(5), 1993"
)
TABLE_ONE = ((30, 32, 33), (32, 34, 35), (33, 35, 36))  # rows: 1, 2, 3 chucks; columns: spheres
RESIDUAL, VALIDATION, CARTESIAN = 0.084, 0.110, 0.34  # mm, Results and Discussion
MOST_ITERATIONS = 10  # "in most cases convergence occurred within ten iterations"
BASE_RADIUS, LEG = 0.109, 0.46  # m; radius of the chucks' triangle for which the paper's factor of four holds
GEARS = (0.0, 0.5e-4, 1e-4, 1.5e-4, 2e-4, 2.2e-4)  # rad; larger ones would leave no room for noise
GEAR = GEARS.index(2e-4)


class ReportStep(Protocol):
    """Report the current step to the user, and its duration."""

    def __call__(self, name: str, /) -> AbstractContextManager[None]: ...


def chapters(made: Bench, quick: bool, seed: int, step: ReportStep) -> Iterator[Chapter]:
    """Yield chapter after chapter; ``quick`` uses fewer Monte Carlo runs."""
    with step("Table I: ranks of all 511 subsets of the pairings"):
        yield _ranks(made)
    rng = np.random.default_rng(seed)
    with step("Table II, Fig. 3 and 4: 46 cm shells fitted, 61 cm judged"):
        estimate = goswami.fitted(made, rng)
        every = goswami.fitted(made, np.random.default_rng(seed), np.ones_like(made.robot.free))
        few = goswami.few_poses(made, 36, rng)
    yield _residuals(made, estimate, every, few)
    runs = 20 if quick else 200
    with step(f"Monte Carlo: {runs} experiments"):
        monte_carlo = [goswami.run(made, NOISE, 0.0, np.random.default_rng([seed, k])) for k in range(runs)]
    yield _monte_carlo(made, monte_carlo)
    with step("validation with gear errors"):
        seeds = range(2 if quick else 8)
        gears = [goswami.with_gears(made, gear, seeds) for gear in GEARS]
    yield _validation(made, monte_carlo, gears)
    yield _table_two(made, estimate)
    yield _stewart(made, estimate)
    yield _left_out()


def _ranks(made: Bench) -> Chapter:
    sets = made.robot.parameter_sets
    found = {name: goswami.Ranks(made, sets[name]) for name in ("design", "optimised")}
    claims = [
        Claim(
            f"parameters identifiable with {_some(c, 'chuck')} and {_some(s, 'sphere')}",
            "",
            TABLE_ONE[c - 1][s - 1],
            found["design"].first(c, s),
            36 - goswami.LOST[c] - goswami.LOST[s],
            why=""
            if found["optimised"].first(c, s) == found["design"].first(c, s)
            else "The rank differs at Table II's values.",
        )
        for c in (1, 2, 3)
        for s in (1, 2, 3)
    ]
    without_factors = np.array([not name.endswith(".gain") for name in made.chain.parameter_names])
    law = goswami.subset_law(found["optimised"])
    axis = goswami.on_axis(made)
    claims += [
        Claim(
            "the same without encoder factors, all nine pairings",
            "",
            30,
            goswami.Ranks(made, sets["design"], free=without_factors).first(3, 3),
            4 * 6 + 6,
            why="N = 4 n_r + 2 n_p + 6 of the papers that Goswami and others quote, where n_r = 6 joints turn and n_p = 0 slide. "
            "With encoder factors it is N = 5 n_r + 3 n_p + 6 = 36, the last number of Table I.",
        ),
        Claim(
            "sets of six pairings with full rank",
            "",
            law.six_all_involved,
            law.six_full,
            why="The paper: any six of the nine are sufficient, so long as no sphere or chuck is uninvolved. Column paper: the "
            "number of such sets among all 84 sets of six. Column truearm: the number of sets with rank 36.",
        ),
        Claim(
            "subsets whose rank is 36 − f(chucks) − f(spheres), f(1) = 3, f(2) = 1, f(3) = 0",
            "",
            None,
            law.agree,
            law.subsets,
            why="Of all 511 subsets of the nine pairings, at the optimised values. The smallest singular value that counts "
            f"towards the rank is at least {figures(law.smallest_gap, 2)} times the largest that does not.",
        ),
        Claim(
            "fewest pairings with full rank",
            "",
            6,
            law.smallest_full,
            3,
            why="The paper argues from the six legs of a Stewart platform that six are the minimum. But each pairing is measured in "
            "many poses, so three pairings that involve every sphere and every chuck already determine all parameters.",
        ),
        Claim(
            "three chucks and one sphere on the axis of joint 6",
            "",
            32,
            axis.first(3, 1),
            30,
            why="The paper expects to lose only the offset of joint 6 (33 − 1). But a sphere on that axis does not move with the "
            "joint: the gain and one direction of link 7 are unidentifiable too.",
        ),
    ]
    text = (
        "Table I and its consequences. The rank is the number of significant singular values of the analytic Jacobian with respect to "
        "all 54 parameters, with columns scaled to length 1, both at the design and at the optimised values."
    )
    return Chapter("Table I: identified parameters", text, tuple(claims))


def _residuals(made: Bench, estimate: Estimate, every: Estimate, few: Estimate) -> Chapter:
    n, free = estimate.n_observations, int(made.robot.free.sum())
    expected = MM.of(NOISE * float(np.sqrt(1.0 - free / n)))
    (rows,) = rows_by_kind(estimate, made.table, goswami.longitudes(made))
    deviation = MM.of(3.0 * NOISE / float(np.sqrt(2.0 * (n - free))))
    r = MM.of(estimate.residual["m"][estimate.fitted])
    claims = (
        Claim("RMS residual before, 46 cm", "mm", None, MM.of(estimate.rms_raw["m"])),
        Claim(
            "RMS residual after, 46 cm",
            "mm",
            RESIDUAL,
            MM.of(estimate.rms_after["m"]),
            expected,
            RESIDUAL - expected + deviation,
            "The simulated noise is the paper's residual, 0.084 mm. After a fit of 36 parameters to "
            f"{n} lengths, a fraction √(1 − 36/{n}) of it remains. Tolerance: this difference plus three standard errors.",
        ),
        Claim(
            "mean of the residuals",
            "mm",
            0.0,
            float(r.mean()),
            0.0,
            MM.of(3.0 * NOISE / float(np.sqrt(n))),
            "Fig. 4: 0.0 mm. Tolerance: three standard errors.",
        ),
        Claim(
            "iterations",
            "",
            MOST_ITERATIONS,
            estimate.iterations,
            None,
            MOST_ITERATIONS - 1,
            "“In most cases convergence occurred within ten iterations”: any number from 1 to 10 counts as reproduced.",
        ),
        Claim(
            "36 poses: RMS residual after",
            "mm",
            0.0,
            MM.of(few.rms_after["m"]),
            0.0,
            0.1 * RESIDUAL,
            "“If we had measured only 36 poses we could obtain a residual error of zero, no matter how poor the result "
            "would be on additional poses.” Tolerance: a tenth of the noise.",
        ),
        Claim(
            "36 poses: RMS on the 61 cm shells",
            "mm",
            None,
            _held(few),
            why="The “poor result on additional poses”: many times the noise.",
        ),
        Claim(
            "54 parameters free instead of 36: largest difference of a residual",
            "mm",
            None,
            MM.of(float(np.abs(every.residual["m"] - estimate.residual["m"]).max())),
            0.0,
            why=f"The 18 held parameters change no prediction. Rank with all 54 free: {every.rank}.",
        ),
    )
    pictures = (
        histogram(rows)._replace(title="Fig. 4: histogram of the final residuals"),
        *([third._replace(title="Fig. 3: residuals against longitude")] if (third := by_longitude(rows)) else []),
        *convergences(estimate),
    )
    text = (
        "The true robot has Table II's optimised values; the fit starts from its design values. The lengths on the 46 cm shells, with the "
        "paper's noise, are fitted; those on the 61 cm shells are held out. Fig. 3 of the paper shows residuals against longitude."
    )
    return Chapter("Fig. 3 and 4: residuals", text, claims, figures=pictures)


def _monte_carlo(made: Bench, runs: list[FitErrors]) -> Chapter:
    count, free = len(runs), int(made.robot.free.sum())
    freedom = int((made.table.bar == goswami.NEAR).sum()) - free
    nees, chi2 = (float(np.mean([getattr(r, k) for r in runs])) for k in ("nees", "chi2"))
    claims = (
        Claim(
            "normalised squared error of the 36 parameters",
            "",
            None,
            nees,
            free,
            why=f"Mean of {count} runs; theory 36 ± {figures(3 * np.sqrt(2 * free / count), 2)} (three standard errors). "
            "The covariance describes the true spread.",
        ),
        Claim(
            "χ² of the residuals",
            "",
            None,
            chi2,
            freedom,
            why=f"Theory {freedom} ± {figures(3 * np.sqrt(2 * freedom / count), 2)}.",
        ),
        Claim(
            "most iterations",
            "",
            MOST_ITERATIONS,
            max(r.iterations for r in runs),
            None,
            MOST_ITERATIONS - 1,
            "Any number from 1 to 10 counts as reproduced.",
        ),
    )
    text = f"The experiment is repeated {count} times, each time with new noise."
    return Chapter("Is the covariance correct?", text, claims)


def _validation(made: Bench, runs: list[FitErrors], gears: list[tuple[float, float, float]]) -> Chapter:
    near, far, _ = (MM.of(np.array(part)) for part in zip(*gears, strict=True))
    explains = f"An amplitude of {float(np.interp(VALIDATION, far, GEARS)) * 1e4:.1f}·10⁻⁴ rad would give 0.110 mm. "
    theory = MM.of(goswami.validation_of_noise(made))
    # The paper prints three figures from one experiment; the RMS of its 800 residuals has a standard error of 2.5 %.
    tolerance = 3.0 * VALIDATION / float(np.sqrt(2.0 * 800))
    claims = (
        Claim(
            "RMS on the 61 cm shells, noise alone",
            "mm",
            VALIDATION,
            MM.of(rms(np.array([r.far for r in runs]))),
            theory,
            tolerance,
            "White noise of 0.084 mm does not explain the paper's 0.110 mm: 800 poses determine the parameters too "
            f"well. Tolerance: three standard errors of an RMS of 800 residuals, {figures(tolerance, 2)} mm.",
        ),
        Claim(
            f"the same with gear errors of {1e4 * GEARS[GEAR]:.0f}·10⁻⁴ rad",
            "mm",
            VALIDATION,
            float(far[GEAR]),
            None,
            None,
            f"{explains if far[-1] >= VALIDATION else ''}Each joint has a sinusoidal error with 3 to 12 periods per turn, which no parameter describes. The noise is reduced so that "
            "the 46 cm residual stays at 0.084 mm. The amplitude is an assumption: it shows what could explain the paper's number.",
        ),
        Claim(
            "its residual on the 46 cm shells",
            "mm",
            RESIDUAL,
            float(near[GEAR]),
            RESIDUAL,
            None,
            "Kept there by the choice of noise.",
        ),
    )
    x = 1e4 * np.array(GEARS)
    top = max(float(far.max()), VALIDATION) * 1.08
    plot = svg.Plot(svg.linear_axis("gear error [10⁻⁴ rad]", 0.0, 2.5), svg.linear_axis("RMS [mm]", 0.0, top))
    parts = [
        svg.line(plot, [0.0, 2.5], [VALIDATION, VALIDATION], "old line"),
        svg.line(plot, x, far, "val line"),
        svg.line(plot, x, near, "fit line"),
        svg.scatter(plot, x, far, "val", [f"{figures(v)} mm" for v in far], 4),
        svg.scatter(plot, x, near, "fit", [f"{figures(v)} mm" for v in near], 4),
    ]
    entries = [("fit line", "46 cm, fitted"), ("val line", "61 cm"), ("old line", "paper, 61 cm")]
    caption = "The noise is reduced so that the 46 cm residual stays at 0.084 mm; the gear errors appear on shells that were not fitted."
    return Chapter(
        "Validation on the 61 cm shells",
        "The paper's second set of shells, and what its residual shows about errors that the parameters do not describe.",
        claims,
        figures=(drawn(plot, "What gear errors do", caption, parts, entries),),
    )


def _table_two(made: Bench, estimate: Estimate) -> Chapter:
    p = estimate.n_robot_parameters
    design, truth = made.robot.parameter_sets["design"], made.truth
    rows = []
    for i in range(p):
        unit = UNITS[estimate.units[i]]
        held = not estimate.free[i]
        apart = (estimate.value[i] - truth[i]) / estimate.sigma[i] if not held else np.nan
        rows.append(
            (
                estimate.parameter_names[i],
                number(unit.scale.of(float(design[i])), unit.decimals),
                number(unit.scale.of(float(truth[i])), unit.decimals),
                "held fixed" if held else number(unit.scale.of(float(estimate.value[i])), unit.decimals),
                "" if held else figures(unit.scale.of(float(estimate.sigma[i])), 2),
                "" if held else number(float(apart), 2, sign=True),
                unit.symbol or unit.si,
            )
        )
    error = (estimate.value - truth)[estimate.free] / estimate.sigma[estimate.free]
    claims = (
        Claim("parameters free", "", 36, int(estimate.free[:p].sum())),
        Claim("rank", "", 36, estimate.rank),
        Claim(
            "largest error of a parameter",
            "σ",
            None,
            float(np.abs(error).max()),
            why="The median of the largest of 36 normally distributed errors is about 2.2 σ.",
        ),
    )
    head = ("parameter", "design", "paper's optimised", "identified", "σ", "error / σ", "unit")
    text = (
        "The simulated robot has the paper's optimised values, so this tests the estimator. It does not test the paper's "
        "measurements, which are not published. The same 18 parameters are held."
    )
    return Chapter("Table II", text, claims, (PageTable("Table II", head, tuple(rows)),))


def _stewart(made: Bench, estimate: Estimate) -> Chapter:
    factor = goswami.stewart_amplification(BASE_RADIUS, 0.06, LEG)
    radius = _circumradius(np.array([p.xyz for p in made.rig.chucks.values()]))
    mine = goswami.stewart_amplification(radius, 0.06, LEG)
    claims = (
        Claim(
            f"amplification at R_b = {BASE_RADIUS} m, legs of {LEG} m",
            "",
            4.0,
            factor,
            0.95 * LEG / BASE_RADIUS,
            None,
            "“Roughly four times.” The paper does not give its fixture: this radius of the chucks' triangle is chosen to give "
            "that factor.",
        ),
        Claim(
            "position error of the platform",
            "mm",
            CARTESIAN,
            RESIDUAL * factor,
            None,
            None,
            "The factor times the paper's residual, with the radius chosen as above.",
        ),
        Claim(
            f"amplification with the chucks of the demo, R_b = {figures(radius)} m",
            "",
            None,
            mine,
            0.95 * LEG / radius,
            why="A wider triangle of chucks has a smaller amplification.",
        ),
        Claim(
            "position error of the identified robot on the 46 cm shells",
            "mm",
            CARTESIAN,
            MM.of(goswami.cartesian_error(made, estimate)),
            None,
            None,
            "RMS from the parameters' covariance. The paper's estimate is for a single pose measured with six bars. Here "
            "hundreds of poses determine one set of parameters, so the robot is known better than any single pose.",
        ),
    )
    text = "The paper estimates the Cartesian error from the residual by considering six ball-bars between base and platform."
    return Chapter("Stewart platform", text, claims)


def _left_out() -> Chapter:
    rows = (
        (
            "travel of 7.5 cm, bars of 46 cm and 61 cm (an extension of 15 cm), about 800 poses per set, 2 s at rest",
            "settings of the experiment, not results; the simulated rig and plan use them",
        ),
        (
            "base fixture within a few centimetres of its intended position",
            "not measured in the paper; Table II contains it",
        ),
        ("typically 90 % of the RMS error of the endpoint is geometric", "quoted from another paper; no data"),
        ("Fig. 1 and 2", "a photograph, and a drawing of the shell"),
        (
            "lengths and joint angles of both sets of shells",
            "not published; a simulated robot with the paper's optimised values replaces them",
        ),
    )
    return left_out(rows)


def _circumradius(corners: Floats) -> float:
    return float(np.linalg.norm(corners - corners.mean(axis=0), axis=1).mean())


def _held(estimate: Estimate) -> float:
    return float(MM.of(estimate.held_out.figures["m"].rms)) if estimate.held_out else float("nan")


def _some(count: int, what: str) -> str:
    return f"{count} {what}{'s' if count > 1 else ''}"
