"""The covariance in result.json, and the bounds of names and numbers there."""

from __future__ import annotations

import math
import zlib
from collections.abc import Collection
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct

from truearm.types import Floats

Name = Annotated[str, Meta(max_length=500)]
Names = Annotated[tuple[Name, ...], Meta(max_length=20_000)]
Size = Annotated[float, Meta(ge=0.0)]
RESOLUTION = 2.0**-30  # of the numbers of a root, whose columns have the norm 1


class Covariance(Struct, frozen=True):
    """The covariance of the free parameters: their sigmas, and a root of the correlations C = RᵀR.

    ``upper`` is the upper triangle of R by rows, as little-endian int32 in units of 2⁻³⁰, deflated. A root needs half the
    digits of C, and RᵀR has no negative variance. Most of it is zeros where many coefficients of curves are not measured.
    """

    names: Names
    units: Names
    sigma: Annotated[tuple[Size | None, ...], Meta(max_length=20_000)]
    upper: bytes  # in base64 in the file

    def __post_init__(self) -> None:
        n = len(self.names)
        if {len(self.units), len(self.sigma)} != {n} or len(_inflated(self.upper, n)) != 2 * n * (n + 1):
            raise ValueError(f"upper needs {n * (n + 1) // 2} numbers for {n} names, units and sigmas")

    @classmethod
    def of(cls, names: Collection[str], units: Collection[str], matrix: Floats) -> Covariance:
        """Return that of a matrix (n, n)."""
        sigma = np.sqrt(np.diag(matrix))
        scale = np.where(sigma > 0.0, sigma, np.inf)
        variance, directions = np.linalg.eigh(np.nan_to_num(matrix / scale[:, None] / scale))
        root: Floats = np.linalg.qr((directions * np.sqrt(np.maximum(variance, 0.0))).T)[1]
        upper = np.rint(root[np.triu_indices(len(root))] / RESOLUTION).astype("<i4")
        sigmas = tuple(value if math.isfinite(value) else None for value in sigma.tolist())
        return cls(tuple(names), tuple(units), sigmas, zlib.compress(upper.tobytes(), 9))

    @property
    def matrix(self) -> Floats:
        """Return the matrix (n, n)."""
        root = np.zeros((len(self.names), len(self.names)))
        root[np.triu_indices(len(root))] = np.frombuffer(_inflated(self.upper, len(root)), "<i4") * RESOLUTION
        root *= np.array(self.sigma, dtype=float)
        return root.T @ root


def _inflated(upper: bytes, n: int) -> bytes:
    """Return the numbers of an upper triangle (n, n), and hardly more than these; nothing if they are damaged."""
    try:
        return zlib.decompressobj().decompress(upper, 2 * n * (n + 1) + 1)
    except zlib.error:
        return b""
