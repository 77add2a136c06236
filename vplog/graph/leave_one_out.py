"""Leave-one-out cost of each closure, and of each group of neighbouring ones, in a solved graph.

The cost is by how much the chi-square of all other edges falls without the closure: its squared distance to the
prediction of the others, in units of the prediction's and its own noise (the externally studentised residual; Baarda's
data snooping, 1968).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Floats, Int32s, Ints, PoseGraph
from vplog.geometry import se3
from vplog.graph.build import AXES, informed, parts
from vplog.graph.consistency import OdometryChain, residual_twists
from vplog.graph.least_squares import Objective
from vplog.graph.marginals import edge_covariances, joint_covariance
from vplog.graph.sparse.cholesky import Cholesky

if TYPE_CHECKING:
    from vplog.graph.factors import Factors

_LEAST_REDUNDANCY = 1e-9
"""Least redundancy of a closure, so that no quotient is infinite."""
_NEAREST = 4
"""Groups tried as the other half of a loop; the nearest in rows may not be the nearest in noise."""
_WINDOW = 64
"""Groups on either side in order of rows among which the nearest are searched."""


@dataclass(frozen=True, eq=False)
class Tension:
    """Leave-one-out statistics of K closures in a solved graph."""

    cost: Floats
    """(K,) by how much chi-square falls without the closure, to first order."""
    whitened: Floats
    """(K, d) residuals in sigma, along axes on which the noise of the rest's prediction is independent."""
    redundancy: Floats
    """(K, d) share of a closure's error that its residual shows along these axes: 0 where nothing else checks it."""
    covariance: Floats
    """(K, d, d) of the motion between the ends, the closure itself included, in the frame of b."""
    force: Floats
    """(K, d) information times residual: to first order the gradient of half the closure's chi-square by b."""
    log_spread: Floats
    """(K,) half the log determinant of the covariance of the rest's prediction and the closure's noise together."""


def tension(factors: Factors, weight: Floats, poses: Floats, loops: Ints) -> Tension:
    """Leave-one-out statistics of closures `loops` (K,) of positive weight at the least squares solution `poses`.

    Raises GraphError where the poses are not determined.
    """
    graph = factors.graph
    axes = AXES[graph.dimension]
    error, Jr_inv = _errors(graph, poses, loops)
    covariance = Jr_inv @ edge_covariances(Objective(factors, weight), poses, loops) @ np.swapaxes(Jr_inv, 1, 2)
    information = informed(graph, loops) * weight[loops, None, None]
    root = np.swapaxes(np.linalg.cholesky(information), 1, 2)
    # leverage: 1 where nothing else constrains the ends of the closure
    leverage, turn = np.linalg.eigh(root @ covariance @ np.swapaxes(root, 1, 2))
    rest = np.clip(1.0 - leverage, _LEAST_REDUNDANCY, 1.0)
    whitened = (np.swapaxes(turn, 1, 2) @ (root @ error[:, axes, None]))[:, :, 0]
    return Tension(
        cost=(whitened**2 / rest).sum(1),
        whitened=whitened,
        redundancy=rest,
        log_spread=-0.5 * (np.linalg.slogdet(information)[1] + np.log(rest).sum(1)),
        covariance=covariance,
        force=(information @ error[:, axes, None])[:, :, 0],
    )


def cost_together(factors: Factors, weight: Floats, poses: Floats, tree: Cholesky, loops: Ints) -> float:
    """By how much chi-square falls without all of a few closures, to first order; `tree` of Objective.information()."""
    size = len(AXES[factors.graph.dimension])
    error, Jr_inv = _errors(factors.graph, poses, loops)
    information = informed(factors.graph, loops) * weight[loops, None, None]
    root = np.swapaxes(np.linalg.cholesky(information), 1, 2)
    whiten = np.zeros((len(loops) * size, len(loops) * size))
    for row, matrix in enumerate(root @ Jr_inv):
        whiten[row * size : (row + 1) * size, row * size : (row + 1) * size] = matrix
    leverage, turn = np.linalg.eigh(whiten @ joint_covariance(factors, tree, poses, loops) @ whiten.T)
    whitened = turn.T @ (root @ error[:, AXES[factors.graph.dimension], None]).ravel()
    return float((whitened**2 / np.clip(1.0 - leverage, _LEAST_REDUNDANCY, 1.0)).sum())


def distance(factors: Factors, weight: Floats, poses: Floats, loops: Ints) -> tuple[Floats, Floats]:
    """Squared distance (K,) of closures without weight to where the solved graph has them, in sigma, and log_spread."""
    graph = factors.graph
    axes = AXES[graph.dimension]
    # with next to no weight they are in the factorisation, which then knows their covariance, and change nothing
    barely = np.array(weight)
    barely[loops] = 1e-9
    error, Jr_inv = _errors(graph, poses, loops)
    covariance = Jr_inv @ edge_covariances(Objective(factors, barely), poses, loops) @ np.swapaxes(Jr_inv, 1, 2)
    covariance = covariance + np.linalg.inv(informed(graph, loops))
    error = error[:, axes]
    return se3.mahalanobis2(error, covariance), 0.5 * np.linalg.slogdet(covariance)[1]


def _errors(graph: PoseGraph, poses: Floats, loops: Ints) -> tuple[Floats, Floats]:
    """Residual twists (K, 6), and how they turn with the motion between the ends, (K, d, d).

    The inverse of the right Jacobian of the exponential, by its series (Barfoot 2017, eq. 7.77, with the other sign).
    """
    error = residual_twists(graph, poses, loops)
    ad = np.zeros((len(loops), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = se3.skew(error[:, :3])
    ad[:, 3:, :3] = se3.skew(error[:, 3:])
    squared = ad @ ad
    axes = AXES[graph.dimension]
    jacobian = np.eye(6) + ad / 2.0 + squared / 12.0 - squared @ squared / 720.0
    return error, jacobian[:, axes][:, :, axes]


def groups(graph: PoseGraph, loops: Ints, chain: OdometryChain) -> list[Ints]:
    """Groups of neighbouring closures among `loops` (K,), which support each other, as positions within `loops`.

    Two closures are of one group where the odometry between their ends adds less noise than they have themselves, and
    so on from neighbour to neighbour. `chain` is the graph's.
    """
    own: Floats = np.asarray(
        np.median(np.diagonal(np.linalg.inv(informed(graph, loops)), axis1=1, axis2=2), axis=0), np.float64
    )
    accumulated_noise = chain.accumulated_noise(own)
    first, second = np.minimum(graph.a[loops], graph.b[loops]), np.maximum(graph.a[loops], graph.b[loops])
    order = np.lexsort((second, first))
    at, to = accumulated_noise[first[order]], accumulated_noise[second[order]]
    # 2: the noise of two closures, each one unit
    starts = np.searchsorted(at, at - 2.0)
    near = [
        begun + np.flatnonzero(at[this] - at[begun:this] + np.abs(to[this] - to[begun:this]) <= 2.0)
        for this, begun in enumerate(starts.tolist())
    ]
    this = np.repeat(np.arange(len(loops)), [len(others) for others in near])
    label = parts(len(loops), np.concatenate([*near, this[:0]]), this)
    by_group = np.argsort(label, kind="stable")
    return [order[part] for part in np.split(by_group, np.cumsum(np.bincount(label))[:-1])]


def group_costs(
    graph: PoseGraph,
    poses: Floats,
    loops: Ints,
    single: Tension,
    members_of: list[Ints],
    chain: OdometryChain,
) -> Floats:
    """Approximate upper bound (G,) of how much chi-square falls without each group.

    The members act as one at their middle one, against the better of two estimates of the rest: the loop by another
    group or by the odometry, and the graph's information on the middle one less theirs. What the members cost each
    other is added. `chain` is the graph's.
    """
    axes = AXES[graph.dimension]
    information = informed(graph)
    at = np.array([members[len(members) // 2] for members in members_of])
    middle, member = loops[at], np.concatenate(members_of)
    size = np.array([len(members) for members in members_of])
    group = np.repeat(np.arange(len(members_of)), size)
    at_middle = se3.adjoint(se3.between(poses[graph.b[loops[member]]], poses[graph.b[middle[group]]]))
    at_middle = at_middle[:, axes][:, :, axes]
    back = np.swapaxes(at_middle, 1, 2)
    first = np.cumsum(size) - size
    force = np.add.reduceat((back @ single.force[member][:, :, None])[:, :, 0], first, axis=0)
    together = np.add.reduceat(back @ information[loops[member]] @ at_middle, first, axis=0)
    own = np.linalg.inv(together)

    a, b = graph.a[middle], graph.b[middle]
    by_loop = _quadratic(force, own + chain.covariance(a, b))
    by_loop = np.where(chain.part[a] == chain.part[b], by_loop, np.inf)
    for near in _nearest(a, b, min(_NEAREST, len(members_of) - 1)):
        moved = se3.adjoint(se3.between(poses[b], poses[b[near]]))[:, axes][:, :, axes]
        covariance = moved @ np.linalg.inv(information[middle[near]]) @ np.swapaxes(moved, 1, 2)
        for here, there in ((b, b[near]), (a, a[near])):
            covariance = covariance + _leg(chain, poses, b, here, there)
        joined = (chain.part[a] == chain.part[a[near]]) & (chain.part[b] == chain.part[b[near]])
        by_loop = np.where(joined, np.minimum(by_loop, _quadratic(force, own + covariance)), by_loop)
    legs = np.linalg.inv(information[loops[member]])
    for here, there in ((graph.b[loops[member]], b[group]), (graph.a[loops[member]], a[group])):
        legs = legs + _leg(chain, poses, graph.b[loops[member]], here, there)
    soft = np.add.reduceat(back @ np.linalg.inv(legs) @ at_middle, first, axis=0)
    root = np.swapaxes(np.linalg.cholesky(soft), 1, 2)
    leverage, turn = np.linalg.eigh(root @ single.covariance[at] @ np.swapaxes(root, 1, 2))
    whitened = (np.swapaxes(turn, 1, 2) @ np.linalg.solve(np.swapaxes(root, 1, 2), force[:, :, None]))[:, :, 0]
    by_graph = (whitened**2 / np.maximum(1.0 - leverage, _LEAST_REDUNDANCY)).sum(1)
    alone = _quadratic(single.force[member], np.asarray(np.linalg.inv(information[loops[member]]), np.float64))
    among = np.add.reduceat(alone, first) - _quadratic(force, own)
    return np.minimum(by_loop, by_graph) + np.maximum(among, 0.0)


def _leg(chain: OdometryChain, poses: Floats, end: Int32s, here: Int32s, there: Int32s) -> Floats:
    """(G, d, d) noise of the odometry between each two poses, in the frames of `end`."""
    later = np.maximum(here, there)
    moved = se3.adjoint(se3.between(poses[end], poses[later]))[:, chain.axes][:, :, chain.axes]
    return moved @ chain.covariance(np.minimum(here, there), later) @ np.swapaxes(moved, 1, 2)


def _quadratic(force: Floats, covariance: Floats) -> Floats:
    return np.einsum("gi,gij,gj->g", force, covariance, force)


def _nearest(a: Int32s, b: Int32s, count: int) -> list[Ints]:
    """For each of G pairs of rows, near pairs of rows: `count` arrays (G,), of those next in order of a."""
    order = np.lexsort((b, a))
    window = np.concatenate([np.arange(-_WINDOW, 0), np.arange(1, _WINDOW + 1)])
    other = np.arange(len(a))[:, None] + window
    inside = (other >= 0) & (other < len(a))
    other = order[np.clip(other, 0, len(a) - 1)]
    rows = np.abs(a[other].astype(np.int64) - a[order, None]) + np.abs(b[other].astype(np.int64) - b[order, None])
    best = np.argsort(np.where(inside, rows, np.iinfo(np.int64).max), axis=1, kind="stable")[:, :count]
    result = np.empty((len(a), count), np.int64)
    result[order] = np.take_along_axis(other, best, axis=1)
    return list(result.T)
