"""τ: late joint readings are detected by lines driven there and back, and only by these."""

from dataclasses import replace

import numpy as np
import pytest
from line_stream import CHAIN, MAGNET, ROBOT, line_session, some_lines, true_params
from session_stream import stream_of

from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.uncertainty import wide_prior
from truearm.model.transforms import rotation_vector
from truearm.session.observations import observations, survey
from truearm.types import Device, Point, Rig

DELAY_S = 8e-3
LATENCY_S = 0.4e-3  # shortest of the robot's link, which no arrival shows: part of τ
SIGMA = np.diag([62e-6, 100e-6, 62e-6]) ** 2  # Renders' device


@pytest.fixture(scope="module")
def observed():
    """Three lines at 100 mm/s, 8 ms late; the devices stand as they were put, to 3°."""
    rng = np.random.default_rng(1)
    lines = some_lines(rng, 3, 0.3)
    made = line_session(rng, lines, true_params(rng), delay_s=DELAY_S)
    turned = {line.name: tuple(rotation_vector(line.turn) + 0.01 * rng.normal(size=3)) for line in lines}
    cov = tuple(map(tuple, SIGMA))
    devices = {name: Device(name, cov, rotation=turn, turn_sigma=0.05) for name, turn in turned.items()}
    rig = Rig(targets={"magnet": Point("magnet", tuple(MAGNET))}, lines=devices)
    return rig, observations(survey(stream_of(made.messages)), rig, line_points=40).table


def identified(rig, table, solver):
    prior = {} if solver == "lm" else {"prior_sigma": wide_prior(CHAIN)}
    return identify(CHAIN, rig, table, free=ROBOT.free, options=SolverOptions(solver=solver), **prior)


@pytest.mark.parametrize("solver", ["lm", "map", "recursive"])
def test_devices_of_which_nothing_is_declared_tell_the_delay(observed, solver):
    """A roll that is not known turns freely about the line's axis. Were its step to tilt the axis too (by the square of the
    roll: 0.1 rad are 100 σ of the axis), a fit would end before the delay is found: 2.3 ms ± 0.08 were said of 8.4. With this noise a
    recursive fit whose passes were not damped ended at a χ² of 8.5."""
    rig, table = observed
    placed = {name: Device(name, device.sensor_cov) for name, device in rig.lines.items()}
    noise = np.sqrt(np.diag(SIGMA)) * np.random.default_rng(5).standard_normal(table.xyz.shape)
    found = identified(replace(rig, lines=placed), replace(table, xyz=table.xyz + noise), solver)
    at = found.parameter_names.index("time_offset")
    assert abs(found.value[at] - DELAY_S - LATENCY_S) < 3.0 * found.sigma[at] < 0.3e-3
    assert found.chi2_reduced < found.chi2_band[1]


def test_there_and_back_tells_the_delay_and_without_it_the_residual_is_several_times_larger(observed):
    rig, table = observed
    found, again = (identified(rig, table, solver) for solver in ("map", "recursive"))
    for each in (found, again):
        assert each.status == "converged"
        at = each.parameter_names.index("time_offset")
        assert 0.0 < each.sigma[at] <= 0.2e-3
        assert abs(each.value[at] - DELAY_S - LATENCY_S) < 3.0 * each.sigma[at]
        assert not any("time_offset" in direction.names for direction in (*each.null_space, *each.hardly_seen))
    without = identified(replace(rig, time_offset_sigma=0.0), table, "map")
    assert "time_offset" not in without.parameter_names
    # 8 ms at 100 mm/s are 0.8 mm, up or down along the line; what noise leaves is some micrometres.
    assert without.rms_after["m"] > 5.0 * found.rms_after["m"]
    assert without.rms_after["m"] == pytest.approx((DELAY_S + LATENCY_S) * 0.1, rel=0.05)
    assert without.chi2_reduced > 2.0 * without.chi2_band[1]


def test_one_way_it_is_not_seen_and_a_declared_prior_is_kept(observed):
    rig, table = observed
    one_way = table.select(np.char.endswith(table.shell.astype(str), "-up"))
    found = identified(rig, one_way, "map")
    at = found.parameter_names.index("time_offset")
    assert np.isnan(found.sigma[at])
    assert not found.identifiable[at]
    assert any(direction.names == ("time_offset",) for direction in found.hardly_seen)
    # It harms nothing else: the residual is what the noise leaves.
    assert found.rms_after["m"] < 3e-5
    found = identified(replace(rig, time_offset=8.4e-3, time_offset_sigma=0.1e-3), one_way, "map")
    assert found.sigma[found.parameter_names.index("time_offset")] == pytest.approx(0.1e-3, rel=0.05)
    assert not any("time_offset" in direction.names for direction in found.hardly_seen)
