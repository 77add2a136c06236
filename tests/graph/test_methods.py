"""Every method behind the one seam, on spatial and planar drives with false closures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from pydantic import TypeAdapter

from tests.benchmarks.graphs import aligned_error, city, spoiled, with_groups
from tests.graph.drive import position_error, ring, without_loops
from tests.graph.gtsam_graph import as_values, edge_factors
from vplog.data import EdgeKind, PoseGraph
from vplog.geometry import se3
from vplog.graph.consistency import is_loop, odometry_chain, residual_before, residual_sigma
from vplog.graph.factors import Factors
from vplog.graph.gnc import GncSettings
from vplog.graph.lm import LmSettings
from vplog.graph.solve import OptimiserSettings, decided

UNION = get_args(get_args(OptimiserSettings)[0])
METHODS = [settings() for settings in UNION]
ROBUST = [method for method in METHODS if method.kind != "lm"]
CITY = city(300, seed=3)
BEST = LmSettings()(CITY)

each_method = pytest.mark.parametrize("method", METHODS, ids=lambda method: method.kind)
each_robust = pytest.mark.parametrize("method", ROBUST, ids=lambda method: method.kind)


def test_the_seam_has_all_methods() -> None:
    assert {method.kind for method in METHODS} == {"gnc", "pcm", "dcs", "cauchy", "geman_mcclure", "lm"}
    for method in METHODS:
        assert TypeAdapter(OptimiserSettings).validate_python({"kind": method.kind}) == method


@each_method
def test_clean_graphs_are_solved_alike(method: Any) -> None:
    drive = ring(loops=12)
    for graph, best in ((CITY, BEST), (drive.graph, LmSettings()(drive.graph))):
        solution = method(graph)
        assert solution.converged
        assert solution.weight.min() >= 0
        assert solution.weight.max() <= 1
        np.testing.assert_array_equal(solution.world_from_body[0], graph.world_from_body[0])
        # a robust kernel may weigh what a true closure is off, and one in a hundred may go
        assert aligned_error(solution.world_from_body, best.world_from_body) < 0.1


@each_robust
@pytest.mark.parametrize("seed", range(2))
def test_false_closures_are_found(method: Any, seed: int) -> None:
    graph, false = spoiled(CITY, 0.3, seed)
    solution = method(graph)
    loops = is_loop(graph)
    assert (solution.weight[false] > 0.5).sum() <= 1  # one may lie where it could be true
    assert (solution.weight[loops & ~false] > 0.5).mean() > 0.9
    assert aligned_error(solution.world_from_body, BEST.world_from_body) < 0.25
    drive = ring(loops=20, false=8, seed=seed)
    solution = method(drive.graph)
    assert (solution.weight[drive.false] < 0.5).all()
    assert position_error(solution.world_from_body, drive.true) < 1.0


@pytest.mark.parametrize(("share", "scale"), [(0.5, 1.0), (0.8, 1.0), (0.5, 100.0)])
def test_gnc_survives_many_false_closures(share: float, scale: float) -> None:
    graph, false = spoiled(CITY, share, seed=1)
    graph = replace(graph, information=graph.information / scale)
    solution = decided(graph, GncSettings()).solution
    assert solution.weight[false].sum() <= 1
    assert (solution.weight[is_loop(graph) & ~false] > 0.5).mean() > 0.9
    assert aligned_error(solution.world_from_body, BEST.world_from_body) < 0.5


@pytest.mark.parametrize("size", [5, 20])
def test_gnc_survives_closures_that_agree_on_what_is_false(size: int) -> None:
    graph, false = with_groups(CITY, BEST.world_from_body, 2, size, seed=size)
    solution = GncSettings()(graph)
    assert solution.weight[false].sum() == 0
    assert aligned_error(solution.world_from_body, BEST.world_from_body) < 0.05


@each_method
def test_without_closures_odometry_comes_back(method: Any) -> None:
    graph = without_loops(CITY)
    np.testing.assert_allclose(method(graph).world_from_body, odometry_chain(graph)[0], atol=1e-9)


@each_method
def test_far_from_the_origin_the_shape_is_the_same(method: Any) -> None:
    graph, _ = spoiled(CITY, 0.2, 0)
    utm = se3.pose(se3.so3_exp(np.array([0.0, 0.0, 1.0])), np.array([5e5, 5.3e6, 0.0]))
    moved = method(replace(graph, world_from_body=utm @ graph.world_from_body))
    expected = utm @ method(graph).world_from_body
    np.testing.assert_allclose(moved.world_from_body[:, :2, 3], expected[:, :2, 3], atol=1e-4)


def test_planar_residuals_agree_with_gtsam() -> None:
    random = np.random.default_rng(0)
    root = random.normal(size=(len(CITY.a), 3, 3))
    information = np.zeros((len(CITY.a), 6, 6))
    information[:, 2:5, 2:5] = root @ np.swapaxes(root, 1, 2) + np.eye(3)
    graph = replace(CITY, information=information)
    poses = graph.world_from_body @ se3.exp(random.normal(size=(300, 6)) * [0, 0, 0.7, 1, 1, 0])
    values = as_values(poses, 2)
    expected = [2.0 * factor.error(values) for factor in edge_factors(graph)]
    np.testing.assert_allclose(residual_sigma(graph, poses) ** 2, expected, rtol=1e-9)


def test_the_planar_solution_is_the_spatial_one_held_in_the_plane() -> None:
    information = np.array(CITY.information)
    information[:, [0, 1, 5], [0, 1, 5]] = 1e4
    spatial = LmSettings()(replace(CITY, information=information, dimension=3))
    np.testing.assert_allclose(spatial.world_from_body, BEST.world_from_body, atol=1e-4)


def test_odometry_may_be_written_either_way_round() -> None:
    graph = ring(40, 6, false=2).graph
    turn = np.arange(len(graph.a)) % 2 == 1
    moved = se3.adjoint(graph.a_from_b)  # the noise is told in the frame of the end, which now is the start
    covariance = moved @ np.linalg.inv(graph.information) @ np.swapaxes(moved, 1, 2)
    mixed = replace(
        graph,
        a=np.where(turn, graph.b, graph.a),
        b=np.where(turn, graph.a, graph.b),
        a_from_b=np.where(turn[:, None, None], se3.inverse(graph.a_from_b), graph.a_from_b),
        information=np.where(turn[:, None, None], np.linalg.inv(covariance), graph.information),
    )
    true = ~ring(40, 6, false=2).false  # covariances are to first order: what is 300 sigma off differs by a tenth
    np.testing.assert_allclose(residual_before(mixed)[true], residual_before(graph)[true], rtol=0.05)
    for method in (GncSettings(), LmSettings()):
        np.testing.assert_allclose(method(mixed).world_from_body, method(graph).world_from_body, atol=0.02)


def two_robots(seed: int, false: int) -> tuple[PoseGraph, np.ndarray, np.ndarray]:
    """Two drives of one city that know nothing of each other's start, and closures between them."""
    random = np.random.default_rng(seed)
    first, second = city(120, seed=10), city(120, seed=11)
    shift = se3.exp(np.array([0.0, 0.0, 2.0, 30.0, 10.0, 0.0]))
    true = np.concatenate([LmSettings()(one).world_from_body for one in (first, second)])
    a = random.integers(0, 120, 12 + false)
    b = random.integers(120, 240, 12 + false)
    measured = se3.between(true[a], true[b])
    measured[12:] = measured[12:] @ se3.exp(random.normal(size=(false, 6)) * [0, 0, 1, 5, 5, 0])
    graph = PoseGraph(
        np.concatenate([first.world_from_body, shift @ second.world_from_body]),
        np.concatenate([first.a, second.a + 120, a]).astype(np.int32),
        np.concatenate([first.b, second.b + 120, b]).astype(np.int32),
        np.concatenate([first.a_from_b, second.a_from_b, measured]),
        np.concatenate([first.information, second.information, first.information[: 12 + false]]),
        first.kind + second.kind + [EdgeKind.LOOP] * (12 + false),
        2,
    )
    wrong = np.arange(len(graph.a)) >= len(graph.a) - false
    return graph, wrong, true


@pytest.mark.parametrize("kind", ["gnc", "pcm"])
@pytest.mark.parametrize("seed", range(3))
def test_two_robots_are_joined_by_what_agrees(kind: str, seed: int) -> None:
    graph, false, true = two_robots(seed, false=8)
    solution = TypeAdapter(OptimiserSettings).validate_python({"kind": kind})(graph)
    assert solution.weight[false].sum() == 0
    assert aligned_error(solution.world_from_body, true) < 0.2


@pytest.mark.parametrize("kind", ["gnc", "pcm"])
def test_a_drive_that_nothing_believed_joins_stays_where_it_is(kind: str) -> None:
    graph, _, _ = two_robots(0, false=0)
    across = (graph.a < 120) & (graph.b >= 120)
    one = np.flatnonzero(~across).tolist() + np.flatnonzero(across)[:1].tolist()
    cut = replace(
        graph,
        a=graph.a[one],
        b=graph.b[one],
        a_from_b=graph.a_from_b[one],
        information=graph.information[one],
        kind=[graph.kind[edge] for edge in one],
    )
    factors = Factors.of(cut)
    weight = np.ones(len(cut.a))
    weight[-1] = 0.0
    assert factors.loose(weight).tolist() == [120]
    np.testing.assert_array_equal(factors.loose(np.ones(len(cut.a))), [])
    solution = TypeAdapter(OptimiserSettings).validate_python({"kind": kind})(cut)
    assert solution.weight[-1] == 1  # it alone joins them, and nothing speaks against it
