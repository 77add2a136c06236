from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.loops.scene import NOISE_PX, Scene, camera, keyframes, pose, scene, view
from vplog.features.matching import MatchSettings, PairMatches
from vplog.geometry import se3
from vplog.loops import landmarks, undistort
from vplog.loops.landmarks import LandmarkSettings, landmarks_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.data import Camera, Features, Floats

EXACT = LandmarkSettings(pixel_sigma=NOISE_PX)


def matched(features: Callable[[int], Features]) -> tuple[int, PairMatches]:
    return MatchSettings().features, PairMatches(features, MatchSettings())


def truth_of(place: Scene, world_from_body: np.ndarray, lens: Camera, features: Features) -> np.ndarray:
    """(M,) true inverse depth of each feature by its descriptor, NaN for clutter."""
    seen = se3.transform(se3.inverse(world_from_body @ lens.body_from_camera), place.points)
    pixels = undistort.project(lens, seen)
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(features.points[:, None] - pixels[None], axis=2)
    distance[:, ~(seen[:, 2] > 1.0)] = np.inf
    nearest = distance.argmin(axis=1)
    apart = np.abs(features.descriptors.astype(int) - place.descriptors[nearest].astype(int)).max(axis=1)
    return np.where(apart <= 8, 1.0 / seen[nearest, 2], np.nan)


@pytest.mark.parametrize("model", [("none", []), ("plumb_bob", [-0.2, 0.05, 1e-3, 0.0]), ("equidistant", [0.01] * 4)])
def test_triangulated_depths_are_as_good_as_they_claim(model: tuple[str, list[float]]) -> None:
    rng = np.random.default_rng(3)
    lens, place = camera(*model), scene(rng)
    poses = [pose(1.5 * i, 0.1 * i, yaw=0.02 * i) for i in range(5)]
    views = [view(place, p, lens, rng) for p in poses]
    # the odometry errs; the window's bundle adjustment has to make up for it
    noisy = [p @ se3.exp(np.concatenate([rng.normal(0, 0.003, 3), rng.normal(0, 0.01, 3)])) for p in poses]
    found = landmarks_of(2, keyframes(noisy), lens, views.__getitem__, *matched(views.__getitem__), EXACT)
    assert not found.from_depth
    assert found.known.sum() > 200
    true = truth_of(place, poses[2], lens, views[2])
    judged = found.known & np.isfinite(true)
    assert judged.sum() > 0.95 * found.known.sum()  # clutter seldom becomes a landmark
    error = (found.rho[judged] - true[judged]) / np.sqrt(found.covariance[judged, 2, 2])
    assert 0.6 < np.median(np.abs(error)) / 0.6745 < 1.5  # the median of |normal| is 0.6745 sigma
    assert np.median(np.abs(found.rho[judged] / true[judged] - 1)) < 0.03


@pytest.mark.parametrize("moved", [0.0, 1e-4])
def test_a_camera_that_stands_still_knows_no_depth(moved: float) -> None:
    rng = np.random.default_rng(4)
    lens, place = camera(), scene(rng)
    poses = [pose(moved * i) for i in range(5)]
    views = [view(place, p, lens, rng) for p in poses]
    found = landmarks_of(2, keyframes(poses), lens, views.__getitem__, *matched(views.__getitem__), EXACT)
    assert found.tracked > 100
    assert found.known.sum() < 0.05 * found.tracked


def test_a_turn_on_the_spot_knows_no_depth() -> None:
    rng = np.random.default_rng(5)
    lens, place = camera(), scene(rng)
    swing = se3.inverse(lens.body_from_camera)
    poses = [lens.body_from_camera @ se3.exp(np.array([0, 0.05 * i, 0, 0, 0, 0])) @ swing for i in range(5)]
    views = [view(place, p, lens, rng) for p in poses]
    found = landmarks_of(2, keyframes(poses), lens, views.__getitem__, *matched(views.__getitem__), EXACT)
    assert found.tracked > 100
    assert found.known.sum() < 0.05 * found.tracked


def test_a_lone_keyframe_has_no_landmarks() -> None:
    rng = np.random.default_rng(6)
    lens = camera()
    seen = view(scene(rng), pose(0), lens, rng)
    found = landmarks_of(0, keyframes([pose(0)]), lens, lambda _: seen, *matched(lambda _: seen), EXACT)
    assert found.tracked == 0
    assert not found.known.any()
    assert np.isnan(found.rho).all()


def test_depth_has_the_sensors_noise() -> None:
    depth = np.array([0.5, 2.0, 8.0, np.nan, 0.0, -1.0, np.inf, 1e9])
    found = landmarks.from_depth(np.zeros((8, 2)), depth, camera(), LandmarkSettings(depth_share=0.0))
    np.testing.assert_array_equal(found.known, [True] * 3 + [False] * 5)
    sigma_z = np.sqrt(found.covariance[:3, 2, 2]) * depth[:3] ** 2
    np.testing.assert_allclose(sigma_z, 1.425e-3 * depth[:3] ** 2)
    assert found.tracked == 3
    assert found.from_depth


def test_derivatives_agree_with_differences() -> None:
    rng = np.random.default_rng(7)
    views = se3.exp(rng.normal(0, 0.1, (3, 6)))
    points = np.column_stack([rng.uniform(-0.5, 0.5, (4, 2)), rng.uniform(0.05, 0.5, 4)])

    def linearised(points: Floats, views: Floats) -> tuple[Floats, Floats, Floats]:
        error, by_point, by_view = np.zeros((3, 4, 2)), np.zeros((3, 4, 2, 3)), np.zeros((3, 4, 2, 6))
        for v, m in np.ndindex(3, 4):
            assert landmarks._linearise(points[m], np.zeros(2), views[v], error[v, m], by_point[v, m], by_view[v, m])
        return error, by_point, by_view

    residual, by_point, by_view = linearised(points, views)
    step = 1e-6
    for axis in range(3):
        moved, _, _ = linearised(points + step * np.eye(3)[axis], views)
        np.testing.assert_allclose(by_point[..., axis], (moved - residual) / step, atol=1e-5)
    for axis in range(6):
        moved, _, _ = linearised(points, views @ se3.exp(step * np.eye(6)[axis]))
        np.testing.assert_allclose(by_view[..., axis], (moved - residual) / step, atol=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.9])
def test_a_few_depths_do_not_replace_the_landmarks_by_motion(share: float) -> None:
    """In sunlight a depth camera measures a few of hundreds of features."""
    rng = np.random.default_rng(3)
    place, lens = scene(rng), camera()
    poses = [pose(0.4 * step) for step in range(5)]
    seen = [view(place, one, lens, rng) for one in poses]
    depth_m = np.full(len(seen[2].points), np.nan, np.float32)
    depth_m[: round(share * len(depth_m))] = 5.0
    seen[2] = replace(seen[2], depth_m=depth_m)
    found = landmarks_of(2, keyframes(poses), lens, seen.__getitem__, *matched(seen.__getitem__), EXACT)
    assert found.known.sum() > 30
    assert found.from_depth == (share > 0.5)
