"""Where to start a solve from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import gtsam
import numpy as np

from vplog import geometry
from vplog.graph.consistency import is_loop, odometry_chain, residual_sigma
from vplog.graph.factors import anchored, as_array, as_values

if TYPE_CHECKING:
    from vplog.data import Floats
    from vplog.graph.factors import Factors


def relaxed(factors: Factors, weight: Floats) -> Floats | None:
    """Poses (N, 4, 4) by rotations first, positions then, each a linear problem: chordal in space, LAGO in the plane.

    None where that fails: an ill-conditioned problem, or poses that are not finite.
    """
    try:
        poses = _planar(factors, weight) if factors.graph.dimension == 2 else _chordal(factors, weight)
    except RuntimeError:  # of GTSAM's elimination
        return None
    return anchored(poses, factors.graph.world_from_body[0]) if np.isfinite(poses).all() else None


def _chordal(factors: Factors, weight: Floats) -> Floats:
    """Chordal relaxation of the rotations, and one linear step: Carlone et al., ICRA 2015, III-B."""
    return as_array(gtsam.InitializePose3.initialize(factors.weighted(weight)), 3)


def _planar(factors: Factors, weight: Floats) -> Floats:
    """Linear approximation for graph optimisation (LAGO): Carlone, Aragues, Castellanos, Bona, IJRR 2014.

    The odometry chain is the spanning tree: along it turns are summed without wrapping, so each other edge tells the
    turn between its ends but for whole circles, and their number is the one that the chain is nearest to (section 4).
    Then orientations are a linear problem, and with them known, positions too: one step of Gauss-Newton.
    """
    graph = factors.graph
    poses, leads = odometry_chain(graph)
    step = np.arctan2(graph.a_from_b[:, 1, 0], graph.a_from_b[:, 0, 0])
    along = np.where(graph.a[leads] < graph.b[leads], step[leads], -step[leads])
    start = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    gaps = np.flatnonzero(leads < 0)  # each piece of the chain goes on from the heading that its first pose has
    piece = np.cumsum(leads < 0) - 1
    total = np.cumsum(np.where(leads < 0, 0.0, along))
    yaw = total - (total - start)[gaps][piece]
    circles = np.round((yaw[graph.b] - yaw[graph.a] - step) / (2.0 * np.pi))
    sigma = 1.0 / np.sqrt(graph.information[:, 2, 2] * np.where(weight > 0, weight, 1.0))

    linear = gtsam.GaussianFactorGraph()
    one, minus = np.eye(1), -np.eye(1)
    model = gtsam.noiseModel.Unit.Create(1)
    linear.add(0, one / 1e-6, np.zeros(1), model)
    turn = ((step + 2.0 * np.pi * circles) / sigma).tolist()
    for edge in np.flatnonzero(weight > 0).tolist():
        scale = 1.0 / sigma[edge]
        linear.add(int(graph.a[edge]), minus * scale, int(graph.b[edge]), one * scale, np.array([turn[edge]]), model)
    solved = linear.optimize()
    yaw = np.array([solved.at(node)[0] for node in range(len(poses))])
    zero = np.zeros(len(yaw))
    turned = geometry.pose(geometry.so3_exp(np.stack([zero, zero, yaw], axis=1)), np.zeros((len(yaw), 3)))
    values = as_values(turned, 2)
    return as_array(values.retract(factors.weighted(weight).linearize(values).optimize()), 2)


def initial_poses(factors: Factors, weight: Floats, bound: float = np.inf) -> Floats:
    """The best of the graph's own poses, the odometry chain and the relaxed solution, (N, 4, 4), pose 0 as given.

    Best is the least weighted (E,) sum of chi-squares, where no loop counts for more than `bound`: a robust solver must
    not prefer a start that has given in to false closures. Without loops the odometry chain is exact.
    """
    graph = factors.graph
    robust = is_loop(graph)
    candidates = [graph.world_from_body, odometry_chain(graph)[0]]
    linear = relaxed(factors, weight) if (robust & (weight > 0)).any() else None
    if linear is not None:
        candidates.append(linear)
    costs = []
    for poses in candidates:
        chi2 = residual_sigma(graph, poses) ** 2
        costs.append((weight * np.where(robust, np.minimum(chi2, bound), chi2)).sum())
    # the given poses unless another is better by more than rounding
    return candidates[int(np.argmin(np.round(costs, 6)))]
