"""What URScript's own functions mean for the moves of a program (Universal Robots, script manual 5.x).

``pose_trans(A, B)`` is A·B; ``pose_add(A, B)`` adds positions and multiplies rotations; ``get_inverse_kin`` gives the joints that a pose needs. A function
that is not listed may move the robot, and is said.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from truearm.files.programs.dataflow import TOOL, Flow
from truearm.files.programs.syntax import (
    Block,
    Call,
    Expression,
    Form,
    Number,
    Routine,
    Source,
    Taught,
    Text,
    Truth,
    words,
)
from truearm.files.programs.values import (
    NOWHERE,
    Fields,
    Listed,
    Pose,
    Solved,
    Unknown,
    Value,
    Values,
    combined,
    first_unknown,
    fixed_six,
    inverse,
    matrices_of,
    numbers_of,
    shifted,
    taught_pose,
    times,
    turned,
)
from truearm.types import Floats
from truearm.units import DEG

# every move with a target: the names of the arguments that give it
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
    force_mode_get_damping force_mode_set_damping force_mode_set_gain_scaling frame_tracking_disable
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
OVERWRITES = frozenset(MOVES) | AIMLESS | {"set_tcp", "get_inverse_kin"}
SIX = 6
_WHERE_IT_IS = frozenset({"get_actual_joint_positions", "get_target_joint_positions"})
TRACKED = "tracked conveyor"  # no name of a variable has a space


class UrScript(NamedTuple):
    """URScript's meaning. ``harmless``: functions from elsewhere that a person says do not move the robot."""

    harmless: frozenset[str] = frozenset()

    @property
    def outer_names(self) -> bool:
        """What a function assigns without ``global`` or ``local`` may be its own or the program's."""
        return False

    def changed_by(self, call: Call) -> Sequence[Expression]:
        """None: arguments are copies."""
        return ()

    def literal(self, of: Taught) -> Value:
        """A literal p[…] is a pose, […] six joint readings or six numbers."""
        return taught_pose(of) if of.form is Form.POSE else of

    def call(self, flow: Flow, call: Call, arguments: Sequence[Values], named: Mapping[str, Values]) -> Values | None:
        """What a built-in function gives, after its effect; None where it is none."""
        name, at = call.function, call.start
        if name in MOVES:
            _move(flow, call, arguments, named)
            return (Truth(True),)
        if name.startswith(("track_conveyor", "frame_tracking_enable")):
            flow.set(TRACKED, (Unknown(f"it follows what {name} tracks", at),), "global")
        if name in ("stop_conveyor_tracking", "frame_tracking_disable"):
            flow.set(TRACKED, (NOWHERE,), "global")
        if name in AIMLESS:
            flow.uncertain(
                name, at, call.end, f"{name} moves the robot without a target; there is nothing to correct in it"
            )
            return (Truth(True),)
        if name == "set_tcp":
            given = arguments[0] if arguments else named.get("pose", ())
            flow.set(TOOL, tuple(_tool(value, at) for value in given))
            return (Truth(True),)
        if name == "get_tcp_offset":
            return flow.get(TOOL) or (Unknown("the tool is not known", at),)
        if name == "struct":
            return (Fields(tuple(named), tuple(named.values())),)
        if name == "get_inverse_kin":
            return _solved(flow, call, arguments, named)
        if name == "make_list":
            return _made(arguments, named, at)
        if name in _PURE:
            values = [*arguments, *named.values()]
            return combined(at, lambda *given: _PURE[name](given, at), values) if values else None
        if name.startswith("."):
            return (Unknown("what a remote procedure gives is known at run time only", at),)
        if name in QUIET or name in self.harmless:
            return (Unknown(f"what {name} gives is known at run time only", at),)
        return None

    def item(self, of: Value, at: Value | str, place: int) -> Values:
        """An element of a list or pose, counted from 0, or a field of a struct; nothing where the list ends before it."""
        if isinstance(of, Unknown):
            return (of,)
        if isinstance(of, Fields) and isinstance(at, str) and at in of.names:
            return of.items[of.names.index(at)]
        items = _items(of)
        if items is None or isinstance(at, str):
            return (Unknown("an element or field is not followed", place),)
        if isinstance(at, Number):
            k = int(at.value)
            return items[k] if 0 <= k < len(items) else ()
        return tuple(dict.fromkeys(value for item in items for value in item))

    def changed(self, of: Value, at: Value | str, new: Values, place: int) -> Value:
        """A list or struct with another item."""
        if isinstance(of, Fields) and isinstance(at, str) and at in of.names:
            k = of.names.index(at)
            return Fields(of.names, (*of.items[:k], new, *of.items[k + 1 :]))
        items = _items(of)
        if items is None or not isinstance(at, Number) or not 0 <= int(at.value) < len(items):
            return first_unknown((of,)) or Unknown("an element is assigned that is not followed", place)
        k = int(at.value)
        return Listed((*items[:k], new, *items[k + 1 :]), isinstance(of, Pose) or (isinstance(of, Listed) and of.pose))


def analyse(source: Source, block: Block, tool: Values, harmless: frozenset[str]) -> Flow:
    """Follow a program; ``tool`` is in force until it sets another."""
    routines = [one for one in block if isinstance(one, Routine)]
    flow = Flow(source, UrScript(harmless), routines)
    for name in flow.routines:
        if name in OVERWRITES:
            raise source.wrong(flow.routines[name].start, f"{name} is a function of the language and cannot be defined")
    flow.environment.set((0, TOOL), tool)
    flow.run(block)
    flow.end_threads(None)
    for routine in routines:
        if routine.name not in flow.called:
            flow.environment.layers.append({})
            flow.enter(routine, None, (), {})
            flow.environment.layers.pop()
    return flow


def _move(flow: Flow, call: Call, arguments: Sequence[Values], named: Mapping[str, Values]) -> None:
    expressions = dict(call.named)
    targets = []
    for k, names in enumerate(MOVES[call.function]):
        name = next((one for one in names if one in named), None)
        if name is not None:
            targets.append((named[name], expressions[name]))
        elif k < len(arguments):
            targets.append((arguments[k], call.arguments[k]))
        else:
            flow.uncertain(call.function, call.start, call.end, "it has no target")
            return
    asked = [(tuple(_target(value, call.start) for value in values), place) for values, place in targets]
    flow.goes_to(call, asked, flow.get(TOOL) or (), flow.get(TRACKED) or (NOWHERE,), straight=call.function in STRAIGHT)


def _target(value: Value, at: int) -> Value:
    """A pose, joints or solved joints, where it is one."""
    if isinstance(value, Taught | Pose | Solved | Unknown):
        return value
    if not isinstance(value, Listed):
        return Unknown("its target is no pose and no joint readings", at)
    if value.pose:
        return _as_pose(value, at)
    return _unknown_in(value) or Unknown("its joint readings are not six plain numbers in one list", at)


def _tool(value: Value, at: int) -> Value:
    found = _as_pose(value, at)
    return Unknown("the tool that set_tcp sets is known at run time only", at) if isinstance(found, Unknown) else found


def _solved(flow: Flow, call: Call, arguments: Sequence[Values], named: Mapping[str, Values]) -> Values:
    at = call.start
    poses = arguments[0] if arguments else named.get("x", ())
    nears = arguments[1] if len(arguments) > 1 else named.get("qnear", ())
    said = call.arguments[1] if len(arguments) > 1 else dict(call.named).get("qnear")
    if isinstance(said, Call) and said.function in _WHERE_IT_IS:
        nears = ()  # which is what the controller takes without qnear
    given = named.get("tcp", arguments[4] if len(arguments) > 4 else ())
    if not given or given == (Text("active_tcp"),):
        tools = flow.get(TOOL) or ()
    else:
        tools = tuple(_tool(value, at) for value in given)

    def solved(pose: Value, near: Value, tool: Value) -> Value:
        there, joints = _as_pose(pose, at), _near(near, at)
        for one in (there, joints, tool):
            if isinstance(one, Unknown):
                return one
        assert isinstance(there, Pose)
        assert isinstance(tool, Pose)
        assert not isinstance(joints, Unknown)
        return Solved(there, joints, tool)

    return combined(at, solved, [poses, nears or (Truth(False),), tools])


def _near(value: Value, at: int) -> Taught | tuple[float, ...] | Unknown | None:
    """The joint readings of a qnear, None where there is none. They say which of the arm's configurations is meant."""
    if isinstance(value, Truth):
        return None
    if isinstance(value, Solved):
        return value.near
    numbers = numbers_of(value)
    if numbers is None or len(numbers) != SIX or (isinstance(value, Taught) and value.form is not Form.JOINTS):
        return Unknown("its qnear is known at run time only, so that its configuration is not known", at)
    return value if isinstance(value, Taught) else numbers


def _as_pose(value: Value, at: int) -> Pose | Unknown:
    if isinstance(value, Pose | Unknown):
        return value
    if isinstance(value, Solved):
        return value.pose
    numbers = numbers_of(value)
    if numbers is not None and len(numbers) == SIX and np.isfinite(numbers).all():
        return fixed_six(numbers)
    return _unknown_in(value) or Unknown("it is no pose of six numbers", at)


def _unknown_in(value: Value) -> Unknown | None:
    inner = value.items if isinstance(value, Listed) else ()
    return next((one for item in inner for one in item if isinstance(one, Unknown)), None)


def _items(of: Value) -> tuple[Values, ...] | None:
    if isinstance(of, Listed):
        return of.items
    if (
        isinstance(of, Pose)
        and len(of.factors) == 1
        and not of.factors[0].inverse
        and isinstance(of.factors[0].pose, Taught)
    ):
        of = of.factors[0].pose
    return tuple((Number(value),) for value in of.values) if isinstance(of, Taught) else None


def _made(arguments: Sequence[Values], named: Mapping[str, Values], at: int) -> Values:
    given = [*arguments, *named.values()]
    if (
        len(given) < 2
        or len(given[0]) != 1
        or not isinstance(given[0][0], Number)
        or not 0 <= given[0][0].value <= 1000
    ):
        return (Unknown("the list that make_list gives is not followed", at),)
    return (Listed((given[1],) * int(given[0][0].value)),)


def _poses(given: Sequence[Value], n: int, at: int) -> list[Pose] | Unknown:
    if len(given) != n:
        return Unknown(f"{len(given)} arguments are given where {n} belong", at)
    found = [_as_pose(value, at) for value in given]
    unknown = first_unknown(found)
    return unknown or [pose for pose in found if isinstance(pose, Pose)]


def _trans(given: Sequence[Value], at: int) -> Value:
    poses = _poses(given, 2, at)
    return poses if isinstance(poses, Unknown) else times(*poses)


def _add(given: Sequence[Value], at: int) -> Value:
    """A's position plus B's, and rotation R_A·R_B: a shift, A, and a turn."""
    poses = _poses(given, 2, at)
    return poses if isinstance(poses, Unknown) else _moved(poses[0], poses[1], 1, at)


def _sub(given: Sequence[Value], at: int) -> Value:
    poses = _poses(given, 2, at)
    return poses if isinstance(poses, Unknown) else _moved(poses[0], poses[1], -1, at)


def _moved(a: Pose, b: Pose, sense: int, at: int) -> Value:
    numbers = b.factors[0].pose if len(b.factors) == 1 and not b.factors[0].inverse else None
    if isinstance(numbers, Taught):
        matrix = matrices_of([numbers])[0]
    elif numbers is not None:
        matrix = np.array(numbers.rows).reshape(4, 4)
    else:
        return Unknown("what is added to a pose is a product itself; that is not followed", at)
    turn = Rotation.from_matrix(matrix[:3, :3])
    return times(shifted(sense * matrix[:3, 3]), a, turned(turn if sense > 0 else turn.inv()))


def _inv(given: Sequence[Value], at: int) -> Value:
    poses = _poses(given, 1, at)
    return poses if isinstance(poses, Unknown) else inverse(poses[0])


def _degrees(given: Sequence[Value], at: int) -> Value:
    return (
        Number(float(DEG.to_si(given[0].value)))
        if isinstance(given[0], Number)
        else Unknown("an angle is not known", at)
    )


def _rotvec(given: Sequence[Value], at: int) -> Value:
    """Roll, pitch and yaw about fixed x, y, z as a rotation vector."""
    return _three(given, at, lambda rpy: Rotation.from_euler("xyz", rpy).as_rotvec())


def _rpy(given: Sequence[Value], at: int) -> Value:
    return _three(given, at, lambda turn: Rotation.from_rotvec(turn).as_euler("xyz"))


def _three(given: Sequence[Value], at: int, function: Callable[[Floats], Floats]) -> Value:
    """What a function makes of a list of three numbers."""
    numbers = numbers_of(given[0]) if len(given) == 1 else None
    if numbers is None or len(numbers) != 3 or not np.isfinite(numbers).all():
        return first_unknown(given) or _unknown_in(given[0]) or Unknown("it is no list of three known numbers", at)
    return Listed(tuple((Number(value),) for value in function(np.array(numbers)).tolist()))


_PURE = {
    "rpy2rotvec": _rotvec,
    "rotvec2rpy": _rpy,
    "pose_trans": _trans,
    "pose_add": _add,
    "pose_sub": _sub,
    "pose_inv": _inv,
    "d2r": _degrees,
}
