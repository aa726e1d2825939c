"""Lines, from the firmware to τ: the world's device, the box in MicroPython, recorder, synchronisation, identification."""

from dataclasses import replace

import pytest
from tests.end_to_end.conftest import record_session

from truearm.estimate.identify import SolverOptions, identify
from truearm.estimate.prior import wide_prior
from truearm.model.robot import builtin_robot
from truearm.session.session_file import open_session
from truearm.workflows.session_observations import attached_rig, observations_of_session
from truearm_sim.line_plan import drawn_line_plan, line_rig

DELAY_S = 8e-3
LATENCY_S = 0.3e-3  # latency.FROM_ROBOT's least: it cannot be told from the delay


@pytest.mark.soak
def test_a_hidden_delay_is_found_through_the_whole_chain(tmp_path):
    """Five lines there and back at 100 mm/s, readings at 50 Hz that are 8 ms late."""
    recorded = record_session(
        tmp_path / "lines.mcap", 0, plan=drawn_line_plan(5, 1), rig=line_rig(), robot_delay_s=DELAY_S
    )
    assert recorded.summary.reason == "robot closed"
    result = observations_of_session(recorded.path)
    assert result.survey.losses.frames_lost == 0
    assert result.pass_reasons == {}
    assert len(result.passes) == 10
    rig, robot = attached_rig(open_session(recorded.path), recorded.path), builtin_robot("puma560")
    prior = wide_prior(robot.chain)

    def identified(solver, sigma):
        return identify(
            robot.chain,
            replace(rig, time_offset_sigma=sigma),
            result.table,
            free=robot.free,
            options=SolverOptions(solver=solver),
            prior_sigma=prior,
            hold_out=result.table.line == "l5",
        )

    for solver in ("map", "recursive"):
        found = identified(solver, None)
        at = found.parameter_names.index("time_offset")
        print(f"{solver}: delay {1e3 * found.value[at]:.3f} ms, sigma {1e3 * found.sigma[at]:.3f} ms")
        assert found.sigma[at] <= 0.2e-3
        assert abs(found.value[at] - DELAY_S - LATENCY_S) < 3.0 * found.sigma[at]
    without = identified("map", 0.0)
    print(f"RMS {1e3 * found.rms_after['m']:.4f} mm, without a delay {1e3 * without.rms_after['m']:.4f} mm")
    assert without.rms_after["m"] > 3.0 * found.rms_after["m"]
