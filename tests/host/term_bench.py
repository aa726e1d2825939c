"""Further terms of the joint law: one of all readings, one of the joint's own."""

import numpy as np

from truearm.model import joint_law
from truearm.model.joint_terms.term import Term


class Sway(Term):
    """Every joint's reading bends a joint: a·sin(q_1 + q_2/2 + …) for each parameter a."""

    name = "sway"
    unit = None

    def __init__(self, chain, parameters):
        super().__init__(chain, parameters)
        self._rate = 1.0 / np.arange(1, len(chain.joints) + 1)

    def value(self, params, q):
        out = np.zeros(q.shape, np.result_type(params, q))
        np.add.at(out, self.joints, params[self.parameters][:, None] * np.sin(self._rate @ q))
        return out

    def by_joints(self, params, q):
        slope = np.zeros((len(q), q.shape[1]), np.result_type(params, q))
        np.add.at(slope, self.joints, params[self.parameters][:, None] * np.cos(self._rate @ q))
        return slope[:, None] * self._rate[:, None]

    def by_parameters(self, params, q):
        return np.broadcast_to(np.sin(self._rate @ q), (len(self.joints), q.shape[1]))


class Ripple(Term):
    """a_k·sin(k·q) of the joint's own reading, one parameter a k."""

    name = "ripple"
    unit = "rad"

    def __init__(self, chain, parameters):
        super().__init__(chain, parameters)
        self._k = np.array([1 + np.sum(self.joints[:i] == joint) for i, joint in enumerate(self.joints)])[:, None]

    def value(self, params, q):
        out = np.zeros(q.shape, np.result_type(params, q))
        np.add.at(out, self.joints, params[self.parameters][:, None] * np.sin(self._k * q[self.joints]))
        return out

    def by_joints(self, params, q):
        out = np.zeros(q.shape, np.result_type(params, q))
        np.add.at(out, self.joints, params[self.parameters][:, None] * self._k * np.cos(self._k * q[self.joints]))
        return out

    def by_parameters(self, params, q):
        return np.sin(self._k * q[self.joints])


def register(monkeypatch):
    """Add the terms to those of the joint law."""
    terms = (*joint_law.terms(), Sway, Ripple)
    monkeypatch.setattr(joint_law, "terms", lambda: terms)
