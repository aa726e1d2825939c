"""A problem: one robot, the rigs around it and a table of observations, with every unknown named.

The parameter vector x (P,) consists of the robot's params followed by the unknowns of the rigs, kind by kind as in
``kinds.registry``: ``chuck.<name>.x .y .z``, ``sphere.<name>.x .y .z``, ``bar.<name>.zero .gain``,
``socket.<place>.<socket>.x .y .z``, ``socket_distance.<a>.<b>``, ``target.<name>.x .y .z``, ``line.<name>.x .y .z .rx
.ry .rz``, ``tracker.<name>`` likewise, ``time_offset``, ``plane.<name>.offset .tilt1 .tilt2``. It includes only those
that a row uses and that the rig does not know exactly. Sockets are always unknown and start at the mean of the ball
positions predicted by the nominal robot.

Several sessions of one robot, each with its own rig, make one problem: they share the robot's parameters, and the
unknowns of a rig are prefixed with its name (``monday.chuck.c1.x``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from truearm.errors import ProblemError
from truearm.estimate.circumstances import Circumstances, payloads_of
from truearm.estimate.residual_noise import Backlash, checked_joint_cov, residual_cov
from truearm.estimate.systematic_effects import (
    BASE,
    MOTION,
    MOVED,
    Cause,
    Errors,
    Modelled,
    modelled_effects,
    motion_of_body,
    with_effects,
    with_payloads,
)
from truearm.kinds.group import Fault, Group, Layout
from truearm.kinds.kind import RigUse, Scope
from truearm.kinds.registry import end_points, kinds
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain
from truearm.model.law_chain import has_payload_law
from truearm.results import Effect
from truearm.types import Floats, Indices, Mask, Residuals, Rig, Rigs, rigs_by_name
from truearm.units import UNITS

BLOCK = 4096  # observations evaluated at once: a Jacobian of 54 columns takes 1.8 MB, about the second-level cache
WIDE = 128  # parameters of a robot; error curves have hundreds
NO_ERRORS = Errors((), ())
PLACED = Fault(slice(None))  # a place of sockets, by the motion of all of them


@dataclass(frozen=True)
class Problem:
    """Observations compiled against x.

    ``prior_sigma`` is inf where x has no prior, and the prior's mean is ``start``.
    """

    chain: Chain
    names: tuple[str, ...]  # P
    units: tuple[str, ...]  # P
    start: Floats  # (P,)
    prior_sigma: Floats  # (P,)
    groups: tuple[Group, ...]
    n_rows: int  # of the table
    joint_cov: Floats | None = None  # (j, j) of the joint readings; None: exact
    errors: Errors = NO_ERRORS  # possible errors of the predictions, in the order of ``effects.error_columns``
    causes: tuple[Cause, ...] = ()  # how items can be off, as declared by their kinds
    effects: frozenset[str] = frozenset()  # names of the parameters that are systematic errors

    @property
    def n_robot(self) -> int:
        return len(self.chain.parameters)

    @property
    def of_rig(self) -> NDArray[np.bool_]:
        """Return a mask (P,) of all unknowns but the robot's."""
        return np.arange(len(self.names)) >= self.n_robot

    @property
    def rig_prior(self) -> Floats:
        """Return ``prior_sigma`` (P,) without that of the robot's parameters."""
        return np.where(self.of_rig, self.prior_sigma, np.inf)

    def columns(self, free: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a mask (P,) of the robot's ``free`` (p,) parameters and all other unknowns."""
        columns = self.of_rig
        columns[: self.n_robot] = free
        return columns

    def names_of(self, columns: NDArray[np.bool_]) -> list[str]:
        """Return the names of masked (P,) unknowns."""
        return [name for name, is_in in zip(self.names, columns, strict=True) if is_in]

    def at(self, values: Mapping[str, float]) -> Floats:
        """Return x (P,) with the values that are given by name, and the start for all others."""
        return np.array([values.get(name, value) for name, value in zip(self.names, self.start, strict=True)])

    def no_residuals(self) -> dict[str, Floats]:
        """Return NaN (n_rows,) for each unit of the table's residuals, to be filled by ``note``."""
        have = {unit for group in self.groups if group.row is not None for unit in group.COMPONENTS}
        return {unit: np.full(self.n_rows, np.nan) for unit in UNITS if unit in have}


def build_problem(
    chain: Chain,
    rig: Rigs,
    table: ObservationTable,
    prior_sigma: Floats | None = None,
    effects: Sequence[Effect] = (),
    rows: Mask | Indices | slice = slice(None),
) -> Problem:
    """Compile the ``rows`` of a table into a problem.

    ``prior_sigma`` (p,): σ of robot parameters, inf for none. ``rig`` is one rig for all rows, or rigs by the names in
    the table's ``rig`` column. ``effects`` are systematic errors that become parameters too, the last of x. Their spans
    and drifts are those of the whole table.

    Raises ProblemError for joint readings that do not match the robot, for unknown kinds, chucks, spheres or bars
    (naming the row), for missing readings, for rigs that differ in the noise of the joints, and for a parameter of the
    rig that has the name of one of the robot.
    """
    if effects:
        causes = build_problem(chain, rig, table).causes
        modelled = modelled_effects(causes, effects, Circumstances.of(table, chain))
        problem = build_problem(chain, rig, table, prior_sigma, rows=rows)
        return _with_effects(problem, [effect.select(rows) for effect in modelled])
    table = table.select(rows)
    _check_joints(chain, table)
    bad = np.flatnonzero(~np.isin(table.kind, list(kinds())))
    if bad.size:
        unknown, known_kinds = str(table.kind[bad[0]]), ", ".join(kinds())
        raise ProblemError(f"{table.source[bad[0]]}: kind {unknown!r} is not known; use one of {known_kinds}")
    rigs = _rigs(rig, table)
    first = next(iter(rigs.values()))
    joint_cov = checked_joint_cov(first.joint_cov, len(chain.joints))
    backlash = Backlash.of(first, joint_cov)
    if backlash is not None:
        table, joint_cov = table.replace(q=backlash.links(table)), backlash.cov_of_known_sides
    uses: list[RigUse] = []
    for name, entries in rigs.items():
        scope = Scope(chain, entries, table, f"{name}." if name else "")
        has_rig = table.rig == name
        for name_of_kind, kind in kinds().items():
            rows = np.flatnonzero(has_rig & (table.kind == name_of_kind))
            if rows.size:
                uses.append(kind.use_rig(scope, rows))
    layout = Layout(len(chain.parameters), [item for use in uses for item in use.used])
    free = layout.unknown
    of_robot = np.full(len(chain.parameters), np.inf) if prior_sigma is None else prior_sigma
    prior = np.concatenate([of_robot, [u.sigma for u in free]])
    start = np.concatenate([chain.params_nominal, [u.value for u in free]])
    names = (*chain.parameter_names, *(u.name for u in free))
    if both := {*chain.parameter_names} & {u.name for u in free}:
        raise ProblemError(
            f"robot and rig both have a parameter {min(both)}; rename the joint, or the entry of the rig"
        )
    units = (*(p.unit for p in chain.parameters), *(u.unit for u in free))
    groups = tuple(group for use in uses for group in use.make(layout))
    if has_payload_law(chain):
        groups = with_payloads(groups, payloads_of(rigs, table))
    errors, causes = _errors(chain, rigs, layout, uses)
    problem = Problem(chain, names, units, start, prior, groups, len(table), joint_cov, errors, causes)
    return problem if backlash is None else _with_unknown_sides(problem, backlash.unknown(table))


def _errors(
    chain: Chain, rigs: Mapping[str, Rig], layout: Layout, uses: Sequence[RigUse]
) -> tuple[Errors, tuple[Cause, ...]]:
    """Return the possible errors of predictions and their causes: rig items, joints, base, and what has several points.

    That is the tool, and places of sockets.
    """
    rig = [*layout.unknown, *layout.known]
    joints = [joint.name for joint in chain.joints]
    names = (*(number.name for number in rig), *joints, *(name for name, _ in BASE))
    units = (*(number.unit for number in rig), *chain.joint_units, *(unit for _, unit in BASE))
    causes = {}
    for item in (item for use in uses for item in use.used):
        for numbers in filter(None, item.numbers):  # a device with every number given has none
            for fault in item.faults:
                names_off = tuple(number.name for number in numbers[fault.numbers])
                name = names_off[0] if len(names_off) == 1 else names_off[0].rpartition(".")[0]
                causes[name] = Cause(name, names_off, fault)
    of_joints = (Cause(name, (name,), MOVED, is_joint=True) for name in joints)
    all_causes = [*causes.values(), *of_joints, Cause("base", tuple(name for name, _ in BASE), MOVED)]
    value = {number.name: number.value for number in rig}
    ends = [
        f"{name}.{group}.{label}".removeprefix(".")
        for name, entries in rigs.items()
        for group, points in end_points(entries).items()
        for label in points
    ]
    bodies = {"tool": [name for name in ends if f"{name}.x" in value]}
    bodies |= {place: list(points) for use in uses for place, points in use.bodies.items()}
    motions = []
    for body, points in bodies.items():
        if len(points) < 2:
            continue
        positions = {name: np.array([value[f"{name}.{k}"] for k in "xyz"]) for name in points}
        fault, about = (MOVED, np.zeros(3)) if body == "tool" else (PLACED, np.mean(list(positions.values()), axis=0))
        all_causes.append(Cause(body, tuple(f"{body}.{name}" for name, _ in MOTION), fault))
        motions.append(motion_of_body(names, positions, about))
    moved = [cause for cause in all_causes if cause.name in bodies]
    return Errors(
        (*names, *(number for cause in moved for number in cause.numbers)),
        (*units, *(unit for _ in moved for _, unit in MOTION)),
        np.concatenate(motions, axis=1) if motions else np.zeros((0, 0)),
    ), tuple(all_causes)


def _with_effects(problem: Problem, effects: Sequence[Modelled]) -> Problem:
    """Return the problem with effects as its last parameters, with the wide prior.

    The prior is needed because the data may not determine every direction of an item, such as a chuck that moved. It is
    that of manual mounting. An offset in all rows of an existing parameter is that parameter with an equally wide
    prior.
    """
    named = {modelled.effect.parameter(modelled.column): modelled for modelled in effects}
    wide = np.array([UNITS[unit].wide_sigma for unit in problem.units])
    wider = np.isin(problem.names, list(named)) & (problem.prior_sigma < wide)
    problem = replace(problem, prior_sigma=np.where(wider, wide, problem.prior_sigma), effects=frozenset(named))
    effects = [modelled for name, modelled in named.items() if name not in problem.names]
    if not effects:
        return problem
    columns = problem.errors.indices([modelled.column for modelled in effects])
    profiles = np.stack([modelled.profile for modelled in effects], axis=1)
    names = tuple(modelled.effect.parameter(modelled.column) for modelled in effects)
    units = tuple(problem.errors.units[i] for i in columns)
    joints = np.isin([modelled.column for modelled in effects], [joint.name for joint in problem.chain.joints])
    drifts = np.array([modelled.effect.drifts_with is not None for modelled in effects])
    unknown = len(problem.names) - problem.n_robot
    unknowns, known_numbers = slice(unknown), slice(unknown, None)
    errors = Errors(
        (*problem.errors.names[unknowns], *names, *problem.errors.names[known_numbers]),
        (*problem.errors.units[unknowns], *units, *problem.errors.units[known_numbers]),
        np.insert(problem.errors.bodies, [unknown] * len(names), 0.0, axis=0)
        if problem.errors.bodies.size
        else problem.errors.bodies,
    )
    return replace(
        problem,
        errors=errors,
        names=(*problem.names, *names),
        units=(*problem.units, *units),
        start=np.concatenate([problem.start, np.zeros(columns.size)]),
        prior_sigma=np.concatenate([problem.prior_sigma, [UNITS[unit].wide_sigma for unit in units]]),
        groups=with_effects(problem.groups, problem.errors.bodies, columns, profiles, ~(joints | drifts)),
    )


def _with_unknown_sides(problem: Problem, sigma: Floats) -> Problem:
    """Return the problem with deviations of links from encoders, ``sigma`` (n_rows, j), as noise of the rows."""
    groups: list[Group] = []
    for group in problem.groups:
        of_rows = np.zeros((0, 0)) if group.row is None else sigma[group.row]
        if of_rows.any():
            jac = group.evaluate(problem.chain, problem.start).jac_joints
            off = jac.reshape(len(of_rows), -1, jac.shape[-1]) * of_rows[:, None]
            cov = residual_cov(group.sensor_cov, off.reshape(jac.shape), np.eye(jac.shape[-1]))
            group = replace(group, sensor_cov=cov)
        groups.append(group)
    return replace(problem, groups=tuple(groups))


def blocks(problem: Problem) -> Iterator[Group]:
    """Yield the problem's observations, at most BLOCK at once, and fewer if the robot has more than WIDE parameters."""
    size = max(1, BLOCK * WIDE // max(problem.n_robot, WIDE))
    for group in problem.groups:
        yield from pieces(group, size)


def pieces(group: Group, size: int = BLOCK) -> Iterator[Group]:
    """Yield a group's observations, at most ``size`` at once."""
    for first in range(0, len(group.sensor_cov), size):
        yield group.take(slice(first, first + size))


def note(block: Group, residual: Floats, out: Residuals) -> None:
    """Write a block's residuals (n·w,) to their rows of the table, unit by unit.

    Knowledge does not belong to any row.
    """
    if block.row is not None:
        for unit, figure in block.by_unit(residual).items():
            out[unit][block.row] = figure


def settled(problem: Problem, x: Floats) -> Problem:
    """Return the problem with its observations settled (``Group.settle``), to compute their rank at x."""
    return _with_groups(problem, [group.settle(problem.chain, x) for group in problem.groups])


def without_effect_priors(problem: Problem) -> Problem:
    """Return the problem without the priors of its effects, to tell what the data determine of them."""
    prior = np.where(np.isin(problem.names, list(problem.effects)), np.inf, problem.prior_sigma)
    return replace(problem, prior_sigma=prior)


def without_knowledge(problem: Problem) -> Problem:
    """Return the problem without knowledge that is not in the table, such as the distance between two sockets."""
    return replace(problem, groups=tuple(group for group in problem.groups if group.row is not None))


def _rigs(rig: Rigs, table: ObservationTable) -> Mapping[str, Rig]:
    """Return the checked rigs by the names that the rows have."""
    rigs = rigs_by_name(rig)
    bad = np.flatnonzero(~np.isin(table.rig, list(rigs)))
    if bad.size:
        have = ", ".join(sorted(filter(None, rigs))) or "one rig without a name"
        raise ProblemError(
            f"{table.source[bad[0]]}: belongs to rig {str(table.rig[bad[0]])!r}; the rigs given are {have}"
        )
    if len({(entries.joint_cov, entries.backlash, entries.backlash_sigma) for entries in rigs.values()}) > 1:
        raise ProblemError("joint_cov belongs to the robot, so all rigs need the same one")
    return rigs


def _check_joints(chain: Chain, table: ObservationTable) -> None:
    if table.q.shape[1] != len(chain.joints):
        raise ProblemError("other-robot", place="table", joints=table.q.shape[1], expected=len(chain.joints))
    bad = np.flatnonzero(~np.isfinite(table.q).all(axis=1))
    if bad.size:
        raise ProblemError(f"{table.source[bad[0]]}: a joint reading is not a finite number")


def held(problem: Problem, x: Floats) -> Problem:
    """Return the problem with its observations held at x (``Group.hold``)."""
    return _with_groups(problem, [group.hold(problem.chain, x) for group in problem.groups])


def _with_groups(problem: Problem, groups: Sequence[Group]) -> Problem:
    """Return the problem with other groups; the problem itself if none differs."""
    is_unchanged = all(a is b for a, b in zip(groups, problem.groups, strict=True))
    return problem if is_unchanged else replace(problem, groups=tuple(groups))
