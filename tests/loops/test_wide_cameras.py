"""Pixel noise is the same all over a fisheye's image, and what is made of it too."""

from __future__ import annotations

import numpy as np
import pytest

from vplog.data import Camera, Features
from vplog.geometry import se3
from vplog.loops import pose_refinement, undistort, verify_metric
from vplog.loops.landmarks import LandmarkSettings, from_depth
from vplog.loops.verify_metric import MetricSettings, Pose

NOISE = LandmarkSettings(depth_range_m=1e3)
ALONE = MetricSettings(systematic_px=0.0)
"""The made-up cameras have no error that matches share."""
PAIRS = 40


def lens(model: str, half_view_deg: float) -> Camera:
    wide = np.radians(half_view_deg)
    focal = 500.0 / (wide if model == "equidistant" else np.tan(wide))
    matrix = np.array([[focal, 0.0, 500.0], [0.0, focal, 500.0], [0.0, 0.0, 1.0]])
    return Camera("front", matrix, model, np.zeros(4 if model == "equidistant" else 0), 1000, 1000, np.eye(4))


def verified(camera: Camera, half_view_deg: float, seed: int) -> tuple[Pose, float, np.ndarray, np.ndarray]:
    """The pose of a pair whose matches are all true, its normalised error squared, and of its matches the angle off the
    axis and whether they are within the gate."""
    random, count = np.random.default_rng(seed), 300
    angle, around = np.radians(random.uniform(1, half_view_deg, count)), random.uniform(0, 2 * np.pi, count)
    bearing = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], axis=1)
    points = bearing * random.uniform(3, 15, count)[:, None]
    truth = se3.exp(random.normal(size=6) * np.repeat([0.03, 0.2], 3))
    seen = se3.transform(se3.inverse(truth), points)
    here, there = (
        undistort.rays(camera, undistort.project(camera, one) + random.normal(0, NOISE.pixel_sigma, (count, 2)))
        for one in (points, seen)
    )
    rho = 1.0 / points[:, 2] + random.normal(0, np.sqrt(NOISE.depth_sigma**2 + (NOISE.depth_share / points[:, 2]) ** 2))
    landmarks = from_depth(here, 1.0 / rho, camera, NOISE)
    rows = np.flatnonzero(landmarks.known & np.isfinite(there).all(1))
    unknown = np.full(len(rows), np.nan, np.float32)
    px, nothing = undistort.project(camera, seen)[rows].astype(np.float32), np.zeros((len(rows), 128), np.uint8)
    query = Features(px, unknown, nothing, unknown, camera.width, camera.height)
    matches = verify_metric.observe(landmarks, rows, there[rows], unknown, camera, NOISE)
    pose = verify_metric.solve(landmarks, rows, query, there[rows], camera, NOISE, ALONE)
    assert pose.match_from_query is not None
    assert pose.covariance is not None
    distance, _ = pose_refinement.agreement(pose.match_from_query, matches)
    error = se3.log(se3.between(truth, pose.match_from_query))
    off_axis = np.degrees(np.arctan(np.hypot(*there[rows].T)))
    return pose, float(error @ np.linalg.solve(pose.covariance, error)), off_axis, distance < verify_metric.CHI2_2


@pytest.mark.parametrize(("model", "half_view_deg"), [("none", 40.0), ("equidistant", 40.0), ("equidistant", 85.0)])
def test_true_matches_are_inside_the_gate_at_every_angle(model: str, half_view_deg: float) -> None:
    """99 % of them, and the squared error of the pose is as large as its covariance says."""
    camera = lens(model, half_view_deg)
    found = [verified(camera, half_view_deg, seed) for seed in range(PAIRS)]
    angle, inside = np.concatenate([one[2] for one in found]), np.concatenate([one[3] for one in found])
    for low, high in ((0, 30), (30, 50), (50, 70), (70, 90)):
        there = (angle >= low) & (angle < high)
        assert not there.any() or 0.975 < inside[there].mean() <= 1.0
    # chi-square of 240 degrees of freedom over their number: 99 % lie within .77 and 1.25
    assert 0.7 < np.mean([one[1] for one in found]) / 6.0 < 1.3


def test_the_noise_of_a_ray_is_that_of_pixels_through_the_lens() -> None:
    camera, random = lens("equidistant", 85.0), np.random.default_rng(0)
    for angle in np.radians([0.1, 40.0, 75.0]):
        pixel = np.array([500.0 + camera.matrix[0, 0] * angle, 500.0]) if camera.matrix is not None else np.zeros(2)
        rays = undistort.rays(camera, pixel + random.normal(0, 0.5, (4000, 2)))
        expected = undistort.noise_of_rays(camera, undistort.rays(camera, pixel[None]), 0.5)[0]
        ratio = np.linalg.solve(expected, np.cov(rays.T))
        np.testing.assert_allclose(np.linalg.eigvals(ratio), 1.0, atol=0.12)
