"""Closures of which only the turn and the direction of the camera's motion are known: held to the line, not to metres.

A camera that moved by R, t sees R and t / |t|. As a constraint between poses the error along t says nothing, and that
across it grows with |t|; how long t is, the solved poses tell well enough to weigh it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vplog import geometry
from vplog.data import EdgeKind
from vplog.graph.build import checked
from vplog.graph.consistency import keep_odometry_if_worse

if TYPE_CHECKING:
    from vplog.data import Floats, Ints, PoseGraph, Solution
    from vplog.stages import Optimiser

_LEAST_M = 0.2
"""m; of a shorter motion the poses themselves are not sure, and its direction is weighed as if it were so long."""
_ALONG_LENGTHS = 100.0
"""Standard deviation along the motion in lengths of it: as good as unknown, and a matrix that can be inverted."""
_ROUNDS = 3
"""Solves, each with the lengths of the one before, which change by little after the first."""


@dataclass(frozen=True, eq=False)
class Directions:
    """Closures without metres."""

    a: Ints
    """(L,) rows of the matches."""
    b: Ints
    """(L,) rows of the queries."""
    a_from_b: Floats
    """(L, 4, 4) bodies, for a motion of the camera of length one."""
    information: Floats
    """(L, 6, 6) in the frame of b, of that motion, none along it."""
    body_from_camera: Floats
    """(4, 4)."""


def with_directions(
    graph: PoseGraph, solution: Solution, directions: Directions, solve: Optimiser
) -> tuple[PoseGraph, Solution]:
    """The graph with one loop edge more for each direction, and its robust solution.

    The odometry may not be bent further than its noise allows: then none of the directions is kept, and the solution
    is the one given. Raises GraphError where the graph cannot be solved.
    """
    grown, solved = graph, solution
    for _ in range(_ROUNDS):
        edges = _edges(directions, solved.world_from_body)
        grown, _ = checked(
            replace(
                graph,
                a=np.concatenate([graph.a, directions.a]).astype(np.int32),
                b=np.concatenate([graph.b, directions.b]).astype(np.int32),
                a_from_b=np.concatenate([graph.a_from_b, directions.a_from_b]),
                information=np.concatenate([graph.information, edges]),
                kind=graph.kind + [EdgeKind.LOOP] * len(directions.a),
            )
        )
        solved = solve(grown)
    kept = int((solved.weight[len(graph.a) :] > 0.5).sum())
    told = replace(solved, reason=f"{solved.reason.strip()} {kept} of them are directions without metres.")
    if kept and keep_odometry_if_worse(grown, told) is told:
        return grown, told
    return grown, replace(solution, weight=np.concatenate([solution.weight, np.zeros(len(directions.a))]))


def _edges(directions: Directions, poses: Floats) -> Floats:
    """Information (L, 6, 6) of bodies at the lengths that the poses say."""
    camera, turned = directions.body_from_camera, geometry.adjoint(directions.body_from_camera)
    moved = geometry.between(poses[directions.a] @ camera, poses[directions.b] @ camera)
    length = np.linalg.norm(moved[:, :3, 3], axis=1)
    of_camera = turned.T @ directions.information @ turned
    unit = geometry.inverse(camera) @ directions.a_from_b @ camera
    along = (np.swapaxes(unit[:, :3, :3], 1, 2) @ unit[:, :3, 3:])[:, :, 0]
    of_camera[:, 3:, 3:] += along[:, :, None] * along[:, None, :] / _ALONG_LENGTHS**2
    scale = np.concatenate([np.ones((len(length), 3)), np.repeat(1.0 / np.maximum(length, _LEAST_M)[:, None], 3, 1)], 1)
    of_camera = of_camera * scale[:, :, None] * scale[:, None, :]
    back = geometry.adjoint(geometry.inverse(camera))
    return back.T @ of_camera @ back
