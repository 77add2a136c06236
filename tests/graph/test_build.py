from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.graph.drive import ledger, ring, with_entry, without_loops
from vplog.data import EdgeKind, Verdict
from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.graph.build import build_graph, checked, parts
from vplog.graph.gnc import GncSettings

DRIVE = ring(30, 3)
N = 30


def test_only_accepted_rows_become_loops_in_order() -> None:
    query, match = np.array([10, 12, 20, 25]), np.array([1, 2, 3, 4])
    rows = ledger(query, match, se3.between(DRIVE.true[match], DRIVE.true[query]))
    verdict = [Verdict.ACCEPTED, Verdict.TOO_FEW_INLIERS, Verdict.ACCEPTED, Verdict.POOR_SPREAD]
    # what was rejected has no pose
    rows = replace(rows, verdict=verdict, match_from_query=with_entry(rows.match_from_query, (1,), np.nan))
    covariance = np.eye(6) * np.arange(1, N)[:, None, None]
    graph, ledger_rows, warnings = build_graph(DRIVE.keyframes, covariance, rows)
    assert ledger_rows.tolist() == [0, 2]
    assert graph.kind == [EdgeKind.ODOMETRY] * (N - 1) + [EdgeKind.LOOP] * 2
    assert graph.a[-2:].tolist() == [1, 3]
    assert graph.b[-2:].tolist() == [10, 20]
    np.testing.assert_allclose(graph.information[4], np.eye(6) / 5)
    assert warnings == []


def test_closures_that_share_a_keyframe_share_their_information() -> None:
    """Three at query 10, two at match 2: each counts as its share of the busier end; a lone closure counts whole."""
    query, match = np.array([10, 10, 10, 12, 20]), np.array([1, 2, 3, 2, 5])
    rows = ledger(query, match, se3.between(DRIVE.true[match], DRIVE.true[query]))
    graph, _, _ = build_graph(DRIVE.keyframes, np.eye(6) + np.zeros((N - 1, 1, 1)), rows)
    for loop, share in zip(graph.information[N - 1 :], (3, 3, 3, 2, 1), strict=True):
        np.testing.assert_allclose(loop, rows.information[0] / share, rtol=1e-12)


def test_no_ledger_gives_odometry_alone() -> None:
    graph, rows, _ = build_graph(DRIVE.keyframes, np.eye(6) + np.zeros((N - 1, 1, 1)), None)
    assert (len(graph.a), len(rows)) == (N - 1, 0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -2.5])
def test_bad_information_is_named_with_its_value(value: float) -> None:
    graph = replace(DRIVE.graph, information=with_entry(DRIVE.graph.information, (30, 2, 2), value))
    for act in (checked, GncSettings()):
        with pytest.raises(GraphError, match=rf"edge 30 .*{value:.6g}"):
            act(graph)


@pytest.mark.parametrize("value", [np.nan, np.inf, 2.0])
def test_bad_poses_are_refused(value: float) -> None:
    with pytest.raises(GraphError, match="Edge 3 "):
        checked(replace(DRIVE.graph, a_from_b=with_entry(DRIVE.graph.a_from_b, (3, 0, 0), value)))
    with pytest.raises(GraphError, match="Pose 3 "):
        checked(replace(DRIVE.graph, world_from_body=with_entry(DRIVE.graph.world_from_body, (3, 0, 0), value)))


@pytest.mark.parametrize(("a", "b"), [(5, 5), (9, 4), (-1, 4), (3, N)])
def test_closures_must_join_an_earlier_to_a_later_keyframe(a: int, b: int) -> None:
    with pytest.raises(GraphError, match=f"Closure 0 joins keyframes {a} and {b}"):
        build_graph(
            DRIVE.keyframes, np.eye(6) + np.zeros((N - 1, 1, 1)), ledger(np.array([b]), np.array([a]), np.eye(4)[None])
        )


def test_an_index_out_of_range_and_a_cut_graph_are_refused() -> None:
    alone = without_loops(DRIVE.graph)
    with pytest.raises(GraphError, match=r"poses 0\.\.29"):
        checked(replace(alone, b=with_entry(alone.b, (7,), 99)))
    with pytest.raises(GraphError, match=r"pose 0 and pose 8 \(22 of 30"):
        checked(replace(alone, a=with_entry(alone.a, (7,), 9), b=with_entry(alone.b, (7,), 10)))


def test_indefinite_information_is_repaired_with_a_warning() -> None:
    information = DRIVE.graph.information.copy()
    information[4, 0, 1] = information[4, 1, 0] = 2.0 * information[4, 0, 0]
    graph, warnings = checked(replace(DRIVE.graph, information=information))
    assert np.linalg.eigvalsh(graph.information[4])[0] > 0
    assert len(warnings) == 1
    assert "edge 4" in warnings[0]
    again, none = checked(graph)
    assert none == []
    np.testing.assert_allclose(again.information, graph.information)
    assert np.isfinite(GncSettings()(graph).world_from_body).all()


def test_an_impossible_correlation_leaves_the_rest_as_it_is() -> None:
    """As in the public graph cubicle: x-yaw and y-yaw stand where z-roll and z-pitch belong."""
    information = DRIVE.graph.information.copy()
    information[4] = np.diag([10.0, 10.0, 9e4, 2.5e6, 1.5e7, 10.0])
    information[4, 3, 4] = information[4, 4, 3] = 5.4e6
    expected = information[4].copy()
    information[4, [0, 5, 1, 5], [5, 0, 5, 1]] = [8e4, 8e4, 1.3e5, 1.3e5]
    graph, warnings = checked(replace(DRIVE.graph, information=information))
    np.testing.assert_allclose(graph.information[4], expected, rtol=1e-9, atol=1e-6)
    assert len(warnings) == 1


def test_a_graph_without_poses_is_refused() -> None:
    with pytest.raises(GraphError, match="1 keyframes"):
        build_graph(replace(DRIVE.keyframes, stamp_ns=DRIVE.keyframes.stamp_ns[:1]), np.zeros((0, 6, 6)), None)


@pytest.mark.parametrize("seed", range(20))
def test_parts_are_what_can_be_reached(seed: int) -> None:
    random = np.random.default_rng(seed)
    n = int(random.integers(1, 40))
    a, b = random.integers(0, n, (2, int(random.integers(0, n))))
    reached = np.eye(n, dtype=bool)
    reached[a, b] = reached[b, a] = True
    for middle in range(n):  # Warshall 1962
        reached |= reached[:, middle, None] & reached[middle]
    first = reached.argmax(1)
    np.testing.assert_array_equal(parts(n, a, b), np.searchsorted(np.unique(first), first))


def test_information_is_repaired_only_where_it_has_to_be() -> None:
    """The bound that spares the eigenvalues of most edges never spares one that is poor."""
    random = np.random.default_rng(0)
    edges = len(DRIVE.graph.a)
    turn = np.linalg.qr(random.normal(size=(edges, 6, 6)))[0]
    values = 10.0 ** random.uniform(-3, 3, (edges, 6))
    poor = random.random(edges) < 0.3
    values[poor, 0] = -1e-3 * values[poor].max(1)
    information = turn * values[:, None] @ np.swapaxes(turn, 1, 2)
    information[~np.isfinite(information)] = 0.0
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    good = (diagonal > 0).all(1)
    information[~good], poor = np.eye(6), poor & good
    fixed, _ = checked(replace(DRIVE.graph, information=information))
    changed = (fixed.information != information).any((1, 2))
    scale = np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    least = np.linalg.eigvalsh(information / scale[:, :, None] / scale[:, None, :])[:, 0]
    np.testing.assert_array_equal(changed, least < 1e-12)
    assert changed.sum() == poor.sum() > 3
    assert (np.linalg.eigvalsh(fixed.information)[:, 0] > 0).all()
