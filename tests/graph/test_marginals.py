"""The covariance of solved poses is that of their errors, and GTSAM's."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy import stats

from tests.graph.drive import ring
from tests.graph.gtsam_graph import as_values, weighted
from vplog.geometry import se3
from vplog.graph.factors import Factors
from vplog.graph.least_squares import Objective, Positions, minimised
from vplog.graph.marginals import pose_covariances
from vplog.graph.sparse import linear

WORLDS = 200


def test_mean_nees_over_many_worlds_is_within_its_interval() -> None:
    """One keyframe of each, so that they are independent: their sum is chi-square distributed with 6 degrees each."""
    random, total = np.random.default_rng(0), 0.0
    for seed in range(WORLDS):
        drive = ring(14, 4, seed=seed)
        objective = Objective(Factors.of(drive.graph), np.ones(len(drive.graph.a)))
        poses = minimised(objective, drive.graph.world_from_body, 20, 1e-9).world_from_body
        row = int(random.integers(1, 14))
        first_from = [se3.between(one[:1], one[row : row + 1]) for one in (poses, drive.true)]
        covariance = pose_covariances(objective, poses)[row : row + 1]
        total += float(se3.mahalanobis2(se3.log(se3.between(*first_from)), covariance)[0])
    low, high = stats.chi2.interval(0.99, 6 * WORLDS) / np.array(6 * WORLDS)
    assert low < total / (6 * WORLDS) < high


@pytest.mark.parametrize("large", [False, True])
def test_covariances_are_those_of_gtsam(large: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its Bayes tree and by our supernodes; edges of no weight are left out."""
    monkeypatch.setattr(linear, "LARGE_POSES", 2 if large else 10**9)
    drive = ring(60, 12, seed=3)
    weight = np.ones(len(drive.graph.a))
    weight[-5:] = 0.0
    objective = Objective(Factors.of(drive.graph), weight)
    poses = minimised(objective, drive.graph.world_from_body, 20, 1e-9).world_from_body
    found = pose_covariances(objective, poses)
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
