"""Drives whose odometry breaks: each piece is placed by the closures that lead to it from what is before it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vplog.data import Floats, Ints, PoseGraph
from vplog.geometry import se3
from vplog.graph.build import subgraph
from vplog.graph.consistency import is_loop
from vplog.graph.pcm import PcmSettings
from vplog.joint.graph import JoinSettings, spaced_apart

_TIMES = 10.0
"""A break's sigmas as a multiple of the spread of the closures across it: a hundredth of one closure's weight."""
_LEAST = np.array([0.001] * 3 + [0.01] * 3)
"""rad and m; closures do not agree better."""


def pieces_placed(graph: PoseGraph, broken: Ints) -> PoseGraph:
    """The graph with its initial poses, and the motion of the odometry edges `broken`, as the largest set of closures
    has them that agree with each other, where these are at as many places as join two drives, or known inliers. The
    edge then has ten times their spread: odometry does not speak against them, and hardly for them. Other pieces stay
    where they are."""
    stops = np.append(broken[1:] + 1, len(graph.world_from_body))[: len(broken)]
    for edge, stop in zip(broken.tolist(), stops.tolist(), strict=True):
        leads = ~graph.odometry & (graph.a <= edge) & (graph.b > edge) & (graph.b < stop)
        vouched = leads & ~is_loop(graph)  # by a person
        if leads.any():
            graph = _placed(graph, edge, np.flatnonzero(vouched if vouched.any() else leads), bool(vouched.any()))
    return graph


def _placed(graph: PoseGraph, edge: int, loops: Ints, vouched: bool) -> PoseGraph:
    """All poses behind an odometry edge moved as these loops across it have it, at enough places unless `vouched`."""
    poses = graph.world_from_body.copy()
    others = np.flatnonzero(np.arange(len(graph.a)) != edge)
    members, _ = PcmSettings().consistent(subgraph(graph, np.arange(len(poses)), others), loops - 1)
    chosen = members + 1
    rule = JoinSettings()
    if min(spaced_apart(ends[chosen].astype(np.int64), rule.spacing) for ends in (graph.a, graph.b)) < (
        1 if vouched else rule.least_closures
    ):
        return graph
    first_from_query = se3.between(poses[edge + 1], poses[graph.b[chosen]])
    world_from_first = poses[graph.a[chosen]] @ graph.a_from_b[chosen] @ se3.inverse(first_from_query)
    found, spread = _mean(world_from_first)
    poses[edge + 1 :] = found @ se3.inverse(poses[edge + 1]) @ poses[edge + 1 :]
    a_from_b = graph.a_from_b.copy()
    a_from_b[edge] = se3.between(poses[edge], poses[edge + 1])
    information = graph.information.copy()
    information[edge] = np.diag((_TIMES * spread) ** -2.0)
    return replace(graph, world_from_body=poses, a_from_b=a_from_b, information=information)


def _mean(poses: Floats) -> tuple[Floats, Floats]:
    """(4, 4) median of (K, 4, 4) poses that are near each other, and their standard deviations (6,) about it."""
    offset = se3.log(se3.between(poses[:1], poses))
    middle = np.median(offset, axis=0)
    spread = np.sqrt(((offset - middle) ** 2).mean(axis=0))
    return poses[0] @ se3.exp(middle[None])[0], np.maximum(spread, _LEAST)
