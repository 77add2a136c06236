"""Nonlinear least squares over the edges of a graph: Gauss-Newton, then Levenberg-Marquardt."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Floats, Ints
from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.graph.normal_equations import edge_costs, normal_equations
from vplog.graph.sparse.cholesky import OPEN, Blocks, Cholesky
from vplog.graph.workers import Workers

if TYPE_CHECKING:
    from vplog.graph.factors import Factors

GAUGE_SIGMA = 1e-6
"""rad and m; holds pose 0 where it is, so that the rest has one best place. What it lets through is undone after."""
_FREE_SIGMA = 1e2
"""rad and m; holds pose 0 so weakly that positions alone say where the graph is."""
_DAMPING = 1e-5
"""First damping of Levenberg-Marquardt, and the factor by which it changes: as GTSAM."""
_DAMPING_CHANGE = 10.0
_MOST_DAMPING = 1e5
"""Damping at which it gives up, as in GTSAM."""
_NONE = np.empty(0, np.int64)
_ROWS = 1 << 14
"""Poses that a thread moves at once, some megabytes."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a least squares descent."""

    world_from_body: Floats
    iterations: int
    converged: bool


@dataclass(frozen=True, eq=False)
class Loss:
    """A robust loss of some edges, as iteratively reweighted least squares."""

    edges: Ints
    estimator: Any
    """An mEstimator of GTSAM."""

    def cost(self, cost: Floats) -> Floats:
        """(E,) the loss in place of half the chi-square (E,)."""
        result = np.array(cost)
        result[self.edges] = [self.estimator.loss(sigma) for sigma in np.sqrt(2.0 * cost[self.edges]).tolist()]
        return result

    def weight(self, cost: Floats) -> Floats:
        """(E,) weights at half the chi-square (E,), 1 for other edges."""
        result = np.ones(len(cost))
        result[self.edges] = [self.estimator.weight(sigma) for sigma in np.sqrt(2.0 * cost[self.edges]).tolist()]
        return result


@dataclass(frozen=True, eq=False)
class Positions:
    """Measured positions (F, 3), in the frame of the start's pose 0, of points fixed to bodies, as GPSFactorArm.

    Or measured directions (F, 3) of axes of bodies, as Pose3AttitudeFactor: they turn and do not move with the bodies.
    """

    row: Ints
    """(F,) pose."""
    arm_m: Floats
    """(F, 3) in the frame of its body."""
    position_m: Floats
    Omega: Floats
    """(F, 3, 3) information; 0 for those that do not count."""
    directions: bool = False

    def error(self, poses: Floats) -> Floats:
        at = poses[self.row]
        turned = (at[:, :3, :3] @ self.arm_m[:, :, None])[:, :, 0]
        return turned - self.position_m + (0.0 if self.directions else at[:, :3, 3])

    def cost(self, poses: Floats) -> float:
        """Half the chi-square."""
        error = self.error(poses)
        return float(0.5 * np.einsum("fi,fij,fj->", error, self.Omega, error))

    def jacobian(self, poses: Floats) -> Floats:
        """(F, 3, 6) by the pose's own twist: R (-[arm], I)."""
        rotation = poses[self.row, :3, :3]
        moved = np.zeros_like(rotation) if self.directions else rotation
        return np.concatenate([-rotation @ se3.skew(self.arm_m), moved], axis=2)

    def add_to(self, diagonal: Floats, gradient: Floats, poses: Floats) -> None:
        """Their normal equations, in place."""
        jacobian = self.jacobian(poses)
        by_error = np.swapaxes(jacobian, 1, 2) @ self.Omega
        np.add.at(diagonal, self.row, by_error @ jacobian)
        np.add.at(gradient, self.row, (by_error @ self.error(poses)[:, :, None])[:, :, 0])


@dataclass(frozen=True, eq=False)
class Objective:
    """Objective of the solve: the weighted edges (E,), under a robust loss and with positions where these are given."""

    factors: Factors
    weight: Floats
    loss: Loss | None = None
    positions: Positions | None = None
    verticals: Positions | None = None

    def cost(self, poses: Floats) -> float:
        """Half the chi-square, or the loss, at poses (N, 4, 4)."""
        edges = edge_costs(self.factors.graph, self.weight, poses)
        total = float((edges if self.loss is None else self.loss.cost(edges)).sum())
        return total + sum(one.cost(poses) for one in self._measured())

    def linearised(self, poses: Floats) -> tuple[Blocks, Floats]:
        """Half the Hessian and the gradient (N, d) at poses (N, 4, 4), as Gauss-Newton has them."""
        graph, weight = self.factors.graph, self.weight
        if self.loss is not None:
            weight = weight * self.loss.weight(edge_costs(graph, weight, poses))
        matrix, gradient, _ = normal_equations(graph, weight, poses)
        for one in self._measured():
            one.add_to(matrix.diagonal, gradient, poses)
        return matrix, gradient

    def _measured(self) -> list[Positions]:
        return [one for one in (self.positions, self.verticals) if one is not None]

    def factorised(self, matrix: Blocks, damping: float, others: Ints = _NONE) -> Cholesky:
        """Factorise a matrix that has blocks of the edges of positive weight and of `others`.

        Pose 0 is held, and the first pose of each part that no edge of positive weight joins to it.
        """
        diagonal, axes = matrix.diagonal.copy(), np.arange(matrix.diagonal.shape[1])
        held = np.concatenate([[0], self.factors.loose(self.weight)]).astype(np.int64)
        diagonal[:, axes, axes] += damping
        sigma = GAUGE_SIGMA if self.positions is None else _FREE_SIGMA
        diagonal[held[:, None], axes, axes] += 1.0 / sigma**2
        on = self.weight > 0
        on[others] = True
        return Cholesky.of(self.factors.elimination(on), matrix._replace(diagonal=diagonal))

    def information(self, poses: Floats) -> Cholesky:
        """The information matrix at `poses` (N, 4, 4). Raises GraphError where these are not determined."""
        return self.factorised(self.linearised(se3.between(poses[:1], poses))[0], 0.0)


def descend(factors: Factors, weight: Floats, start: Floats, max_iterations: int = 100, tolerance: float = 1e-4) -> Fit:
    """The least cost of the weighted edges (E,) from poses `start` (N, 4, 4), as minimised()."""
    return minimised(Objective(factors, weight), start, max_iterations, tolerance)


def minimised(objective: Objective, start: Floats, max_iterations: int, tolerance: float) -> Fit:
    """The least cost from poses `start` (N, 4, 4), pose 0 staying where it is.

    Gauss-Newton as long as its steps help, then Levenberg-Marquardt. Ends when a step gains less than `tolerance` of
    the cost. Raises GraphError where the poses are not determined.
    """
    dimension = objective.factors.graph.dimension
    poses = se3.between(start[:1], start)
    cost, (matrix, gradient) = objective.cost(poses), objective.linearised(poses)
    steps, converged, damping, last = 0, False, 0.0, 0.0
    while steps < max_iterations and not converged and damping <= _MOST_DAMPING:
        try:
            step = -objective.factorised(matrix, damping).solve(gradient[:, :, None])[:, :, 0]
        except GraphError:
            damping = max(_DAMPING, damping * _DAMPING_CHANGE)
            last = 0.0
            continue
        steps += 1
        moved = _retracted(poses, step, dimension)
        gain = cost - objective.cost(moved)
        # a step gains at most as much less than the one before as that did: the next is not worth its time
        coming = gain * gain / last if 0 < gain < last else abs(gain)
        converged = bool(min(abs(gain), coming) <= tolerance * max(cost, 1.0))
        if not (gain >= 0 or converged):  # NaN too
            damping = max(_DAMPING, damping * _DAMPING_CHANGE)
            continue
        last, cost = gain, cost - gain
        if gain >= 0:
            poses = moved
        if not converged and steps < max_iterations:
            damping = damping / _DAMPING_CHANGE if damping > _DAMPING else 0.0
            matrix, gradient = objective.linearised(poses)
    if damping > _MOST_DAMPING:
        if steps == 0:
            raise GraphError(OPEN)
        converged = True  # no step, however short, is better
    if not np.isfinite(poses).all():
        raise GraphError("The pose graph's solution is not finite. Check the information of its edges.")
    return Fit(anchored(poses, start[0]), steps, converged)


def anchored(poses: Floats, world_from_first: Floats) -> Floats:
    """The poses (N, 4, 4) moved as one so that the first is exactly `world_from_first`."""
    moved = world_from_first @ se3.inverse(poses[0]) @ poses
    moved[0] = world_from_first
    return moved


def _retracted(poses: Floats, step: Floats, dimension: int) -> Floats:
    """The poses (N, 4, 4), each moved in its own frame by a twist (N, d)."""
    if dimension == 3:
        with Workers() as workers:
            rows = [slice(first, first + _ROWS) for first in range(0, len(poses), _ROWS)]
            return np.concatenate(workers.each(lambda part: poses[part] @ se3.exp(step[part]), [(r,) for r in rows]))
    result = np.array(poses)
    cos, sin = np.cos(step[:, 0]), np.sin(step[:, 0])
    c, s = poses[:, 0, 0], poses[:, 1, 0]
    result[:, 0, 0] = result[:, 1, 1] = c * cos - s * sin
    result[:, 1, 0] = s * cos + c * sin
    result[:, 0, 1] = -result[:, 1, 0]
    result[:, 0, 3] += c * step[:, 1] - s * step[:, 2]
    result[:, 1, 3] += s * step[:, 1] + c * step[:, 2]
    return result
