"""Corrected targets: what to command, the remaining error, and which targets must be rejected.

``newton`` is the full inverse of the identified model. The other methods are those of Renders (1991, IV); each yields
joint readings q. A controller that accepts poses is given f_n(q), which it converts back into q.

**False targets** (IV-B), for a controller that keeps its nominal model. For the target x_d the end arrives at x_n =
f_i(f_n⁻¹(x_d)), so the target is shifted by the opposite:

    x_m = x_d + (x_d − x_n)                                   (32)

Repeated: x_m ← f_n(q) + (x_d − f_i(q)); orientations compose.

**Joint space** (IV-C), for a controller that accepts readings, with the nominal Jacobian or its pseudo-inverse:

    q_i = f_n⁻¹(x_d) + J_n⁻¹·(x_d − x_n)                      (34)

One step of either leaves an error of second order.

**Offsets** (IV-C), there the encoders' zeros:

    q_i = f_n⁻¹(x_d) − Δq                                     (35)

Here it is the reading θ_i⁻¹(θ_n(q_n)) at which the true joints are where the controller aims: exact if only the joint
law is wrong.

Targets are rejected that the nominal or the identified robot cannot reach within the joint limits, that are closer to a
singularity than ``margin``, or where an iteration increases the error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, assert_never

import numpy as np
from numpy.typing import NDArray

from truearm.correct.configurations import Origins, search, within
from truearm.correct.methods import Method
from truearm.model.chain import Chain, forward
from truearm.model.inverse import inverse, jacobian, singular_value
from truearm.model.robot_mounting import NONE, Mountings, own_law
from truearm.model.transforms import apart, inverted, moved, rotation_vector
from truearm.option_defaults import MARGIN
from truearm.text import counted
from truearm.types import Displayed, Floats

ROUNDING = 1e-9  # m, rad: below this, an iteration only changes the last digits
TURNS = 3  # of a free orientation: each makes its error by the mounting of the tool a hundred times smaller
MOST_TURN = 0.5  # rad, m: a correction that moves a joint further leads to another configuration
JUMP = 1.0  # rad, m of a joint between samples: more means another configuration, or passing a singularity
SAMPLES = 9  # points between the ends: the deviation is smooth, largest near the middle


class ModelPair(NamedTuple):
    """A chain with nominal and identified parameters (p,).

    ``mountings`` other than the identity are removed: targets are then poses of the robot's own flange in its own base
    frame. Otherwise they are poses of the calibration's end frame in its base frame.
    """

    chain: Chain
    nominal: Floats
    identified: Floats
    mountings: Mountings = NONE


def believed(pair: ModelPair, q: Floats) -> Floats:
    """Return f_n(q), (n, 4, 4): the pose of the end in the controller's model (Renders 1991, (29))."""
    return forward(pair.chain, pair.nominal, q)


def reached(pair: ModelPair, q: Floats) -> Floats:
    """Return f_i(q), (n, 4, 4): the actual pose of the end (Renders 1991, (30))."""
    pose = forward(pair.chain, pair.identified, q)
    return np.asarray(inverted(pair.mountings.base) @ pose @ inverted(pair.mountings.tool))


def in_rig(pair: ModelPair, targets: Floats) -> Floats:
    """Return targets (n, 4, 4) as poses in the identified chain's own frames."""
    return np.asarray(pair.mountings.base @ targets @ pair.mountings.tool)


def false_target(pair: ModelPair, targets: Floats, q: Floats, oriented: bool = True) -> Floats:
    """Apply one step of (32): return the joint readings (n, j) that the controller uses for the false targets.

    targets : (n, 4, 4) x_d. q : (n, j) where the controller goes for the current targets, initially f_n⁻¹(x_d). NaN
        where the nominal robot does not reach the false target.
    """
    commanded = moved(believed(pair, q), apart(targets, reached(pair, q)))
    return inverse(pair.chain, pair.nominal, commanded, q, oriented)


def joint_space(pair: ModelPair, targets: Floats, q: Floats, oriented: bool = True) -> Floats:
    """Apply one step of (34) for targets (n, 4, 4) from q (n, j), initially f_n⁻¹(x_d)."""
    error = apart(targets, reached(pair, q))[:, : 6 if oriented else 3, None]
    return np.asarray(q + (np.linalg.pinv(jacobian(pair.chain, pair.nominal, q, oriented, lever=1.0)) @ error)[..., 0])


def offsets(pair: ModelPair, q_nominal: Floats) -> Floats:
    """Return the readings (n, j) at which the true joint angles are those of the nominal robot at q_nominal (n, j).

    NaN where there are none.
    """
    law = pair.chain.law
    taken_out = pair.mountings is not NONE
    identified = own_law(pair.chain, pair.nominal, pair.identified) if taken_out else pair.identified
    return law.readings(identified, law.angles(pair.nominal, q_nominal))


class Configuration(NamedTuple):
    """Which of the arm's configurations the controller uses.

    ``q_start``: (n, j) near the joints that it will use. Without it they are searched for (``configurations.search``),
    near ``home`` (j,) first, within ``quadrants`` (n, j), each nearest to the robot's previous position by ``origins``.
    """

    q_start: Floats | None = None
    home: Floats | None = None
    quadrants: Floats | None = None
    origins: Origins | None = None


SEARCHED = Configuration()


@dataclass(frozen=True, eq=False, repr=False)
class Correction(Displayed):
    """n corrected targets.

    ``q`` (n, j) are the joint readings to move to, and ``q_nominal`` (n, j) those that the controller would use without
    correction. ``commanded`` (n, 4, 4) are the poses to command. ``before`` and ``after`` (n, 2) are the errors of the
    end in m and rad, or of the tool by ``at_tools``. ``problem`` says why a row must not be used, "" if it may be; what
    was not found for it is NaN. ``name`` are the names that were given for the targets, ``joint_units`` "rad" or "m"
    for each joint, and ``simulated`` says whether the calibration is.

    Examples
    --------
    >>> import numpy as np
    >>> import truearm
    >>> result = truearm.read_result("result.json")
    >>> pose = np.array([[0, 0, 1, 0.5], [0, 1, 0, 0.1], [-1, 0, 0, 0.2], [0, 0, 0, 1]])
    >>> corrected = truearm.correct_poses(result, pose, home=np.radians([0, 0, 180, 0, -90, 0]))
    >>> corrected.q.shape, corrected.problem
    ((1, 6), ('',))
    """

    q_nominal: Floats
    q: Floats
    commanded: Floats
    before: Floats
    after: Floats
    problem: tuple[str, ...]
    name: tuple[str, ...] = ()
    joint_units: tuple[str, ...] = ()
    simulated: bool = False

    @property
    def status(self) -> tuple[str, ...]:
        """Return "corrected", or why a target must not be used, for each target."""
        return tuple(problem or "corrected" for problem in self.problem)

    def _headline(self) -> str:
        refused = sum(map(bool, self.problem))
        return f"{counted(len(self.q), 'target')}, {refused} refused"

    def _columns(self) -> Mapping[str, Any]:
        six = np.concatenate([self.commanded[:, :3, 3], rotation_vector(self.commanded[:, :3, :3])], axis=1)
        titles = ["x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"]
        titles += [f"q{i}_{unit}" for i, unit in enumerate(self.joint_units, start=1)]
        return {
            "name": self.name or [""] * len(self.q),
            **dict(zip(titles, [*six.T, *self.q.T], strict=True)),
            "before_m": self.before[:, 0],
            "after_m": self.after[:, 0],
            "before_rad": self.before[:, 1],
            "after_rad": self.after[:, 1],
            "simulated": ["yes" * self.simulated] * len(self.q),
            "status": self.status,
        }


def correct(
    pair: ModelPair,
    targets: Floats,
    method: Method | str = Method.NEWTON,
    steps: int = 1,
    *,
    oriented: bool = True,
    configuration: Configuration = SEARCHED,
    margin: float = MARGIN,
) -> Correction:
    """Correct targets (n, 4, 4), x_d.

    steps : how often (32) and (34) are applied. oriented : False if only positions matter. margin : smallest singular
        value of targets that are accepted. Raises ValueError for an unknown method.
    """
    q_start, home, quadrants, origins = configuration
    if q_start is None:
        q_nominal = search(pair.chain, pair.nominal, targets, oriented, home, quadrants, origins)
    else:
        q_nominal = inverse(pair.chain, pair.nominal, targets, q_start, oriented)
        q_nominal[~within(pair.chain, q_nominal)] = np.nan
    error_before = _error(pair, targets, q_nominal, oriented)
    q = _corrected(pair, targets, q_nominal, Method(method), steps, oriented)
    error_after = _error(pair, targets, q, oriented)
    models = (pair.nominal, q_nominal), (pair.identified, q)
    singular = np.fmin(*(singular_value(pair.chain, *model, oriented) for model in models))
    q = pair.chain.completed(q)
    unreached = "no joint values within the limits were found at which the nominal robot reaches the target; "
    near = f"too near a singularity (smallest singular value {{:.3f}}, the margin is {margin:g}); "
    reasons: tuple[tuple[Any, str], ...] = (
        (np.isnan(q_nominal).any(axis=1), unreached + "move the target or the base"),
        (singular < margin, near + "move the target, or lower the margin"),
        (np.isnan(q).any(axis=1), "the correction does not converge"),
        (np.abs(q - q_nominal).max(axis=-1) > MOST_TURN, "the correction leads to another configuration of the arm"),
        (~within(pair.chain, q), "the corrected joints are outside the joint limits"),
    )
    problem = (next((words for refused, words in reasons if refused[i]), "") for i in range(len(q)))
    words = tuple(text.format(value) for text, value in zip(problem, singular.tolist(), strict=True))
    return Correction(q_nominal, q, believed(pair, q), error_before, error_after, words)


def joined(corrections: Sequence[Correction]) -> Correction:
    """Return the targets of each part after those of the one before."""
    names = ("q_nominal", "q", "commanded", "before", "after")
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(correction, name) for correction in corrections]) for name in names
    }
    return Correction(**arrays, problem=tuple(problem for correction in corrections for problem in correction.problem))


def at_tools(pair: ModelPair, done: Correction, tools: Floats) -> Correction:
    """Return a correction with the errors of tools, whose poses in the end frame are (n, 4, 4) or (4, 4)."""
    goal, *ends = (
        (poses @ tools)[:, :3, 3]
        for poses in (believed(pair, done.q_nominal), reached(pair, done.q_nominal), reached(pair, done.q))
    )
    error_before, error_after = (
        np.column_stack([np.linalg.norm(end - goal, axis=1), error[:, 1]])
        for end, error in zip(ends, (done.before, done.after), strict=True)
    )
    return replace(done, before=error_before, after=error_after)


def _corrected(
    pair: ModelPair, targets: Floats, q_nominal: Floats, method: Method, steps: int, oriented: bool
) -> Floats:
    """Return corrected joints q (n, j), NaN where no correction reduces the error."""
    match method:
        case Method.OFFSETS:
            return offsets(pair, q_nominal)
        case Method.NEWTON:
            q, poses = q_nominal, targets.copy()
            for _ in range(1 if oriented else TURNS):  # the mounting of the tool turns with the end
                if not oriented:
                    poses[:, :3, :3] = reached(pair, q)[:, :3, :3]
                goals = in_rig(pair, poses)
                q = inverse(pair.chain, pair.identified, goals, q, oriented)
            outside = ~within(pair.chain, q) & within(pair.chain, q_nominal)
            # An arm with more joints than needed may have joints within the limits for the same pose.
            stopped = inverse(pair.chain, pair.identified, goals[outside], q_nominal[outside], oriented, bounded=True)
            q[outside] = np.where(np.isnan(stopped), q[outside], stopped)
            return q
        case Method.FALSE_TARGET | Method.JOINTS:
            step = false_target if method is Method.FALSE_TARGET else joint_space
            return _repeated(step, pair, targets, q_nominal, steps, oriented)
        case _:
            assert_never(method)


def _repeated(
    step: Callable[[ModelPair, Floats, Floats, bool], Floats],
    pair: ModelPair,
    targets: Floats,
    q_nominal: Floats,
    steps: int,
    oriented: bool,
) -> Floats:
    """Return ``_corrected`` for a method applied ``steps`` times, each time to the previous result."""
    q, size = q_nominal, _error(pair, targets, q_nominal, oriented)
    for _ in range(steps):
        q = step(pair, targets, q, oriented)
        previous, size = size, _error(pair, targets, q, oriented)
        grew = np.nansum(size, axis=-1) > np.maximum(np.nansum(previous, axis=-1), ROUNDING)
        q = np.where(grew[:, None], np.nan, q)
    return q


def _error(pair: ModelPair, targets: Floats, q: Floats, oriented: bool) -> Floats:
    """Return distance [m] and angle [rad] (n, 2) from targets to the end; NaN for the angle if it does not matter."""
    error = apart(targets, reached(pair, q))
    angle = np.linalg.norm(error[:, 3:], axis=-1) if oriented else np.full(len(q), np.nan)
    return np.stack([np.linalg.norm(error[:, :3], axis=-1), angle], axis=-1)


class StraightMoves(NamedTuple):
    """n moves: the largest deviation of the true tool from the line, and the smallest margins, with both ends.

    Of a line that the controller's model cannot follow, the limits are those as far as it can.
    """

    deviation: Floats  # (n,) m, NaN if the line cannot be followed
    singular_value: Floats  # (n,) of the nominal robot, NaN likewise
    limits: Floats  # (n, j) rad or m to each joint's nearest limit, negative beyond it
    drivable: NDArray[np.bool_]  # (n,) whether the controller's model follows the line without a jump of a joint


def straight_moves(pair: ModelPair, q_start: Floats, commanded: Floats, tool: Floats) -> StraightMoves:
    """Drive straight from joint readings (n, j) to commanded poses ``commanded`` (n, 4, 4) of the end.

    ``tool`` (n, 4, 4) is the pose of the tool in the end frame.
    """
    begin = believed(pair, q_start) @ tool
    motion = apart(commanded @ tool, begin)
    path = [np.asarray(q_start, dtype=float)]
    drivable, lost = np.ones(len(commanded), dtype=bool), np.zeros(len(commanded), dtype=bool)
    for share in np.linspace(0.0, 1.0, SAMPLES + 2)[1:]:
        q = inverse(pair.chain, pair.nominal, moved(begin, share * motion) @ inverted(tool), path[-1])
        drivable &= np.abs(q - path[-1]).max(axis=-1) < JUMP
        lost |= np.isnan(q).any(axis=-1)
        path.append(np.where(np.isnan(q), path[-1], q))
    places = np.array([(reached(pair, q) @ tool)[:, :3, 3] for q in path])
    singular = np.min([singular_value(pair.chain, pair.nominal, q) for q in path], axis=0)
    limits = np.min([limit_margins(pair.chain, q) for q in path], axis=0)
    deviation, singular = (np.where(lost, np.nan, values) for values in (_deviation(places), singular))
    return StraightMoves(deviation, singular, limits, drivable & (limits >= 0.0).all(axis=1))


def limit_margins(chain: Chain, q: Floats) -> Floats:
    """Return the distance (…, j) [rad or m] of joint readings (…, j) to the nearest limit of each.

    It is negative outside the limits, and inf where there is none.
    """
    lower, upper = chain.limits
    return np.asarray(np.minimum(q - lower, upper - q))


def _deviation(places: Floats) -> Floats:
    """Return the largest distance (n,) of points (samples, n, 3) from the line between the first and the last."""
    chord = places[-1] - places[0]
    length = np.linalg.norm(chord, axis=-1, keepdims=True)
    along = np.divide(chord, length, out=np.zeros_like(chord), where=length > 0.0)
    offset = places - places[0]
    offset = offset - (offset * along).sum(axis=-1, keepdims=True) * along
    return np.asarray(np.linalg.norm(offset, axis=-1).max(axis=0))
