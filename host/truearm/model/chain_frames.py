"""Frames along a chain, computed from its links and the joints' true angles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from truearm.model.transforms import elementary
from truearm.types import Floats


def far_frames(links: Floats, motions: Sequence[str], angles: Floats) -> list[Floats]:
    """Return frames (…, 4, 4) in the base frame: each joint's after its motion (j of them), then the end.

    links : (j + 1, 4, 4) constants before, between and after the joints. motions : "tx" … "rz" of each joint. angles :
    (…, j) true angles or positions [rad or m].
    """
    frame = np.broadcast_to(links[0], (*angles.shape[:-1], 4, 4))
    frames = []
    for i, motion in enumerate(motions):
        frame = frame @ elementary(motion, angles[..., i])
        frames.append(frame)
        frame = frame @ links[i + 1]
    return [*frames, frame]
