"""The six elementary motions, as 4×4 transforms and on vectors that lie in columns (3, n)."""

from __future__ import annotations

from typing import Any

import numpy as np

from truearm.types import Floats

MOTIONS = ("tx", "ty", "tz", "rx", "ry", "rz")


def axis_of(motion: str) -> int:
    """0, 1, 2 for a motion along or about x, y, z."""
    return "xyz".index(motion[1])


def elementary(motion: str, amount: Any) -> Floats:
    """The transform (…, 4, 4) that moves along or turns about one axis by amount (…) [m or rad]."""
    amount = np.asarray(amount)
    out = np.zeros((*amount.shape, 4, 4), dtype=np.result_type(amount, float))
    out[..., range(4), range(4)] = 1.0
    k = axis_of(motion)
    if motion[0] == "t":
        out[..., k, 3] = amount
        return out
    a, b = (k + 1) % 3, (k + 2) % 3
    out[..., a, a] = out[..., b, b] = np.cos(amount)
    out[..., b, a] = np.sin(amount)
    out[..., a, b] = -out[..., b, a]
    return out


def before(motion: str, amount: Any, transform: Floats) -> Floats:
    """elementary(motion, amount) @ transform for one amount and a transform (4, 4)."""
    out = transform.astype(np.result_type(transform, amount))
    k = axis_of(motion)
    if motion[0] == "t":
        out[k, 3] += amount
        return out
    a, b = (k + 1) % 3, (k + 2) % 3
    cos, sin = np.cos(amount), np.sin(amount)
    out[a] = cos * transform[a] - sin * transform[b]
    out[b] = sin * transform[a] + cos * transform[b]
    return out


def apply(transform: Floats, points: Floats) -> Floats:
    return transform[:3, :3] @ points + transform[:3, 3:]


def move(motion: str, amount: Floats, cos_sin: tuple[Floats, Floats], points: Floats) -> Floats:
    """A joint's motion of points (3, n)."""
    if motion[0] == "r":
        return turn(motion, *cos_sin, points)
    moved = np.array(np.broadcast_to(points, (3, amount.size)), dtype=np.result_type(points, amount))
    moved[axis_of(motion)] += amount
    return moved


def turn(motion: str, cos: Floats, sin: Floats, vectors: Floats) -> Floats:
    """Rotate vectors (3, n) about one coordinate axis."""
    k = axis_of(motion)
    a, b = (k + 1) % 3, (k + 2) % 3
    out = np.empty((3, cos.size), dtype=np.result_type(cos, vectors))
    out[k] = vectors[k]
    out[a] = cos * vectors[a] - sin * vectors[b]
    out[b] = sin * vectors[a] + cos * vectors[b]
    return out


def cross(a: Floats, b: Floats) -> Floats:
    """a × b for (3, n); numpy's cross moves axes about and takes four times as long."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
