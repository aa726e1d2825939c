"""A chain with error curves and sag: the joint laws that an identification adds to a robot.

The robot file describes the geometry. The laws are described by data (``types.Law``) that are small enough for a result
file: the knots of each curve and the unit masses of each sag. ``with_laws`` turns these into further parameters of the
chain, after all others and neutral until they are identified.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from truearm.model.chain import Chain
from truearm.model.chain_structure import Parameter
from truearm.model.joint_terms.curve import Curve
from truearm.model.joint_terms.sag import Sag
from truearm.model.robot import Robot
from truearm.types import CurveKnots, Law, Payload, SagMasses

DOWN = (0.0, 0.0, -1.0)  # default direction of gravity in the base frame
PAYLOAD = "payload"  # last part of the name of the parameter that is multiplied by the payload's torque


def with_laws(chain: Chain, laws: Sequence[Law]) -> Chain:
    """Return the chain with the parameters of these laws after its own."""
    added = tuple(parameter for law in laws for parameter in _parameters(chain, law))
    return replace(chain, parameters=(*chain.parameters, *added))


def robot_with_laws(robot: Robot, laws: Sequence[Law]) -> Robot:
    """Return the robot with the parameters of these laws, neutral in all its sets.

    They are fixed: only evidence may fit them.
    """
    if not laws:
        return robot
    chain = with_laws(robot.chain, laws)
    added = len(chain.parameters) - len(robot.chain.parameters)
    sets = {name: np.append(values, np.zeros(added)) for name, values in robot.parameter_sets.items()}
    return replace(robot, chain=chain, parameter_sets=sets, free=np.append(robot.free, np.zeros(added, dtype=bool)))


def _parameters(chain: Chain, law: Law) -> list[Parameter]:
    joint = chain.joints[law.joint]
    if isinstance(law, CurveKnots):
        unit, term = Curve.unit_of(joint.kind), Curve.name
        period = law.count * law.spacing * law.periodic
        bases: list[tuple[float, ...]] = [(law.first + k * law.spacing, law.spacing, period) for k in range(law.count)]
        labels = [str(k) for k in range(law.count)]
    else:
        unit, term = Sag.unit_of(joint.kind), Sag.name
        ends = (*law.frames, len(chain.joints) + 1) if law.payload else law.frames
        bases = [(float(frame), *law.gravity) for frame in ends]
        labels = [*map(str, law.frames), *[PAYLOAD] * law.payload]
    return [
        Parameter(f"{joint.name}.{term}.{label}", unit, 0.0, term, law.joint, tuple(basis))
        for label, basis in zip(labels, bases, strict=True)
    ]


def carries(chain: Chain, payload: Payload) -> Chain:
    """Return the chain with a payload."""
    return chain if chain.payload == payload else _carries(chain, payload)


@lru_cache(maxsize=64)
def _carries(chain: Chain, payload: Payload) -> Chain:
    return replace(chain, payload=payload)


def has_payload_law(chain: Chain) -> bool:
    """Return whether a payload acts on the joints."""
    return any(parameter.term == Sag.name and parameter.name.endswith(f".{PAYLOAD}") for parameter in chain.parameters)


def distal_frames(chain: Chain, joint: int) -> tuple[int, ...]:
    """Return the frames beyond a joint at whose origins masses are distinguishable by their torque about it."""
    motions = len(chain.joints)
    extended = replace(
        chain,
        parameters=(*chain.parameters, *_parameters(chain, SagMasses(joint, tuple(range(joint + 1, motions + 1))))),
    )
    rng = np.random.default_rng(0)
    q = chain.completed(rng.uniform(-np.pi, np.pi, (motions, 64)).T).T
    sag = Sag.of_chain(extended)
    # about three directions of gravity, so that none is unlucky for the torque
    frames: list[int] = []
    rows: list[np.ndarray] = []
    for k, frame in enumerate(range(joint + 1, motions + 1)):
        torque = sag.by_parameters(extended.params_nominal, q)[k]
        if np.abs(torque).max() > 1e-6 and not any(np.abs(torque - row).max() < 1e-6 for row in rows):
            frames.append(frame)
            rows.append(torque)
    return tuple(frames)
