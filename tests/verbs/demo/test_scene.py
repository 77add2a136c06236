"""The rendered street is seen as a real camera would see it: geometry, light, places told apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from vplog.geometry.se3 import angle, between, inverse, pose, so3_exp, transform
from vplog.verbs.demo import DemoSettings, route
from vplog.verbs.demo.scene import FIRST_LIGHT, LATER_LIGHT, Scene, make_scene, render, take_picture
from vplog.verbs.demo.world import traffic

if TYPE_CHECKING:
    from vplog.data import Bytes, Floats


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(DemoSettings())


def revisits(scene: Scene) -> list[tuple[int, int]]:
    """Frames of the second lap, each with the nearest frame of the first."""
    lap = int(route.lap_length(scene.settings) / scene.settings.speed_m_s * scene.settings.frame_rate_hz)
    at = scene.world_from_body[:, :3, 3]
    queries = range(lap + 6, len(at), 18)
    return [(query, int(np.argmin(np.linalg.norm(at[: lap - 10] - at[query], axis=1)))) for query in queries]


def two_view(scene: Scene, a: Bytes, b: Bytes) -> tuple[int, Floats | None]:
    """Inliers of the essential matrix between two images, and a_from_b with a translation of length 1."""
    assert scene.camera.matrix is not None
    sift = cv2.SIFT_create(1000)  # pyrefly: ignore[missing-attribute]
    (points_a, described_a), (points_b, described_b) = (sift.detectAndCompute(image, None) for image in (a, b))
    matcher = cv2.BFMatcher()
    back = {m.queryIdx: m.trainIdx for m in matcher.match(described_a, described_b)}
    ratio = [m for m, n in matcher.knnMatch(described_b, described_a, k=2) if m.distance < 0.8 * n.distance]
    pairs = [m for m in ratio if back[m.trainIdx] == m.queryIdx]
    if len(pairs) < 8:
        return 0, None
    in_b = np.array([points_b[m.queryIdx].pt for m in pairs])
    in_a = np.array([points_a[m.trainIdx].pt for m in pairs])
    essential, mask = cv2.findEssentialMat(in_b, in_a, scene.camera.matrix, cv2.RANSAC, 0.9999, 1.0)
    if essential is None or essential.shape != (3, 3):
        return 0, None
    _, rotation, direction, mask = cv2.recoverPose(essential, in_b, in_a, scene.camera.matrix, mask=mask)
    return int((mask > 0).sum()), pose(np.asarray(rotation, np.float64), np.asarray(direction[:, 0], np.float64))


def test_a_place_is_recognised_in_other_light_and_traffic_with_its_true_pose(scene: Scene) -> None:
    for query, match in revisits(scene):
        a, b = take_picture(scene, match)[0], take_picture(scene, query)[0]
        assert abs(float(a.mean()) - float(b.mean())) > 15  # grey levels: the light did change
        inliers, found = two_view(scene, a, b)
        assert inliers >= 40
        assert found is not None
        camera = scene.camera.body_from_camera
        truth = between(scene.world_from_body[match] @ camera, scene.world_from_body[query] @ camera)
        assert np.degrees(angle(between(found, truth))) < 2.5
        length = np.linalg.norm(truth[:3, 3])
        assert truth[:3, 3] @ found[:3, 3] / length > np.cos(np.radians(25))  # the step is short against the scene


def test_other_places_share_almost_nothing(scene: Scene) -> None:
    for a, b in ((0, 32), (8, 64), (44, 104), (56, 164)):
        inliers, _ = two_view(scene, take_picture(scene, a)[0], take_picture(scene, b)[0])
        assert inliers < 20, (a, b)


def test_the_same_place_seen_backwards_is_not_matched(scene: Scene) -> None:
    turned = scene.world_from_body[8] @ pose(so3_exp(np.array([0, 0, np.pi])), np.zeros(3))
    image, _ = render(scene.world, scene.camera, turned @ scene.camera.body_from_camera, LATER_LIGHT)
    inliers, _ = two_view(scene, take_picture(scene, 8)[0], image)
    assert inliers < 20


def test_every_frame_has_enough_to_hold_on_to(scene: Scene) -> None:
    sift = cv2.SIFT_create(1000)  # pyrefly: ignore[missing-attribute]
    for frame in range(0, len(scene.stamp_ns), 29):
        assert len(sift.detect(take_picture(scene, frame)[0], None)) >= 500


def test_depth_of_one_view_predicts_depth_and_brightness_of_the_next(scene: Scene) -> None:
    assert scene.camera.matrix is not None
    camera = scene.world_from_body[20:22] @ scene.camera.body_from_camera
    (image_a, depth_a), (image_b, depth_b) = (render(scene.world, scene.camera, c, FIRST_LIGHT) for c in camera)
    y, x = np.mgrid[4:356:3, 4:636:3]
    z = depth_a[y, x].astype(float)
    known = np.isfinite(z) & (z < 20)
    x, y, z = x[known], y[known], z[known]
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float64)
    points = pixels @ np.linalg.inv(scene.camera.matrix).T * z[:, None]
    in_b = transform(between(camera[1], camera[0]), points)
    front = in_b[:, 2] > 1
    pixel = (in_b[front] @ scene.camera.matrix.T)[:, :2] / in_b[front, 2:]
    inside = ((pixel > 1) & (pixel < (638, 358))).all(axis=1)
    u, v = np.round(pixel[inside]).astype(int).T
    same = np.abs(depth_b[v, u] - in_b[front, 2][inside]) < 0.15  # the rest is hidden in the other view
    assert same.mean() > 0.85
    grey_a, grey_b = image_a[y, x][front][inside][same], image_b[v, u][same]
    assert np.corrcoef(grey_a, grey_b)[0, 1] > 0.9


def test_depth_of_the_ground_is_where_the_ray_meets_z_0(scene: Scene) -> None:
    assert scene.camera.matrix is not None
    camera = scene.world_from_body[5] @ scene.camera.body_from_camera
    _, depth = render(scene.world, scene.camera, camera, FIRST_LIGHT)
    ray = camera[:3, :3] @ np.linalg.inv(scene.camera.matrix) @ np.array([320.0, 350.0, 1.0])
    assert depth[350, 320] == pytest.approx(-camera[2, 3] / ray[2], rel=1e-6)


def test_a_car_hides_what_is_behind_it(scene: Scene) -> None:
    camera = scene.world_from_body[0] @ scene.camera.body_from_camera
    empty, empty_depth = render(scene.world, scene.camera, camera, FIRST_LIGHT)
    busy, busy_depth = render(scene.world, scene.camera, camera, FIRST_LIGHT, traffic(scene.settings, 0.0))
    hidden = busy_depth < empty_depth
    assert hidden.sum() > 100
    assert np.array_equal(busy[~hidden], empty[~hidden])


def test_other_traffic_in_every_lap(scene: Scene) -> None:
    lap_s = route.lap_length(scene.settings) / scene.settings.speed_m_s
    first, second = (traffic(scene.settings, t).corner for t in (1.0, 1.0 + lap_s))
    assert len(first)
    assert first.shape != second.shape or not np.allclose(first, second)


def test_another_seed_is_another_street() -> None:
    small = {"block_length_m": 24.0, "block_width_m": 16.0, "corner_radius_m": 5.0, "width": 160, "height": 90}
    images = [take_picture(make_scene(DemoSettings(seed=seed, **small)), 0)[0] for seed in (1, 1, 2)]
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


def test_the_camera_looks_ahead_and_a_little_down(scene: Scene) -> None:
    mount = scene.camera.body_from_camera
    np.testing.assert_allclose(mount @ inverse(mount), np.eye(4), atol=1e-12)
    assert mount[0, 2] > 0.99  # its z along the body's x
    assert -0.1 < mount[2, 2] < 0
    assert mount[1, 0] == -1  # its x to the right
