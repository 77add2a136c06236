"""graph.g2o: the pose graph with its solved poses, for any solver that reads g2o."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog import geometry
from vplog.results.atomic import replacing

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Floats, PoseGraph

_UPPER = np.triu_indices(6)
_TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]
"""g2o has translation before rotation; information here is rotation first."""


def write_g2o(path: Path, graph: PoseGraph, world_from_body: Floats) -> None:
    """`VERTEX_SE3:QUAT` at the poses given (N, 4, 4), node 0 fixed, and `EDGE_SE3:QUAT`; 17 digits, so nothing is lost.

    The information matrix is that of the rotation vector, as GTSAM reads it, not of g2o's half-angle quaternion.
    """
    information = graph.information[:, _TRANSLATION_FIRST][:, :, _TRANSLATION_FIRST][:, *_UPPER]
    with replacing(path) as stream:
        for node, row in enumerate(_rows(world_from_body)):
            stream.write(f"VERTEX_SE3:QUAT {node} {row}\n".encode())
        if len(world_from_body):
            stream.write(b"FIX 0\n")
        edges = zip(graph.a.tolist(), graph.b.tolist(), _rows(graph.a_from_b), information.tolist(), strict=True)
        for a, b, row, upper in edges:
            stream.write(f"EDGE_SE3:QUAT {a} {b} {row} {' '.join(map(repr, upper))}\n".encode())


def _rows(poses: Floats) -> list[str]:
    values = np.concatenate([poses[:, :3, 3], geometry.quaternion(poses[:, :3, :3])], axis=1)
    return [" ".join(map(repr, row)) for row in values.tolist()]
