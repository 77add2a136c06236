"""Where to start a solve from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import gtsam
import numpy as np

from vplog.data import EdgeKind
from vplog.graph.consistency import odometry_chain, residual_sigma
from vplog.graph.factors import anchored, as_array, factor_graph

if TYPE_CHECKING:
    from vplog.data import Floats, PoseGraph


def chordal(graph: PoseGraph, factors: list[gtsam.BetweenFactorPose3], weight: Floats) -> Floats | None:
    """Poses (N, 4, 4) from rotations by chordal relaxation (Carlone et al., ICRA 2015, III-B) and one linear step.

    None where GTSAM cannot: an ill-conditioned rotation problem, or poses that are not finite.
    """
    try:
        values = gtsam.InitializePose3.initialize(factor_graph(graph, factors, weight, graph.world_from_body[0]))
        poses = as_array(values, len(graph.world_from_body))
    except RuntimeError:
        return None
    return anchored(poses, graph.world_from_body[0]) if np.isfinite(poses).all() else None


def initial_poses(
    graph: PoseGraph, factors: list[gtsam.BetweenFactorPose3], weight: Floats, bound: float = np.inf
) -> Floats:
    """The best of the graph's own poses, the odometry chain and the chordal solution, (N, 4, 4), pose 0 as given.

    Best is the least weighted (E,) sum of chi-squares, where no loop counts for more than `bound`: a robust solver must
    not prefer a start that has given in to false closures. Without loops the odometry chain is exact.
    """
    robust = np.array([kind != EdgeKind.ODOMETRY for kind in graph.kind])
    candidates = [graph.world_from_body, odometry_chain(graph)[0]]
    relaxed = chordal(graph, factors, weight) if (robust & (weight > 0)).any() else None
    if relaxed is not None:
        candidates.append(relaxed)
    costs = []
    for poses in candidates:
        chi2 = residual_sigma(graph, poses) ** 2
        costs.append((weight * np.where(robust, np.minimum(chi2, bound), chi2)).sum())
    # the given poses unless another is better by more than rounding
    return candidates[int(np.argmin(np.round(costs, 6)))]
