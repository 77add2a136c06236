"""Metres of a single camera by its height over the ground: drawn landmarks, a rendered street, and no ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vplog.data import Camera, Floats, Frame, Odometry
from vplog.geometry import se3
from vplog.graph.noise import NoiseSettings, edge_covariance
from vplog.odometry.ground import Below, below, by_height
from vplog.odometry.metric_scale import without_scale
from vplog.odometry.visual import visual_odometry
from vplog.verbs.demo.scene import make_scene, take_picture
from vplog.verbs.demo.settings import DemoSettings

MOUNT = np.array([[0, 0, 1, 0.0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
CAMERA = Camera("camera", np.eye(3), "none", np.zeros(0), 640, 480, MOUNT)
VIEWS = 120


def drive(log_scale: Floats) -> Odometry:
    """A metre a frame straight on, in units of exp(log_scale) m."""
    poses = np.tile(np.eye(4), (VIEWS, 1, 1))
    poses[1:, 0, 3] = np.cumsum(np.exp(-log_scale[1:]))
    stamp_ns = np.arange(VIEWS, dtype=np.int64) * 10**8
    return Odometry(stamp_ns, poses, np.tile(np.eye(6), (VIEWS, 1, 1)), breaks=np.zeros(0, np.int64), metric=False)


def views(log_scale: Floats, height_m: float, clutter: float, seed: int) -> list[Below]:
    """Landmarks of a road seen by a camera that is pitched and rolled, and a share of things that stand on it."""
    rng = np.random.default_rng(seed)
    tilted, found = se3.so3_exp(rng.normal(0.0, 0.02, 3)), list[Below]()
    for row, scale in enumerate(log_scale):
        count = int(rng.integers(4, 25))
        ahead, left = rng.uniform(2.5, 12.0, count) * height_m, rng.uniform(-2.5, 2.5, count) * height_m
        above = np.where(rng.random(count) < clutter, rng.uniform(0.05, 0.9, count) * height_m, 0.0)
        points = np.column_stack([left, height_m - above, ahead]) * rng.normal(1.0, 0.03, (count, 1))
        found.append(below(row, points @ tilted.T * np.exp(-scale), CAMERA))
    return found


@pytest.mark.parametrize("seed", range(6))
def test_a_road_gives_metres_to_a_scale_that_wanders(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height_m, clutter = rng.uniform(0.3, 3.0), rng.uniform(0.0, 0.5)
    log_scale = rng.normal(0.0, 1.0) + np.cumsum(rng.normal(0.0, 0.01, VIEWS))
    found = by_height(drive(log_scale), views(log_scale, height_m, clutter, seed), height_m, CAMERA)
    assert found is not None and found.metric
    steps = np.linalg.norm(np.diff(found.odom_from_body[:, :3, 3], axis=0), axis=1)
    assert steps.mean() == pytest.approx(1.0, abs=0.03)
    assert np.abs(steps.reshape(-1, 17).mean(axis=1) - 1.0).max() < 0.06


def test_there_is_no_ground_without_landmarks_or_where_they_do_not_agree() -> None:
    log_scale, rng = np.zeros(VIEWS), np.random.default_rng(1)
    seldom = [view if view.row % 10 == 0 else view._replace(points=view.points[:2])
              for view in views(log_scale, 1.6, 0.1, 1)]  # fmt: skip
    assert by_height(drive(log_scale), seldom, 1.6, CAMERA) is None
    clouds = [rng.uniform([-4, -2, 3], [4, 4, 20], (40, 3)) for _ in range(VIEWS)]
    bushes = [below(row, cloud, CAMERA) for row, cloud in enumerate(clouds)]
    assert by_height(drive(log_scale), bushes, 1.6, CAMERA) is None
    assert by_height(drive(log_scale), [], 1.6, CAMERA) is None


def test_a_rendered_street_has_metres() -> None:
    scene = make_scene(DemoSettings(laps=0.5, frame_rate_hz=6, width=384, height=216, seed=3))
    images = [take_picture(scene, row)[0] for row in range(30)]
    frames = [Frame(int(scene.stamp_ns[row]), scene.camera, image) for row, image in enumerate(images)]
    found = visual_odometry(frames, scene.camera, metric=False, height_m=1.5)
    assert found is not None and found.metric
    truth = scene.world_from_body[np.searchsorted(scene.stamp_ns, found.stamp_ns)]
    own, known = (np.linalg.norm(np.diff(one[:, :3, 3], axis=0), axis=1).sum() for one in (found.odom_from_body, truth))
    assert own == pytest.approx(known, rel=0.05)


def test_a_piece_without_a_ground_does_not_take_the_unit_of_its_neighbours_for_its_own(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Each piece has its own unit: what was not measured may be any length."""
    log_scale = np.repeat([0.0, 1.0, 0.0], VIEWS // 3)
    odometry = replace(drive(log_scale), breaks=np.array([VIEWS // 3, 2 * VIEWS // 3]))
    shown = [view for view in views(log_scale, 1.6, 0.1, 2) if log_scale[view.row] == 0.0]
    found = by_height(odometry, shown, 1.6, CAMERA)
    assert found is not None and found.covariance is not None
    assert "view of the ground" in caplog.text
    sigma_m = np.sqrt(found.covariance[:, 3, 3])
    piece = np.arange(VIEWS // 3 + 1, 2 * VIEWS // 3)
    steps = np.linalg.norm(np.diff(found.odom_from_body[:, :3, 3], axis=0), axis=1)
    assert np.sqrt((sigma_m[piece] ** 2).sum()) > 0.9 * steps[piece - 1].sum()
    assert sigma_m[5] < 2 * sigma_m[: VIEWS // 3].min()
    assert steps[[*range(38), *range(81, 118)]] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("count", [300, 1000])
def test_a_long_piece_without_a_scale_is_no_surer_than_a_short_one(count: int) -> None:
    poses = np.tile(np.eye(4), (count + 100, 1, 1))
    poses[:, 0, 3] = 1.4 * np.arange(count + 100)
    noise = np.random.default_rng(1).uniform(1e-4, 2e-4, count + 100)
    odometry = Odometry(
        np.arange(count + 100, dtype=np.int64) * 10**8, poses, noise[:, None, None] * np.eye(6),
        breaks=np.array([count]), of_images=True, increments=True,
    )  # fmt: skip
    found = without_scale(odometry, [(0, count)], "satellite fixes")
    keys = np.arange(5, count - 5, 5, dtype=np.int64) * 10**8
    edges, warnings, _ = edge_covariance(found, keys, NoiseSettings())
    assert np.sqrt(edges[:, 3, 3]).min() > 0.9 * 1.4 * np.sqrt(5 * count)
    assert not any("unusable" in line for line in warnings)
