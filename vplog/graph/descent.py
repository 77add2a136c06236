"""Least squares over the edges of a graph, by GTSAM or, where the graph is large, by our own elimination."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog import geometry
from vplog.errors import GraphError
from vplog.graph.cholesky import OPEN, Blocks, Cholesky
from vplog.graph.factors import GAUGE_SIGMA, Fit, anchored, least_squares
from vplog.graph.normal import half_chi2_of, normal_equations
from vplog.graph.workers import Workers

if TYPE_CHECKING:
    from vplog.data import Floats
    from vplog.graph.factors import Factors

LARGE_POSES = 10_000
"""Poses from which on our own elimination is taken. It is faster from 1 000 on, by two to seven times, but there GTSAM
takes a second, and nothing need be compiled."""
_DAMPING = 1e-5
"""First damping of Levenberg-Marquardt, and the factor by which it changes: as GTSAM."""
_DAMPING_CHANGE = 10.0
_MOST_DAMPING = 1e5
"""Where it gives up, as GTSAM."""

_ROWS = 1 << 14
"""Poses that a thread moves at once, some megabytes."""


def descend(factors: Factors, weight: Floats, start: Floats, max_iterations: int, tolerance: float) -> Fit:
    """The least error of the weighted edges (E,) from poses `start` (N, 4, 4), pose 0 staying where it is.

    Gauss-Newton as long as its steps help, then Levenberg-Marquardt. Ends when a step gains less than `tolerance` of
    the error. Raises GraphError where the poses are not determined.
    """
    if is_large(start):
        return descend_large(factors, weight, start, max_iterations, tolerance)
    return least_squares(factors, factors.weighted(weight), start, max_iterations, tolerance)


def is_large(poses: Floats) -> bool:
    """Whether a graph of these poses (N, 4, 4) goes through our own elimination."""
    return len(poses) >= LARGE_POSES


def descend_large(factors: Factors, weight: Floats, start: Floats, max_iterations: int, tolerance: float) -> Fit:
    """As descend(), by sparse normal equations: the same steps, without an object for each edge."""
    graph = factors.graph
    poses = geometry.between(start[:1], start)
    matrix, slope, error = normal_equations(graph, weight, poses)
    steps, converged, damping = 0, False, 0.0
    last = 0.0
    while steps < max_iterations and not converged and damping <= _MOST_DAMPING:
        try:
            step = -_root(factors, weight, matrix, damping).solve(slope[:, :, None])[:, :, 0]
        except GraphError:
            damping = max(_DAMPING, damping * _DAMPING_CHANGE)
            last = 0.0
            continue
        steps += 1
        moved = _moved(poses, step, graph.dimension)
        gain = error - float(half_chi2_of(graph, weight, moved).sum())
        # a step gains at most as much less than the one before as that did: the next is not worth its time
        coming = gain * gain / last if 0 < gain < last else abs(gain)
        converged = bool(min(abs(gain), coming) <= tolerance * max(error, 1.0))
        if not (gain >= 0 or converged):  # NaN too
            damping = max(_DAMPING, damping * _DAMPING_CHANGE)
            continue
        last, error = gain, error - gain
        if gain >= 0:
            poses = moved
        if not converged and steps < max_iterations:
            damping = damping / _DAMPING_CHANGE if damping > _DAMPING else 0.0
            matrix, slope, error = normal_equations(graph, weight, poses)
    if damping > _MOST_DAMPING:
        if steps == 0:
            raise GraphError(OPEN)
        converged = True  # no step, however short, is better
    if not np.isfinite(poses).all():
        raise GraphError("The pose graph's solution is not finite. Check the information of its edges.")
    return Fit(anchored(poses, start[0]), steps, converged)


def eliminated(factors: Factors, weight: Floats, poses: Floats) -> Cholesky:
    """The weighted edges (E,), linear at `poses` (N, 4, 4). Raises GraphError where these are not determined."""
    matrix, _, _ = normal_equations(factors.graph, weight, geometry.between(poses[:1], poses))
    return _root(factors, weight, matrix, 0.0)


def _root(factors: Factors, weight: Floats, matrix: Blocks, damping: float) -> Cholesky:
    """Pose 0 is held, and the first pose of each part that no edge of positive weight joins to it."""
    diagonal, axes = matrix.diagonal.copy(), np.arange(matrix.diagonal.shape[1])
    held = np.concatenate([[0], factors.loose(weight)]).astype(np.int64)
    diagonal[:, axes, axes] += damping
    diagonal[held[:, None], axes, axes] += 1.0 / GAUGE_SIGMA**2
    return Cholesky.of(factors.elimination(weight > 0), Blocks(diagonal, matrix.a, matrix.b, matrix.other))


def _moved(poses: Floats, step: Floats, dimension: int) -> Floats:
    """The poses (N, 4, 4), each moved in its own frame by a twist (N, d)."""
    if dimension == 3:
        with Workers() as workers:
            rows = [slice(first, first + _ROWS) for first in range(0, len(poses), _ROWS)]
            return np.concatenate(
                workers.each(lambda part: poses[part] @ geometry.exp(step[part]), [(r,) for r in rows])
            )
    result = np.array(poses)
    cos, sin = np.cos(step[:, 0]), np.sin(step[:, 0])
    c, s = poses[:, 0, 0], poses[:, 1, 0]
    result[:, 0, 0] = result[:, 1, 1] = c * cos - s * sin
    result[:, 1, 0] = s * cos + c * sin
    result[:, 0, 1] = -result[:, 1, 0]
    result[:, 0, 3] += c * step[:, 1] - s * step[:, 2]
    result[:, 1, 3] += s * step[:, 1] + c * step[:, 2]
    return result
