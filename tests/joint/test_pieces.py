"""Pieces of a drive, placed by their closures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vplog.data import EdgeKind, PoseGraph
from vplog.geometry import se3
from vplog.graph.solve import GncSettings, decided
from vplog.joint.pieces import pieces_placed

N, BREAK = 60, 29
WRONG = 4


def ring(seed: int, places: int) -> tuple[PoseGraph, np.ndarray]:
    """Two laps of a ring whose odometry breaks after the first, with a closure at every third keyframe of some of the
    places and a few false ones; and the true poses (N, 4, 4)."""
    rng = np.random.default_rng(seed)
    turn = np.arange(N) * 2 * np.pi / 30
    truth = se3.pose(se3.so3_exp(turn[:, None] * [0, 0, 1.0]), 10 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1))
    step = se3.between(truth[:-1], truth[1:]) @ se3.exp(rng.normal(0, 0.002, (N - 1, 6)))
    step[BREAK] = np.eye(4)
    b = np.arange(BREAK + 1, BREAK + 1 + places, 3)
    a = b - 30
    a[: WRONG if places > 20 else 0] = rng.integers(0, BREAK, WRONG if places > 20 else 0)
    closures = se3.between(truth[b - 30], truth[b]) @ se3.exp(rng.normal(0, 0.01, (len(b), 6)))
    information = np.tile(np.eye(6) / 0.002**2, (N - 1 + len(b), 1, 1))
    information[N - 1 :] = np.eye(6) / 0.01**2
    information[BREAK] = np.diag([1 / 3.0] * 3 + [1e-4] * 3)
    poses = [np.eye(4)]
    for one in step:
        poses.append(poses[-1] @ one)
    edges = np.concatenate([np.arange(N - 1), a]), np.concatenate([np.arange(1, N), b])
    kind = [EdgeKind.ODOMETRY] * (N - 1) + [EdgeKind.LOOP] * len(b)
    a, b = (one.astype(np.int32) for one in edges)
    return PoseGraph(np.stack(poses), a, b, np.concatenate([step, closures]), information, kind), truth


def off_m(poses: np.ndarray, truth: np.ndarray) -> float:
    """m that the second piece lies off, seen from the first pose."""
    away = se3.between(truth[:1], truth) @ se3.inverse(se3.between(poses[:1], poses))
    return float(np.linalg.norm(away[BREAK + 1 :, :3, 3], axis=1).max())


def test_a_piece_is_placed_by_the_closures_that_agree() -> None:
    for seed in range(3):
        graph, truth = ring(seed, 30)
        assert off_m(graph.world_from_body, truth) > 1.0
        placed = pieces_placed(graph, np.array([BREAK]))
        assert off_m(placed.world_from_body, truth) < 1.0
        found = decided(placed, GncSettings()).solution
        assert off_m(found.world_from_body, truth) < 0.5
        assert found.weight[N - 1 :].tolist() == [0.0] * WRONG + [1.0] * 6


def test_a_few_closures_at_one_place_move_nothing() -> None:
    graph, _ = ring(0, 7)
    placed = pieces_placed(graph, np.array([BREAK]))
    assert placed is graph


def test_without_a_break_nothing_changes() -> None:
    graph, _ = ring(0, 30)
    assert pieces_placed(graph, np.zeros(0, np.int64)) is graph


def test_a_closure_that_a_person_accepted_places_a_piece_against_false_ones_that_agree() -> None:
    graph, truth = ring(0, 30)
    loops = np.flatnonzero(~graph.odometry)
    a_from_b = graph.a_from_b.copy()
    away = se3.pose(np.eye(3), np.array([0.0, 0.0, 20.0]))
    a_from_b[loops[:-1]] = se3.between(truth[graph.a[loops[:-1]]], away @ truth[graph.b[loops[:-1]]])
    kind = [*graph.kind[:-1], EdgeKind.KNOWN_LOOP]
    placed = pieces_placed(replace(graph, a_from_b=a_from_b, kind=kind), np.array([BREAK]))
    assert off_m(placed.world_from_body, truth) < 1.0
    without = pieces_placed(replace(graph, a_from_b=a_from_b), np.array([BREAK]))
    assert off_m(without.world_from_body, truth) > 10.0
