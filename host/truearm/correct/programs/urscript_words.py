"""URScript's functions by effect (Universal Robots, script manual 5.x).

Compared with the functions that a public editor extension (urscript for VS Code 0.1.21) lists from the manuals up to
5.19: each is listed here, or is followed in ``urscript_meaning``.
"""

from __future__ import annotations

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
AIMLESS = words(
    """
    direct_torque force_mode frame_tracking_enable freedrive_mode freedrive_mode_no_incorrect_payload_check
    interpreter_mode mc_add_circular mc_add_linear mc_add_path mc_initialize mc_load_path mc_run_motion
    path_offset_enable path_offset_set screw_driving speedj speedl teach_mode track_conveyor_circular
    track_conveyor_linear
    """
)
QUIET = words(
    """
    acos add_frame asin assert atan atan2 attach_frame binary_list_to_integer calculate_payload_parameters ceil
    clear_interpreter convert_pose conveyor_pulse_decode cos d2r delete_all_frames delete_frame eip_reader_factory
    eip_writer_factory enable_external_ft_sensor encoder_enable_pulse_decode encoder_enable_set_tick_count
    encoder_get_tick_count encoder_set_tick_count encoder_unwind_delta_tick_count end_force_mode end_freedrive_mode
    end_interpreter end_screw_driving end_teach_mode enter_critical estimate_payload exit_critical floor force
    force_mode_get_damping force_mode_get_gain_scaling force_mode_set_damping force_mode_set_gain_scaling frame_tracking_disable
    ft_rtde_input_enable get_actual_joint_accelerations get_actual_joint_positions
    get_actual_joint_positions_history get_actual_joint_speeds get_actual_tcp_pose get_actual_tcp_speed
    get_actual_tool_flange_pose get_analog_in get_analog_out get_base_acceleration get_children
    get_configurable_digital_in get_configurable_digital_out get_controller_temp get_conveyor_tick_count
    get_coriolis_and_centrifugal_torques get_digital_in get_digital_out get_euromap_input get_euromap_output
    get_feature get_flag get_forward_kin get_frame_parent get_freedrive_status get_gravity
    get_inverse_kin_has_solution get_jacobian get_jacobian_time_derivative get_joint_temp get_joint_torques
    get_last_cleared_id get_last_executed_id get_last_interpreted_id get_list_length get_mass_matrix get_pose
    get_rtde_value get_standard_analog_in get_standard_analog_out get_standard_digital_in get_standard_digital_out
    get_steptime get_target_joint_accelerations get_target_joint_positions get_target_joint_speeds
    get_target_payload get_target_payload_cog get_target_payload_inertia get_target_tcp_pose
    get_target_tcp_pose_along_path get_target_tcp_speed get_target_tcp_speed_along_path get_target_waypoint
    get_tcp_force get_tool_accelerometer_reading get_tool_analog_in get_tool_analog_mode get_tool_current
    get_tool_digital_in get_tool_digital_out get_tool_temp get_unexecuted_count high_holding_torque_disable
    high_holding_torque_enable integer_to_binary_list interpolate_pose inv is_frame is_steady
    is_within_safety_limits jerk_gain_scaling_get jerk_gain_scaling_set length log mc_get_target_rtcp_speed
    mc_set_pcs mc_set_speed_factor modbus_add_rtu_signal modbus_add_rw_signal modbus_add_signal modbus_delete_signal
    modbus_get_error modbus_get_error_count modbus_get_signal_status modbus_get_time_since_signal_invalid
    modbus_request_update_signal_value modbus_reset_connection modbus_send_custom_command
    modbus_set_digital_input_action modbus_set_output_register modbus_set_output_signal
    modbus_set_runstate_dependent_choice modbus_set_signal_update_frequency modbus_set_signal_watchdog
    motion_version_get motion_version_set move_frame norm normalize path_offset_disable path_offset_get
    path_offset_set_alpha_filter path_offset_set_max_offset pause_on_error_code point_dist popup pose_dist
    position_deviation_warning pow powerdown protective_stop r2d random read_input_boolean_register
    read_input_float_register read_input_integer_register read_output_boolean_register read_output_float_register
    read_output_integer_register read_port_bit read_port_register request_boolean_from_primary_client
    request_float_from_primary_client request_integer_from_primary_client request_string_from_primary_client
    reset_revolution_counter reset_world_model rpc_factory rtde_set_watchdog set_analog_inputrange set_analog_out
    set_analog_outputdomain set_base_acceleration set_baselight_iec set_baselight_off set_baselight_solid
    set_configurable_digital_input_action set_configurable_digital_out set_configurable_digital_output_action
    set_conveyor_tick_count set_digital_out set_euromap_output set_euromap_runstate_dependent_choice set_flag
    set_gp_boolean_input_action set_gravity set_input_actions_to_default set_mass_properties set_payload
    set_payload_cog set_payload_from_attached_frames set_payload_mass set_pos
    set_runstate_configurable_digital_output_to_value set_runstate_gp_boolean_output_to_value
    set_runstate_standard_analog_output_to_value set_runstate_standard_digital_output_to_value
    set_runstate_tool_digital_output_to_value set_safety_mode_transition_hardness set_standard_analog_input_domain
    set_standard_analog_out set_standard_analog_output_domain set_standard_digital_input_action
    set_standard_digital_out set_standard_digital_output_action set_target_payload set_tool_analog_input_domain
    set_tool_communication set_tool_digital_input_action set_tool_digital_out set_tool_digital_output_mode
    set_tool_output_mode set_tool_voltage sin size sleep socket_close socket_get_var socket_open
    socket_read_ascii_float socket_read_binary_integer socket_read_byte_list socket_read_line socket_read_string
    socket_send_byte socket_send_int socket_send_line socket_send_string socket_set_var sqrt stop_conveyor_tracking
    stopj stopl str_at str_cat str_empty str_find str_len str_sub sync tan textmsg time to_num to_str tool_contact
    tool_wrench_limit_disable tool_wrench_limit_set transpose wrench_trans write_output_boolean_register
    write_output_float_register write_output_integer_register write_port_bit write_port_register zero_ftsensor
    """
)
EFFECTS = frozenset(MOVES) | AIMLESS | {"set_tcp", "frame_tracking_disable", "stop_conveyor_tracking"}
