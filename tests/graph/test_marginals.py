"""The covariance of solved poses is that of their errors, and GTSAM's."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy.special import chdtri

from tests.graph.drive import ring
from tests.graph.gtsam_graph import as_values, weighted
from vplog.geometry import se3
from vplog.graph.factors import Factors
from vplog.graph.least_squares import Objective, Positions, minimised
from vplog.graph.marginals import SharedScale, pose_covariances, relative_covariances

WORLDS = 200


@pytest.mark.parametrize("shared", [(), (0.02, 0.05), (0.02, 0.05, 0.03)])
def test_mean_nees_over_many_worlds_is_within_its_interval(shared: tuple[float, ...]) -> None:
    """One keyframe of each, relative to another one. The worlds are independent, so that their sum is chi-square
    distributed with 6 degrees of freedom each.

    The metric scales of the odometry and of the closures have these standard deviations, as the odometry's turns do.
    """
    random, total = np.random.default_rng(0), 0.0
    for seed in range(WORLDS):
        drive = ring(14, 4, seed=seed)
        a_from_b, odometry = drive.graph.a_from_b.copy(), drive.graph.odometry
        kinds = (odometry, False), (~odometry, False), (odometry, True)
        scales = [
            SharedScale(edges, sigma, of_rotation) for (edges, of_rotation), sigma in zip(kinds, shared, strict=False)
        ]
        for edges, sigma, of_rotation in scales:
            factor = 1.0 + sigma * random.normal()
            if of_rotation:
                a_from_b[edges, :3, :3] = se3.so3_exp(factor * se3.so3_log(a_from_b[edges, :3, :3]))
            else:
                a_from_b[edges, :3, 3] *= factor
        graph = replace(drive.graph, a_from_b=a_from_b)
        objective = Objective(Factors.of(graph), np.ones(len(graph.a)))
        poses = minimised(objective, graph.world_from_body, 20, 1e-9).world_from_body
        reference, row = random.choice(14, 2, replace=False)
        both = [se3.between(one[[reference]], one[[row]]) for one in (poses, drive.true)]
        [covariance] = relative_covariances(objective, poses, [reference], scales)
        total += float(se3.mahalanobis2(se3.log(se3.between(*both)), covariance[[row]])[0])
    low, high = chdtri(6 * WORLDS, [0.995, 0.005]) / (6 * WORLDS)
    assert low < total / (6 * WORLDS) < high


def test_covariances_relative_to_a_pose_are_those_of_a_graph_that_starts_there() -> None:
    drive = ring(30, 6, seed=1)
    graph, odometry, weight = drive.graph, drive.graph.odometry, np.ones(len(drive.graph.a))
    scales = [SharedScale(odometry, 0.02), SharedScale(~odometry, 0.05), SharedScale(odometry, 0.03, True)]
    swapped = np.arange(30)
    swapped[[0, 17]] = 17, 0
    a, b = (swapped[ends].astype(np.int32) for ends in (graph.a, graph.b))
    started = replace(graph, world_from_body=graph.world_from_body[swapped], a=a, b=b)
    expected = pose_covariances(Objective(Factors.of(started), weight), drive.true[swapped], scales)[swapped]
    objective = Objective(Factors.of(graph), weight)
    first, found = relative_covariances(objective, drive.true, [0, 17], scales)
    np.testing.assert_allclose(found, expected, atol=1e-8)
    np.testing.assert_allclose(first, pose_covariances(objective, drive.true, scales), atol=1e-8)


def test_shared_scales_come_back_from_their_records() -> None:
    for edges in ([True, True, False, True, False], [False, False, True], [True], []):
        scale = SharedScale(np.array(edges, bool), 0.02, True)
        found = SharedScale.of(scale.record(), len(edges))
        np.testing.assert_array_equal(found.edges, edges)
        assert found[1:] == scale[1:]


def test_covariances_are_those_of_gtsam() -> None:
    """Edges of no weight are left out."""
    drive = ring(60, 12, seed=3)
    weight = np.ones(len(drive.graph.a))
    weight[-5:] = 0.0
    objective = Objective(Factors.of(drive.graph), weight)
    poses = minimised(objective, drive.graph.world_from_body, 20, 1e-9).world_from_body
    scaled = pose_covariances(objective, poses, [SharedScale(np.ones(len(weight), bool), 0.02)])
    found = pose_covariances(objective, poses)
    away = se3.between(poses, poses[:1])[:, :3, 3]  # from the first pose, all metres being wrong alike
    np.testing.assert_allclose((scaled - found)[:, 3:, 3:], 0.02**2 * away[:, :, None] * away[:, None], atol=2e-3)
    assert not found[0].any()
    marginals = gtsam.Marginals(weighted(drive.graph, weight), as_values(se3.between(poses[:1], poses), 3))
    expected = np.array([marginals.marginalCovariance(node) for node in range(60)])
    np.testing.assert_allclose(found[1:], expected[1:], rtol=1e-3, atol=1e-9)


def test_poses_that_no_edge_joins_with_the_first_have_none() -> None:
    drive = ring(20, 0)
    weight = np.where(drive.graph.b == 12, 0.0, 1.0)
    graph = replace(drive.graph, kind=[*drive.graph.kind])
    factors = replace(Factors.of(graph), piece=(np.arange(20) >= 12).astype(np.int64))
    found = pose_covariances(Objective(factors, weight), drive.true)
    assert np.isfinite(found[:12]).all()
    assert np.isnan(found[12:]).all()


def test_measured_positions_bound_the_sigma_of_every_pose() -> None:
    drive = ring(30, 0)
    rows, sigma = np.arange(30), 0.1
    at = se3.between(drive.true[:1], drive.true)[:, :3, 3]
    positions = Positions(rows, np.zeros((30, 3)), at, np.tile(np.eye(3) / sigma**2, (30, 1, 1)))
    objective = Objective(Factors.of(drive.graph), np.ones(29), positions=positions)
    sigmas = np.sqrt(np.diagonal(pose_covariances(objective, drive.true), axis1=1, axis2=2)[:, 3:])
    assert (sigmas < sigma).all()
    assert (sigmas[0] > 0.01).all()  # the first, too, is known by the fixes alone
