"""A calibrated robot arm: the pose of its end at joint readings, and the readings at which its end has a pose.

Units: m, rad, kg. A pose has three rows of [R | p] in the base frame. ``forward(q)`` returns the pose at readings q.
``correct(pose, q)`` returns readings near q at which the arm has the pose, and the remaining error: the larger of the
distance [m] and of 2·sin(turn/2) [rad]. Use the readings only if this error is below your limit. Each of them stays
within LARGEST_CHANGE [rad or m] of q and within the joint limits. The error of a pose that has no such readings, or of
an R that is no rotation, is not small. If the pose or q is not finite, or q lies farther than that outside the joint
limits, q is returned and the error is infinite.
"""

from __future__ import annotations

import math

# tables
JOINTS = 0
SLIDES: tuple[bool, ...] = ()
LINKS: tuple[tuple[tuple[float, ...], ...], ...] = ()
OFFSETS: tuple[float, ...] = ()
GAINS: tuple[float, ...] = ()
LOWER: tuple[float, ...] = ()
UPPER: tuple[float, ...] = ()
CURVES: tuple[tuple[int, float, float, bool, tuple[float, ...]], ...] = ()
NOMINAL_LINKS: tuple[tuple[tuple[float, ...], ...], ...] = ()
NOMINAL_OFFSETS: tuple[float, ...] = ()
NOMINAL_GAINS: tuple[float, ...] = ()
SAG: tuple[tuple[int, int, tuple[float, ...], float], ...] = ()
PAYLOAD_MASS = 0.0
PAYLOAD_CENTRE = (0.0, 0.0, 0.0)
# end tables

LARGEST_CHANGE, LARGEST_STEP = 0.5, 0.1
STEPS, STEP_END, DAMPING = 60, 1e-13, 1e-12


def forward(q: list[float]) -> list[list[float]]:
    """Return the pose of the end at readings q."""
    return _frames(LINKS, true_angles(q))[-1]


def true_angles(q: list[float]) -> list[float]:
    """Return the joints' true angles or positions: offset + gain·q + error curve(q) + sag."""
    if len(q) != JOINTS:
        raise ValueError(f"q has {len(q)} readings; the arm has {JOINTS} joints")
    angles = [offset + gain * reading for offset, gain, reading in zip(OFFSETS, GAINS, q)]
    for joint, first, spacing, periodic, coefficients in CURVES:
        angles[joint] += _spline(q[joint], first, spacing, periodic, coefficients)
    if SAG:
        drawn = [offset + gain * reading for offset, gain, reading in zip(NOMINAL_OFFSETS, NOMINAL_GAINS, q)]
        frames = _frames(NOMINAL_LINKS, drawn)
        points = [[row[3] for row in frame] for frame in frames]
        points.append([sum(row[k] * PAYLOAD_CENTRE[k] for k in range(3)) + row[3] for row in frames[-1]])
        for joint, point, gravity, compliance in SAG:
            mass = PAYLOAD_MASS if point > JOINTS else 1.0
            pull = _cross(gravity, [row[2] for row in frames[joint]])
            arm = [a - b for a, b in zip(points[point], points[joint])]
            angles[joint] += compliance * mass * sum(a * b for a, b in zip(pull, arm))
    return angles


def correct(pose: list[list[float]], q: list[float]) -> tuple[list[float], float]:
    """Return readings near q at which the arm has the pose, and the remaining error [m or rad]."""
    q, error = list(q), math.inf
    lower = [max(limit, reading - LARGEST_CHANGE) for limit, reading in zip(LOWER, q)]
    upper = [min(limit, reading + LARGEST_CHANGE) for limit, reading in zip(UPPER, q)]
    is_finite = all(map(math.isfinite, [*q, *pose[0], *pose[1], *pose[2]]))
    if not is_finite or any(low > high for low, high in zip(lower, upper)):
        return q, error
    for index in range(STEPS + 1):
        frames = _frames(LINKS, true_angles(q))
        end = frames[-1]
        difference = [pose[k][3] - end[k][3] for k in range(3)]
        turn = [[sum(pose[r][k] * end[c][k] for k in range(3)) for c in range(3)] for r in range(3)]
        difference += [0.5 * (turn[(k + 2) % 3][(k + 1) % 3] - turn[(k + 1) % 3][(k + 2) % 3]) for k in range(3)]
        changes = [pose[r][k] - end[r][k] for r in range(3) for k in range(3)]
        error = max(math.hypot(*difference[:3]), math.sqrt(0.5) * math.hypot(*changes))
        if index == STEPS:
            break
        columns = []
        for joint in range(JOINTS):
            axis = [row[2] * GAINS[joint] for row in frames[joint]]
            arm = [end[k][3] - frames[joint][k][3] for k in range(3)]
            columns.append([*axis, 0.0, 0.0, 0.0] if SLIDES[joint] else [*_cross(axis, arm), *axis])
        # the squared error: short steps where the arm is singular, Newton's near the pose (Sugihara 2011)
        damping = DAMPING + error * error
        square = [[sum(c[r] * c[s] for c in columns) + damping * (r == s) for s in range(6)] for r in range(6)]
        weights = _solved(square, difference)
        step = [sum(a * b for a, b in zip(column, weights)) for column in columns]
        if not all(map(math.isfinite, step)):
            break
        scale = LARGEST_STEP / max(LARGEST_STEP, *map(abs, step))
        previous = q
        q = [min(max(a + scale * b, low), high) for a, b, low, high in zip(q, step, lower, upper)]
        if max(abs(a - b) for a, b in zip(q, previous)) < STEP_END:
            break
    return q, error


def _frames(links: tuple[tuple[tuple[float, ...], ...], ...], angles: list[float]) -> list[list[list[float]]]:
    """Return the frame of each joint after its motion along or about z, then the end's."""
    frame, frames = [list(row) for row in links[0]], []
    for joint, angle in enumerate(angles):
        if SLIDES[joint]:
            frame = [[x, y, z, p + angle * z] for x, y, z, p in frame]
        else:
            c, s = math.cos(angle), math.sin(angle)
            frame = [[c * x + s * y, c * y - s * x, z, p] for x, y, z, p in frame]
        frames.append(frame)
        link = links[joint + 1]
        frame = [
            [sum(row[k] * link[k][column] for k in range(3)) + (row[3] if column == 3 else 0.0) for column in range(4)]
            for row in frame
        ]
    return [*frames, frame]


def _spline(reading: float, first: float, spacing: float, periodic: bool, coefficients: tuple[float, ...]) -> float:
    """Return a cubic B-spline of uniform knots, whose readings a turn apart are equal."""
    count, turn = len(coefficients), 2.0 * math.pi
    middle = first + 0.5 * (count - 1) * spacing
    place = (reading - turn * math.floor((reading - middle) / turn + 0.5) - first) / spacing
    cell = math.floor(place)
    u = place - cell
    weights = ((1 - u) ** 3, 4 - 6 * u**2 + 3 * u**3, 1 + 3 * (u + u**2 - u**3), u**3)
    total = 0.0
    for k, weight in enumerate(weights):
        index = cell - 1 + k
        index = index % count if periodic else index
        if 0 <= index < count:
            total += coefficients[index] * weight / 6.0
    return total


def _cross(a: list[float] | tuple[float, ...], b: list[float]) -> list[float]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _solved(square: list[list[float]], vector: list[float]) -> list[float]:
    """Return the solution of six linear equations, by elimination with pivots."""
    rows = [[*row, value] for row, value in zip(square, vector)]
    for i in range(6):
        pivot = max(range(i, 6), key=lambda k: abs(rows[k][i]))
        rows[i], rows[pivot] = rows[pivot], rows[i]
        for k in range(i + 1, 6):
            factor = rows[k][i] / rows[i][i]
            rows[k] = [a - factor * b for a, b in zip(rows[k], rows[i])]
    out = [0.0] * 6
    for i in reversed(range(6)):
        out[i] = (rows[i][6] - sum(rows[i][k] * out[k] for k in range(i + 1, 6))) / rows[i][i]
    return out
