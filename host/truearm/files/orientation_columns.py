"""Measured orientations that a table gives as quaternions or rotation matrices, in place of rotation vectors.

``qw qx qy qz`` is a quaternion, ``r11 … r33`` a matrix by rows; both turn the tracker's axes into the end frame's.
``m00 … m33`` is a matrix with the position in its last column; its last row is ignored.
"""

from __future__ import annotations

import numpy as np

from truearm.errors import TableError
from truearm.files.csv_cells import Row, number
from truearm.model.rotation import rotation_vector
from truearm.types import Floats

QUATERNION = ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"r{row}{column}" for row in "123" for column in "123")
HOMOGENEOUS = tuple(f"m{row}{column}" for row in "012" for column in "012")
LAST_ROW = ("m30", "m31", "m32", "m33")
VECTOR = ("rx_rad", "ry_rad", "rz_rad")
ROUNDING = 5e-3  # by which a published quaternion's length or a matrix's products may differ from those of a rotation


def with_rotation_vectors(header: list[str], rows: list[Row], name: str) -> tuple[list[str], list[Row]]:
    """Return header and rows with columns of rotation vectors after those of the file.

    The columns of a quaternion or a matrix lose their titles. Cells of rows without an orientation stay empty. Raises
    TableError.
    """
    header = ["" if title in LAST_ROW else title for title in header]
    notations = [notation for notation in (QUATERNION, MATRIX, HOMOGENEOUS) if set(notation) & set(header)]
    if not notations:
        return header, rows
    titles = notations[0]
    missing = [title for title in titles if title not in header]
    if missing:
        raise TableError("missing-column", place=name, column=missing[0])
    if len(notations) > 1:
        raise TableError(
            f"{name}: has the orientation in {titles[0]} to {titles[-1]} and in {notations[1][0]} to {notations[1][-1]}; keep one"
        )
    columns = [header.index(title) for title in titles]
    for column in columns:
        header[column] = ""
    measured = []
    for row in rows:
        cells = [row.cells[i] for i in columns]
        vector = _vector(cells, titles, f"{name} row {row.number}").tolist() if any(cells) else ["", "", ""]
        measured.append(Row(row.number, [*row.cells, *map(str, vector)]))
    return [*header, *VECTOR], measured


def _vector(cells: list[str], titles: tuple[str, ...], place: str) -> Floats:
    """Return the rotation vector (3,) [rad] of four or nine cells."""
    values = np.array([number(cell, f"{place} column {title}") for title, cell in zip(titles, cells, strict=True)])
    if len(values) == len(MATRIX):
        u, singular, vt = np.linalg.svd(values.reshape(3, 3))
        if np.abs(singular - 1.0).max() > ROUNDING or np.linalg.det(u @ vt) < 0.0:
            raise TableError(
                f"{place}: {titles[0]} to {titles[-1]} are not a rotation matrix; give them by rows, for right-handed axes"
            )
        return rotation_vector(u @ vt)
    length = float(np.linalg.norm(values))
    if abs(length - 1.0) > ROUNDING:
        raise TableError(f"{place}: the quaternion qw, qx, qy, qz has the length {length:.6g}, not 1; correct it")
    w, imaginary = values[0], values[1:]
    sine = float(np.linalg.norm(imaginary))
    if sine == 0.0:
        return np.zeros(3)
    return np.asarray(2.0 * np.arctan2(sine, abs(w)) / sine * np.copysign(1.0, w) * imaginary)
