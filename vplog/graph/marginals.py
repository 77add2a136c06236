"""Covariances of the poses of a solved graph and of the motion between two."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog.geometry import se3
from vplog.graph.build import AXES, parts

if TYPE_CHECKING:
    from vplog.data import Floats, Ints
    from vplog.graph.factors import Factors
    from vplog.graph.least_squares import Objective
    from vplog.graph.sparse.linear import BayesTree, Supernodes


def edge_covariances(objective: Objective, poses: Floats, edges: Ints) -> Floats:
    """Covariance (K, d, d) of a_from_b for these edges of positive weight, after the least squares at `poses`.

    In the frame of b, to first order; d = 6, or 3 in the plane. Of the inverse of the information matrix just the
    blocks that the factorisation touches are computed, and those of every edge are among them. So all edges of a graph
    cost about as much as two steps of its solution. Raises GraphError where the poses are not determined.
    """
    graph = objective.factors.graph
    aa, ab, bb = objective.information(poses).inverse_blocks(graph.a[edges], graph.b[edges])
    axes = AXES[graph.dimension]
    Ad = se3.adjoint(se3.between(poses[graph.b[edges]], poses[graph.a[edges]]))[:, axes][:, :, axes]
    mixed = Ad @ ab
    return bb - mixed - np.swapaxes(mixed, 1, 2) + Ad @ aa @ np.swapaxes(Ad, 1, 2)


def pose_covariances(objective: Objective, poses: Floats) -> Floats:
    """Covariance (N, d, d) of world_from_body of every pose, in its own frame, after the least squares at `poses`.

    Relative to the first pose, whose own is 0, or with positions to where these are measured; d = 6, or 3 in the plane.
    To first order; NaN where edges of positive weight do not lead to pose 0. Raises GraphError where the poses are not
    determined.
    """
    graph, on = objective.factors.graph, np.flatnonzero(objective.weight > 0)
    a, b = graph.a[on], graph.b[on]
    ends = np.concatenate([a, b])
    aa, _, bb = objective.information(poses).inverse_blocks(a, b)
    result = np.full((len(poses), *aa.shape[1:]), np.nan)
    result[ends] = np.concatenate([aa, bb])
    part = parts(len(poses), a, b)
    result[part != part[0]] = np.nan
    if objective.positions is None:
        result[0] = 0.0
    return result


def positions_redundancy(objective: Objective, poses: Floats) -> float:
    """Degrees of freedom with which the rest of what is minimised checks its positions (Foerstner 1979).

    Raises GraphError where the poses are not determined.
    """
    positions = objective.positions
    if positions is None:
        return 0.0
    used = positions.Omega.any((1, 2))
    jacobian = positions.jacobian(se3.between(poses[:1], poses))[used]
    own = pose_covariances(objective, poses)[positions.row[used]]
    spread = jacobian @ own @ np.swapaxes(jacobian, 1, 2)
    return 3.0 * float(used.sum()) - float(np.einsum("fij,fji->", positions.Omega[used], spread))


def joint_covariance(factors: Factors, information: Supernodes | BayesTree, poses: Floats, edges: Ints) -> Floats:
    """Covariance (K d, K d) of a_from_b of a few edges together, each in the frame of its b."""
    graph = factors.graph
    axes = AXES[graph.dimension]
    size = len(axes)
    ends = np.stack([graph.a[edges], graph.b[edges]], axis=1)
    nodes = np.unique(ends).astype(np.int64)
    covariance = information.joint_inverse(nodes)
    Ad = se3.adjoint(se3.between(poses[ends[:, 1]], poses[ends[:, 0]]))[:, axes][:, :, axes]
    jacobian = np.zeros((len(edges) * size, len(covariance)))
    for row, (a, b) in enumerate(np.searchsorted(nodes, ends).tolist()):
        part = slice(row * size, (row + 1) * size)
        jacobian[part, a * size : (a + 1) * size] = -Ad[row]
        jacobian[part, b * size : (b + 1) * size] = np.eye(size)
    return jacobian @ covariance @ jacobian.T
