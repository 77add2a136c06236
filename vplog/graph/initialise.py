"""Where to start a solve from."""

from __future__ import annotations

from heapq import heappop, heappush
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from vplog import geometry
from vplog.errors import GraphError
from vplog.graph.cholesky import Blocks, Cholesky
from vplog.graph.consistency import is_loop, odometry_chain, residual_sigma
from vplog.graph.descent import is_large
from vplog.graph.factors import anchored, as_array

if TYPE_CHECKING:
    from vplog.data import Floats, PoseGraph
    from vplog.graph.factors import Factors


_LINEAR_STEPS = 300
"""Conjugate gradients on a linear problem at most: with the chain as preconditioner they end after a step per loop."""
_ROUGH_STEPS = 50
"""The same for headings where there are more loops than that: what is left is within the reach of least squares."""
_LOST_RAD = np.pi / 3.0
"""Noise of the heading, rad, beyond which the chain's whole circles may be wrong: half a circle is three sigmas."""
_HELD = 1e6
"""How much more firmly than by any edge the first pose is held."""
_LINEAR_TOLERANCE = 1e-4
"""They end at this share of the first residual: what follows corrects far more."""


def relaxed(factors: Factors, weight: Floats, chain: Floats) -> Floats | None:
    """Poses (N, 4, 4) by rotations first, positions then, each a linear problem: chordal in space, LAGO in the plane.

    `chain` are the poses by odometry alone. None where that fails: an ill-conditioned problem, parts that no edge of
    positive weight joins, or poses that are not finite.
    """
    if len(factors.loose(weight)):
        return None
    try:
        if factors.graph.dimension == 2:
            poses = _planar(factors, weight, chain)
        else:
            poses = _chordal_large(factors, weight) if is_large(chain) else _chordal(factors, weight)
    except (RuntimeError, GraphError):  # of GTSAM's elimination, and of our own
        return None
    return anchored(poses, factors.graph.world_from_body[0]) if np.isfinite(poses).all() else None


def _chordal(factors: Factors, weight: Floats) -> Floats:
    """Chordal relaxation of the rotations, and one linear step: Carlone et al., ICRA 2015, III-B."""
    return as_array(gtsam.InitializePose3.initialize(factors.weighted(weight)), 3)


def _chordal_large(factors: Factors, weight: Floats) -> Floats:
    """The same relaxation of the rotations by our own elimination, and positions as a linear problem of their own."""
    graph = factors.graph
    n, held = len(graph.world_from_body), np.eye(3)
    firmness = weight * np.trace(graph.information[:, :3, :3], axis1=1, axis2=2) / 3.0
    # each row r of a rotation by itself: r_b = r_a a_from_b
    diagonal = _ends(graph, firmness)[:, None, None] * np.eye(3)
    diagonal[0] += firmness.max() * _HELD * held
    right = np.zeros((n, 3, 3))
    right[0] = firmness.max() * _HELD * held
    between = -firmness[:, None, None] * graph.a_from_b[:, :3, :3]
    shape = factors.elimination(weight > 0)
    columns = Cholesky.of(shape, Blocks(diagonal, graph.a, graph.b, between)).solve(right)
    left, _, turned = np.linalg.svd(np.swapaxes(columns, 1, 2))
    left[:, :, 2] *= np.linalg.det(left @ turned)[:, None]  # the nearest rotations
    rotation = left @ turned
    firmness = weight * np.trace(graph.information[:, 3:, 3:], axis1=1, axis2=2) / 3.0
    shift = (rotation[graph.a] @ graph.a_from_b[:, :3, 3:])[:, :, 0]
    return geometry.pose(rotation, _apart(factors, weight, firmness, shift))


def _apart(factors: Factors, weight: Floats, firmness: Floats, difference: Floats) -> Floats:
    """Values (N, k) whose differences along the edges are nearest to `difference` (E, k), weighted; the first is 0."""
    graph = factors.graph
    diagonal = _ends(graph, firmness)
    diagonal[0] += firmness.max() * _HELD
    right = _pull(graph, firmness[:, None] * difference)
    matrix = Blocks(diagonal[:, None, None], graph.a, graph.b, -firmness[:, None, None])
    return Cholesky.of(factors.elimination(weight > 0), matrix).solve(right[:, None, :])[:, 0]


def _ends(graph: PoseGraph, firmness: Floats) -> Floats:
    """(N,) sum of the firmness of the edges at each pose."""
    n = len(graph.world_from_body)
    return np.asarray(np.bincount(graph.a, firmness, n) + np.bincount(graph.b, firmness, n), np.float64)


def _pull(graph: PoseGraph, tension: Floats) -> Floats:
    """(N, k) what tensions (E, k) of the edges add up to at their ends, the first pose being held."""
    n = len(graph.world_from_body)
    result = np.empty((n, tension.shape[1]))
    for column, along in enumerate(tension.T):
        result[:, column] = np.bincount(graph.b, along, n) - np.bincount(graph.a, along, n)
    result[0] = 0.0
    return result


def _planar(factors: Factors, weight: Floats, chain: Floats) -> Floats:
    """Linear approximation for graph optimisation: Carlone, Aragues, Castellanos, Bona, IJRR 2014 (LAGO).

    Along a spanning tree turns are summed without wrapping, so each other edge tells the turn between its ends but for
    whole circles, and their number is the one that the tree is nearest to (section 4). The tree is the odometry chain,
    or where that is so long that it no longer knows its heading, the one of least noise. Then orientations are a linear
    problem, and with them known, positions too.
    """
    graph = factors.graph
    turn = np.arctan2(graph.a_from_b[:, 1, 0], graph.a_from_b[:, 0, 0])
    yaw = np.unwrap(np.arctan2(chain[:, 1, 0], chain[:, 0, 0]))
    if (1.0 / graph.information[~is_loop(graph), 2, 2]).sum() > _LOST_RAD**2:
        yaw = _turned_least(graph, weight, turn, yaw)
    turn = turn + 2.0 * np.pi * np.round((yaw[graph.b] - yaw[graph.a] - turn) / (2.0 * np.pi))
    many = (np.abs(graph.a - graph.b) != 1).sum() > _LINEAR_STEPS
    steps = _ROUGH_STEPS if many else _LINEAR_STEPS
    large = is_large(chain)
    if large:
        yaw = yaw[0] + _apart(factors, weight, weight * graph.information[:, 2, 2], turn[:, None])[:, 0]
    else:
        yaw = _spread(graph, weight * graph.information[:, 2, 2], turn[:, None], yaw[:, None], steps)[:, 0]
    zero = np.zeros(len(yaw))
    poses = geometry.pose(geometry.so3_exp(np.stack([zero, zero, yaw], axis=1)), chain[:, :3, 3])
    shift = (poses[graph.a, :2, :2] @ graph.a_from_b[:, :2, 3:])[:, :, 0]
    firmness = np.trace(graph.information[:, 3:5, 3:5], axis1=1, axis2=2) / 2.0
    if large:
        poses[:, :2, 3] = _apart(factors, weight, weight * firmness, shift)
        return poses
    if many:  # factorising is faster
        poses[:, :2, 3] = _placed(graph, weight * firmness, shift)
        return poses
    poses[:, :2, 3] = _spread(graph, weight * firmness, shift, poses[:, :2, 3], _LINEAR_STEPS)
    return poses


def _turned_least(graph: PoseGraph, weight: Floats, turn: Floats, yaw: Floats) -> Floats:
    """Headings (N,) rad along the tree of edges over which each has gathered least noise (Dijkstra 1959)."""
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


def _placed(graph: PoseGraph, firmness: Floats, shift: Floats) -> Floats:
    """What _spread finds for positions (N, 2), from the origin and by factorisation."""
    linear = gtsam.NonlinearFactorGraph()
    linear.add(gtsam.PriorFactorPoint2(0, np.zeros(2), gtsam.noiseModel.Isotropic.Precision(2, 1e12)))
    noise = {one: gtsam.noiseModel.Isotropic.Precision(2, one) for one in np.unique(firmness[firmness > 0]).tolist()}
    for a, b, moved, one in zip(graph.a.tolist(), graph.b.tolist(), shift, firmness.tolist(), strict=True):
        if one > 0:
            linear.add(gtsam.BetweenFactorPoint2(a, b, moved, noise[one]))
    values = gtsam.Values()
    for node in range(len(graph.world_from_body)):
        values.insert(node, np.zeros(2))
    values = values.retract(linear.linearize(values).optimize())
    return np.asarray(gtsam.utilities.extractPoint2(values), np.float64)


def _spread(graph: PoseGraph, firmness: Floats, difference: Floats, start: Floats, steps: int) -> Floats:
    """Values (N, k) whose differences along the edges are nearest to `difference` (E, k), weighted; the first stays.

    Conjugate gradients on the normal equations. The preconditioner is the same problem on the chain of poses alone,
    which two running sums solve; a link that has no edge is given the mean firmness.
    """
    n, k = start.shape
    a, b = graph.a, graph.b

    chain = np.bincount(np.maximum(a, b), np.where(np.abs(a - b) == 1, firmness, 0.0), n)[1:, None]
    chain = np.where(chain > 0, chain, firmness.mean())

    def precondition(residual: Floats) -> Floats:
        flow = np.cumsum(residual[:0:-1], axis=0)[::-1]  # through each link goes what everything after it pulls
        return np.concatenate([np.zeros((1, k)), np.cumsum(flow / chain, axis=0)])

    values = np.array(start)
    residual = _pull(graph, firmness[:, None] * (difference - values[b] + values[a]))
    direction = step = precondition(residual)
    energy = first = (residual * step).sum(0)
    for _ in range(steps):
        if (energy <= _LINEAR_TOLERANCE**2 * first).all():
            break
        back = _pull(graph, firmness[:, None] * (direction[b] - direction[a]))
        along = (direction * back).sum(0)
        length = np.divide(energy, along, out=np.zeros(k), where=along > 0)
        values = values + length * direction
        residual = residual - length * back
        step = precondition(residual)
        before, energy = energy, (residual * step).sum(0)
        direction = step + np.divide(energy, before, out=np.zeros(k), where=before > 0) * direction
    return values


def initial_poses(factors: Factors, weight: Floats, bound: float = np.inf) -> Floats:
    """The best of the graph's own poses, the odometry chain and the relaxed solution, (N, 4, 4), pose 0 as given.

    Best is the least weighted (E,) sum of chi-squares, where no loop counts for more than `bound`: a robust solver must
    not prefer a start that has given in to false closures. Without loops the odometry chain is exact.
    """
    graph = factors.graph
    robust = is_loop(graph)
    candidates = [graph.world_from_body, odometry_chain(graph)[0]]
    linear = relaxed(factors, weight, candidates[1]) if (robust & (weight > 0)).any() else None
    if linear is not None:
        candidates.append(linear)
    costs = []
    for poses in candidates:
        chi2 = residual_sigma(graph, poses) ** 2
        costs.append((weight * np.where(robust, np.minimum(chi2, bound), chi2)).sum())
    # the given poses unless another is better by more than rounding
    return candidates[int(np.argmin(np.round(costs, 6)))]
