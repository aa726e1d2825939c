"""Error curve: a cubic B-spline of the joint's own reading, with one parameter per coefficient.

The parameter of coefficient k has ``basis`` (centre, spacing, period): its B-spline has its maximum at the reading
``centre`` and extends two spacings to either side. The knots of a joint are uniform. With a period other than 0 they
cover a complete turn; otherwise the curve is zero beyond its last coefficients. In both cases readings a complete turn
of the joint apart are equivalent.

A curve has no key in a robot file: ``model.law_chain`` adds it to a chain from the result of an identification.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from truearm.model.chain_structure import Structure
from truearm.model.joint_terms.term import Term
from truearm.types import Floats


@dataclass(frozen=True)
class _Knots:
    """The coefficients of one joint: ``members`` of the term's parameters."""

    joint: int
    members: slice
    first: float  # centre of the first coefficient
    spacing: float
    periodic: bool

    @property
    def count(self) -> int:
        """Return the number of coefficients."""
        return int(self.members.stop - self.members.start)

    def weights(self, q: Floats, derivative: bool = False) -> tuple[NDArray[np.intp], Floats]:
        """Return the coefficients (4, n) that act at readings q (n,), and their weights.

        Coefficients count from 0; index ``count`` stands for a zero.
        """
        turn = 2.0 * np.pi
        middle = self.first + 0.5 * (self.count - 1) * self.spacing
        with np.errstate(invalid="ignore"):
            place = (q - turn * np.round((q.real - middle) / turn) - self.first) / self.spacing
        cell = np.floor(np.where(np.isfinite(place.real), place.real, 0.0)).astype(np.intp)
        u = place - cell
        if derivative:
            slopes = [-0.5 * (1 - u) ** 2, (1.5 * u - 2) * u, 0.5 + u - 1.5 * u**2, 0.5 * u**2]
            values = np.stack(slopes) / self.spacing
        else:
            values = np.stack([(1 - u) ** 3, 4 - 6 * u**2 + 3 * u**3, 1 + 3 * (u + u**2 - u**3), u**3]) / 6.0
        index = cell - 1 + np.arange(4)[:, None]
        if self.periodic:
            return index % self.count, values
        return np.where((index >= 0) & (index < self.count), index, self.count), values


class Curve(Term):
    """Σ coefficient_k · B((q − centre_k)/spacing), of the joint's own reading."""

    name = "curve"
    unit = None
    learned = True

    def __init__(self, structure: Structure, parameters: NDArray[np.intp]) -> None:
        super().__init__(structure, parameters)
        edges = np.flatnonzero(np.diff(self.joints, prepend=-1, append=-1))
        self._knots = []
        for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            centre, spacing, period = structure.parameters[parameters[start]].basis
            self._knots.append(_Knots(int(self.joints[start]), slice(start, stop), centre, spacing, period != 0.0))

    def value(self, params: Floats, q: Floats) -> Floats:
        return self._summed(params, q, derivative=False)

    def by_joints(self, params: Floats, q: Floats) -> Floats:
        return self._summed(params, q, derivative=True)

    def by_parameters(self, params: Floats, q: Floats) -> Floats:
        n = q.shape[1]
        out = np.zeros((self.parameters.size + 1, n), q.dtype)
        sample = np.arange(n)
        for indices, weights in self._weights(q):
            for row, weight in zip(indices, weights, strict=True):
                out[row, sample] += weight
        return out[:-1]

    def mean_by_parameters(self, q: Floats) -> Floats:
        """Return the mean (k,) of ``by_parameters`` over readings q (j, n).

        For many readings, ``by_parameters`` would take hundreds of megabytes.
        """
        out = np.zeros(self.parameters.size + 1)
        for indices, weights in self._weights(q):
            out += np.bincount(indices.ravel(), weights.ravel(), out.size)
        return np.asarray(out[:-1] / q.shape[1])

    def _weights(self, q: Floats) -> Iterator[tuple[NDArray[np.intp], Floats]]:
        """Return each joint's ``_Knots.weights``, with coefficients counted through all joints."""
        for knots in self._knots:
            indices, weights = knots.weights(q[knots.joint])
            yield np.where(indices < knots.count, indices + knots.members.start, self.parameters.size), weights

    def _summed(self, params: Floats, q: Floats, *, derivative: bool) -> Floats:
        out = np.zeros(q.shape, np.result_type(params, q))
        for knots in self._knots:
            indices, weights = knots.weights(q[knots.joint], derivative)
            coefficients = np.append(params[self.parameters[knots.members]], 0.0)
            out[knots.joint] = (coefficients[indices] * weights).sum(axis=0)
        return out


TERM = Curve
