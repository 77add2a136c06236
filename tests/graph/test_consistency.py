from __future__ import annotations

from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import pytest
from scipy.special import chdtr, gammaincinv

from tests.graph.drive import ring
from tests.graph.gtsam_graph import edge_factors
from vplog.data import EdgeKind
from vplog.geometry import se3
from vplog.graph.consistency import (
    chi2_quantile,
    is_loop,
    residual_before,
    residual_sigma,
)
from vplog.graph.solve import GncSettings, decided


def test_chi2_agrees_with_gtsam() -> None:
    drive = ring(40, 10)
    random = np.random.default_rng(3)
    root = random.normal(size=(len(drive.graph.a), 6, 6))
    graph = replace(drive.graph, information=root @ np.swapaxes(root, 1, 2) + np.eye(6))
    poses = drive.true @ se3.exp(random.normal(size=(40, 6)) * 0.5)
    values = gtsam.Values()
    for node, pose in enumerate(poses):
        values.insert(node, gtsam.Pose3(pose))
    expected = [2.0 * factor.error(values) for factor in edge_factors(graph)]
    np.testing.assert_allclose(residual_sigma(graph, poses) ** 2, expected, rtol=1e-8)


def test_information_is_in_the_frame_of_b_rotation_first() -> None:
    graph = ring(10, 1, noise=0.0).graph
    information = np.array(graph.information)
    information[-1] = np.diag([1.0, 4.0, 9.0, 16.0, 25.0, 36.0])
    graph = replace(graph, information=information)
    for axis in range(6):
        poses = np.array(graph.world_from_body)
        poses[graph.b[-1]] = poses[graph.b[-1]] @ se3.exp(1e-3 * np.eye(6)[axis])
        assert residual_sigma(graph, poses)[-1] == pytest.approx(1e-3 * (axis + 1), rel=1e-5)


def test_distance_to_the_odometry_agrees_with_a_walk_along_the_chain() -> None:
    graph = ring(50, 8, false=3).graph
    result = residual_before(graph)
    assert (result[:49] == 0).all()
    for edge in range(49, len(graph.a)):
        a, b = int(graph.a[edge]), int(graph.b[edge])
        covariance = np.zeros((6, 6))
        for k in range(a, b):
            moved = se3.adjoint(se3.inverse(graph.a_from_b[k]))
            covariance = moved @ covariance @ moved.T + np.linalg.inv(graph.information[k])
        covariance += np.linalg.inv(graph.information[edge])
        odometry = se3.between(graph.world_from_body[a], graph.world_from_body[b])
        error = se3.log(se3.between(graph.a_from_b[edge], odometry))
        assert result[edge] == pytest.approx(np.sqrt(error @ np.linalg.solve(covariance, error)), rel=1e-6)


def test_distance_to_the_odometry_is_chi_square() -> None:
    chi2 = np.concatenate([residual_before(ring(60, 1, seed=seed).graph)[-1:] ** 2 for seed in range(150)])
    from scipy.stats import kstest  # a second to load

    assert kstest(chi2, partial(chdtr, 6)).pvalue > 1e-3


def test_distance_does_not_depend_on_where_the_odometry_starts() -> None:
    graph = ring(50, 8).graph
    far = se3.pose(se3.so3_exp(np.array([0.0, 0.0, 1.0])), np.array([5e5, 5e6, 0.0]))
    moved = residual_before(replace(graph, world_from_body=far @ graph.world_from_body))
    np.testing.assert_allclose(moved, residual_before(graph), rtol=1e-4)


def test_distance_is_unknown_across_a_gap() -> None:
    graph = ring(50, 8).graph
    kind = list(graph.kind)
    kind[20] = EdgeKind.LOOP
    result = residual_before(replace(graph, kind=kind))
    across = (graph.a <= 20) & (graph.b > 20)
    np.testing.assert_array_equal(np.isnan(result), across)


def test_noise_told_a_little_too_small_costs_no_closures_in_large_graphs() -> None:
    graph = ring(3000, 600, seed=1).graph
    odometry = ~is_loop(graph)
    information = np.where(odometry[:, None, None], graph.information * 1.3**2, graph.information)
    sure = replace(graph, information=information)
    assert decided(sure, GncSettings()).solution.weight[~odometry].sum() > 0.97 * (~odometry).sum()


@pytest.mark.parametrize("dof", [6, 60, 6000])
@pytest.mark.parametrize("probability", [0.9, 0.99, 0.9999, 0.999999])
def test_quantiles_agree_with_scipy(dof: int, probability: float) -> None:
    assert chi2_quantile(probability, dof) == pytest.approx(2 * gammaincinv(dof / 2, probability), rel=1e-8)
