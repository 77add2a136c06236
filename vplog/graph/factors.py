"""Our pose graph in GTSAM's terms, and back. Every optimiser goes through here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from vplog import geometry
from vplog.errors import GraphError

if TYPE_CHECKING:
    from vplog.data import Floats, PoseGraph

_GAUGE_SIGMA = 1e-6
"""rad and m; holds pose 0 where it is, so that the rest has one best place. What it lets through is undone after."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Where a least squares descent ended."""

    world_from_body: Floats
    iterations: int
    converged: bool


def edge_factors(graph: PoseGraph) -> list[gtsam.BetweenFactorPose3]:
    """One factor per edge with its full information."""
    information = gtsam.noiseModel.Gaussian.Information
    return [
        gtsam.BetweenFactorPose3(a, b, gtsam.Pose3(measured), information(matrix))
        for a, b, measured, matrix in zip(
            graph.a.tolist(), graph.b.tolist(), graph.a_from_b, graph.information, strict=True
        )
    ]


def factor_graph(
    graph: PoseGraph, factors: list[gtsam.BetweenFactorPose3], weight: Floats, world_from_first: Floats
) -> gtsam.NonlinearFactorGraph:
    """The edges of positive weight (E,), their information times the weight, and the gauge at pose 0.

    `factors` are edge_factors(graph): those of weight 1 are taken as they are, which is most of them at every stage.
    """
    result = gtsam.NonlinearFactorGraph()
    gauge = gtsam.noiseModel.Isotropic.Sigma(6, _GAUGE_SIGMA)
    result.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(world_from_first), gauge))
    for edge in np.flatnonzero(weight > 0).tolist():
        factor = factors[edge]
        if weight[edge] != 1.0:
            noise = gtsam.noiseModel.Gaussian.Information(graph.information[edge] * weight[edge])
            factor = gtsam.BetweenFactorPose3(int(graph.a[edge]), int(graph.b[edge]), factor.measured(), noise)
        result.add(factor)
    return result


def least_squares(
    graph: PoseGraph,
    factors: list[gtsam.BetweenFactorPose3],
    weight: Floats,
    start: Floats,
    max_iterations: int,
    tolerance: float,
) -> Fit:
    """Levenberg-Marquardt from poses `start` (N, 4, 4) on the weighted edge_factors(graph), pose 0 fixed.

    Ends when a step gains less than `tolerance` of the error. Raises GraphError where the poses are not determined.
    """
    values = gtsam.Values()
    for node, pose in enumerate(start):
        values.insert(node, gtsam.Pose3(pose))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(max_iterations)
    settings.setRelativeErrorTol(tolerance)
    settings.setAbsoluteErrorTol(tolerance)
    try:
        optimiser = gtsam.LevenbergMarquardtOptimizer(factor_graph(graph, factors, weight, start[0]), values, settings)
        poses = as_array(optimiser.optimize(), len(start))
    except RuntimeError as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else "no reason given"
        raise GraphError(f"The pose graph cannot be solved ({first}). Check the information of its edges.") from None
    if not np.isfinite(poses).all():
        raise GraphError("The pose graph's solution is not finite. Check the information of its edges.")
    iterations = int(optimiser.iterations())
    return Fit(anchored(poses, start[0]), iterations, iterations < max_iterations)


def as_array(values: gtsam.Values, n: int) -> Floats:
    """(N, 4, 4) of the poses 0..n-1."""
    return np.array([values.atPose3(node).matrix() for node in range(n)])


def anchored(poses: Floats, world_from_first: Floats) -> Floats:
    """The poses (N, 4, 4) moved as one so that the first is exactly where asked."""
    moved = world_from_first @ geometry.inverse(poses[0]) @ poses
    moved[0] = world_from_first
    return moved
