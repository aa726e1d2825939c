"""A kind of observation whose residual is an angle: the inclination of the end's z axis from the base's, in rad."""

from dataclasses import dataclass

import numpy as np

from truearm.extend import Group, Kind, Quantity, RigUse, about, forward, linearised, measured, sigmas, trace_point

ANGLE = Quantity("incline", ("incline",), "rad")


@dataclass(frozen=True, kw_only=True)
class InclineRows(Group):
    """n inclinations."""

    COMPONENTS = ("rad",)

    q: np.ndarray  # (n, j)
    angle: np.ndarray  # (n,) measured, rad

    def evaluate(self, chain, x):
        """Return residuals (n,) and derivatives at x (P,): a rotation about the normal of both axes tilts the end's."""
        params = x[: len(chain.parameters)]
        axis = forward(chain, params, self.q)[:, :3, 2]
        normal = np.cross([0.0, 0.0, 1.0], axis)
        size = np.linalg.norm(normal, axis=1)
        trace = trace_point(chain, params, self.q, np.zeros((len(self.q), 3)))
        tilt = about(trace, (normal / size[:, None])[None])
        return linearised(self.angle - np.arctan2(size, axis[:, 2]), tilt, x)


def use_rig(scope, rows):
    """Use one item that has no numbers: nothing of the rig is known or unknown."""
    angle = measured(scope, rows, ANGLE)
    variance = sigmas(scope, rows, np.full((len(rows), 1), np.nan), "rad") ** 2
    return RigUse.of(InclineRows, scope, rows, variance, angle=angle)


KIND = Kind(
    group=InclineRows,
    use_rig=use_rig,
    needs=(ANGLE,),
    grouped_by=("place",),
    name="inclination",
    residual={"rad": "measured minus predicted inclination of the end's z axis"},
)
