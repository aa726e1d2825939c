"""Corrected targets: what to command, the remaining error, and which targets must be rejected.

``newton`` is the full inverse of the identified model; ``false-target`` (32), ``joints`` (34) and ``offsets`` (35) are
the paper's methods. Each yields joint readings q. A controller that accepts poses is given f_n(q), which it converts
back into q.

A target is rejected, without a guess, if the nominal or the identified robot cannot reach it within the joint limits.
So is one closer to a singularity than ``margin``, and one where an iteration increases the error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, assert_never

import numpy as np

from truearm.correct.configurations import Origins, search, within
from truearm.correct.methods import Method
from truearm.correct.model_pair import ModelPair, believed, in_rig, reached
from truearm.correct.renders_methods import false_target, joint_space, offsets
from truearm.display import Displayed
from truearm.model.inverse import inverse, singular_value
from truearm.model.poses import apart
from truearm.model.rotation import rotation_vector
from truearm.option_defaults import MARGIN
from truearm.text import counted
from truearm.types import Floats

ROUNDING = 1e-9  # m, rad: below this, an iteration only changes the last digits
TURNS = 3  # of a free orientation: each makes its error by the mounting of the tool a hundred times smaller
MOST_TURN = 0.5  # rad, m: a correction that moves a joint further leads to another configuration


class Configuration(NamedTuple):
    """Which of the arm's configurations the controller uses.

    ``q_start``: (n, j) near the joints that it will use. Without it they are searched for (``inverse.search``), near
    ``home`` (j,) first, within ``quadrants`` (n, j), each nearest to the robot's previous position by ``origins``.
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
    was not found for it is NaN. ``name`` are the names that were given for the targets, ``joint_units`` "rad" or "m" for
    each joint, and ``simulated`` says whether the calibration is.

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
