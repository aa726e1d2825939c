"""The chapters of ``truearm reproduce renders``: the results of ``renders`` compared with the paper."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import assert_never

import numpy as np

from truearm.model.chain import Chain
from truearm.model.robot import builtin_robot
from truearm.report.page_text import figures, number
from truearm.report.reproduce_page import Chapter, Claim, PageTable, left_out
from truearm.reproduce import renders
from truearm.reproduce.goswami_page import ReportStep
from truearm.reproduce.line_bench import ANGLE_SIGMA, LENGTH_SIGMA, measured_lines
from truearm.reproduce.prediction_page import figure_four
from truearm.reproduce.renders import CASE_E, CASE_F, GEAR, N_LINES, N_POINTS, PRINTED_E, PRINTED_F, WIDE, Case
from truearm.reproduce.renders_plots import map_figure, runs_figure
from truearm.types import Floats, LinePlacement
from truearm.units import MM

TITLE = "Straight-line calibration of the ULB robot"
SOURCE = (
    "J.-M. Renders, E. Rossignol, M. Becquet, R. Hanus: Kinematic Calibration and Geometrical Parameter Identification "
    "for Robots. IEEE Transactions on Robotics and Automation 7(6), 1991"
)
PAPER_E, PAPER_F = (11.28, 4.95, 0.89, 0.81), {1: 3.15, 12: 0.61}  # mm, mean error before and after each run
RUNS_E, RUNS_F = 3, 12
COMMENTED = ("joint2.offset", "joint5.offset", "joint6.offset")  # III-G compares their errors
IMPROVEMENT = 0.25  # III-G 1: "about 25%"
FROZEN = ("joint1.offset", "joint1.d", "joint2.d", "joint6.alpha")
UNSTATED = "The paper does not say where its lines were; the number is a median over sets of lines."


def chapters(quick: bool, seed: int, step: ReportStep) -> Iterator[Chapter]:
    """Yield chapter after chapter; ``quick`` uses fewer line sets and Monte Carlo runs."""
    chain = builtin_robot("ulb").chain
    sets = 3 if quick else 12
    with step("III-D: what must be frozen; II-F: batch and recursive"):
        yield _frozen(chain, seed)
    with step(f"III-E: joint offsets, {sets} sets of lines"):
        yield _identified(chain, "E", sets, seed)
    with step(f"III-F: offsets and lengths, {sets} sets of lines"):
        yield _identified(chain, "F", sets, seed)
    with step(f"III-G: offsets alone, and offsets and lengths, {sets} sets of lines"):
        yield _comments(chain, sets, seed)
    runs = 6 if quick else 60
    with step(f"II-G: is the covariance correct? {runs} experiments per solver"):
        yield _covariance(chain, runs, seed)
    with step("Fig. 4: maximum likelihood and least squares"):
        yield figure_four(quick, seed)
    with step("II-D and Fig. 5: error maps"):
        yield _maps(chain)
    yield _left_out()


def _left_out() -> Chapter:
    rows = (
        (
            "II-B: joint and link flexibility 8 to 10 %, of links 5 %, backlash 0.5 to 1 %, temperature 0.1 %, all nongeometrical "
            "errors 10 % of the error",
            "quoted from other papers; no data",
        ),
        (
            "III-C: S_x, S_q, 1 mm and 0.052 rad; III-E and III-F: the five and nine identified errors",
            "inputs: the simulated sensors, joints, priors and robots have these values",
        ),
        (
            "II-C: 1000 mm and 0.1 mm, 15 mm and 0.6 µm, 0.1 mm in each direction",
            "specifications of the device; the simulated noise has the covariance S_x of III-C",
        ),
        (
            "III-E: 12 points on each of 5 lines, 4 of them fitted; III-G: 10 points per line, 8 of them used; II-C: six unknowns per "
            "line",
            "settings of the experiments, not results; the simulated lines have them",
        ),
        (
            "II-C: a few seconds to measure a line",
            "depends on the device; the simulated robot drives at a speed of its own",
        ),
        ("II-C: 1/4000 of full scale, 0.1 mm, 50 Hz", "specifications of devices that the paper does not use"),
        ("III-E: 90 % of the error comes from joint offsets", "quoted from other papers; no data"),
        (
            "V: 1 kg bends the arm by 0.2 mm; 0.5 mm is the best without nongeometrical errors",
            "measured on an arm; the data are not published",
        ),
        (
            "IV: (32), (34), (35)",
            "methods of correction, without numbers in the paper; `truearm correct --method` implements them",
        ),
        ("Fig. 1, 2, 3", "drawings and a photograph"),
    )
    return left_out(rows)


def _frozen(chain: Chain, seed: int) -> Chapter:
    rows = renders.with_d2(chain)
    rng = np.random.default_rng(seed)
    counted = {a6: (renders.unseen(rows, a6, (), rng), renders.unseen(rows, a6, FROZEN, rng)) for a6 in (0.0, 0.05)}
    session = measured_lines(chain, renders.errors_added(chain, CASE_E), N_LINES, N_POINTS, rng)
    delta, covariance = renders.batch_against_recursive(chain, session)
    claims = (
        Claim("numbers of Table I that the robot file has", "", 18, renders.table_one(chain)),
        Claim(
            "parameters that lines cannot determine, a6 ≠ 0",
            "",
            len(FROZEN),
            counted[0.05][0],
            4,
            why="The paper freezes θ1, d1, α6 and d2; the rank confirms this.",
        ),
        Claim("unidentifiable after θ1, d1, α6 and d2 are frozen, a6 ≠ 0", "", 0, counted[0.05][1], 0),
        Claim(
            "parameters that lines cannot determine, a6 = 0 as in Table I",
            "",
            len(FROZEN),
            counted[0.0][0],
            7,
            why="The flange's centre is on the axis of joint 6: θ6 has no effect, θ5 cannot be distinguished from a5, and α5 not from "
            "d5. The paper gives a σ of θ6 below its prior, so it may have measured a point off that axis; it does not say.",
        ),
        Claim("unidentifiable after θ1, d1, α6 and d2 are frozen, a6 = 0", "", None, counted[0.0][1], 3),
        Claim(
            "batch (12) against recursive (18), (20): estimate",
            "1",
            0.0,
            delta,
            0.0,
            1e-7,
            "Largest relative difference: rounding errors times the condition number of the problem.",
        ),
        Claim("the same: covariance", "1", 0.0, covariance, 0.0, 1e-10),
    )
    text = (
        "Rank of the Jacobian of the points with respect to all Denavit–Hartenberg parameters, with the device's pose projected out. (18) is "
        "missing in the scanned paper, the second “=” of (20) should be “+”, and the signs after (19) are wrong. With these corrections, both forms agree."
    )
    return Chapter("III-D: fixed parameters; II-F: recursive form", text, claims)


def _identified(chain: Chain, name: str, sets: int, seed: int) -> Chapter:
    errors, runs = (CASE_E, RUNS_E) if name == "E" else (CASE_F, RUNS_F)
    truth = renders.errors_added(chain, errors)
    found: dict[str, list[Case]] = {"paper": [], "map": [], "gears": []}
    starts: dict[LinePlacement, list[float]] = {rule: [] for rule in LinePlacement}
    for k in range(sets):
        clean = measured_lines(chain, truth, N_LINES, N_POINTS, np.random.default_rng([seed, k]))
        rough = measured_lines(chain, truth, N_LINES, N_POINTS, np.random.default_rng([seed, k]), GEAR)
        for rule in LinePlacement:
            starts[rule].append(renders.before(chain, clean, rule))
        found["paper"].append(renders.case(chain, clean, truth, errors, "renders-1991", runs=runs))
        found["map"].append(renders.case(chain, clean, truth, errors, "map"))
        found["gears"].append(renders.case(chain, rough, truth, errors, "map"))
    histories = {key: _median_history(cases) for key, cases in found.items()}
    placed = {rule: MM.of(float(np.median(values))) for rule, values in starts.items()}
    claims = (*_case_claims(name, placed, found, histories, runs), *_sigma_claims(chain, name, found, runs))
    text = (
        f"Four lines of {N_POINTS} points are fitted, and a fifth validates. The true robot has the errors that the paper identified in "
        f"III-{name}. Sensors, joints and priors are those of III-C, except for the position of the device: it is estimated with the "
        f"inaccurate nominal robot, so the prior is {MM.text(WIDE, '.0f')} instead of 1 mm. Numbers are medians over {sets} sets of lines."
    )
    title = "III-E: errors of the joint encoders' zeroes" if name == "E" else "III-F: offsets and four lengths"
    head = ("placement of a line", "mean error before [mm]")
    table = PageTable(
        "What “before” depends on", head, tuple((_placed_by(rule), number(value, 2)) for rule, value in placed.items())
    )
    paper = np.array(PAPER_E if name == "E" else [PAPER_E[0], *PAPER_F.values()])
    at = np.array([0.0, 1.0, 2.0, 3.0] if name == "E" else [0.0, *map(float, PAPER_F)])
    return Chapter(title, text, claims, (table,), (runs_figure(histories, paper, at),))


def _placed_by(rule: LinePlacement) -> str:
    match rule:
        case LinePlacement.LEAST_SQUARES:
            return "least squares"
        case LinePlacement.TWO_POINT:
            return "its first two points"
        case _:
            assert_never(rule)


def _case_claims(
    name: str, placed: dict[LinePlacement, float], found: dict[str, list[Case]], histories: dict[str, Floats], runs: int
) -> tuple[Claim, ...]:
    paper = dict(enumerate(PAPER_E)) if name == "E" else {0: PAPER_E[0], **PAPER_F}
    claims = [
        Claim(
            "mean error before, lines placed by their first two points",
            "mm",
            PAPER_E[0],
            placed[LinePlacement.TWO_POINT],
            None,
            None,
            f"{UNSTATED} III-G places lines by two points; by least squares it is {figures(placed[LinePlacement.LEAST_SQUARES])} mm.",
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
                "Lines placed by least squares. Each run uses the posterior of the previous run as its prior, on the same data."
                if run == 1
                else "",
            )
        )
    for key, what in (
        ("map", "map, no unmodelled error"),
        ("gears", f"map, gear errors of {figures(GEAR, 1)} rad"),
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
                f"map is truearm's solver: maximum a posteriori with one fixed prior. {runs_needed:.0f} runs, {figures(float(histories[key][3]))} mm after the third."
                if key == "map"
                else "Gear errors represent what the paper calls nongeometrical errors; their amplitude is an assumption.",
            )
        )
    before, after = (
        MM.of(float(np.median([getattr(c, k) for c in found["gears"]])))
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
            "The pose of its device is fitted with the robot fixed, before and after.",
        ),
        Claim("validation line, after", "mm", 0.81 if name == "E" else 0.68, after, None, None),
        Claim(
            "error before over error after",
            "1",
            PAPER_E[0] / paper[runs],
            factor,
            None,
            None,
            "map, lines placed by least squares, with gear errors. The abstract says “by a factor of more than 15”.",
        ),
    ]
    return tuple(claims)


def _sigma_claims(chain: Chain, name: str, found: dict[str, list[Case]], runs: int) -> Iterator[Claim]:
    """Yield the σ that the paper prints next to its errors, in its units."""
    metres = {p.name for p in chain.parameters if p.unit == "m"}
    for parameter, (_, sigma) in (PRINTED_E if name == "E" else PRINTED_F).items():
        unit, shown = ("mm", MM.of) if parameter in metres else ("rad", float)
        recipe, once = (shown(_median([c.sigma[parameter] for c in found[key]])) for key in ("paper", "map"))
        because = (
            " In Table I a6 = 0: the flange's centre is on the axis of joint 6, so θ6 has no effect and its σ is that of the prior."
            if parameter == "joint6.offset" and name == "E"
            else ""
        )
        why = f"{UNSTATED} The paper's recipe counts the data {runs} times; map counts them once and gives {figures(once, 2)} {unit}.{because}"
        yield Claim(f"σ of {parameter}, the paper's recipe", unit, shown(sigma), recipe, None, None, why)


def _median(values: Sequence[float]) -> float:
    return float(np.median(values))


def _comments(chain: Chain, sets: int, seed: int) -> Chapter:
    """Return III-G 1 and 2: the same lines explained by offsets alone, and by offsets and lengths."""
    found: dict[str, dict[str, list[Case]]] = {}
    for truth_name, errors in (("III-E", CASE_E), ("III-F", CASE_F)):
        truth = renders.errors_added(chain, errors)
        cases: dict[str, list[Case]] = {"alone": [], "beside": []}
        for k in range(sets):
            lines = measured_lines(chain, truth, N_LINES, N_POINTS, np.random.default_rng([seed, k]), GEAR)
            cases["alone"].append(renders.case(chain, lines, truth, CASE_E, "map"))
            cases["beside"].append(renders.case(chain, lines, truth, CASE_F, "map"))
        found[truth_name] = cases
    claims = [_improvement(name, cases) for name, cases in found.items()]
    for parameter in COMMENTED:
        alone, beside = (_median([c.error[parameter] for c in found["III-F"][key]]) for key in ("alone", "beside"))
        printed = PRINTED_E[parameter][0], PRINTED_F[parameter][0]
        claims.append(
            Claim(
                f"{parameter}: second case minus first case",
                "rad",
                printed[1] - printed[0],
                beside - alone,
                None,
                None,
                f"{UNSTATED} The paper: {printed[0]} and {printed[1]} rad; here {figures(alone)} and {figures(beside)} rad, for a robot with "
                "the errors of III-F.",
            )
        )
    text = (
        "The same lines are fitted twice: with the joints' offsets alone (the paper's first case), and with offsets and the lengths a2, d4, "
        f"a6, d6 (its second case). The joints have gear errors of {figures(GEAR, 1)} rad. “Difference on some values of error between the two cases is "
        "significant”: in the first case, the offsets absorb errors of the lengths."
    )
    return Chapter("III-G: offsets alone, and offsets and lengths", text, tuple(claims))


def _improvement(truth: str, cases: Mapping[str, Sequence[Case]]) -> Claim:
    alone, beside = (MM.of(_median([c.history[-1] for c in cases[key]])) for key in ("alone", "beside"))
    return Claim(
        f"reduction of the mean error by fitting the lengths, for a robot with the errors of {truth}",
        "1",
        IMPROVEMENT,
        1.0 - beside / alone,
        None,
        None,
        f"{figures(alone)} mm with offsets alone, {figures(beside)} mm with lengths too; the paper's 0.81 and 0.61 mm give 0.247. The "
        "reduction depends on the errors of the lengths. The two robots are the extremes: no errors, and all errors of III-F.",
    )


def _median_history(cases: Sequence[Case]) -> Floats:
    """Return the median (runs + 1,) over cases of the mean error [mm] after each run; finished cases keep their last."""
    longest = max(4, *(len(c.history) for c in cases))
    held = [np.concatenate([c.history, np.full(longest, c.history[-1])])[:longest] for c in cases]
    return np.asarray(MM.of(np.median(held, axis=0)))


def _covariance(chain: Chain, runs: int, seed: int) -> Chapter:
    solvers = (("map", 50, True), ("renders-1991", RUNS_E, True), ("map", 50, False))
    nees, after, third = [], [], []
    for solver, most, joint_noise in solvers:
        cases = [
            renders.drawn_case(chain, solver, most, np.random.default_rng([seed, k]), joint_noise) for k in range(runs)
        ]
        nees.append([c.nees for c in cases])
        after.append(MM.of(float(np.median([c.history[-1] for c in cases]))))
        third.append(MM.of(float(np.median([c.history[min(3, len(c.history) - 1)] for c in cases]))))
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
            why="Median, because the worst experiment dominates the mean. By (25) and (26) the covariance is P(N), which is true if the data "
            "count once. Three runs count them three times, and treat the error of the first linearisation as if it were measured.",
        ),
        Claim(
            "S_q left out: normalised squared error, map",
            "",
            None,
            float(np.mean(nees[2])),
            k,
            why="With exact joint readings assumed, the estimate is nearly the same, but its covariance is far too small.",
        ),
        Claim("mean error after three runs, map", "mm", None, third[0]),
        Claim("mean error after three runs, the paper's recipe", "mm", None, after[1]),
    )
    text = (
        "The true offsets are drawn from the paper's prior, and there are no unmodelled errors. The squared error of the five offsets, "
        "normalised by the covariance from the solver, must then be 5 on average."
    )
    return Chapter("II-G: properties of the estimator", text, claims)


def _maps(chain: Chain) -> Chapter:
    where = renders.section(chain, 0.05)
    prior = renders.a_priori(chain, where)
    found = MM.of(renders.error_map(chain, where, CASE_F))
    worst = prior.worst
    claims = (
        Claim("largest expected error (RMS) in the section", "mm", None, MM.of(float(prior.rms.max()))),
        Claim("smallest", "mm", None, MM.of(float(prior.rms.min()))),
        Claim(
            "largest over smallest standard deviation at the worst place",
            "1",
            None,
            float(prior.sigma_largest[worst] / prior.sigma_smallest[worst]),
            why="The expected error depends on the direction by this factor.",
        ),
        Claim("error map (31) with the errors of III-F: largest", "mm", None, float(found.max())),
        Claim("smallest", "mm", None, float(found.min())),
    )
    text = (
        f"Tolerances of {MM.text(LENGTH_SIGMA, '.0f')} and {ANGLE_SIGMA} rad on every row (III-C) cause an error before anything is "
        "measured. Measuring is most useful where this error is largest (III-G). Each place has a direction in which the error is smallest. "
        "The scale of Fig. 5 is not legible in the scan of the paper."
    )
    pictures = (
        map_figure(
            "II-D: expected error, direction of the smallest", where, MM.of(prior.rms), prior.direction_smallest
        ),
        map_figure("Fig. 5: error map of the identified robot", where, found, None),
    )
    return Chapter("II-D and Fig. 5: error maps", text, claims, figures=pictures)
