"""The chapters of ``truearm reproduce renders``: what ``renders`` computes beside what the paper says."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from truearm.model.chain import Chain
from truearm.model.robot import builtin_robot
from truearm.observe.line import PLACEMENTS
from truearm.report import svg
from truearm.report.figures import Figure
from truearm.report.reproduce_page import Chapter, Claim, Table
from truearm.report.text import figures, number
from truearm.reproduce import renders
from truearm.reproduce.goswami_page import Step
from truearm.reproduce.lines import ANGLE_SIGMA, LENGTH_SIGMA, measured_lines
from truearm.reproduce.renders import CASE_E, CASE_F, GEAR, N_LINES, N_POINTS, WIDE, Case, Convergence
from truearm.types import Floats

TITLE = "Straight-line calibration of the ULB robot"
SOURCE = (
    "J.-M. Renders, E. Rossignol, M. Becquet, R. Hanus: Kinematic Calibration and Geometrical Parameter Identification "
    "for Robots. IEEE Transactions on Robotics and Automation 7(6), 1991"
)
PAPER_E, PAPER_F = (11.28, 4.95, 0.89, 0.81), {1: 3.15, 12: 0.61}  # mm, mean error before and after each run
RUNS_E, RUNS_F = 3, 12
SHOWN = 12  # runs in the figures; what comes after is level
P0 = (1e1, 1e2, 1e3, 1e4, 1e6)
FROZEN = ("joint1.offset", "joint1.d", "joint2.d", "joint6.alpha")
UNSTATED = "The paper does not say where its lines lay; the figure is a median over line sets."


def chapters(quick: bool, seed: int, step: Step) -> Iterator[Chapter]:
    """Chapter after chapter; ``quick`` does with fewer line sets and Monte Carlo runs."""
    chain = builtin_robot("ulb").chain
    sets = 3 if quick else 12
    with step("III-D: what must be frozen; II-F: batch and recursive"):
        yield _frozen(chain, seed)
    with step(f"III-E: joint offsets, {sets} sets of lines"):
        yield _identified(chain, "E", sets, seed)
    with step(f"III-F: offsets and lengths, {sets} sets of lines"):
        yield _identified(chain, "F", sets, seed)
    runs = 6 if quick else 60
    with step(f"II-G: is the covariance true? {runs} experiments a solver"):
        yield _covariance(chain, runs, seed)
    with step("Fig. 4: maximum likelihood and least squares"):
        yield _figure_four(4 if quick else 24, 1 if quick else 6, seed)
    with step("II-D and Fig. 5: error maps"):
        yield _maps(chain)
    yield Chapter(
        "Not on this page: compensation",
        "The false target (32), the correction in joint space (34) and of offsets alone (35) correct a robot, they do not identify "
        "it. They need its inverse kinematics and come with the room correct/. The experimental figures of Fig. 3 and Fig. 2 are "
        "photographs and drawings.",
    )


def _frozen(chain: Chain, seed: int) -> Chapter:
    rows = renders.with_d2(chain)
    rng = np.random.default_rng(seed)
    counted = {a6: (renders.unseen(rows, a6, (), rng), renders.unseen(rows, a6, FROZEN, rng)) for a6 in (0.0, 0.05)}
    session = measured_lines(chain, renders.errors_added(chain, CASE_E), N_LINES, N_POINTS, rng)
    delta, covariance = renders.batch_against_recursive(chain, session)
    claims = (
        Claim(
            "parameters that no line shows, a6 ≠ 0",
            "",
            len(FROZEN),
            counted[0.05][0],
            4,
            why="The paper freezes θ1, d1, α6 and d2; rank says the same.",
        ),
        Claim("of these, left when θ1, d1, α6, d2 are frozen", "", 0, counted[0.05][1], 0),
        Claim(
            "parameters that no line shows, a6 = 0 as in Table I",
            "",
            len(FROZEN),
            counted[0.0][0],
            7,
            why="The flange's centre lies on the axis of joint 6: θ6 moves nothing, and θ5 cannot be told from a5, α5 from "
            "d5. The paper, which quotes a σ of θ6 below its prior, may have measured a point beside that axis; it does not say.",
        ),
        Claim("left when θ1, d1, α6, d2 are frozen, a6 = 0", "", None, counted[0.0][1], 3),
        Claim(
            "batch (12) against recursive (18), (20): estimate",
            "1",
            0.0,
            delta,
            0.0,
            1e-7,
            "Largest relative difference; rounding, times the problem's condition.",
        ),
        Claim("the same: covariance", "1", 0.0, covariance, 0.0, 1e-10),
    )
    text = (
        "Rank of the derivatives of one point by all parameters of the rows, the device's pose projected out. (18) is missing in the "
        "scanned paper, the second “=” of (20) should be “+”, and the signs after (19) are wrong; corrected, both forms agree."
    )
    return Chapter("III-D: fixed parameters; II-F: recursive form", text, claims)


def _identified(chain: Chain, name: str, sets: int, seed: int) -> Chapter:
    errors, runs = (CASE_E, RUNS_E) if name == "E" else (CASE_F, RUNS_F)
    truth = renders.errors_added(chain, errors)
    found: dict[str, list[Case]] = {"paper": [], "map": [], "gears": []}
    starts: dict[str, list[float]] = {rule: [] for rule in PLACEMENTS}
    for k in range(sets):
        clean = measured_lines(chain, truth, N_LINES, N_POINTS, np.random.default_rng([seed, k]))
        rough = measured_lines(chain, truth, N_LINES, N_POINTS, np.random.default_rng([seed, k]), GEAR)
        for rule in PLACEMENTS:
            starts[rule].append(renders.before(chain, clean, rule))
        found["paper"].append(renders.case(chain, clean, truth, errors, "renders-1991", runs=runs))
        found["map"].append(renders.case(chain, clean, truth, errors, "map"))
        found["gears"].append(renders.case(chain, rough, truth, errors, "map"))
    histories = {key: _median_history(cases) for key, cases in found.items()}
    placed = {rule: 1e3 * float(np.median(values)) for rule, values in starts.items()}
    claims = _case_claims(name, placed, found, histories, runs)
    text = (
        f"Four lines of {N_POINTS} points identify, a fifth validates. The true robot has the errors that the paper identified in "
        f"III-{name}; sensors, joints and priors are those of III-C, but for the place of a device: it is found through the bad "
        f"nominal robot, so 1 mm is a false prior and {1e3 * WIDE:.0f} mm is used. Medians over {sets} sets of lines."
    )
    title = "III-E: errors of the joint encoders' zeroes" if name == "E" else "III-F: offsets and four lengths"
    head = ("placement of a line", "mean error before [mm]")
    words = {"least_squares": "least squares", "two_point": "its first two points"}
    table = Table(
        "What “before” depends on", head, tuple((words[rule], number(value, 2)) for rule, value in placed.items())
    )
    paper = np.array(PAPER_E if name == "E" else [PAPER_E[0], *PAPER_F.values()])
    at = np.array([0.0, 1.0, 2.0, 3.0] if name == "E" else [0.0, *map(float, PAPER_F)])
    return Chapter(title, text, claims, (table,), (_runs_figure(histories, paper, at),))


def _case_claims(
    name: str, placed: dict[str, float], found: dict[str, list[Case]], histories: dict[str, Floats], runs: int
) -> tuple[Claim, ...]:
    paper = dict(enumerate(PAPER_E)) if name == "E" else {0: PAPER_E[0], **PAPER_F}
    claims = [
        Claim(
            "mean error before, lines placed by their first two points",
            "mm",
            PAPER_E[0],
            placed["two_point"],
            None,
            None,
            f"{UNSTATED} III-G places lines by two points; by least squares it is {figures(placed['least_squares'])} mm.",
        )
    ]
    for run, value in list(paper.items())[1:]:
        claims.append(
            Claim(
                f"after run {run}, the paper's recipe",
                "mm",
                value,
                float(histories["paper"][run]),
                None,
                None,
                "Lines placed by least squares. Each run takes the last one's posterior as its prior on the same data."
                if run == 1
                else "",
            )
        )
    for key, what in (
        ("map", "map, no unmodelled error"),
        ("gears", f"map, joints that err by {figures(GEAR, 1)} rad"),
    ):
        runs_needed = float(np.median([c.runs for c in found[key]]))
        claims.append(
            Claim(
                f"after the last run, {what}",
                "mm",
                paper[runs] if key == "gears" else None,
                float(histories[key][-1]),
                None,
                None,
                f"One fixed prior; {runs_needed:.0f} runs, {figures(float(histories[key][3]))} mm after the third."
                if key == "map"
                else "Gear-like errors stand for what the paper calls nongeometrical; their size is our choice.",
            )
        )
    before, after = (
        1e3 * float(np.median([getattr(c, k) for c in found["gears"]]))
        for k in ("validation_before", "validation_after")
    )
    factor = float(np.median([c.history[0] / c.history[-1] for c in found["gears"]]))
    claims += [
        Claim(
            "validation line, before",
            "mm",
            10.83,
            before,
            None,
            None,
            "Its device is fitted with the robot held, before as after.",
        ),
        Claim("validation line, after", "mm", 0.81 if name == "E" else 0.68, after, None, None),
        Claim(
            "error before over error after",
            "1",
            PAPER_E[0] / paper[runs],
            factor,
            None,
            None,
            "map, lines placed by least squares, joints that err. “By a factor of more than 15”, says the abstract.",
        ),
    ]
    return tuple(claims)


def _median_history(cases: Sequence[Case]) -> Floats:
    """(runs + 1,) median over cases of the mean error [mm] after each run; a case that ended stays where it is."""
    longest = max(4, *(len(c.history) for c in cases))
    held = [np.concatenate([c.history, np.full(longest, c.history[-1])])[:longest] for c in cases]
    return np.asarray(1e3 * np.median(held, axis=0))


def _covariance(chain: Chain, runs: int, seed: int) -> Chapter:
    solvers = (("map", 50, True), ("renders-1991", RUNS_E, True), ("map", 50, False))
    nees, after, third = [], [], []
    for solver, most, joint_noise in solvers:
        cases = [
            renders.drawn_case(chain, solver, most, np.random.default_rng([seed, k]), joint_noise) for k in range(runs)
        ]
        nees.append([c.nees for c in cases])
        after.append(1e3 * float(np.median([c.history[-1] for c in cases])))
        third.append(1e3 * float(np.median([c.history[min(3, len(c.history) - 1)] for c in cases])))
    k = len(CASE_E)
    band = figures(3.0 * np.sqrt(2.0 * k / runs), 2)
    claims = (
        Claim(
            "normalised squared error, map",
            "",
            None,
            float(np.mean(nees[0])),
            k,
            why=f"Mean over {runs} experiments; theory {k} ± {band} (three standard errors).",
        ),
        Claim(
            "normalised squared error, the paper's recipe",
            "",
            None,
            float(np.median(nees[1])),
            k,
            why="Median, for the mean is dominated by the worst. (25), (26) say the covariance is P(N); that holds for data counted "
            "once. Three runs count them three times, and keep what the first linearisation got wrong as if measured.",
        ),
        Claim(
            "S_q left out: normalised squared error, map",
            "",
            None,
            float(np.mean(nees[2])),
            k,
            why="Joint readings taken as exact: the estimate is nearly the same, its covariance far too small.",
        ),
        Claim("mean error after three runs, map", "mm", None, third[0]),
        Claim("mean error after three runs, the paper's recipe", "mm", None, after[1]),
    )
    text = (
        "True offsets are drawn from the paper's prior, nothing is unmodelled. The squared error of the five offsets, in units of "
        "the covariance that the solver claims, must then be 5 on average."
    )
    return Chapter("II-G: properties of the estimator", text, claims)


def _figure_four(few_sets: int, many_sets: int, seed: int) -> Chapter:
    robot = builtin_robot("ulb")
    few = [renders.convergence(robot, 8, P0, np.random.default_rng([seed, k])) for k in range(few_sets)]
    many = [renders.convergence(robot, 60, P0, np.random.default_rng([seed, k])) for k in range(many_sets)]
    ml, plain = _means(few)
    ml60, plain60 = _means(many)
    best = int(np.argmin(plain.mean(axis=1)))
    share, share_best = (float(np.mean(ml <= plain[i])) for i in (-1, best))
    tail = float(ml60[-30:].mean() / plain60[-1, -30:].mean())
    claims = (
        Claim(
            "steps at which ML predicts no worse than LS, 8 points a line, P₀ large",
            "1",
            1.0,
            share,
            None,
            None,
            f"P₀ = {figures(P0[-1], 1)}, the “arbitrary large number” of II-I. “Prediction errors obtained by the ML algorithm "
            f"are smaller” (III-G): mean error over {few_sets} sets of lines, step by step.",
        ),
        Claim(
            "the same, P₀ chosen for LS",
            "1",
            1.0,
            share_best,
            None,
            0.1,
            f"Fig. 4 has P₀ “such that convergence rate was optimal”: here, of {len(P0)} values, the one with the smallest mean "
            f"error, {figures(P0[best], 1)}. A P₀ that fits the case is itself a prior and takes part of ML's advantage away; "
            "the paper shows one set of lines, the lead at a single step is within what noise does. Tolerance: a tenth of the steps.",
        ),
        Claim(
            "ML over LS at the end, 60 points a line",
            "1",
            1.0,
            tail,
            1.0,
            0.03,
            "“The accuracy levels become nearly identical if a large number of measurement points is used”: the last 30 steps, "
            "tolerance 3 %.",
        ),
    )
    pictures = (
        _prediction_figure("Fig. 4: 8 points a line", 8, ml, plain[-1], plain[best]),
        _prediction_figure("The same with 60 points a line", 60, ml60, plain60[-1], plain60[best]),
    )
    text = (
        "Prediction error of the point to come, in one recursive run over four lines, each placed by two points more. All row "
        "parameters that can be told apart are free and as uncertain as the prior says, angles to 0.01 rad."
    )
    return Chapter("Fig. 4: maximum likelihood and least squares", text, claims, figures=pictures)


def _means(runs: Sequence[Convergence]) -> tuple[Floats, Floats]:
    return (
        1e3 * np.mean([r.ml for r in runs], axis=0),
        1e3 * np.mean([r.ls for r in runs], axis=0),
    )


def _maps(chain: Chain) -> Chapter:
    where = renders.section(chain, 0.05)
    prior = renders.a_priori(chain, where)
    found = 1e3 * renders.error_map(chain, where, CASE_F)
    worst = prior.worst
    claims = (
        Claim("largest expected error (RMS) in the section", "mm", None, 1e3 * float(prior.rms.max())),
        Claim("smallest", "mm", None, 1e3 * float(prior.rms.min())),
        Claim(
            "largest over smallest standard deviation at the worst place",
            "1",
            None,
            float(prior.sigma_largest[worst] / prior.sigma_smallest[worst]),
            why="How much the direction of motion matters there.",
        ),
        Claim("error map (31) with the errors of III-F: largest", "mm", None, float(found.max())),
        Claim("smallest", "mm", None, float(found.min())),
    )
    text = (
        f"Tolerances of {1e3 * LENGTH_SIGMA:.0f} mm and {ANGLE_SIGMA} rad on every row (III-C) make an error before anything is "
        "measured; it is largest where measuring pays most (III-G), and smallest along one direction. Fig. 5 of the paper prints no "
        "scale that could be read from the scan."
    )
    pictures = (
        _map_figure(
            "II-D: expected error, direction of the smallest", where, 1e3 * prior.rms, prior.direction_smallest
        ),
        _map_figure("Fig. 5: error map of the identified robot", where, found, None),
    )
    return Chapter("II-D and Fig. 5: error maps", text, claims, figures=pictures)


def _runs_figure(histories: dict[str, Floats], paper: Floats, at: Floats) -> Figure:
    histories = {key: values[: SHOWN + 1] for key, values in histories.items()}
    every = np.concatenate([*histories.values(), paper])
    last = max(len(h) for h in histories.values()) - 1
    plot = svg.Plot(svg.linear_axis("run", 0, last, 1.0 if last < 6 else 2.0), svg.log_axis("mean error [mm]", every))
    parts = [svg.axes(plot), svg.line(plot, at, paper, "old line")]
    parts.append(svg.scatter(plot, at, paper, "old", [f"paper: {v} mm" for v in paper], 4))
    names = {"paper": ("val", "its recipe"), "map": ("fit", "map"), "gears": ("law", "map, gear errors")}
    for key, (css, name) in names.items():
        values = histories[key]
        parts.append(svg.line(plot, np.arange(values.size), values, css + " line"))
        parts.append(
            svg.scatter(plot, np.arange(values.size), values, css, [f"{name}: {figures(v)} mm" for v in values], 3)
        )
    entries = [("old line", "paper"), *((css + " line", name) for css, name in names.values())]
    parts.append(svg.legend(plot, entries))
    caption = "Mean error of the identification lines, placed by least squares; the paper's points are as printed."
    return _drawn(plot, "Mean error, run by run", caption, parts)


def _prediction_figure(title: str, points: int, ml: Floats, plain: Floats, best: Floats) -> Figure:
    steps = np.arange(1, ml.size + 1)
    reach = np.concatenate([ml, plain, best])
    plot = svg.Plot(
        svg.linear_axis("point", 0, ml.size), svg.log_axis("prediction error [mm]", np.percentile(reach, [1.0, 100.0]))
    )
    parts = [svg.axes(plot)]
    for css, values in (("old line", plain), ("val line", best), ("fit line", ml)):
        parts.append(svg.line(plot, steps, values, css))
    parts.append(svg.legend(plot, [("fit line", "ML"), ("val line", "LS, best P₀"), ("old line", "LS, large P₀")]))
    caption = f"A new line begins every {points} points, with six unknowns of its own: there the error leaps."
    return _drawn(plot, title, caption, parts)


def _map_figure(title: str, where: renders.Section, error: Floats, direction: Floats | None) -> Figure:
    """A cell for every pose, the darker the larger the error; a stroke along ``direction`` (n, 3) as seen from the side."""
    half = 0.025
    x_axis = svg.linear_axis("x [m]", float(where.x.min()) - half, float(where.x.max()) + half, 0.1)
    z_axis = svg.linear_axis("z [m]", float(where.z.min()) - half, float(where.z.max()) + half, 0.2)
    plot = svg.Plot(x_axis, z_axis, height=480.0)
    shade = (error - error.min()) / max(float(np.ptp(error)), svg.SMALLEST)
    left, right = plot.px(where.x - half), plot.px(where.x + half)
    top, bottom = plot.py(where.z + half), plot.py(where.z - half)
    parts = [svg.axes(plot)]
    for i, e in enumerate(error):
        tip = f"x {where.x[i]:.2f} m, z {where.z[i]:.2f} m: {figures(float(e))} mm"
        size = right[i] - left[i], bottom[i] - top[i]
        parts.append(svg.rect(left[i], top[i], *size, "cell", tip, f' fill-opacity="{0.08 + 0.8 * shade[i]:.2f}"'))
        if direction is not None:
            ends = 0.02 * np.array([-1.0, 1.0])
            x, z = where.x[i] + ends * direction[i, 0], where.z[i] + ends * direction[i, 2]
            parts.append(svg.line(plot, x, z, "stroke"))
    caption = f"Vertical section, θ1 = θ4 = θ6 = 0, elbow up, hand down: {figures(float(error.min()))} to "
    caption += f"{figures(float(error.max()))} mm, the darker the larger."
    if direction is not None:
        caption += " Strokes: the direction of the smallest error, projected; a dot is one across the section."
    return _drawn(plot, title, caption, parts)


def _drawn(plot: svg.Plot, title: str, caption: str, parts: Sequence[str]) -> Figure:
    return Figure(title, caption, svg.drawing(plot.width, plot.height, parts, f"{title}. {caption}"))
