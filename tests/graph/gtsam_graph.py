"""A pose graph in GTSAM's terms: the reference that our own normal equations are held against."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np

from vplog.geometry import se3
from vplog.graph.build import informed

if TYPE_CHECKING:
    from vplog.data import PoseGraph

PLANAR = [1, 2, 0]
"""GTSAM has x, y, yaw; the planar rows of vplog are yaw, x, y."""


def as_gtsam(poses: np.ndarray, dimension: int) -> list[Any]:
    """Pose3, or Pose2 of planar poses."""
    if dimension == 3:
        return [gtsam.Pose3(pose) for pose in poses]
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    return [gtsam.Pose2(*row) for row in np.stack([poses[:, 0, 3], poses[:, 1, 3], yaw], axis=1).tolist()]


def as_values(poses: np.ndarray, dimension: int) -> gtsam.Values:
    values = gtsam.Values()
    for node, pose in enumerate(as_gtsam(poses, dimension)):
        values.insert(node, pose)
    return values


def as_array(values: gtsam.Values, dimension: int) -> np.ndarray:
    """(N, 4, 4) of the poses 0..N-1."""
    if dimension == 3:
        return np.array([values.atPose3(node).matrix() for node in range(values.size())])
    x, y, yaw = gtsam.utilities.extractPose2(values).T
    zero = np.zeros(len(x))
    return se3.pose(se3.so3_exp(np.stack([zero, zero, yaw], axis=1)), np.stack([x, y, zero], axis=1))


def edge_factors(graph: PoseGraph, weight: np.ndarray | None = None) -> list[Any]:
    """BetweenFactorPose3 or Pose2 of each edge, its information times its weight."""
    information = informed(graph) * (1.0 if weight is None else weight[:, None, None])
    if graph.dimension == 2:
        information = information[:, PLANAR][:, :, PLANAR]
    between = gtsam.BetweenFactorPose2 if graph.dimension == 2 else gtsam.BetweenFactorPose3
    ends = zip(graph.a.tolist(), graph.b.tolist(), as_gtsam(graph.a_from_b, graph.dimension), information, strict=True)
    return [between(a, b, z, gtsam.noiseModel.Gaussian.Information(Omega)) for a, b, z, Omega in ends]


def weighted(graph: PoseGraph, weight: np.ndarray) -> gtsam.NonlinearFactorGraph:
    """The edges of positive weight (E,), and a prior that holds pose 0 at the origin."""
    result = gtsam.NonlinearFactorGraph()
    planar = graph.dimension == 2
    noise = gtsam.noiseModel.Isotropic.Sigma(3 if planar else 6, 1e-6)
    result.add(
        gtsam.PriorFactorPose2(0, gtsam.Pose2(), noise) if planar else gtsam.PriorFactorPose3(0, gtsam.Pose3(), noise)
    )
    for factor, share in zip(edge_factors(graph, np.where(weight > 0, weight, 1.0)), weight.tolist(), strict=True):
        if share > 0:
            result.add(factor)
    return result
