"""URScript's functions by effect (Universal Robots, script manual 5.x).

They cover the functions that a public editor extension (urscript for VS Code 0.1.21) lists from the manuals up to 5.19.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from truearm.correct.programs.tokens import words

# every move with a target: the names of the arguments that contain it
MOVES: Mapping[str, tuple[tuple[str, ...], ...]] = {
    "movej": (("q", "pose"),),
    "movel": (("pose", "q"),),
    "movep": (("pose", "q"),),
    "movec": (("pose_via", "q_via"), ("pose_to", "q_to")),
    "optimovej": (("q", "pose", "goal"),),
    "optimovel": (("pose", "q", "goal"),),
    "servoj": (("q",),),
    "servoc": (("pose", "q"),),
    "servol": (("pose",),),
}
STRAIGHT = frozenset({"movel", "movep", "optimovel"})  # of them
MOVE_TEXT = re.compile(rf"({'|'.join(MOVES)}) *\(")  # in a text that is sent elsewhere
SOLVER = "get_inverse_kin"
AIMLESS = words(
    """
    direct_torque force_mode frame_tracking_enable freedrive_mode freedrive_mode_no_incorrect_payload_check
    interpreter_mode mc_add_circular mc_add_linear mc_add_path mc_initialize mc_load_path mc_run_motion
    path_offset_enable path_offset_set screw_driving speedj speedl teach_mode track_conveyor_circular
    track_conveyor_linear
    """
)
# what neither moves the robot nor sets its tool, by families of names and by name
FAMILIES = re.compile(
    r"""(modbus|socket|str|encoder|conveyor|eip|rtde)_\w+
    |(get|set|read|write)_(analog|configurable|digital|euromap|input|output|port|runstate|standard)_\w+
    |(get|set)_tool_(analog|digital|output|voltage|current|communication|temp|accelerometer)\w*
    |get_(actual|target)_(joint|tcp|payload)\w*|\w+_from_primary_client""",
    re.VERBOSE,
)
QUIET = words(
    """
    acos add_frame asin assert atan atan2 attach_frame binary_list_to_integer calculate_payload_parameters ceil
    clear_interpreter convert_pose cos d2r delete_all_frames delete_frame enable_external_ft_sensor end_force_mode
    end_freedrive_mode end_interpreter end_screw_driving end_teach_mode enter_critical estimate_payload exit_critical
    floor force force_mode_get_damping force_mode_get_gain_scaling force_mode_set_damping force_mode_set_gain_scaling
    frame_tracking_disable ft_rtde_input_enable get_actual_tool_flange_pose get_base_acceleration get_children
    get_controller_temp get_conveyor_tick_count get_coriolis_and_centrifugal_torques get_feature get_flag
    get_forward_kin get_frame_parent get_freedrive_status get_gravity get_inverse_kin get_inverse_kin_has_solution
    get_jacobian get_jacobian_time_derivative get_joint_temp get_joint_torques get_last_cleared_id
    get_last_executed_id get_last_interpreted_id get_list_length get_mass_matrix get_pose get_rtde_value get_steptime
    get_target_waypoint get_tcp_force get_tcp_offset get_unexecuted_count high_holding_torque_disable
    high_holding_torque_enable integer_to_binary_list interpolate_pose inv is_frame is_steady is_within_safety_limits
    jerk_gain_scaling_get jerk_gain_scaling_set length log make_list mc_get_target_rtcp_speed mc_set_pcs
    mc_set_speed_factor motion_version_get motion_version_set move_frame norm normalize path_offset_disable
    path_offset_get path_offset_set_alpha_filter path_offset_set_max_offset pause_on_error_code point_dist popup
    pose_add pose_dist pose_inv pose_sub pose_trans position_deviation_warning pow powerdown protective_stop r2d
    random reset_revolution_counter reset_world_model rotvec2rpy rpc_factory rpy2rotvec set_base_acceleration
    set_baselight_iec set_baselight_off set_baselight_solid set_conveyor_tick_count set_flag
    set_gp_boolean_input_action set_gravity set_mass_properties set_payload set_payload_cog
    set_payload_from_attached_frames set_payload_mass set_pos set_safety_mode_transition_hardness set_target_payload
    sin size sleep sqrt stop_conveyor_tracking stopj stopl struct sync tan textmsg time to_num to_str tool_contact
    tool_wrench_limit_disable tool_wrench_limit_set transpose wrench_trans zero_ftsensor
    """
)
KEYWORDS = words("if elif while return not and or xor run kill join")  # before a bracket
EFFECTS = frozenset(MOVES) | AIMLESS | {"set_tcp", "frame_tracking_disable", "stop_conveyor_tracking", SOLVER}


def is_in_language(name: str) -> bool:
    """Return whether a function belongs to the language."""
    return name in EFFECTS or name in QUIET or name in KEYWORDS or FAMILIES.fullmatch(name) is not None
