"""What ``truearm characterize`` says of a simulated robot, against the simulator's truth; and what identify does with it."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from approaches_bench import planned
from scipy import stats
from sync_stream import stream_of
from world_stream import HOST_NS, messages_of

from truearm.commands.characterizing import Part, characterized
from truearm.commands.resuming import SETUP
from truearm.estimate.identify import identify
from truearm.estimate.noise import residual_cov
from truearm.estimate.problem import build_problem, evaluate
from truearm.files.noise import NoiseFile, read_noise, with_noise
from truearm.files.plan import write_plan
from truearm.files.rig import format_rig
from truearm.model.robot import builtin_robot
from truearm.record.links import HostClock
from truearm.record.session_writer import SessionWriter
from truearm.sync.pipeline import observations
from truearm.sync.visits import came_from, visits
from truearm.types import Message
from truearm_sim import robot, sensors
from truearm_sim.arm import Arm
from truearm_sim.world import REPEATABILITY, World, standard_plan, standard_rig

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
    return characterized([Part(messages(seed), "run")], PUMA.chain, standard_rig(), BANDS)


def truth():
    """Of each figure that ``characterized()`` gives as an interval, by name."""
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
    """32 of 95 %: fewer than 25 would be one in ten thousand runs."""
    assert sum(covered(said(1)[0]).values()) >= 25


@pytest.mark.soak
def test_intervals_hold_the_truth_as_often_as_they_say():
    """50 seeds: each figure's interval covers in a share of runs that 95 % give, within 99.9 %; all together within 1.5 %."""
    runs = []
    for seed in range(100, 150):
        stream = stream_of(messages_of(World(seed, planned()[1].visits, arm=WORN), seed))
        runs.append(covered(characterized([Part(stream, "run")], PUMA.chain, standard_rig(), BANDS)[0]))
    share = {name: np.mean([run[name] for run in runs]) for name in runs[0]}
    print({name: round(float(value), 3) for name, value in share.items()})
    least = stats.binom.ppf(0.0005, 50, 0.95) / 50
    assert min(share.values()) >= least
    assert np.mean(list(share.values())) == pytest.approx(0.95, abs=0.015)


def stop_of(seed, dwell):
    """The controller's stop that a dwell is, by time: the plan has the same pose again and again."""
    return int(world(seed).controller.stop_index(np.array([1e-9 * (dwell.start_host_ns - HOST_NS)]))[0])


def test_every_visit_came_from_the_side_it_came_from():
    result = observations(messages(1), standard_rig())
    used = [dwell for dwell in result.dwells if not dwell.reason]
    controller = world(1).controller
    sides = np.array([came_from(result.survey.joints.bins, dwell) for dwell in used])
    assert np.array_equal(sides, [controller.direction[stop_of(1, dwell)] for dwell in used])


def test_settling_times_are_those_of_the_bar_without_noise():
    """Within a sample's period at either end for most visits: whether a swing just grazes the band is left to the noise."""
    result = observations(messages(1), standard_rig())
    found = visits(messages(1), result, standard_rig(), BANDS)
    controller = world(1).controller
    for k, band in enumerate(BANDS):
        times, true = found.settling[:, k], np.full(len(found.dwells), np.nan)
        for i in np.flatnonzero(np.isfinite(times)):
            stop = stop_of(1, found.dwells[i])
            t = np.arange(controller.move_start[stop], controller.arrive[stop] + 0.6, 2e-4)
            size = np.abs(world(1).length(t) - world(1).length(t[-1:]))
            coming = int(np.flatnonzero(size >= 0.5 * size.max())[-1])
            outside = np.flatnonzero(size[coming:] > band)
            true[i] = 2e-4 * max(0, int(outside[-1]) + 1 - int(np.argmax(size[coming:] <= band)))
        known = np.isfinite(times)
        assert known.sum() > 0.6 * len(times)
        error = times[known] - true[known]
        assert np.mean(np.abs(error) <= 2.0 * found.period_s) > 0.85


@cache
def worn_calibration():
    """A calibration of the same robot: 100 poses with each bar."""
    visited = World(11, standard_plan(100, 11), arm=WORN)
    return observations(stream_of(messages_of(visited, 11)), standard_rig())


def fitted(noise: NoiseFile):
    rig = with_noise(standard_rig(), noise)
    result = worn_calibration()
    sigma = np.sqrt([d.value_var + rig.bars[d.mounted["bar"]].sigma ** 2 for d in result.dwells if not d.reason])
    table = result.table.select(np.ones(len(result.table), dtype=bool))
    table.sigma[:] = sigma
    return identify(PUMA.chain, rig, table, free=PUMA.free)


def test_the_noise_that_was_found_makes_chi2_one_and_wrong_noise_is_told():
    """Of 200 rows with 36 unknowns: inside the band of χ². As declared, without backlash, above it."""
    _, noise = said(1)
    both = NoiseFile(noise.joint_cov, dict.fromkeys(("bar46", "bar61"), noise.bar_sigma["bar46"]))
    right = fitted(both)
    # The band is of exact sigmas; those found from 96 visits have a variance good to √(2/70) = 17 %, one sigma.
    low, high = right.chi2_band
    assert low / 1.34 < right.chi2_reduced < 1.34 * high
    declared = fitted(NoiseFile())
    assert declared.chi2_reduced > declared.chi2_band[1]
    quiet = fitted(NoiseFile(bar_sigma=dict.fromkeys(("bar46", "bar61"), 1e-3)))
    assert quiet.chi2_reduced < 0.2 * quiet.chi2_band[0]


def normalised_error(fit, visited):
    """Squared error of the identified parameters in units of their covariance, and its degrees of freedom."""
    free = fit.free[: len(visited.params)] & fit.identifiable[: len(visited.params)]
    error = (fit.value[: len(visited.params)] - visited.params)[free]
    return float(error @ np.linalg.solve(fit.covariance[np.ix_(free, free)], error)), int(free.sum())


def owed_error(rig, table, visited, direction):
    """What ``normalised_error()`` is on average where joints lag by these directions (n, 6) and only the bar is chance."""
    problem = build_problem(PUMA.chain, rig, table)
    (group,) = problem.groups
    lin = evaluate(problem, group, visited.params)
    cov = residual_cov(group.sensor_cov, lin.jac_joints, problem.joint_cov)
    basis, weight, _ = np.linalg.svd(lin.jac_params[:, PUMA.free] / np.sqrt(cov), full_matrices=False)
    basis = basis[:, weight > 1e-9 * weight[0]]
    lag = np.sum(lin.jac_joints * WORN.behind(direction), axis=1) / np.sqrt(cov[:, 0])
    return float(np.sum((basis.T @ lag) ** 2) + np.sum(basis**2 * REPEATABILITY**2 / cov))


@pytest.mark.soak
def test_the_covariance_is_honest_with_the_noise_that_was_found():
    """NEES over 25 calibrations of a worn arm, each with noise found in a run of its own.

    Noise has each joint lag one way or the other by chance, at each pose anew. On the short way between poses the joints
    turn back more often than by chance, so lags cancel and the error is smaller; by how much is calculated.
    """
    found, told, owed, by_chance = [], [], [], []
    for seed in range(200, 225):
        run = World(seed, planned()[1].visits, arm=WORN)
        _, noise = characterized([Part(stream_of(messages_of(run, seed)), "run")], PUMA.chain, standard_rig(), BANDS)
        rig = with_noise(
            standard_rig(), NoiseFile(noise.joint_cov, dict.fromkeys(("bar46", "bar61"), noise.bar_sigma["bar46"]))
        )
        visited = World(seed + 1000, standard_plan(100, seed), arm=WORN)
        stream = stream_of(messages_of(visited, seed))
        for around, errors in ((rig, found), (standard_rig(), told)):
            table = observations(stream, around).table
            errors.append(normalised_error(identify(PUMA.chain, around, table, free=PUMA.free), visited))
            if around is rig:
                driven = visited.controller.direction[visited.controller.dwells]
                drawn = np.random.default_rng(seed).choice([-1.0, 1.0], (20, *driven.shape))
                owed.append(owed_error(rig, table, visited, driven))
                by_chance.append(np.mean([owed_error(rig, table, visited, one) for one in drawn]))
    mean, declared, free = np.mean([one for one, _ in found]), np.mean([one for one, _ in told]), found[0][1]
    print(f"NEES {mean:.2f}, due as driven {np.mean(owed):.2f}; if lags were chance {np.mean(by_chance):.2f} of {free}")
    print(f"with the noise as declared {declared:.2f}")
    assert abs(mean - np.mean(owed)) < 3.3 * np.sqrt(2 * np.mean(owed) / len(owed))
    # The found variances are off by 17 % each, whose mean of 1/v is 3 % above 1/mean.
    assert np.mean(by_chance) == pytest.approx(1.03 * free, rel=3.3 * 0.17 / np.sqrt(len(owed)))
    assert declared > 1.2 * free


def write(path, kept, rig, of=None):
    with SessionWriter(path, HostClock()) as writer:
        if of is not None:
            writer.metadata(SETUP, {"of": of})
        if rig is not None:
            writer.attach("rig.toml", "application/toml", format_rig(rig).encode())
        for message in kept:
            writer.add(message.topic, message.t_host_ns, message.data)
    return path


def test_from_a_session_file_to_a_noise_file(tmp_path, run):
    path, out = write(tmp_path / "s.mcap", messages(1)(None), standard_rig()), tmp_path / "noise.toml"
    code, text, err = run("characterize", path, "--robot", "puma560", "--within-mm", "0.02", "--out", out)
    assert (code, err) == (0, "")
    for word in (
        "repeatability, one side",
        "backlash/mrad",
        "settled within 0.02 mm",
        "Allan deviation",
        f"written: {out}",
    ):
        assert word in text
    assert read_noise(out).bar_sigma["bar46"] == said(1)[1].bar_sigma["bar46"]
    code, text, _ = run("characterize", path, "--robot", "puma560", "--json", "--out", out)  # its own file, again
    document = json.loads(text)
    assert code == 0
    assert document["noise"] == said(1)[0]["noise"]


def test_the_parts_of_a_session_are_one(tmp_path, run):
    """A break in the middle: the second part begins with what the box and the plan say, as the recorder writes it."""
    said_first = [m for m in messages(1)(None) if m.topic in ("/box/ident", "/plan")]
    told = [m for m in messages(1)(None) if m.topic not in ("/box/ident", "/plan")]
    middle = told[len(told) // 2].t_host_ns
    begun = [Message(m.topic, middle, m.data) for m in said_first]
    first = write(tmp_path / "s.mcap", [*said_first, *(m for m in told if m.t_host_ns < middle)], standard_rig())
    second = write(
        tmp_path / "s.2.mcap", [*begun, *(m for m in told if m.t_host_ns >= middle)], standard_rig(), of="s.mcap"
    )
    both, alone = (
        json.loads(run("characterize", path, "--robot", "puma560", "--json").out) for path in (first, second)
    )
    whole = said(1)[0]
    assert (both["parts"], alone["parts"]) == (2, 1)
    assert whole["visits"] - 2 <= both["visits"] < whole["visits"] + 1
    assert 0.3 * whole["visits"] < alone["visits"] < 0.7 * whole["visits"]
    assert both["poses"] == whole["poses"]
    for name, one in intervals(both).items():
        of_all = intervals(whole)[name]
        assert abs(one["value"] - of_all["value"]) < 0.25 * (of_all["high"] - of_all["low"]), name
    code, text, err = run("characterize", first, "--robot", "puma560", "--out", second)
    assert (code, text, err.count("\n")) == (2, "", 1)

    other = replace(standard_rig(), seat_sigma=1e-3)
    write(tmp_path / "s.3.mcap", said_first, other, of="s.mcap")
    code, _, err = run("characterize", first, "--robot", "puma560")
    assert (code, "recorded with another rig" in err) == (2, True)
    code, text, _ = run("characterize", first, "--robot", "puma560", "--rig", rig_file(tmp_path), "--json")
    assert (code, json.loads(text)["parts"], json.loads(text)["visits"]) == (0, 3, both["visits"])


def rig_file(folder):
    path = folder / "rig.toml"
    path.write_text(format_rig(standard_rig()))
    return path


def test_a_plan_serves_where_the_session_has_none(tmp_path, run):
    kept = [message for message in messages(1)(None) if message.topic != "/plan"]
    path, plan = write(tmp_path / "s.mcap", kept, standard_rig()), tmp_path / "plan.csv"
    write_plan(plan, world(1).controller.plan)
    code, _, err = run("characterize", path, "--robot", "puma560")
    assert (code, err.count("\n")) == (2, 1)
    assert "0 dwells can be used" in err
    code, text, _ = run("characterize", path, "--robot", "puma560", "--plan", plan, "--json")
    assert (code, json.loads(text)["poses"]) == (0, 4)


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (("--robot", "panda"), "6 joints, the robot given has 7"),
        (("--robot", "puma560", "--out", "-"), "no file name"),
        (("--robot", "puma560", "--rig", "none.toml"), "none.toml"),
        (("--robot", "puma560", "--within-mm", "nan"), "within-mm"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(tmp_path, run, more, says):
    path = write(tmp_path / "s.mcap", list(messages(1)(None))[:3000], standard_rig())
    code, text, err = run("characterize", path, *more)
    assert (code, text, err.count("\n")) == (2, "", 1)
    assert says in err


def test_nobodys_file_is_written_over(tmp_path, run):
    path, out = write(tmp_path / "s.mcap", [], None), tmp_path / "notes.toml"
    out.write_text("mine")
    code, _, err = run("characterize", path, "--robot", "puma560", "--out", out)
    assert (code, out.read_text(), err.count("\n")) == (2, "mine", 1)
    code, _, err = run("characterize", path, "--robot", "puma560")
    assert (code, "recorded without a rig" in err) == (2, True)
