"""The joint law: a joint's true angle θ (or position) as a function of all joint readings q and the parameters.

    θ_i = Σ terms ,    by default  θ_i = offset_i + gain_i·q_i

All code that needs true angles uses this module: their value, derivatives by readings and parameters, and inverse.
TERM_FILES is the registry: to add a term, add a file in ``model/joint_terms`` and a line there. A chain has parameters
of a term if its builder created them, for example from a key of a robot file's [jointN].

A parameter of a law moves everything beyond its joint about the joint's axis. The derivative is therefore that by the
true angle, which ``chain`` computes, times ∂θ/∂parameter. Where this factor varies, the parameter is one more column
(``columns``); where it is 1, it is a combination of the columns of the links.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, reduce
from importlib import import_module
from itertools import pairwise

import numpy as np

from truearm.additions import check_loaded, with_additions
from truearm.model.chain_structure import Structure, completed
from truearm.model.joint_terms.term import Gain, Offset, Term
from truearm.types import Floats

# In the order of a joint's parameters, after offset and gain, which every controller has.
TERM_FILES = (
    "curve",
    "sag",
)
MAX_STEPS = 30  # of Newton's method, which squares the error at each step; more steps do not help
LARGEST_STEP = 0.5  # rad, m
STEP_END = 1e-13  # of the readings, rad, m
GOOD = 1e-9  # rad, m: largest error of a valid inverse


def _term(item: type[Term]) -> type[Term]:
    if not issubclass(item, Term):
        raise TypeError("it is not a subclass of Term")
    return item


@cache
def terms() -> tuple[type[Term], ...]:
    """Return offset, gain and the terms of TERM_FILES, then those of packages (entry points "truearm.joint_terms")."""
    further = {file: import_module(f"truearm.model.joint_terms.{file}").TERM for file in TERM_FILES}
    bundled = {"offset": Offset, "gain": Gain, **further}
    registry = with_additions("joint_terms", bundled, _term)
    check_loaded("joint_terms")
    return tuple(registry.values())


@dataclass(frozen=True, eq=False)
class LawAt:
    """The law at given params (p,) and readings q (j, n); each result is computed once, on demand."""

    law: JointLaw
    params: Floats
    q: Floats

    @cached_property
    def angles(self) -> Floats:
        """(j, n) θ [rad or m]"""
        values = (term.value(self.params, self.q) for term in self.law.terms)
        return reduce(np.add, values)

    @cached_property
    def by_joints(self) -> Floats:
        """∂θ/∂q: its diagonal, (j, n) or (j, 1), if the joints do not depend on each other, otherwise (j, j, n)."""
        jacobians = [term.by_joints(self.params, self.q) for term in self.law.moving]
        if self.law.mimics or (len(jacobians) > 1 and any(jacobian.ndim == 3 for jacobian in jacobians)):
            jacobians = [_square(jacobian) for jacobian in jacobians]
        jac = reduce(np.add, jacobians)
        for joint, mimic in self.law.mimics.items():
            jac[:, mimic.followed] += mimic.multiplier * jac[:, joint]
            jac[:, joint] = 0.0
        return np.broadcast_to(jac, (*jac.shape[:-1], self.q.shape[1])) if self.law.mimics else jac

    @cached_property
    def by_parameters(self) -> Floats:
        """∂θ/∂parameter (m, n) of the law's ``columns``, joint by joint."""
        terms = self.law.varying
        if not terms:
            return np.zeros((0, self.q.shape[1]))
        derivatives = [term.by_parameters(self.params, self.q) for term in terms]
        rows = derivatives[0] if len(derivatives) == 1 else np.concatenate(derivatives)
        return rows if self.law.order is None else rows[self.law.order]


class JointLaw:
    """The terms that a chain has parameters of; always includes offset and gain."""

    def __init__(self, structure: Structure) -> None:
        term_names = {parameter.term for parameter in structure.parameters}
        self.mimics = structure.mimics
        self.offset, self.gain = Offset.of_chain(structure), Gain.of_chain(structure)
        further = (
            term.of_chain(structure) for term in terms() if term not in (Offset, Gain) and term.name in term_names
        )
        self.terms: tuple[Term, ...] = (self.offset, self.gain, *further)
        self.affine = all(term.affine for term in self.terms)
        # parameters with ∂θ/∂parameter = 1, and those where it varies: (parameter, joint) and by joint
        self.constant = tuple(
            pair
            for term in self.terms
            if term.constant
            for pair in zip(term.parameters.tolist(), term.joints.tolist(), strict=True)
        )
        self.moving = tuple(term for term in self.terms if not term.constant)
        self.varying = tuple(term for term in self.moving if term.parameters.size)
        joints = np.concatenate([np.zeros(0, int), *(term.joints for term in self.varying)])
        order = np.argsort(joints, kind="stable")
        self.order = None if np.array_equal(order, np.arange(order.size)) else order
        parameters = np.concatenate([np.zeros(0, int), *(term.parameters for term in self.varying)])[order]
        edges = np.searchsorted(joints[order], np.arange(len(structure.joints) + 1)).tolist()
        self.columns: Sequence[slice] = [slice(*ends) for ends in pairwise(edges)]
        self.of_column = parameters

    def at(self, params: Floats, q: Floats) -> LawAt:
        """Return the law at params (p,) and readings q (j, n)."""
        return LawAt(self, params, completed(q.T, self.mimics, len(q)).T if self.mimics else q)

    def angles(self, params: Floats, q: Floats) -> Floats:
        """Return true angles or positions (…, j) at readings q (…, j) [rad or m]."""
        return self.at(params, flat(q)).angles.T.reshape(q.shape)

    def by_joints(self, params: Floats, q: Floats) -> Floats:
        """Return ∂θ/∂q (…, j, j)."""
        full = _square(self.at(params, flat(q)).by_joints)
        full = np.broadcast_to(full, (*full.shape[:2], math.prod(q.shape[:-1])))
        return np.moveaxis(full, -1, 0).reshape(*q.shape, q.shape[-1])

    def readings(self, params: Floats, angles: Floats, near: Floats | None = None) -> Floats:
        """Return the inverse: readings (…, j) at which the joints' true angles are ``angles`` (…, j).

        Offset and gain are inverted in closed form. Starting from there, or from readings ``near`` (…, j), further
        terms are inverted by Newton's method. NaN where it does not converge.
        """
        targets = flat(angles)
        with np.errstate(all="ignore"):
            if near is None or self.affine:
                q = (targets - self.offset.of(params)[:, None]) / self.gain.of(params)[:, None]
            else:
                q = flat(near)
            if not self.affine:
                q = self._newton(params, targets, q)
        return q.T.reshape(angles.shape)

    def _newton(self, params: Floats, targets: Floats, q: Floats) -> Floats:
        for _ in range(MAX_STEPS):
            state = self.at(params, q)
            step = np.clip(_solved(state.by_joints, targets - state.angles), -LARGEST_STEP, LARGEST_STEP)
            q = q + step
            if not np.abs(step).max(initial=0.0, where=np.isfinite(step)) > STEP_END:
                break
        bad = ~(np.abs(self.at(params, q).angles - targets).max(axis=0) < GOOD)
        return np.where(bad, np.nan, q)


def _square(jac: Floats) -> Floats:
    """Return a Jacobian (j, j, n) by its diagonal (j, n), or as it is."""
    return jac if jac.ndim == 3 else np.asarray(jac[:, None] * np.eye(len(jac))[..., None])


def flat(q: Floats) -> Floats:
    """Return joint readings (…, j) as (j, n)."""
    return q.reshape(math.prod(q.shape[:-1]), q.shape[-1]).T


def _solved(jac: Floats, error: Floats) -> Floats:
    """Return jac⁻¹·error (j, n), using the pseudo-inverse of a singular jac."""
    if jac.ndim == 2:
        return np.asarray(error / jac)
    square, vector = np.moveaxis(jac, -1, 0), error.T[..., None]
    square = np.where(np.isfinite(square), square, 0.0)  # a failed pose must not affect the others
    try:
        step = np.linalg.solve(square, vector)
    except np.linalg.LinAlgError:
        step = np.linalg.pinv(square) @ vector
    return np.asarray(step[..., 0].T)
