"""How far a solved graph leaves the motion between two poses open."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog import geometry
from vplog.errors import GraphError
from vplog.graph.build import AXES
from vplog.graph.cholesky import Cholesky
from vplog.graph.descent import eliminated, is_large
from vplog.graph.factors import as_values
from vplog.graph.inverse import inverse_blocks, joint_inverse

if TYPE_CHECKING:
    import gtsam

    from vplog.data import Floats, Ints
    from vplog.graph.factors import Factors

_ROTATION_FIRST = {2: [2, 0, 1], 3: [0, 1, 2, 3, 4, 5]}
"""GTSAM's rows of a pose in our order of axes."""


def edge_covariances(
    factors: Factors, weight: Floats, poses: Floats, edges: Ints, weighted: gtsam.NonlinearFactorGraph | None = None
) -> Floats:
    """Covariance (K, d, d) of a_from_b for these edges of positive weight, after the weighted least squares at `poses`.

    In the frame of b, to first order; d = 6, or 3 in the plane. `weighted` is the graph where it has more than the
    weighted edges. Of the inverse of the information matrix just the blocks that the factorisation touches are
    computed, from the root of the elimination tree down, and those of every edge are among them (Takahashi et al. 1973;
    Kaess and Dellaert, RAS 2009, section 3). So all edges of a graph cost about as much as two steps of its solution.
    Raises GraphError where the poses are not determined.
    """
    graph = factors.graph
    if is_large(poses) and weighted is None:
        aa, ab, bb = inverse_blocks(eliminated(factors, weight, poses), graph.a[edges], graph.b[edges])
    else:
        aa, ab, bb = _by_tree(factors, weighted or factors.weighted(weight), poses, edges)
    axes = AXES[graph.dimension]
    moved = geometry.adjoint(geometry.between(poses[graph.b[edges]], poses[graph.a[edges]]))[:, axes][:, :, axes]
    turned = np.swapaxes(moved, 1, 2)
    mixed = moved @ ab
    return bb - mixed - np.swapaxes(mixed, 1, 2) + moved @ aa @ turned


def _by_tree(
    factors: Factors, weighted: gtsam.NonlinearFactorGraph, poses: Floats, edges: Ints
) -> tuple[Floats, Floats, Floats]:
    """Covariances (K, d, d) of a with a, a with b, and b with b, from GTSAM's Bayes tree."""
    graph = factors.graph
    size = len(AXES[graph.dimension])
    tree = _bayes_tree(factors, weighted, poses)
    ends: dict[int, list[tuple[int, int]]] = {}
    for row, (a, b) in enumerate(zip(graph.a[edges].tolist(), graph.b[edges].tolist(), strict=True)):
        ends.setdefault(a, []).append((row, b))
        ends.setdefault(b, []).append((row, a))
    aa, ab, bb = (np.zeros((len(edges), size, size)) for _ in range(3))
    start = graph.a[edges].tolist()

    # depth first, each clique with the covariance (k, k) of its separator, which its parent knows
    ready = [(clique, np.zeros((0, 0))) for clique in tree.roots()]
    while ready:
        clique, separator = ready.pop()
        conditional = clique.conditional()
        keys = conditional.keys()
        root = np.linalg.inv(conditional.R())
        gain = -root @ conditional.S()
        cross = gain @ separator
        inner = len(root)
        whole = np.empty((size * len(keys), size * len(keys)))
        whole[:inner, :inner] = root @ root.T + cross @ gain.T
        whole[:inner, inner:], whole[inner:, :inner], whole[inner:, inner:] = cross, cross.T, separator
        place = {key: slice(k * size, (k + 1) * size) for k, key in enumerate(keys)}
        for key in keys[: inner // size]:
            for row, other in ends.get(key, ()):
                if other in place:
                    a, b = (place[key], place[other]) if start[row] == key else (place[other], place[key])
                    aa[row], ab[row], bb[row] = whole[a, a], whole[a, b], whole[b, b]
        for number in range(clique.nrChildren()):
            child = clique[number]
            below = child.conditional()
            shared = below.keys()[below.R().shape[0] // size :]
            rows = (np.array([place[key].start for key in shared], int)[:, None] + np.arange(size)).ravel()
            ready.append((child, whole[rows[:, None], rows]))

    order = _ROTATION_FIRST[graph.dimension]
    return aa[:, order][:, :, order], ab[:, order][:, :, order], bb[:, order][:, :, order]


def joint_covariance(factors: Factors, tree: gtsam.GaussianBayesTree | Cholesky, poses: Floats, edges: Ints) -> Floats:
    """Covariance (K d, K d) of a_from_b of a few edges together, each in the frame of its b; `tree` is factorised()."""
    graph = factors.graph
    axes, order = AXES[graph.dimension], _ROTATION_FIRST[graph.dimension]
    size = len(axes)
    ends = np.stack([graph.a[edges], graph.b[edges]], axis=1)
    nodes = np.unique(ends).tolist()
    if isinstance(tree, Cholesky):
        covariance = joint_inverse(tree, np.array(nodes))
    else:
        joint = tree.jointMarginalCovariance(nodes)
        covariance = np.block([[joint.at(one, other)[np.ix_(order, order)] for other in nodes] for one in nodes])
    moved = geometry.adjoint(geometry.between(poses[ends[:, 1]], poses[ends[:, 0]]))[:, axes][:, :, axes]
    change = np.zeros((len(edges) * size, len(covariance)))
    for row, (a, b) in enumerate(np.searchsorted(nodes, ends).tolist()):
        part = slice(row * size, (row + 1) * size)
        change[part, a * size : (a + 1) * size] = -moved[row]
        change[part, b * size : (b + 1) * size] = np.eye(size)
    return change @ covariance @ change.T


def factorised(factors: Factors, weight: Floats, poses: Floats) -> gtsam.GaussianBayesTree | Cholesky:
    """The weighted edges (E,), linear at `poses` (N, 4, 4). Raises GraphError where these are not determined."""
    if is_large(poses):
        return eliminated(factors, weight, poses)
    return _bayes_tree(factors, factors.weighted(weight), poses)


def _bayes_tree(factors: Factors, weighted: gtsam.NonlinearFactorGraph, poses: Floats) -> gtsam.GaussianBayesTree:
    """The graph `weighted`, linear at `poses` (N, 4, 4). Raises GraphError where they are not determined."""
    values = as_values(geometry.between(poses[:1], poses), factors.graph.dimension)
    try:
        return weighted.linearize(values).eliminateMultifrontal()
    except RuntimeError:
        raise GraphError("The graph does not constrain all its poses. Check the edges and their information.") from None
