"""How far a solved graph leaves the motion between two poses open."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vplog import geometry
from vplog.errors import GraphError
from vplog.graph.build import AXES
from vplog.graph.factors import as_values

if TYPE_CHECKING:
    from vplog.data import Floats, Ints
    from vplog.graph.factors import Factors

_ROTATION_FIRST = {2: [2, 0, 1], 3: [0, 1, 2, 3, 4, 5]}
"""GTSAM's rows of a pose in our order of axes."""


def edge_covariances(
    factors: Factors, weight: Floats, poses: Floats, edges: Ints, weighted: Any | None = None
) -> Floats:
    """Covariance (K, d, d) of a_from_b for these edges of positive weight, after the weighted least squares at `poses`.

    In the frame of b, to first order; d = 6, or 3 in the plane. `weighted` is the graph where it has more than the
    weighted edges. Of the inverse of the information matrix just the blocks that the factorisation touches are
    computed, from the root of GTSAM's Bayes tree down, and those of every edge are among them (Takahashi et al. 1973;
    Kaess and Dellaert, RAS 2009, section 3). So all edges of a graph cost about as much as one step of its solution.
    Raises GraphError where the poses are not determined.
    """
    graph = factors.graph
    size = len(AXES[graph.dimension])
    values = as_values(geometry.between(poses[:1], poses), graph.dimension)
    try:
        tree = (weighted or factors.weighted(weight)).linearize(values).eliminateMultifrontal()
    except RuntimeError:
        raise GraphError(
            "The graph leaves its poses too open to say how far. Check the information of its edges."
        ) from None
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
    aa, ab, bb = (block[:, order][:, :, order] for block in (aa, ab, bb))
    axes = AXES[graph.dimension]
    moved = geometry.adjoint(geometry.between(poses[graph.b[edges]], poses[graph.a[edges]]))[:, axes][:, :, axes]
    turned = np.swapaxes(moved, 1, 2)
    mixed = moved @ ab
    return bb - mixed - np.swapaxes(mixed, 1, 2) + moved @ aa @ turned
