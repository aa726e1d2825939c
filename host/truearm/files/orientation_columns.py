"""Measured orientations that a table gives as quaternions or rotation matrices, in place of rotation vectors.

``qw qx qy qz`` is a quaternion, ``r11 … r33`` a matrix by rows; both turn the tracker's axes into the end frame's.
``m00 … m23`` is a matrix with the position in its last column.
"""

from __future__ import annotations

import re

import numpy as np

from truearm.errors import TableError
from truearm.files.csv_cells import Row, number
from truearm.model.rotation import rotation_vector
from truearm.types import Floats

QUATERNION = ("qw", "qx", "qy", "qz")
MATRIX = tuple(f"r{row}{column}" for row in "123" for column in "123")
ELEMENT = re.compile(r"m([0-2])([0-3])(_\w+)?")
LAST_ROW = ("m30", "m31", "m32", "m33")
VECTOR = ("rx_rad", "ry_rad", "rz_rad")
ROUNDING = 5e-3  # by which a published quaternion's length or a matrix's products may differ from those of a rotation


def with_rotation_vectors(header: list[str], rows: list[Row], name: str) -> tuple[list[str], list[Row]]:
    """Return header and rows with columns of rotation vectors in the place of a quaternion's or a matrix's columns.

    Cells of rows without an orientation stay empty. Raises TableError.
    """
    header = [_of_matrix(title) for title in header]
    titles = [notation for notation in (QUATERNION, MATRIX) if set(notation) & set(header)]
    if not titles:
        return header, rows
    missing = [title for title in titles[0] if title not in header]
    if missing:
        raise TableError("missing-column", place=name, column=missing[0])
    if len(titles) > 1:
        raise TableError(f"{name}: has a quaternion and a rotation matrix; keep the columns of one of them")
    columns = [header.index(title) for title in titles[0]]
    others = [i for i in range(len(header)) if i not in columns]
    measured = []
    for row in rows:
        cells = [row.cells[i] for i in columns]
        vector = (
            ["", "", ""] if not any(cells) else [repr(float(v)) for v in _vector(cells, f"{name} row {row.number}")]
        )
        measured.append(Row(row.number, [*(row.cells[i] for i in others), *vector]))
    return [*(header[i] for i in others), *VECTOR], measured


def _of_matrix(title: str) -> str:
    """Return our title of an element of a 4×4 matrix, that of an ignored column for its last row; others as they are."""
    if found := ELEMENT.fullmatch(title):
        row, column, unit = int(found[1]), int(found[2]), found[3] or ""
        return f"{'xyz'[row]}{unit}" if column == 3 else f"r{row + 1}{column + 1}{unit}"
    return f"x_{title}" if title in LAST_ROW else title


def _vector(cells: list[str], where: str) -> Floats:
    """Return the rotation vector (3,) [rad] of four or nine cells."""
    titles = QUATERNION if len(cells) == len(QUATERNION) else MATRIX
    values = np.array([number(cell, f"{where} column {title}") for title, cell in zip(titles, cells, strict=True)])
    if len(values) == len(MATRIX):
        u, singular, vt = np.linalg.svd(values.reshape(3, 3))
        if np.abs(singular - 1.0).max() > ROUNDING or np.linalg.det(u @ vt) < 0.0:
            raise TableError(f"{where}: r11 to r33 are not a rotation matrix; give them by rows, for right-handed axes")
        return rotation_vector(u @ vt)
    length = float(np.linalg.norm(values))
    if abs(length - 1.0) > ROUNDING:
        raise TableError(f"{where}: the quaternion qw, qx, qy, qz has the length {length:.6g}, not 1; correct it")
    w, imaginary = values[0], values[1:]
    sine = float(np.linalg.norm(imaginary))
    if sine == 0.0:
        return np.zeros(3)
    return np.asarray(2.0 * np.arctan2(sine, abs(w)) / sine * np.copysign(1.0, w) * imaginary)
