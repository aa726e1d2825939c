"""The identifiability of a chain's parameters from full poses, for tests, with separate simple linear algebra."""

import numpy as np

from truearm.model.chain import point_jacobians

SEEN = 1e-10  # of the largest singular value, columns scaled to 1; analytic Jacobians leave 1e-15 for null directions
THREE_POINTS = 0.1 * np.eye(3)  # m, in the end frame: three points not on one line are a full pose


def random_joints(chain, n, rng):
    return rng.uniform([j.lower for j in chain.joints], [j.upper for j in chain.joints], (n, len(chain.joints)))


def sensitivity(chain, params, q, p_end_points=THREE_POINTS):
    """Return derivatives (3·points·n, p) of the points; columns have length 1, or 0 if the parameter moves nothing."""
    rows = [point_jacobians(chain, params, q, p)[1].reshape(-1, len(chain.parameters)) for p in p_end_points]
    return scaled(np.concatenate(rows))


def scaled(jac):
    """Return columns of length 1, or 0 where there was only rounding."""
    length = np.linalg.norm(jac, axis=0)
    return np.where(length > 1e-12 * length.max(), jac, 0.0) / np.where(length > 0.0, length, 1.0)


def rank_and_gap(matrix):
    """Return the rank, and the ratio of the smallest kept to the largest dropped singular value."""
    singular = np.linalg.svd(matrix, compute_uv=False)
    rank = int((singular > SEEN * singular[0]).sum())
    dropped = singular[rank] if rank < singular.size else 0.0
    return rank, float(singular[rank - 1] / max(dropped, 1e-300))
