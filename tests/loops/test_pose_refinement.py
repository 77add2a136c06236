"""The least squares behind a closure: derivatives, and the best pose of noisy matches."""

from __future__ import annotations

import numpy as np
import pytest

from vplog.geometry import se3
from vplog.loops import pose_refinement
from vplog.loops.pose_refinement import LandmarkMatches


def landmarks(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), rng.uniform(0.1, 0.5, count)])


def of_rays(sigma: float, count: int) -> np.ndarray:
    return np.tile(sigma**2 * np.eye(2), (count, 1, 1))


def image_only(points: np.ndarray, covariance: np.ndarray, seen: np.ndarray) -> LandmarkMatches:
    """Landmarks whose depth the query did not measure, each ray with a standard deviation of 1e-3."""
    unknown = np.full(len(points), np.nan)
    return LandmarkMatches(points, covariance, seen, of_rays(1e-3, len(points)), unknown, unknown)


def predict(match_from_query: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(x, y, rho) in the query, and the derivatives by pose and landmark."""
    back = se3.inverse(match_from_query)
    here, by_pose, by_point = np.empty((len(points), 3)), np.empty((len(points), 3, 6)), np.empty((len(points), 3, 3))
    for row, point in enumerate(points):
        assert pose_refinement._predict(back, point, here[row], by_point[row], by_pose[row])
    return here, by_pose, by_point


def test_derivatives_agree_with_differences() -> None:
    rng = np.random.default_rng(8)
    at, points, step = se3.exp(rng.normal(0, 0.1, 6)), landmarks(rng, 4), 1e-6
    here, by_pose, by_point = predict(at, points)
    metric = np.column_stack([points[:, :2], np.ones(4)]) / points[:, 2:]
    seen = se3.transform(se3.inverse(at), metric)
    np.testing.assert_allclose(here, np.column_stack([seen[:, :2], np.ones(4)]) / seen[:, 2:], atol=1e-12)
    for axis in range(6):
        moved, _, _ = predict(at @ se3.exp(step * np.eye(6)[axis]), points)
        np.testing.assert_allclose(by_pose[..., axis], (moved - here) / step, atol=1e-5)
    for axis in range(3):
        moved, _, _ = predict(at, points + step * np.eye(3)[axis])
        np.testing.assert_allclose(by_point[..., axis], (moved - here) / step, atol=1e-5)


@pytest.mark.parametrize("deep", [False, True])
def test_the_pose_is_found_and_its_covariance_is_that_of_its_errors(deep: bool) -> None:
    rng = np.random.default_rng(3)
    sigma, rho_sigma, errors = 1e-3, 2e-3, []
    for _ in range(60):
        points, true = landmarks(rng, 40), se3.exp(rng.normal(0, 0.1, 6))
        exact, _, _ = predict(true, points)
        seen = exact[:, :2] + rng.normal(0, sigma, (40, 2))
        rho = exact[:, 2] + rng.normal(0, rho_sigma, 40) if deep else np.full(40, np.nan)
        start = true @ se3.exp(rng.normal(0, 0.02, 6))
        matches = LandmarkMatches(
            points, np.zeros((40, 3, 3)), seen, of_rays(sigma, 40), rho, np.full(40, rho_sigma**2)
        )
        found, hessian, excess = pose_refinement.fit(start, matches)
        error = se3.log(se3.between(true, found))
        errors.append(error @ hessian @ error / 6)
        assert 0.4 < excess < 1.6
    assert 0.7 < np.mean(errors) < 1.5


def test_a_landmark_explained_by_its_own_uncertainty_agrees() -> None:
    points, seen = np.array([[0.1, 0.0, 0.5]]), np.array([[0.11, 0.0]])
    for variance, near in ((0.0, False), (1e-4, True)):
        covariance = np.diag([variance, variance, 0.0])[None]
        squared, alone = pose_refinement.agreement(np.eye(4), image_only(points, covariance, seen))
        assert (squared[0] < 9.21) == near
        assert alone[0] == pytest.approx(10.0**2)
    behind = se3.pose(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    assert np.isnan(pose_refinement.agreement(behind, image_only(points, np.zeros((1, 3, 3)), seen))[0]).all()


def test_landmarks_on_one_line_through_the_camera_leave_the_pose_where_it_was() -> None:
    points = np.column_stack([np.zeros((8, 2)), np.linspace(0.1, 0.5, 8)])
    found, hessian, _ = pose_refinement.fit(np.eye(4), image_only(points, np.zeros((8, 3, 3)), np.zeros((8, 2))))
    np.testing.assert_array_equal(found, np.eye(4))
    assert np.linalg.cond(hessian) > 1e12
