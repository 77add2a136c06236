"""Covariances of the poses of a solved graph and of the motion between two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vplog.data import Bools, Floats, Ints
from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.graph.build import AXES, parts
from vplog.graph.least_squares import Objective
from vplog.graph.normal_equations import normal_equations
from vplog.graph.sparse.cholesky import Cholesky, inverse_blocks, joint_inverse

if TYPE_CHECKING:
    from vplog.graph.factors import Factors

_STEP = 1e-4
"""Step of a scale for differences: far above rounding, and errors of edges are linear in it."""


class SharedScale(NamedTuple):
    """An error of the metres of some edges that they share: a factor of 1 with this standard deviation."""

    edges: Bools
    """(E,)."""
    sigma: float


def edge_covariances(objective: Objective, poses: Floats, edges: Ints) -> Floats:
    """Covariance (K, d, d) of a_from_b for these edges of positive weight, after the least squares at `poses`.

    In the frame of b, to first order; d = 6, or 3 in the plane. Of the inverse of the information matrix just the
    blocks that the factorisation touches are computed, and those of every edge are among them. So all edges of a graph
    cost about as much as two steps of its solution. Raises GraphError where the poses are not determined.
    """
    graph = objective.factors.graph
    aa, ab, bb = inverse_blocks(objective.information(poses), graph.a[edges], graph.b[edges])
    axes = AXES[graph.dimension]
    Ad = se3.adjoint(se3.between(poses[graph.b[edges]], poses[graph.a[edges]]))[:, axes][:, :, axes]
    mixed = Ad @ ab
    return bb - mixed - np.swapaxes(mixed, 1, 2) + Ad @ aa @ np.swapaxes(Ad, 1, 2)


def pose_covariances(objective: Objective, poses: Floats, scales: Sequence[SharedScale] = ()) -> Floats:
    """Covariance (N, d, d) of world_from_body of every pose, in its own frame, after the least squares at `poses`.

    Relative to the first pose, whose own is 0, or with positions to where these are measured; d = 6, or 3 in the plane.
    What the errors of `scales` add no number of edges averages out. To first order; NaN where edges of positive weight
    do not lead to pose 0. Raises GraphError where the poses are not determined.
    """
    graph, on = objective.factors.graph, np.flatnonzero(objective.weight > 0)
    a, b = graph.a[on], graph.b[on]
    ends = np.concatenate([a, b])
    information = objective.information(poses)
    aa, _, bb = inverse_blocks(information, a, b)
    result = np.full((len(poses), *aa.shape[1:]), np.nan)
    result[ends] = np.concatenate([aa, bb])
    if scales:
        moved = information.solve(_by_scales(objective, poses, scales))
        result += moved @ np.swapaxes(moved, 1, 2)
    part = parts(len(poses), a, b)
    result[part != part[0]] = np.nan
    if objective.positions is None:
        result[0] = 0.0
    return result


def _by_scales(objective: Objective, poses: Floats, scales: Sequence[SharedScale]) -> Floats:
    """(N, d, S) by how much one sigma of each scale changes the gradient at `poses`."""
    graph = objective.factors.graph
    columns = []
    for edges, sigma in scales:
        gradients = []
        for factor in (1.0 - _STEP, 1.0 + _STEP):
            a_from_b = graph.a_from_b.copy()
            a_from_b[edges, :3, 3] *= factor
            gradients.append(normal_equations(replace(graph, a_from_b=a_from_b), objective.weight, poses)[1])
        columns.append((gradients[1] - gradients[0]) * (sigma / (2.0 * _STEP)))
    return np.stack(columns, axis=2)


def positions_redundancy(objective: Objective, poses: Floats) -> float:
    """Degrees of freedom with which the rest of what is minimised checks its positions (Foerstner 1979): all of them
    where rounding leaves poses undetermined, as heights by centimetre fixes without altitude."""
    positions = objective.positions
    if positions is None:
        return 0.0
    used = positions.Omega.any((1, 2))
    jacobian = positions.jacobian(se3.between(poses[:1], poses))[used]
    try:
        own = pose_covariances(objective, poses)[positions.row[used]]
    except GraphError:
        return 3.0 * float(used.sum())
    spread = jacobian @ own @ np.swapaxes(jacobian, 1, 2)
    return 3.0 * float(used.sum()) - float(np.einsum("fij,fji->", positions.Omega[used], spread))


def joint_covariance(factors: Factors, information: Cholesky, poses: Floats, edges: Ints) -> Floats:
    """Covariance (K d, K d) of a_from_b of a few edges together, each in the frame of its b."""
    graph = factors.graph
    axes = AXES[graph.dimension]
    size = len(axes)
    ends = np.stack([graph.a[edges], graph.b[edges]], axis=1)
    nodes = np.unique(ends).astype(np.int64)
    covariance = joint_inverse(information, nodes)
    Ad = se3.adjoint(se3.between(poses[ends[:, 1]], poses[ends[:, 0]]))[:, axes][:, :, axes]
    jacobian = np.zeros((len(edges) * size, len(covariance)))
    for row, (a, b) in enumerate(np.searchsorted(nodes, ends).tolist()):
        part = slice(row * size, (row + 1) * size)
        jacobian[part, a * size : (a + 1) * size] = -Ad[row]
        jacobian[part, b * size : (b + 1) * size] = np.eye(size)
    return jacobian @ covariance @ jacobian.T
