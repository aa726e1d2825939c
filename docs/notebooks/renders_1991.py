"""The bench and the estimators of Renders, Rossignol, Becquet and Hanus 1991: straight lines of the ULB robot.

The paper states neither where its lines were nor the arm's postures. Here each line has a random position, direction
and posture; the controller, which has the nominal model, keeps the flange on it, and the device lies along the path of
the true arm. Figures are therefore distributions over sets of lines.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from papers import levenberg_marquardt, rank
from scipy.spatial.transform import Rotation

import truearm
from truearm.extend import Chain, along, forward, trace_point

ROBOT = truearm.load_robot("ulb")
CHAIN = ROBOT.chain
NAMES, NOMINAL = CHAIN.parameter_names, np.array(CHAIN.params_nominal)
SENSORS = np.array([3.84e-9, 10e-9, 3.84e-9])  # m², III-C, y along the line
JOINTS = np.array([21e-9, 21e-9, 21e-9, 1.31e-9, 21e-9, 305e-9])  # rad², the fifth is not printed: as its neighbours
LENGTH_SIGMA, ANGLE_SIGMA = 1e-3, 0.052  # III-C, prior of lengths [m] and angles [rad]
PRIOR = np.array([{"m": LENGTH_SIGMA, "rad": ANGLE_SIGMA}.get(p.unit, 0.0) for p in CHAIN.parameters])
DEVICE_SIGMA = 0.1  # m, of a device placed through the nominal robot; 1 mm would be false
GEAR = 2e-3  # rad, for an arm with a floor of some tenths of a millimetre
# Identified errors and their printed σ [rad, m]; III-F prints its lengths as Δα2, Δα4, Δα6, Δα6.
PRINTED_E = {
    "joint2.offset": (0.0236, 0.0005),
    "joint3.offset": (-0.1277, 0.0007),
    "joint4.offset": (-0.0341, 0.0014),
    "joint5.offset": (0.2585, 0.0010),
    "joint6.offset": (-0.0109, 0.0148),
}
PRINTED_F = {
    "joint2.offset": (0.0049, 0.0002),
    "joint3.offset": (-0.0995, 0.0005),
    "joint4.offset": (-0.0334, 0.0010),
    "joint5.offset": (0.1760, 0.0012),
    "joint6.offset": (0.3122, 0.0122),
    "joint2.a": (-0.0022, 0.00011),
    "joint4.d": (-0.0148, 0.00034),
    "joint6.a": (0.0017, 0.00008),
    "joint6.d": (0.0166, 0.00010),
}
LOWEST = np.radians([-150.0, -80.0, 30.0, -120.0, 30.0, -120.0])  # elbow and wrist bent: far from singular
HIGHEST = np.radians([150.0, 10.0, 120.0, 120.0, 110.0, 120.0])


def indices(names) -> np.ndarray:
    return np.array([NAMES.index(name) for name in names], dtype=int)


def with_errors(errors) -> np.ndarray:
    """Return the nominal parameters with errors added, by name."""
    params = NOMINAL.copy()
    params[indices(errors)] += [*errors.values()]
    return params


def printed(table) -> dict[str, float]:
    """Return the errors of ``PRINTED_E`` or ``PRINTED_F``."""
    return {name: error for name, (error, _) in table.items()}


def flange(params: np.ndarray, q: np.ndarray, chain: Chain = CHAIN):
    """Return the flange's centre (n, 3) and its derivatives by parameters (n, 3, p) and by joints (n, 3, 6)."""
    trace = trace_point(chain, params, q, np.zeros(3))
    rows = along(trace, np.eye(3)[:, None])
    return trace.p_base, np.moveaxis(rows.jac_params, 0, 1), np.moveaxis(rows.jac_joints, 0, 1)


@dataclass
class Lines:
    """Joint readings (n, 6), readings of the devices (n, 3), the line (n,) of each, and the devices' axes as set up by
    hand (lines, 3, 3)."""

    q: np.ndarray
    xyz: np.ndarray
    line: np.ndarray
    by_hand: np.ndarray

    def select(self, mask: np.ndarray) -> Lines:
        return replace(self, q=self.q[mask], xyz=self.xyz[mask], line=self.line[mask])


def measured_lines(truth, n_lines: int, n_points: int, rng: np.random.Generator, gear: float = 0.0) -> Lines:
    """Return lines of 0.5 m measured with the noise of III-C; ``gear`` [rad] is the amplitude of the joints' gear errors."""
    q = _driven(n_lines, n_points, int(rng.integers(2**32))).reshape(-1, 6)
    error = gear * np.sin(rng.integers(3, 13, 6) * q + rng.uniform(0.0, 2.0 * np.pi, 6))
    p = flange(truth, q + error)[0].reshape(n_lines, n_points, 3)
    y = p[:, -1] - p[:, 0]
    x = np.cross(y, rng.normal(size=y.shape))
    axes = np.stack([v / np.linalg.norm(v, axis=1, keepdims=True) for v in (x, y, np.cross(x, y))], axis=2)
    xyz = ((p - p.mean(axis=1, keepdims=True)) @ axes).reshape(-1, 3)
    xyz += np.sqrt(SENSORS) * rng.standard_normal(xyz.shape)
    by_hand = Rotation.from_rotvec(ANGLE_SIGMA * rng.standard_normal((n_lines, 3))).as_matrix() @ axes
    reading = q + np.sqrt(JOINTS) * rng.standard_normal(q.shape)
    return Lines(reading, xyz, np.repeat(np.arange(n_lines), n_points), by_hand)


@cache
def _driven(n_lines: int, n_points: int, seed: int) -> np.ndarray:
    """Return joints (lines, points, 6) that keep the nominal flange on straight lines within reach."""
    rng = np.random.default_rng(seed)
    share = 0.5 * np.linspace(-0.5, 0.5, n_points)
    lines = np.zeros((0, n_points, 6))
    while len(lines) < n_lines:
        middle = rng.uniform(LOWEST, HIGHEST, (8 * n_lines, 6))
        direction = rng.normal(size=(8 * n_lines, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        centre = flange(NOMINAL, middle)[0]
        q, away = np.empty((n_points, *middle.shape)), np.zeros(len(middle))
        for k in np.argsort(np.abs(share), kind="stable"):  # outwards from the middle, either side from its neighbour
            inner = k + 1 if share[k] < 0.0 else k - 1
            q[k] = middle if np.abs(share[k]) == np.abs(share).min() else q[inner]
            for _ in range(4):
                p, _, jac = flange(NOMINAL, q[k])
                step = np.linalg.pinv(jac, rcond=1e-2) @ (centre + share[k] * direction - p)[..., None]
                q[k] += np.clip(step[..., 0], -0.3, 0.3)
            away = np.maximum(away, np.abs(centre + share[k] * direction - flange(NOMINAL, q[k])[0]).max(axis=1))
        inside = ((q > LOWEST - 0.5) & (q < HIGHEST + 0.5)).all(axis=(0, 2))
        lines = np.concatenate([lines, q[:, inside & (away < 1e-9)].swapaxes(0, 1)])
    return lines[:n_lines]


def placed(lines: Lines, number: int, params: np.ndarray, first: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) and axes (3, 3) of a device through a robot: by all points, or by the ``first`` (III-G 5 a).

    The points determine no roll about the line: that is as set up by hand.
    """
    rows = np.flatnonzero(lines.line == number)[:first]
    p, xyz, axes = flange(params, lines.q[rows])[0], lines.xyz[rows], lines.by_hand[number]
    u, _, v = np.linalg.svd((p - p.mean(axis=0)).T @ (xyz - xyz.mean(axis=0)) @ axes.T)
    along_p, along_xyz = u[:, 0], v[0]
    across = np.cross(along_xyz, along_p)
    sine = np.linalg.norm(across)
    turn = across / max(sine, 1e-300) * np.arctan2(sine, along_xyz @ along_p)
    axes = Rotation.from_rotvec(turn).as_matrix() @ axes
    return p.mean(axis=0) - axes @ xyz.mean(axis=0), axes


@dataclass
class Problem:
    """Unknowns x: parameters ``free`` of the robot, then position and rotation vector of each device from ``devices``.

    ``sigma`` is the prior of x about ``mean``. ``weight`` False: least squares, without S_x, S_q; ``joint_noise`` False:
    without S_q.
    """

    lines: Lines
    free: np.ndarray
    devices: list[tuple[np.ndarray, np.ndarray]]
    start: np.ndarray = field(default_factory=NOMINAL.copy)
    weight: bool = True
    joint_noise: bool = True

    def __post_init__(self) -> None:
        device = np.tile(np.repeat([DEVICE_SIGMA, ANGLE_SIGMA], 3), len(self.devices))
        self.sigma = np.concatenate([PRIOR[self.free], device])
        self.mean = np.zeros(self.sigma.size)

    def params(self, x: np.ndarray) -> np.ndarray:
        params = self.start.copy()
        params[self.free] += x[: self.free.size]
        return params

    def linearised(self, x: np.ndarray, rows: np.ndarray | slice = slice(None)):
        """Return Δx (n, 3) [m], J (n, 3, k) of (7), and the triangle L (n, 3, 3) with C⁻¹ = L Lᵀ = S_x + J₂ S_q J₂ᵀ."""
        line, xyz = self.lines.line[rows], self.lines.xyz[rows]
        p, jac_params, jac_joints = flange(self.params(x), self.lines.q[rows])
        device = x[self.free.size :].reshape(-1, 6)
        origin = np.array([position for position, _ in self.devices]) + device[:, :3]
        turned = Rotation.from_rotvec(device[:, 3:]).as_matrix()
        axes = turned @ np.array([axes for _, axes in self.devices])
        delta = origin[line] + np.einsum("nij,nj->ni", axes[line], xyz) - p
        jac = np.zeros((len(p), 3, x.size))
        jac[:, :, : self.free.size] = jac_params[:, :, self.free]
        # (28), with the lever in base axes; that of the predicted point, because S_x turns with the device.
        spread = skew(p - origin[line]) @ left_jacobian(device[:, 3:])[line]
        for k in range(len(self.devices)):
            at = self.free.size + 6 * k
            jac[line == k, :, at : at + 3] = -np.eye(3)
            jac[line == k, :, at + 3 : at + 6] = spread[line == k]
        covariance = (axes * SENSORS) @ axes.swapaxes(1, 2)
        covariance = covariance[line] + self.joint_noise * (jac_joints * JOINTS) @ jac_joints.swapaxes(1, 2)
        return delta, jac, np.linalg.cholesky(covariance if self.weight else np.tile(np.eye(3), (len(p), 1, 1)))

    def whitened(self, x: np.ndarray, rows: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals (3 n,) and their Jacobian (3 n, k) in standard deviations."""
        delta, jac, root = self.linearised(x, rows)
        return np.linalg.solve(root, delta[..., None]).ravel(), np.linalg.solve(root, jac).reshape(-1, x.size)

    def mean_error(self, x: np.ndarray) -> float:
        return float(np.linalg.norm(self.linearised(x)[0], axis=1).mean())

    def fit(self, x: np.ndarray, rows: np.ndarray | slice = slice(None), steps: int = 50) -> np.ndarray:
        """Return the maximum a posteriori of ``rows``, from x."""

        def evaluate(x):
            residual, jac = self.whitened(x, rows)
            prior = (self.mean - x) / self.sigma
            return np.concatenate([residual, prior]), np.concatenate([jac, np.diag(1.0 / self.sigma)])

        return levenberg_marquardt(evaluate, x, steps)[0]

    def runs(self, count: int, recipe: bool):
        """Return x after runs of (12), their mean errors, and the covariance.

        With the paper's ``recipe`` (III-E) P_N of a run is P_0 of the next, on the same data. Without, P_0 is the prior.
        """
        x, history = self.mean.copy(), [self.mean_error(self.mean)]
        information, target = np.diag(1.0 / self.sigma**2), np.zeros(x.size)
        for _ in range(count):
            residual, jac = self.whitened(x)
            posterior = information + jac.T @ jac
            x = x + np.linalg.solve(posterior, jac.T @ residual + information @ (target - x) * (not recipe))
            information = posterior if recipe else information
            history.append(self.mean_error(x))
        return x, np.array(history), np.linalg.inv(posterior)


def skew(v: np.ndarray) -> np.ndarray:
    """Return the matrices (n, 3, 3) of v × ."""
    return np.cross(np.eye(3), v[:, None, :]).swapaxes(1, 2) * -1.0


def left_jacobian(turn: np.ndarray) -> np.ndarray:
    """Return the rotation (n, 3, 3) that a change of the rotation vectors (n, 3) adds, per change."""
    angle = np.maximum(np.linalg.norm(turn, axis=1), 1e-12)[:, None, None]
    s = skew(turn)
    return np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * s + (angle - np.sin(angle)) / angle**3 * s @ s


def recursive(problem: Problem, x: np.ndarray, used: np.ndarray):
    """Return Δ, P and the prediction errors (n,) [m] of (18) and (20), point by point, linearised at x.

    Corrected: (18) is lost in the scan, the second "=" of (20) is "+", and the minus signs after (19) are wrong.
    """
    delta, covariance, errors = np.zeros(x.size), np.diag(problem.sigma**2), []
    for observed, jac, root, use in zip(*problem.linearised(x), used, strict=True):
        innovation = observed - jac @ delta
        errors.append(np.linalg.norm(innovation))
        if use:
            gain = covariance @ jac.T @ np.linalg.inv(jac @ covariance @ jac.T + root @ root.T)
            delta = delta + gain @ innovation
            covariance = covariance - gain @ jac @ covariance
    return delta, covariance, np.array(errors)


def predictions(lines: Lines, free: np.ndarray, p0: float | None, last: int = 10**6, steps: int = 3) -> np.ndarray:
    """Return the prediction errors of Fig. 4 [m] of maximum likelihood, or of least squares from P(0) = ``p0``.

    The estimate before each point is the minimum over the points before; a line is placed by its first two points
    through the robot as estimated then. Only the ``last`` points are predicted, each after ``steps`` from the one before.
    """
    problem = Problem(lines, free, [(np.zeros(3), np.eye(3))] * len(lines.by_hand), weight=p0 is None)
    if p0 is not None:
        problem.sigma[:] = np.sqrt(p0)
    x, used, errors = problem.mean.copy(), np.zeros(len(lines.line), dtype=bool), []
    counted = len(lines.line) - 2 * len(lines.by_hand)
    for number in range(len(lines.by_hand)):
        rows = np.flatnonzero(lines.line == number)
        x = problem.fit(x, used, steps) if used.any() else x
        problem.devices[number] = placed(lines, number, problem.params(x), first=2)
        x[free.size + 6 * number :] = 0.0
        for row in rows[2:]:
            if used.sum() >= counted - last:
                x = problem.fit(x, used, steps) if used.any() else x
                errors.append(np.linalg.norm(problem.linearised(x, [row])[0]))
            used[row] = True
    return np.array(errors)


def unseen(a6: float, frozen, rng: np.random.Generator) -> int:
    """Return how many Denavit–Hartenberg parameters, d2 among them, lines cannot determine: the device moves with base."""
    link = next(i for i, e in enumerate(CHAIN.elements) if e.joint == 1) + 1
    d2 = replace(CHAIN.parameters[NAMES.index("joint1.d")], name="joint2.d", nominal=0.0)
    elements = [*CHAIN.elements]
    elements[link] = replace(elements[link], parameter=len(NAMES))
    chain = replace(CHAIN, elements=tuple(elements), parameters=(*CHAIN.parameters, d2))
    params = np.append(with_errors({"joint6.a": a6}), 0.0)
    jac = flange(params, rng.uniform(*CHAIN.limits, (100, 6)), chain)[1].reshape(300, -1)
    names = np.array(chain.parameter_names)
    device = np.char.startswith(names, "base.")
    rows = np.char.startswith(names, "joint") & ~np.char.endswith(names, ".gain") & ~np.isin(names, frozen)
    return int(rows.sum()) - (rank(jac[:, rows | device])[0] - rank(jac[:, device])[0])


def cross_section(step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, z (n,) and joints (n, 6) of Fig. 5: θ1 = θ4 = θ6 = 0, elbow up, hand down."""
    a2, d4, d6 = NOMINAL[indices(["joint2.a", "joint4.d", "joint6.d"])]
    x, z = (v.ravel() for v in np.meshgrid(np.arange(0.1, 0.8, step), np.arange(-0.6, 0.7, step)))
    cosine = (x**2 + (z + d6) ** 2 - a2**2 - d4**2) / (2.0 * a2 * d4)
    x, z, bend = (v[np.abs(cosine) < 0.98] for v in (x, z, np.arccos(np.clip(cosine, -1.0, 1.0))))
    shoulder = np.arctan2(z + d6, x) + np.arctan2(d4 * np.sin(bend), a2 + d4 * np.cos(bend))
    q = np.zeros((x.size, 6))
    q[:, 1], q[:, 2] = -shoulder, bend + np.pi / 2.0
    q[:, 4] = np.pi - q[:, 1] - q[:, 2]
    return x, z, q


def calibrated(errors):
    """Return what ``truearm.identify`` makes of a robot with errors, from noise-free poses of its end."""
    q = np.random.default_rng(0).uniform(LOWEST, HIGHEST, (60, 6))
    pose = forward(CHAIN, with_errors(errors), q)
    table = truearm.ObservationTable(
        q=q,
        kind="pose",
        tracker="t",
        xyz=pose[:, :3, 3],
        rotation=Rotation.from_matrix(pose[:, :3, :3]).as_rotvec(),
        source=[f"pose {i}" for i in range(len(q))],
    )
    exact = truearm.Device("t", tuple(map(tuple, 1e-10 * np.eye(3))), (0.0, 0.0, 0.0), sigma=0.0, turn_sigma=0.0, rotation_sigma=1e-5)  # fmt: skip
    options = truearm.IdentifyOptions(free=tuple(errors), prior="none", joint_laws="none")
    return truearm.identify(ROBOT, table, truearm.Rig(trackers={"t": exact}), options=options)
