"""A ball-bar between a sphere on the endpoint and a chuck on the table: one length an observation.

d = ‖T(q)·s − c‖ (Goswami, Quaid, Peshkin 1993, Optimization). The table holds the length that the bar's declared zero
z₀ and gain k₀ make of its reading. With other zero z and gain k the same reading means d = z + k·(length − z₀)/k₀, so

    predicted length = z₀ + k₀·(d − z)/k ,

which is d itself while zero and gain are as declared. ∂d/∂x is the derivative of the sphere along the bar's direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from truearm import schema
from truearm.kinds.draft import Draft, Scope, measured, sigmas, use
from truearm.kinds.group import Group
from truearm.kinds.kind import Kind
from truearm.kinds.linearised import Indices, Linearised, gather, no_columns, scatter
from truearm.kinds.quantities import LENGTH
from truearm.kinds.rig_entries import NAME, POINT, SIZE, SPHERE, by_name
from truearm.kinds.unknowns import Fault, Layout, Number, point_numbers
from truearm.model.chain import Chain, along, trace_point
from truearm.schema import Entries, Key, Table
from truearm.types import BallBar, Floats

# The sensor's zero drifts and jumps, its gain may be wrong; the bar itself stands nowhere.
BAR_FAULTS = (Fault(slice(0, 1), drift=True), Fault(slice(1, 2), step=False))


@dataclass(frozen=True, kw_only=True)
class BallBarRows(Group):
    """n ball-bar observations; indices point into x followed by ``constants``."""

    COMPONENTS = ("m",)

    q: Floats  # (n, j)
    length: Floats  # (n,) measured, m
    sphere: Indices  # (n, 3)
    chuck: Indices  # (n, 3)
    scale: Indices  # (n, 2) zero and gain
    declared: Floats  # (n, 2) zero and gain that made ``length``

    def evaluate(self, chain: Chain, x: Floats) -> Linearised:
        """Residuals (n,) and their derivatives at x (P,)."""
        p = len(chain.parameters)
        trace = trace_point(chain, x[:p], self.q, gather(x, self.constants, self.sphere))
        bar = trace.p_base - gather(x, self.constants, self.chuck)
        d = np.sqrt((bar * bar).sum(axis=1))
        zero, gain = gather(x, self.constants, self.scale).T
        declared_zero, declared_gain = self.declared.T
        ratio = declared_gain / gain
        predicted = declared_zero + ratio * (d - zero)
        # A sphere in the chuck's centre has no direction: such a row says nothing to first order.
        u = bar * (ratio / np.where(d > 0.0, d, 1.0))[:, None]
        derivative = along(trace, u[None])
        by_rig = no_columns(derivative.wrenches, x.size - p)
        scatter(by_rig, self.sphere - p, derivative.jac_point)
        scatter(by_rig, self.chuck - p, -u[None])
        scatter(by_rig, self.scale - p, np.stack([-ratio, -ratio * (d - zero) / gain], axis=1)[None])
        return Linearised(
            self.length - predicted, derivative.wrenches, derivative.twists, by_rig, derivative.jac_joints
        )


def bar_numbers(name: str, bar: BallBar) -> list[Number]:
    """Zero and gain of a bar."""
    zero = Number(f"{name}.zero", "m", bar.zero, bar.zero_sigma)
    return [zero, Number(f"{name}.gain", "1", bar.gain, bar.gain_sigma)]


def draft(scope: Scope, rows: Indices) -> Draft:
    """Chucks, spheres and bars that the rows use."""
    table, rig = scope.table, scope.rig
    chucks = use(scope, rows, "chuck", rig.chucks, point_numbers)
    spheres = use(scope, rows, "sphere", rig.spheres, point_numbers)
    bars = use(scope, rows, "bar", rig.bars, bar_numbers, BAR_FAULTS)
    length = measured(scope, rows, LENGTH)
    declared = np.array([[number.value for number in bar] for bar in bars.numbers])[bars.which]
    sigma = np.array([rig.bars[str(label)].sigma for label in bars.labels])[bars.which]
    variance = sigmas(scope, rows, sigma[:, None]) ** 2

    def make(layout: Layout) -> list[Group]:
        return [
            BallBarRows(
                row=rows,
                sensor_cov=variance,
                q=table.q[rows],
                length=length,
                sphere=layout.index(spheres),
                chuck=layout.index(chucks),
                scale=layout.index(bars),
                declared=declared,
                constants=layout.constants,
            )
        ]

    return Draft((chucks, spheres, bars), make)


CHUCK = Entries("chuck", POINT, "chucks", by_name)
BAR = Entries(
    "bar",
    Table(
        (
            NAME,
            Key("zero", SIZE),
            Key("gain", schema.Number("1", positive=True), optional=True),
            Key("travel", SIZE),
            Key("sigma", SIZE),
            Key("zero_sigma", schema.sigma("m"), optional=True),
            Key("gain_sigma", schema.sigma("1"), optional=True),
        ),
        lambda gain=1.0, **values: BallBar(gain=gain, **values),
    ),
    "bars",
    by_name,
)
KIND = Kind(
    group=BallBarRows,
    draft=draft,
    needs=("bar", "chuck", "sphere", LENGTH),
    entries=(CHUCK, SPHERE, BAR),
    point="sphere",
    grouped_by=("chuck", "sphere"),
    regions=("bar",),
    name="ball-bar",
    residual={"m": "measured less predicted length of the bar"},
    groups="pairing of chuck and sphere",
)
