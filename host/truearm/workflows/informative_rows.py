"""Rows that cannot identify a robot, refused before anything is fitted."""

from __future__ import annotations

import numpy as np

from truearm.errors import ProblemError
from truearm.kinds.quantities import POINT, Quantity
from truearm.kinds.registry import kinds
from truearm.kinds.table import ObservationTable
from truearm.model.chain import Chain, forward
from truearm.types import Floats, Mask

IN_SPACE = 0.01  # m, standard deviation in the direction of least motion
LEAST_ROWS = 5  # of a kind, which must not all be equal


def check_rows(chain: Chain, table: ObservationTable, rows: Mask) -> None:
    """Raise ProblemError for ``rows`` (n,) without information: a single row, or readings that never change though the
    robot moves.

    A single coordinate of a point may stay the same while the end moves in a plane, but not while it moves in space.
    """
    if rows.sum() == 1:
        more = "measure more poses" if len(table) == 1 else f"hold out or leave out fewer of the {len(table)}"
        raise ProblemError(f"{table.source[int(np.argmax(rows))]}: 1 row cannot identify a robot; {more}")
    for name, kind in kinds().items():
        mine = table.select(rows & (table.kind == name))
        if len(mine) < LEAST_ROWS or not np.ptp(mine.q, axis=0).max() > 0.0:
            continue
        for quantity in (column for column in kind.needs if isinstance(column, Quantity)):
            values = mine[quantity.field].reshape(len(mine), -1)
            if not np.ptp(values, axis=0).any():
                are = "are" if " and " in quantity.words else "is"
                text = f"{quantity.words} {are} the same in all {len(mine)} {name} rows though the joints move"
                raise ProblemError(f"{mine.source[0]}: {text}; check that the sensor was read")
            same = [one for one, span in zip(quantity.columns, np.ptp(values, axis=0), strict=False) if not span]
            if quantity == POINT and same and _moves_in_space(chain, mine.q):
                are = "are" if len(same) > 1 else "is"
                text = f"{' and '.join(same)} {are} the same in all {len(mine)} {name} rows though the joints move the end in space"
                column = f"column{'s' if len(same) > 1 else ''} of {' and '.join(same)}"
                raise ProblemError(f"{mine.source[0]}: {text}; check what the device wrote to the {column}")


def _moves_in_space(chain: Chain, q: Floats) -> bool:
    """Return whether the nominal end moves in all three directions, at readings q (n, j)."""
    if q.shape[1] != len(chain.joints) or not np.isfinite(q).all():
        return False  # ``build_problem`` names these errors
    points = forward(chain, chain.params_nominal, q)[:, :3, 3]
    return bool(np.sqrt(np.linalg.eigvalsh(np.cov(points.T))[0]) > IN_SPACE)
