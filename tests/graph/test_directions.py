"""Turn and direction alone, without metres, pull a drive together, and false ones do not."""

from __future__ import annotations

import numpy as np
import pytest

from vplog import geometry
from vplog.data import EdgeKind, PoseGraph
from vplog.graph.consistency import is_loop, odometry_chain
from vplog.graph.directions import Directions, with_directions
from vplog.graph.solve import GncSettings

from .drive import position_error, ring

MOUNT = geometry.exp(np.array([0.1, 1.2, -0.3, 0.5, 0.2, 1.0]))
SIGMA_RAD = 0.01


def without_loops(graph: PoseGraph) -> PoseGraph:
    kept = np.flatnonzero(~is_loop(graph))
    kind = [EdgeKind.ODOMETRY] * len(kept)
    return PoseGraph(
        graph.world_from_body, graph.a[kept], graph.b[kept], graph.a_from_b[kept], graph.information[kept], kind
    )


def seen(true: np.ndarray, count: int, seed: int, false: int = 0) -> Directions:
    """What a camera on the body sees of the turn and the direction between keyframes a lap apart."""
    random = np.random.default_rng(seed)
    half = len(true) // 2
    b = np.sort(random.choice(np.arange(half + 3, len(true)), count, replace=False))
    a = b - half + random.integers(1, 3, count)
    moved = geometry.between(true[a] @ MOUNT, true[b] @ MOUNT)
    moved[:false, :3, :3] = geometry.so3_exp(random.normal(size=(false, 3)) * 0.5) @ moved[:false, :3, :3]
    moved[:, :3, 3] /= np.linalg.norm(moved[:, :3, 3], axis=1, keepdims=True)
    information = np.zeros((count, 6, 6))
    information[:, :3, :3] = np.eye(3) / SIGMA_RAD**2
    along = np.swapaxes(moved[:, :3, :3], 1, 2) @ moved[:, :3, 3:]
    information[:, 3:, 3:] = (np.eye(3) - along @ np.swapaxes(along, 1, 2)) / SIGMA_RAD**2
    back = geometry.adjoint(geometry.inverse(MOUNT))
    body = MOUNT @ moved @ geometry.inverse(MOUNT)
    return Directions(a, b, body, back.T @ information @ back, MOUNT)


@pytest.mark.parametrize("false", [0, 5])
def test_a_drive_is_pulled_together_by_directions(false: int) -> None:
    drive = ring(120, loops=0, seed=3)
    graph = without_loops(drive.graph)
    solution = GncSettings()(graph)
    before = position_error(solution.world_from_body, drive.true)
    grown, solved = with_directions(graph, solution, seen(drive.true, 40, 0, false), GncSettings())
    weight = solved.weight[len(graph.a) :]
    assert len(grown.a) == len(graph.a) + 40
    assert weight[:false].sum() <= 1
    assert weight[false:].sum() >= 30
    assert position_error(solved.world_from_body, drive.true) < 0.5 * before
    assert "directions without metres" in solved.reason


def test_the_length_is_left_open() -> None:
    """Two poses whose odometry says 2 m along the line, and a direction seen: the 2 m stay as they are."""
    drive = ring(120, loops=0, seed=3)
    graph = without_loops(drive.graph)
    solution = GncSettings()(graph)
    chain = odometry_chain(graph)[0]
    exact = seen(chain, 20, 1)
    _, solved = with_directions(graph, solution, exact, GncSettings())
    np.testing.assert_allclose(solved.world_from_body, chain, atol=1e-3)


def test_false_directions_alone_change_nothing() -> None:
    drive = ring(120, loops=0, seed=3)
    graph = without_loops(drive.graph)
    solution = GncSettings()(graph)
    grown, solved = with_directions(graph, solution, seen(drive.true, 10, 2, false=10), GncSettings())
    assert solved.weight[len(graph.a) :].sum() <= 2
    assert len(solved.weight) == len(grown.a)
