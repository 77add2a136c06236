"""The frames of a log that were localised, joined by its odometry: those at odds with it and the others are left out,
and every sample gets a pose."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Bools, EdgeKind, Floats, Ints, Keyframes, Odometry, PoseGraph, Trajectory
from vplog.geometry import se3
from vplog.graph.build import build_graph, checked
from vplog.graph.consistency import is_loop
from vplog.graph.correct_trajectory import correct_trajectory
from vplog.graph.noise import edge_covariance

if TYPE_CHECKING:
    from vplog.pipeline import Pipeline


def join_by_odometry(
    odometry: Odometry, keyframes: Keyframes, rows: Ints, world_from_body: Floats, covariance: Floats,
    pipeline: Pipeline,
) -> tuple[Trajectory, Bools]:  # fmt: skip
    """The trajectory by odometry and the poses (L, 4, 4), with covariance (L, 6, 6) in the body, of keyframes `rows`
    (L,), one at least; and (L,) which of these the rest agrees with. Raises GraphError where there is none."""
    edges, _, _ = edge_covariance(odometry, keyframes.stamp_ns, pipeline.noise)
    graph, _, _ = build_graph(keyframes, edges, None)
    world = len(keyframes.stamp_ns)  # the map is one more node, to which only localised frames lead
    odom_from_world = keyframes.odom_from_body[rows[0]] @ se3.inverse(world_from_body[0])
    graph = PoseGraph(
        np.concatenate([graph.world_from_body, odom_from_world[None]]),
        np.concatenate([graph.a, np.full(len(rows), world)]).astype(np.int32),
        np.concatenate([graph.b, rows]).astype(np.int32),
        np.concatenate([graph.a_from_b, world_from_body]),
        np.concatenate([graph.information, np.linalg.inv(covariance)]).astype(np.float64),
        [*graph.kind, *[EdgeKind.LOOP] * len(rows)],
    )
    graph, _ = checked(graph)
    solution = pipeline.solve(graph)  # not `decided`: it takes what one place measures alike for one accident
    poses = solution.world_from_body
    solved = se3.between(np.broadcast_to(poses[world], (world, 4, 4)), poses[:world])
    agrees = solution.weight[is_loop(graph)] > 0.5
    return correct_trajectory(odometry, keyframes, solved), agrees
