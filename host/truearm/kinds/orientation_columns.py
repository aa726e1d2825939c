"""Measured orientations that a table gives as quaternions or rotation matrices, in place of rotation vectors.

``qw qx qy qz`` is a quaternion, ``r11 … r33`` a matrix by rows; both turn the tracker's axes into the end frame's.
``m00 … m33`` is a matrix with the position in its last column; its last row is ignored.
"""

from __future__ import annotations

import numpy as np

from truearm.errors import TableError
from truearm.kinds.csv_cells import CsvTable
from truearm.model.rotation import rotation_vector
from truearm.types import Floats

QUATERNION = ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"r{row}{column}" for row in "123" for column in "123")
HOMOGENEOUS = tuple(f"m{row}{column}" for row in "012" for column in "012")
LAST_ROW = "m3[0-3]"
ROUNDING = 5e-3  # by which a published quaternion's length or a matrix's products may differ from those of a rotation


def rotation_vectors(cells: CsvTable) -> Floats | None:
    """Return the orientations (n, 3) [rad] of a table with a quaternion or a matrix, NaN in rows without one.

    None if it has neither. Raises TableError.
    """
    notations = [titles for titles in (QUATERNION, MATRIX, HOMOGENEOUS) if {*titles} & {*cells.columns}]
    if not notations:
        return None
    titles, *further = notations
    for title in titles:
        if title not in cells.columns:
            raise TableError("missing-column", place=cells.name, column=title)
    if further or "rx" in cells.columns:
        second_notation = f"{further[0][0]} to {further[0][-1]}" if further else cells.columns["rx"].title
        raise TableError(
            f"{cells.name}: has the orientation in {titles[0]} to {titles[-1]} and in {second_notation}; keep one"
        )
    values = cells.vectors(titles, f"{titles[0]} to {titles[-1]}")
    measured = np.flatnonzero(~np.isnan(values[:, 0]))
    out = np.full((len(values), 3), np.nan)
    if titles == QUATERNION:
        w, imaginary = values[measured, 0], values[measured, 1:]
        sine = np.linalg.norm(imaginary, axis=1)
        wrong = np.abs(np.hypot(w, sine) - 1.0) > ROUNDING
        per_sine = 2.0 * np.arctan2(sine, np.abs(w)) / np.where(sine > 0.0, sine, 1.0) * np.copysign(1.0, w)
        out[measured], remedy = per_sine[:, None] * imaginary, "are no quaternion of length 1"
    else:
        u, singular, vt = np.linalg.svd(values[measured].reshape(-1, 3, 3))
        wrong = (np.abs(singular - 1.0).max(axis=1) > ROUNDING) | (np.linalg.det(u @ vt) < 0.0)
        out[measured], remedy = (
            rotation_vector(u @ vt),
            "are not a rotation matrix; give them by rows, for right-handed axes",
        )
    for row in measured[wrong][:1]:
        raise TableError(f"{cells.sources[row]}: {titles[0]} to {titles[-1]} {remedy}")
    return out
