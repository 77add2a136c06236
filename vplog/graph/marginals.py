"""Covariances of the poses of a solved graph and of the motion between two."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from vplog.data import Bools, Floats, Ints
from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.graph.build import AXES, informed, parts
from vplog.graph.least_squares import Objective
from vplog.graph.sparse.cholesky import inverse_blocks


class SharedScale(NamedTuple):
    """Unknown factor, about 1, by which the translations or the rotations of some edges are all wrong together.

    Sources are the radius of a wheel, a wheel base, a gyroscope, a stereo baseline or a focal length.
    """

    edges: Bools
    """(E,)."""
    sigma: float
    """Standard deviation."""
    of_rotation: bool = False

    def record(self) -> dict[str, Any]:
        """Return plain values for JSON. `changes` has the edges that differ in membership from the edge before them."""
        changes = np.flatnonzero(np.diff(self.edges, prepend=False)).tolist()
        return {"sigma": self.sigma, "of_rotation": self.of_rotation, "changes": changes}

    @classmethod
    def of(cls, record: dict[str, Any], count: int) -> SharedScale:
        """Return the scale of a `record` for a graph with `count` edges."""
        edges = np.searchsorted(record["changes"], np.arange(count), side="right") % 2 == 1
        return cls(edges, record["sigma"], record["of_rotation"])


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
    The errors of `scales` are added, which no number of edges averages out. To first order; NaN where edges of positive
    weight do not lead to pose 0. Raises GraphError where the poses are not determined.
    """
    graph, on = objective.factors.graph, np.flatnonzero(objective.weight > 0)
    a, b = graph.a[on], graph.b[on]
    ends = np.concatenate([a, b])
    information = objective.information(poses)
    aa, _, bb = inverse_blocks(information, a, b)
    result = np.full((len(poses), *aa.shape[1:]), np.nan)
    result[ends] = np.concatenate([aa, bb])
    if scales:
        shift = information.solve(_by_scales(objective, poses, scales))
        result += shift @ np.swapaxes(shift, 1, 2)
    part = parts(len(poses), a, b)
    result[part != part[0]] = np.nan
    if objective.positions is None:
        result[0] = 0.0
    return result


def relative_covariances(
    objective: Objective, poses: Floats, references: Sequence[int], scales: Sequence[SharedScale] = ()
) -> Iterator[Floats]:
    """Yield the covariance (N, d, d) of reference_from_body of every pose, for each of the poses `references`.

    The covariances are in the frame of the body. Errors of `scales`, NaN and GraphError are as in `pose_covariances`.
    """
    axes, information = AXES[objective.factors.graph.dimension], objective.information(poses)
    own, shift = pose_covariances(objective, poses, scales), information.solve(_by_scales(objective, poses, scales))
    for reference in references:
        unit = np.zeros_like(own)
        unit[reference] = np.eye(len(axes))
        Ad = se3.adjoint(se3.between(poses, poses[[reference]]))[:, axes][:, :, axes]
        mixed = (information.solve(unit) + shift @ shift[reference].T) @ np.swapaxes(Ad, 1, 2)
        yield own - mixed - np.swapaxes(mixed, 1, 2) + Ad @ own[reference] @ np.swapaxes(Ad, 1, 2)


def _by_scales(objective: Objective, poses: Floats, scales: Sequence[SharedScale]) -> Floats:
    """Compute by how much one sigma of each scale changes the gradient at `poses`, (N, d, S)."""
    graph, axes = objective.factors.graph, AXES[objective.factors.graph.dimension]
    turn, moved = graph.a_from_b[:, :3, :3], graph.a_from_b[:, :3, 3:]
    motion = np.concatenate([se3.so3_log(turn), (np.swapaxes(turn, 1, 2) @ moved)[:, :, 0]], axis=1)
    error = np.zeros((*motion.shape, len(scales)))  # of each edge, in the frame of b
    for column, (edges, sigma, of_rotation) in enumerate(scales):
        part = slice(0, 3) if of_rotation else slice(3, 6)
        error[edges, part, column] = sigma * motion[edges, part]
    pull = objective.weight[:, None, None] * informed(graph) @ error[:, axes]
    Ad = se3.adjoint(se3.between(poses[graph.b], poses[graph.a]))[:, axes][:, :, axes]
    gradient = np.zeros((len(poses), len(axes), len(scales)))
    np.add.at(gradient, graph.b, pull)
    np.subtract.at(gradient, graph.a, np.swapaxes(Ad, 1, 2) @ pull)
    return gradient


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
