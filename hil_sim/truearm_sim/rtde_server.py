"""The controller's side of RTDE: the World's robot on the port of a Universal Robots controller.

It implements protocol version 2 of the public description as far as needed to read outputs; the bytes are in
``truearm.record.robots.rtde``. The output fields are those that readers of robots request; fields without a
value in the World are zero. Inputs (fields that a client would write) are rejected. There is one client at a time, as
in ``Port``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from itertools import chain

import numpy as np

from truearm.record.robots import rtde
from truearm_sim.robot import States

from .ports import Port

CONTROLLER = (5, 15, 0, 0)  # as reported by an e-Series

_VECTORS = """target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current
actual_current_window joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed
joint_temperatures actual_joint_voltage ft_raw_wrench actual_TCP_acceleration target_TCP_acceleration tcp_offset payload_inertia actual_current_as_torque"""
_DOUBLES = """timestamp actual_execution_time target_execution_time speed_scaling target_speed_fraction actual_momentum
actual_main_voltage actual_robot_voltage actual_robot_current standard_analog_input0 standard_analog_input1
standard_analog_output0 standard_analog_output1 io_current tool_analog_input0 tool_analog_input1 tool_output_current tool_temperature
tcp_force_scalar payload time_scale_source collision_detection_ratio"""
TYPES = {
    **dict.fromkeys(_VECTORS.split(), "VECTOR6D"),
    **dict.fromkeys(_DOUBLES.split(), "DOUBLE"),
    **dict.fromkeys(["actual_tool_accelerometer", "elbow_position", "elbow_velocity", "payload_cog"], "VECTOR3D"),
    **dict.fromkeys(["actual_digital_input_bits", "actual_digital_output_bits"], "UINT64"),
    **dict.fromkeys(
        ["runtime_state", "robot_status_bits", "safety_status_bits", "analog_io_types", "tool_analog_input_types"],
        "UINT32",
    ),
    **dict.fromkeys(["robot_mode", "safety_mode", "safety_status", "tool_mode", "tool_output_voltage"], "INT32"),
    "joint_mode": "VECTOR6INT32",
}
_REGISTERS = {
    re.compile(r"(in|out)put_int_register_\d{1,2}"): "INT32",
    re.compile(r"(in|out)put_double_register_\d{1,2}"): "DOUBLE",
    re.compile(r"(in|out)put_bit_registers(0_to_31|32_to_63)"): "UINT32",
    re.compile(r"(in|out)put_bit_register_\d{2,3}"): "BOOL",
}
# Constant values: the robot runs (7), so does its program (2), safety is normal (1), at full speed.
CONSTANT = {"robot_mode": 7, "runtime_state": 2, "safety_mode": 1, "speed_scaling": 1.0, "target_speed_fraction": 1.0}


def type_of(name: str) -> str:
    """Return the type of an output field, NOT_FOUND if the description has no such field."""
    for pattern, type_ in _REGISTERS.items():
        if pattern.fullmatch(name):
            return type_
    return TYPES.get(name, rtde.NOT_FOUND)


@dataclass
class RtdeServer:
    """A listening controller. ``rate_hz``: of the World's readings, the highest rate for a client."""

    port: Port
    rate_hz: float
    _packages: rtde.Packages = field(default_factory=rtde.Packages)
    _recipe: rtde.Recipe | None = None
    _every: int = 1
    running: bool = False

    def connected(self) -> bool:
        before = self.port.client
        there = self.port.connected()
        if self.port.client is not before:
            self._packages, self._recipe, self.running = rtde.Packages(), None, False
        return there

    def report(self, states: States) -> None:
        """Answer the client's requests, then send it the readings if it has started them."""
        for kind, payload in self._packages.push(self.port.receive()):
            self.port.send(self._answer(kind, payload))
        if self._packages.broken:
            self.port.drop()
        data = self.data(states) if self.running else b""
        # A reader that is slower than the controller misses packages, but never receives part of one.
        self.port.send(data if len(data) <= self.port.room() else b"")

    def close(self) -> None:
        self.port.close()

    def _answer(self, kind: int, payload: bytes) -> bytes:
        if kind == rtde.VERSION:
            return rtde.packed(kind, bytes([payload == b"\0\2"]))
        if kind == rtde.CONTROLLER:
            return rtde.packed(kind, b"".join(number.to_bytes(4, "big") for number in CONTROLLER))
        if kind == rtde.OUTPUTS:
            return rtde.packed(kind, self._set_up(payload))
        if kind in (rtde.START, rtde.PAUSE):
            accepted = self._recipe is not None
            self.running = accepted and kind == rtde.START
            return rtde.packed(kind, bytes([accepted]))
        return rtde.packed(rtde.TEXT, _text(f"package type {kind} is not served"))

    def _set_up(self, payload: bytes) -> bytes:
        """Accept an output recipe; return the answer's payload."""
        frequency = float(np.frombuffer(payload[:8].ljust(8, b"\0"), ">f8")[0])
        names = [name for name in payload[8:].decode("ascii", "replace").split(",") if name]
        types = [type_of(name) for name in names]
        answer = ",".join(types).encode()
        found = bool(names) and len(set(names)) == len(names) and rtde.NOT_FOUND not in types and frequency >= 1.0
        self._recipe = rtde.recipe_of(names, b"\1" + answer) if found else None
        self._every = max(1, round(self.rate_hz / frequency)) if found else 1
        return bytes([found]) + answer

    def data(self, states: States) -> bytes:
        """Return data packages of the readings, at the rate that the client requested."""
        rows = np.flatnonzero(states.number % self._every == 0)
        if self._recipe is None or not rows.size:
            return b""
        columns = [self._values(name, states)[rows].reshape(len(rows), -1).tolist() for name in self._recipe.places]
        numbers = (chain([self._recipe.number], *row) for row in zip(*columns, strict=True))
        return b"".join(rtde.packed(rtde.DATA, self._recipe.layout.pack(*row)) for row in numbers)

    def _values(self, name: str, states: States) -> np.ndarray:
        """Return the values (m,) or (m, n) of a field, one row for each state."""
        known = {
            "timestamp": states.t_robot,
            "actual_q": states.q,
            "target_q": states.q_cmd,
            "actual_qd": states.qd,
            "target_qd": states.qd_cmd,
            "actual_digital_input_bits": states.inputs,
        }
        if name in known:
            return known[name]
        shape = (len(states.t), *np.dtype(rtde.TYPES[type_of(name)]).shape)
        return np.full(shape, CONSTANT.get(name, 0))


def _text(text: str) -> bytes:
    data = text.encode()[:255]
    source = b"truearm_sim"
    return bytes([len(data)]) + data + bytes([len(source)]) + source + b"\2"
