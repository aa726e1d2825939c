"""``truearm characterize`` on a simulated robot, compared with the simulator's truth; and identify with its noise file."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from approaches_bench import planned
from command_line import told
from scipy import stats
from session_stream import stream_of, write_session
from tests.refusals import shown
from world_stream import HOST_NS, messages_of

from truearm.estimate.identify import identify
from truearm.estimate.problem import build_problem
from truearm.estimate.whitened_rows import whitened_blocks
from truearm.kinds.rig_file import NoiseFile, format_rig, read_noise, with_noise
from truearm.model.chain import along, trace_point
from truearm.model.robot_file import builtin_robot
from truearm.plan.first_rig import REPEATABILITY
from truearm.plan.plan_file import write_plan
from truearm.session.observations import observations, survey
from truearm.types import Message
from truearm.workflows.characterize import characterized, visits
from truearm_sim import robot, sensors
from truearm_sim.arm import Arm
from truearm_sim.world import World, standard_plan, standard_rig

BACKLASH = (4e-4, 2e-4, 3e-4, 5e-4, 2e-4, 8e-4)
WORN = Arm(backlash=BACKLASH, reading_sigma=2e-5)
BANDS = (20e-6, 50e-6)
PUMA = builtin_robot("puma560")


@cache
def world(seed):
    return World(seed, planned()[1].visits, arm=WORN)


@cache
def messages(seed):
    return stream_of(messages_of(world(seed), seed))


@cache
def said(seed):
    return characterize(messages(seed))


def characterize(stream):
    result = observations(survey(stream), standard_rig(), name="run")
    return characterized([result], PUMA.chain, standard_rig(), BANDS, "run")


def truth():
    """Return the true value of each number that ``characterized()`` gives as an interval, by name."""
    rounding = robot.STEP**2 / 12.0  # a reading's, which its noise spreads over several steps
    readings = WORN.reading_sigma**2 + rounding
    spread = np.sqrt(robot.SERVO_SIGMA**2 + readings / 80.0)  # 80 readings or so a dwell: next to nothing
    return {
        "bar_sigma": REPEATABILITY,
        "sample": sensors.SAMPLE_SIGMA,
        **{f"backlash {j}": b for j, b in enumerate(BACKLASH)},
        **{f"S_q {j}": np.sqrt(0.25 * b**2 + readings / 80.0) for j, b in enumerate(BACKLASH)},
        **{f"difference {j}": 0.0 for j in range(6)},
        **{f"spread {j}": spread for j in range(6)},
        **{f"reading {j}": np.sqrt(readings) for j in range(6)},
    }


def intervals(document):
    of = document["repeatability"]
    return {
        "bar_sigma": document["noise"]["bar_sigma_m"],
        "sample": document["sensor"]["sample_m"],
        **{f"backlash {j}": one for j, one in enumerate(of["backlash_si"])},
        **{f"S_q {j}": one for j, one in enumerate(document["noise"]["joint_sigma_si"])},
        **{f"difference {j}": one for j, one in enumerate(of["reading_difference_si"])},
        **{f"spread {j}": one for j, one in enumerate(of["reading_spread_si"])},
        **{f"reading {j}": one["reading_si"] for j, one in enumerate(document["readings"])},
    }


def covered(document):
    return {name: one["low"] <= truth()[name] <= one["high"] for name, one in intervals(document).items()}


def test_intervals_hold_the_truth():
    """32 intervals of 95 %: fewer than 25 that contain the truth would occur once in ten thousand runs."""
    assert sum(covered(said(1)[0]).values()) >= 25


@pytest.mark.soak
def test_intervals_hold_the_truth_as_often_as_they_say():
    """50 seeds: each figure's interval covers in a share of runs that 95 % give, within 99.9 %; all together within 1.5 %."""
    runs = []
    for seed in range(100, 150):
        stream = stream_of(messages_of(World(seed, planned()[1].visits, arm=WORN), seed))
        runs.append(covered(characterize(stream)[0]))
    share = {name: np.mean([run[name] for run in runs]) for name in runs[0]}
    print({name: round(float(value), 3) for name, value in share.items()})
    least = stats.binom.ppf(0.0005, 50, 0.95) / 50
    assert min(share.values()) >= least
    assert np.mean(list(share.values())) == pytest.approx(0.95, abs=0.015)


def stop_of(seed, dwell):
    """Return the controller's stop that corresponds to a dwell, by time: the plan has the same pose several times."""
    return int(world(seed).controller.stop_index(np.array([1e-9 * (dwell.start_host_ns - HOST_NS)]))[0])


def test_every_visit_came_from_the_side_it_came_from():
    found = visits(observations(survey(messages(1)), standard_rig()), standard_rig(), BANDS)
    controller = world(1).controller
    for visit in found:
        assert np.array_equal(np.nan_to_num(visit.side), controller.direction[stop_of(1, visit.dwell)])


def settled_after(size, band_first, band_last):
    """Return the time from the first entry into one band to the last exit from another, for a bar's motion (n,) at steps of 0.2 ms."""
    coming = int(np.flatnonzero(size >= 0.5 * size.max())[-1])
    left = int(np.flatnonzero(size[coming:] > band_last).max(initial=-1)) + 1
    return 2e-4 * (left - int(np.argmax(size[coming:] <= band_first)))


def test_settling_times_are_those_of_the_bar_without_noise():
    """Each between what a band narrower and one wider by the noise allow, and a sample's period. Noise: five sigma of a sample
    and four of the dwell's mean. Of a wide band that says it to some samples, and the medians are alike."""
    result = observations(survey(messages(1)), standard_rig())
    found = visits(result, standard_rig(), BANDS)
    controller = world(1).controller
    for k, band in enumerate(BANDS):
        times = np.array([visit.settling[k] for visit in found])
        known = np.flatnonzero(np.isfinite(times))
        assert known.size > 0.6 * len(times)
        least, most, true = np.empty((3, known.size))
        for at, i in enumerate(known):
            dwell, period_s = found[i].dwell, found[i].period_s
            stop = stop_of(1, dwell)
            t = np.arange(controller.move_start[stop], controller.arrive[stop] + 0.6, 2e-4)
            size = np.abs(world(1).length(t) - world(1).length(t[-1:]))
            noise = 5.0 * dwell.noise + 4.0 * np.sqrt(dwell.value_var)
            assert noise < 0.9 * band
            least[at] = settled_after(size, band - noise, band + noise) - period_s
            most[at] = settled_after(size, band + noise, band - noise) + period_s
            true[at] = max(0.0, settled_after(size, band, band))
        assert (times[known] >= least).all()
        assert (times[known] <= most).all()
        # of the narrower one half the visits swing out once more and half do not: either is the median
        if band == max(BANDS):
            assert np.median(most - least) < 6.0 * period_s
            assert abs(np.median(times[known]) - np.median(true)) <= period_s


def found_noise(seed):
    """Return the noise that a run finds, for both bars, and its degrees of freedom."""
    run = stream_of(messages_of(World(seed, planned()[1].visits, arm=WORN), seed))
    document, noise = characterize(run)
    freedom = document["visits"] - document["poses"] - len(BACKLASH)
    return replace(noise, bar_sigma=dict.fromkeys(("bar46", "bar61"), noise.bar_sigma["bar46"])), freedom


class Calibration:
    """100 poses of a worn arm with each bar, and the simulator's truth."""

    def __init__(self, seed):
        self.world = World(seed, standard_plan(100, seed), arm=WORN)
        self._synced = observations(survey(stream_of(messages_of(self.world, seed))), standard_rig())
        used = [dwell for dwell in self._synced.dwells if not dwell.reason]
        controller = self.world.controller
        middle = np.array([0.5e-9 * (d.start_host_ns + d.end_host_ns - 2 * HOST_NS) for d in used])
        self.side = controller.direction[controller.stop_index(middle)]
        self.value_var = np.array([dwell.value_var for dwell in used])

    def table(self, noise, sides=True):
        """Return the rows as an identification with this noise sees them; without ``sides``, as from an external table."""
        table, bars = self._synced.table, with_noise(standard_rig(), noise).bars
        bar_sigma = np.array([bars[str(name)].sigma for name in table.bar])
        side = table.side if sides else np.full_like(table.side, np.nan)
        return replace(table, sigma=np.hypot(np.sqrt(self.value_var), bar_sigma), side=side)

    def fitted(self, noise, sides=True):
        return identify(PUMA.chain, with_noise(standard_rig(), noise), self.table(noise, sides), free=PUMA.free)

    def error(self, fit):
        """Return the squared error of the identified parameters in units of their covariance (NEES)."""
        free = PUMA.free
        error = fit.value[: free.size][free] - self.world.params[free]
        return float(error @ np.linalg.solve(fit.covariance[: free.size, : free.size][np.ix_(free, free)], error))

    def expected(self, noise, fit):
        """Mean and σ of χ² (n − 36 of it) and of NEES, by theory: from the true backlash, sides and noise, and the sigmas that were told.

        Whitened, the lengths' errors are e = ε + ν: ε what the links lie behind their encoders by, which is not chance once the sides are
        drawn, and ν of variance w. With the projection H on what 36 parameters can do, χ² = eᵀ(I − H)e and NEES = eᵀHe.
        """
        rig, table = with_noise(standard_rig(), noise), self.table(noise, sides=False)
        problem = build_problem(PUMA.chain, rig, table)
        columns = np.zeros(len(problem.names), bool)
        columns[: PUMA.free.size] = PUMA.free
        (rows,) = whitened_blocks(problem, fit.value, columns)
        sigma = rows.noise_root[:, 0, 0]
        points = [
            [getattr(rig, kind)[name].xyz for name in getattr(table, kind[:-1])] for kind in ("spheres", "chucks")
        ]
        trace = trace_point(PUMA.chain, self.world.params, table.q, np.array(points[0]))
        bar = trace.p_base - points[1]
        jac = along(trace, bar / np.linalg.norm(bar, axis=1)[:, None]).jac_joints
        reading = (WORN.reading_sigma**2 + robot.STEP**2 / 12.0) / 80.0
        lag = -0.5 * (jac * self.side) @ BACKLASH / sigma
        w = (REPEATABILITY**2 + self.value_var + reading * np.square(jac).sum(axis=1)) / sigma**2
        basis, _ = np.linalg.qr(rows.jac[:, 0])
        projection = basis @ basis.T
        found = []
        for part in (np.eye(len(lag)) - projection, projection):
            mean = lag @ part @ lag + w @ np.diag(part)
            variance = 2.0 * np.sum((part * w) * (part * w).T) + 4.0 * np.square(part @ lag) @ w
            found += [mean, np.sqrt(variance)]
        return found


@cache
def worn_calibration():
    return Calibration(11)


def test_the_noise_that_was_found_makes_chi2_one():
    """200 rows with 36 unknowns and a noise that was measured too: within 99 % of F; a quiet bar is far below that."""
    noise, noise_freedom = found_noise(1)
    right = worn_calibration().fitted(noise)
    low, high = stats.f.ppf([0.005, 0.995], right.chi2_freedom, noise_freedom)
    assert low < right.chi2_reduced < high
    quiet = worn_calibration().fitted(NoiseFile(bar_sigma=dict.fromkeys(("bar46", "bar61"), 1e-3)))
    assert quiet.chi2_reduced < 0.2 * quiet.chi2_band[0]


def test_backlash_as_declared_or_without_sides_is_what_theory_says():
    """Not told of backlash χ² is too large, with backlash as noise of either side too small, both within 99 % of their theory.

    A joint moves so that the bar keeps about its length, and what the sides of several joints do to it cancels in part.
    """
    calibration = worn_calibration()
    for noise, above in ((NoiseFile(), True), (found_noise(1)[0], False)):
        fit = calibration.fitted(noise, sides=False)
        mean, sigma, *_ = calibration.expected(noise, fit)
        freedom = len(calibration.side) - int(PUMA.free.sum())
        assert abs(fit.chi2_reduced * freedom - mean) < 2.58 * sigma
        assert (mean > freedom) == above


@pytest.mark.soak
def test_the_covariance_is_honest_with_the_noise_that_was_found():
    """NEES and χ² over 50 calibrations of a worn arm, each with noise found in a run of its own.

    A noise of ν degrees of freedom makes both F(·, ν): over 120 runs NEES has a standard deviation of 10.4, χ² alone 8.5.
    """
    runs, free = [], int(PUMA.free.sum())
    for seed in range(200, 250):
        (noise, noise_freedom), calibration = found_noise(seed), Calibration(seed + 1000)
        fit, blind = calibration.fitted(noise), calibration.fitted(noise, sides=False)
        freedom = len(calibration.side) - free
        expected = calibration.expected(noise, blind)
        ratio = np.median((fit.sigma / blind.sigma)[: PUMA.free.size][PUMA.free])
        one = [
            calibration.error(fit),
            fit.chi2_reduced * freedom,
            calibration.error(blind),
            blind.chi2_reduced * freedom,
        ]
        runs.append([*one, freedom, noise_freedom, *expected, ratio])
    errors, chi2, blind_errors, blind_chi2, freedom, noise_freedom, *expected, ratio = np.array(runs).T
    print("NEES", errors.mean(), "χ²", (chi2 / freedom).mean(), "σ to that without sides", ratio.mean())
    print(
        "without sides: NEES", blind_errors.mean(), expected[2].mean(), "χ²", blind_chi2.sum() / freedom.sum(), end=" "
    )
    print(expected[0].sum() / freedom.sum())
    rng = np.random.default_rng(0)
    for total, of in ((errors.sum(), np.full(50, free)), (chi2.sum(), freedom)):
        low, high = np.quantile(rng.f(of, noise_freedom, (100_000, 50)) @ of, [0.005, 0.995])
        assert low < total < high
    for total, mean, sigma in ((blind_chi2, *expected[:2]), (blind_errors, *expected[2:])):
        assert abs(total.sum() - mean.sum()) < 2.58 * np.linalg.norm(sigma)
    assert expected[2].mean() < free


def test_from_a_session_file_to_a_noise_file(tmp_path, run):
    path, out = write_session(tmp_path / "s.mcap", messages_of(world(1), 1), standard_rig()), tmp_path / "noise.toml"
    code, text, err = run("characterize", path, "--model", "puma560", "--within-mm", "0.02", "--out", out)
    assert (code, err) == (0, "")
    assert text.startswith("Repeatability ")
    assert len(text.splitlines()) <= 15
    assert text.endswith(f"Written: {out}\n")
    assert shown["settling-measured"]["bands"][0].startswith("0.02 mm ")
    assert shown["noise-measured"]["floor"].endswith(" µm")
    assert read_noise(out).bar_sigma["bar46"] == said(1)[1].bar_sigma["bar46"]
    code, text, _ = run("characterize", path, "--model", "puma560", "--json", "--out", out, "--force")  # again
    document = json.loads(text)
    assert code == 0
    assert document["noise"] == json.loads(json.dumps(said(1)[0]["noise"]))
    assert "backlash/mrad" in run("characterize", path, "--model", "puma560", "--details").out


def test_the_parts_of_a_session_are_one(tmp_path, run):
    """A break in the middle: the second part begins with the box's description and the plan, as the recorder writes them."""
    said_first = [m for m in messages_of(world(1), 1) if m.topic in ("/box/ident", "/plan")]
    told = [m for m in messages_of(world(1), 1) if m.topic not in ("/box/ident", "/plan")]
    middle = told[len(told) // 2].t_host_ns
    begun = [Message(m.topic, middle, m.data) for m in said_first]
    first = write_session(
        tmp_path / "s.mcap", [*said_first, *(m for m in told if m.t_host_ns < middle)], standard_rig()
    )
    second = write_session(
        tmp_path / "s.2.mcap",
        [*begun, *(m for m in told if m.t_host_ns >= middle)],
        standard_rig(),
        setup={"of": "s.mcap"},
    )
    both, alone = (
        json.loads(run("characterize", path, "--model", "puma560", "--json").out) for path in (first, second)
    )
    whole = said(1)[0]
    assert (both["parts"], alone["parts"]) == (2, 1)
    assert whole["visits"] - 2 <= both["visits"] < whole["visits"] + 1
    assert 0.3 * whole["visits"] < alone["visits"] < 0.7 * whole["visits"]
    assert both["poses"] == whole["poses"]
    for name, one in intervals(both).items():
        of_all = intervals(whole)[name]
        assert abs(one["value"] - of_all["value"]) < 0.25 * (of_all["high"] - of_all["low"]), name
    code, text, err = run("characterize", first, "--model", "puma560", "--out", second)
    assert (code, text, err.count("\n")) == (2, "", 1)

    other = replace(standard_rig(), seat_sigma=1e-3)
    write_session(tmp_path / "s.3.mcap", said_first, other, setup={"of": "s.mcap"})
    code, _, err = run("characterize", first, "--model", "puma560")
    assert (code, "another rig" in err) == (2, True)
    code, text, _ = run("characterize", first, "--model", "puma560", "--rig", rig_file(tmp_path), "--json")
    assert (code, json.loads(text)["parts"], json.loads(text)["visits"]) == (0, 3, both["visits"])


def rig_file(folder):
    path = folder / "rig.toml"
    path.write_text(format_rig(standard_rig()))
    return path


def test_a_plan_serves_where_the_session_has_none(tmp_path, run):
    kept = [message for message in messages_of(world(1), 1) if message.topic != "/plan"]
    path, plan = write_session(tmp_path / "s.mcap", kept, standard_rig()), tmp_path / "plan.csv"
    write_plan(plan, world(1).controller.plan)
    code, _, err = run("characterize", path, "--model", "puma560")
    assert (code, err.count("\n")) == (2, 1)
    assert "only 0 dwells can be used" in err
    code, text, _ = run("characterize", path, "--model", "puma560", "--plan", plan, "--json")
    assert (code, json.loads(text)["poses"]) == (0, 4)


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (("--model", "panda"), "other-robot"),
        (("--model", "puma560", "--out", "-"), "unreadable-file"),
        (("--model", "puma560", "--rig", "none.toml"), "none.toml"),
        (("--model", "puma560", "--within-mm", "nan"), "within-mm"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(tmp_path, run, more, says):
    path = write_session(tmp_path / "s.mcap", list(messages_of(world(1), 1))[:3000], standard_rig())
    told(run("characterize", path, *more), says)


def test_nobodys_file_is_written_over(tmp_path, run):
    path, out = write_session(tmp_path / "s.mcap", []), tmp_path / "notes.toml"
    out.write_text("mine")
    code, _, err = run("characterize", path, "--model", "puma560", "--out", out)
    assert (code, out.read_text(), err.count("\n")) == (2, "mine", 1)
    code, _, err = run("characterize", path, "--model", "puma560")
    assert (code, "recorded without" in err) == (2, True)
