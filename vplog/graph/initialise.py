"""Initial poses of a solve."""

from __future__ import annotations

from heapq import heappop, heappush
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Floats, PoseGraph
from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.graph.consistency import is_loop, odometry_chain, residual_sigma
from vplog.graph.least_squares import anchored
from vplog.graph.sparse.cholesky import Blocks, Cholesky

if TYPE_CHECKING:
    from vplog.graph.factors import Factors


_LOST_RAD = np.pi / 3.0
"""Sigma of the heading, rad, beyond which the chain's whole turns may be wrong: half a turn is three sigmas."""
_HELD = 1e6
"""Information of the first pose's prior, as a multiple of the largest of any edge."""


def relaxed(factors: Factors, weight: Floats, chain: Floats) -> Floats | None:
    """Poses (N, 4, 4) by rotations first, positions then, each a linear problem: chordal in space, LAGO in the plane.

    `chain` are the poses by odometry alone. None where that fails: an ill-conditioned problem, parts that no edge of
    positive weight joins, or poses that are not finite.
    """
    if len(factors.loose(weight)):
        return None
    try:
        poses = _lago(factors, weight, chain) if factors.graph.dimension == 2 else _chordal(factors, weight)
    except GraphError:
        return None
    return anchored(poses, factors.graph.world_from_body[0]) if np.isfinite(poses).all() else None


def _chordal(factors: Factors, weight: Floats) -> Floats:
    """Chordal relaxation of the rotations, then positions as a linear problem: Carlone et al., ICRA 2015, III-B."""
    graph = factors.graph
    n, held = len(graph.world_from_body), np.eye(3)
    precision = weight * np.trace(graph.information[:, :3, :3], axis1=1, axis2=2) / 3.0
    # each row r of a rotation by itself: r_b = r_a a_from_b
    diagonal = _degree(graph, precision)[:, None, None] * np.eye(3)
    diagonal[0] += precision.max() * _HELD * held
    right = np.zeros((n, 3, 3))
    right[0] = precision.max() * _HELD * held
    between = -precision[:, None, None] * graph.a_from_b[:, :3, :3]
    matrix = Blocks(diagonal, graph.a, graph.b, between)
    columns = Cholesky.of(factors.elimination(weight > 0), matrix).solve(right)
    left, _, turned = np.linalg.svd(np.swapaxes(columns, 1, 2))
    left[:, :, 2] *= np.linalg.det(left @ turned)[:, None]  # the nearest rotations
    rotation = left @ turned
    precision = weight * np.trace(graph.information[:, 3:, 3:], axis1=1, axis2=2) / 3.0
    shift = (rotation[graph.a] @ graph.a_from_b[:, :3, 3:])[:, :, 0]
    return se3.pose(rotation, _solve_laplacian(factors, weight, precision, shift))


def _solve_laplacian(factors: Factors, weight: Floats, precision: Floats, difference: Floats) -> Floats:
    """Values (N, k) whose differences along the edges are nearest to `difference` (E, k), weighted; the first is 0.

    The Laplacian of the graph with `precision` (E,) as weights of the edges.
    """
    graph = factors.graph
    diagonal = _degree(graph, precision)
    diagonal[0] += precision.max() * _HELD
    right = np.zeros((len(diagonal), difference.shape[1]))
    np.add.at(right, graph.b, precision[:, None] * difference)
    np.subtract.at(right, graph.a, precision[:, None] * difference)
    right[0] = 0.0
    matrix = Blocks(diagonal[:, None, None], graph.a, graph.b, -precision[:, None, None])
    return Cholesky.of(factors.elimination(weight > 0), matrix).solve(right[:, None, :])[:, 0]


def _degree(graph: PoseGraph, precision: Floats) -> Floats:
    """(N,) weighted degree: the sum of the precision of the edges at each pose."""
    n = len(graph.world_from_body)
    return np.asarray(np.bincount(graph.a, precision, n) + np.bincount(graph.b, precision, n), np.float64)


def _lago(factors: Factors, weight: Floats, chain: Floats) -> Floats:
    """Linear approximation for graph optimisation: Carlone, Aragues, Castellanos, Bona, IJRR 2014 (LAGO).

    Along a spanning tree turns are summed without wrapping, so each other edge tells the turn between its ends but for
    whole circles, and their number is the one that the tree is nearest to (section 4). The tree is the odometry chain,
    or where that is so long that it no longer knows its heading, the one of least noise. Then orientations are a linear
    problem, and with them known, positions too.
    """
    graph = factors.graph
    turn = np.arctan2(graph.a_from_b[:, 1, 0], graph.a_from_b[:, 0, 0])
    yaw = np.unwrap(np.arctan2(chain[:, 1, 0], chain[:, 0, 0]))
    if (1.0 / graph.information[graph.odometry, 2, 2]).sum() > _LOST_RAD**2:
        yaw = _least_noise_headings(graph, weight, turn, yaw)
    turn = turn + 2.0 * np.pi * np.round((yaw[graph.b] - yaw[graph.a] - turn) / (2.0 * np.pi))
    yaw = yaw[0] + _solve_laplacian(factors, weight, weight * graph.information[:, 2, 2], turn[:, None])[:, 0]
    zero = np.zeros(len(yaw))
    poses = se3.pose(se3.so3_exp(np.stack([zero, zero, yaw], axis=1)), chain[:, :3, 3])
    shift = (poses[graph.a, :2, :2] @ graph.a_from_b[:, :2, 3:])[:, :, 0]
    precision = np.trace(graph.information[:, 3:5, 3:5], axis1=1, axis2=2) / 2.0
    poses[:, :2, 3] = _solve_laplacian(factors, weight, weight * precision, shift)
    return poses


def _least_noise_headings(graph: PoseGraph, weight: Floats, turn: Floats, yaw: Floats) -> Floats:
    """Headings (N,) rad along the shortest-path tree by accumulated variance (Dijkstra 1959)."""
    n = len(yaw)
    used = np.flatnonzero(weight > 0)
    ends = np.concatenate([graph.a[used], graph.b[used]])
    order = np.argsort(ends, kind="stable")
    first = np.searchsorted(ends[order], np.arange(n + 1)).tolist()
    other = np.concatenate([graph.b[used], graph.a[used]])[order].tolist()
    step = np.concatenate([turn[used], -turn[used]])[order].tolist()
    noise = np.tile(1.0 / (weight[used] * graph.information[used, 2, 2]), 2)[order].tolist()
    result, least = yaw.tolist(), [np.inf] * n
    least[0] = 0.0
    waiting = [(0.0, 0)]
    while waiting:
        gathered, node = heappop(waiting)
        if gathered > least[node]:
            continue
        for edge in range(first[node], first[node + 1]):
            there, total = other[edge], gathered + noise[edge]
            if total < least[there]:
                least[there] = total
                result[there] = result[node] + step[edge]
                heappush(waiting, (total, there))
    return np.array(result)


def initial_poses(factors: Factors, weight: Floats, bound: float = np.inf) -> Floats:
    """The best of the graph's own poses, the odometry chain and the relaxed solution, (N, 4, 4), pose 0 as given.

    Best is the least weighted (E,) sum of chi-squares, where no loop counts for more than `bound`: a robust solver must
    not prefer a start that has given in to false closures. Without loops the odometry chain is exact.
    """
    graph = factors.graph
    robust = is_loop(graph)
    candidates = [graph.world_from_body, odometry_chain(graph)[0]]
    linear = relaxed(factors, weight, candidates[1]) if (~graph.odometry & (weight > 0)).any() else None
    if linear is not None:
        candidates.append(linear)
    costs = []
    for poses in candidates:
        chi2 = residual_sigma(graph, poses) ** 2
        costs.append((weight * np.where(robust, np.minimum(chi2, bound), chi2)).sum())
    # the given poses unless another is better by more than rounding
    return candidates[int(np.argmin(np.round(costs, 6)))]
