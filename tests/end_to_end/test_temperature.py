"""A session during which bar and sensor warm up: lengths are corrected with thermometers, and a warning is printed without."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.end_to_end.conftest import lab_with, recorded_with_plan, truearm
from tests.end_to_end.levels import wait_until_ready

from truearm.estimate.identify import identify
from truearm.kinds.rig_file import read_rig
from truearm.session.session_tables import tabulate
from truearm.workflows.inputs import Sources, read_sources
from truearm.workflows.recorded_session import observations_of_session, open_finished
from truearm_sim.robot import STEP as ENCODER_STEP
from truearm_sim.thermal import STEEL, Thermal
from truearm_sim.world import Setup, World, standard_plan, standard_rig

OSR = 16384
GAIN_DRIFT = 1e-4
SIGMA = 1e-6  # m, repeatability of this bar: a usual one's would hide what 2 K do
POSES = 14


def one_shell():
    """Return a rig with one chuck, one sphere and one bar."""
    rig = standard_rig()
    first = {kind: dict([next(iter(getattr(rig, kind).items()))]) for kind in ("chucks", "spheres", "bars")}
    return replace(rig, **first)


def session(path, thermal, seed=3):
    """The lab, and its session, of a robot that visits POSES poses; the rig knows the bar's coefficients."""
    rig = one_shell()
    bars = {
        name: replace(
            bar, sigma=SIGMA, expansion=STEEL, expansion_sigma=1e-6, gain_drift=GAIN_DRIFT, gain_drift_sigma=2e-5
        )
        for name, bar in rig.bars.items()
    }
    rig = replace(rig, bars=bars)
    plan = standard_plan(POSES, seed, rig)
    world = World(seed, plan, rig, setup=Setup(thermal=thermal))
    with lab_with(world) as lab:
        wait_until_ready(lab)
        recorded_with_plan(lab, path, osr=OSR)
    return world, rig


def left(world, rig, result):
    """(2, n) [m] how far the lengths are from the true ones of that dwell: as measured, and with the temperatures of the table."""
    (bar,) = rig.bars.values()
    table = result.table
    used = [i for i, dwell in enumerate(result.dwells) if not dwell.reason]
    truth = world.truth.length[[result.dwells[i].pose for i in used]]
    extension = (table.value - bar.zero) / bar.gain
    warm, hot = table.bar_temperature - 20.0, table.sensor_temperature - 20.0
    corrected = bar.zero * (1.0 + STEEL * warm) + bar.gain * (1.0 + GAIN_DRIFT * hot) * extension
    return np.stack([table.value, corrected]) - truth


@pytest.fixture(scope="module")
def warm(tmp_path_factory):
    path = tmp_path_factory.mktemp("warm") / "session.mcap"
    world, rig = session(path, Thermal(drift=2.0, ahead=3.0, gain_drift=GAIN_DRIFT))
    return world, rig, observations_of_session(open_finished(path)), read_sources(Sources((path,)), None).findings


def test_two_kelvins_of_a_steel_bar_are_corrected_to_the_noise(warm):
    world, rig, result, said = warm
    assert len(result.table) >= POSES - 1
    measured, corrected = left(world, rig, result)
    assert np.ptp(measured) > 10e-6, "0.46 m · 11.5 ppm/K · 2 K, and the sensor's part"
    # a step of 62.5 mK is half up or down 0.28 µm, a reading is of a moment 1 s off in a session of 47 s: 0.4 µm; noise of a mean: 0.1 µm
    assert np.abs(corrected).max() < 0.8e-6
    assert np.all(np.abs(corrected) < result.table.sigma)
    assert said == [], "nothing to warn of"


def fitted(world, rig, table):
    """The coefficients that a fit finds in ``table``, of an arm that is known: every other number is. Nothing is known of them."""
    bars = {name: replace(bar, expansion=0.0, expansion_sigma=30e-6) for name, bar in rig.bars.items()}
    reading = np.diag(np.full(len(world.chain.joints), ENCODER_STEP**2 / 12.0))
    rig = replace(rig, bars=bars, joint_cov=tuple(map(tuple, reading.tolist())))
    known = zip(world.chain.parameters, world.params.tolist(), strict=True)
    chain = replace(world.chain, parameters=tuple(replace(one, nominal=value) for one, value in known))
    return identify(chain, rig, table, free=np.zeros(world.params.size, dtype=bool))


@pytest.mark.parametrize("seeds", [range(3, 4), pytest.param(range(4, 44), marks=pytest.mark.soak)], ids=["1", "40"])
def test_an_unknown_expansion_is_found_from_a_session_with_a_drift_of_2_k(seeds, tmp_path):
    """Within its sigma, which 14 dwells and 2 K make 1.2 ppm/K here; the residuals are the noise."""
    away, at_noise = [], []
    for seed in seeds:
        path = tmp_path / f"{seed}.mcap"
        world, rig = session(path, Thermal(drift=2.0, ahead=3.0, gain_drift=GAIN_DRIFT), seed=seed)
        found = fitted(world, rig, observations_of_session(open_finished(path)).table)
        assert found.parameter_names[-2:] == ("bar.bar46.expansion", "bar.bar46.gain_drift")
        assert found.sigma[-2] < 2e-6
        away.append((found.value[-2:] - (STEEL, GAIN_DRIFT)) / found.sigma[-2:])
        at_noise.append(found.chi2_band[0] < found.chi2_reduced < found.chi2_band[1])
    assert np.abs(away).max() < 3.5
    assert np.all(np.mean(np.square(away), axis=0) < 1.0 + 4.0 * np.sqrt(2.0 / len(away)))
    assert np.mean(at_noise) > 0.85, "a band of 95 %"


def test_tables_hold_every_reading_with_its_name_and_time(warm):
    _, _, result, _ = warm
    rows = [columns for name, columns in tabulate(result.survey) if name == "box_temperature"]
    names = np.concatenate([columns["name"] for columns in rows])
    degc = np.concatenate([columns["temperature_mdegc"] for columns in rows]) * 1e-3
    assert set(names) == {"bar", "sensor"}
    assert np.all(np.diff(degc[names == "bar"]) >= 0.0)
    assert 1.5 < np.ptp(degc[names == "bar"]) <= 2.0
    np.testing.assert_allclose(degc[names == "sensor"] - degc[names == "bar"], 3.0, atol=1e-9)


def test_a_simulated_laboratory_that_warms_up_is_in_rig_inspect_and_report(tmp_path):
    run = ("simulate", "--fast", "--warming", "2", "--poses", "9", "--out", tmp_path / "lab")
    assert truearm(*run).returncode == 0
    session_file, report = tmp_path / "lab" / "session.mcap", tmp_path / "report.html"
    (bar, *_) = read_rig(tmp_path / "lab" / "rig.toml").bars.values()
    assert (bar.expansion, bar.gain_drift) == (STEEL, GAIN_DRIFT)
    (bar_degc, sensor_degc) = json.loads(truearm("inspect", session_file, "--json").stdout)["temperature_degc"][
        "thermometers"
    ].values()
    assert bar_degc == sensor_degc == [pytest.approx(20.0, abs=0.1), 22.0]
    said = f"{bar_degc[0]:.1f} to 22.0 °C"
    assert f"bar {said}, sensor {said}." in " ".join(truearm("inspect", session_file, "--details").stdout.split())
    done = truearm(
        "identify", session_file, "--model", "puma560", "--free", "joint*.offset", "--report", report, "--details"
    )
    assert done.returncode == 0, done.stderr
    assert "bar.bar46.expansion" in done.stdout
    assert report.read_text().count(f"<dd>{said}</dd>") == 2  # of the bar and of the sensor


def test_without_a_thermometer_a_session_far_from_the_calibration_is_warned_of_with_the_size(tmp_path):
    session(tmp_path / "session.mcap", Thermal(begin=24.0, drift=0.0, ahead=1.0, thermometers=()))
    observed = read_sources(Sources((tmp_path / "session.mcap",)), None)
    assert "bar_temperature" not in observed.table.columns
    (warning,) = observed.findings
    assert (warning.code, warning.values["warmer"], warning.values["channel"]) == ("other-temperature", True, "lvdt")
    assert warning.values["difference"]["degc"] == pytest.approx(5.0, abs=0.05)
    # 5 K · (11.5 ppm/K · 460 mm + 100 ppm/K · 37.5 mm)
    assert warning.values["error"]["mm"] == pytest.approx(0.045, abs=5e-4)
