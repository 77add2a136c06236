"""Visual odometry of the demo's street, with depth and with a stereo pair, and where nothing is to be seen."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from vplog.data import EdgeKind, Frame, Odometry, PoseGraph, Solution, Trajectory
from vplog.geometry import se3
from vplog.graph.noise import NoiseSettings, edge_covariance
from vplog.graph.variance_components import Sigmas, claimed_times
from vplog.odometry.sensor import disparities, follow
from vplog.odometry.visual import visual_odometry
from vplog.refinement.refine import Refined
from vplog.run.back_end import BackEndResult, keyframe_covariances
from vplog.verbs.demo.scene import Scene, make_scene, take_picture
from vplog.verbs.demo.settings import DemoSettings

FRAMES = 20
BASELINE_M = 0.3
SETTINGS = DemoSettings(laps=0.5, frame_rate_hz=6, width=384, height=216, seed=3)


@cache
def scene(stereo: bool) -> Scene:
    made = make_scene(SETTINGS)
    return replace(made, camera=replace(made.camera, baseline_m=BASELINE_M)) if stereo else made


@cache
def slow() -> Scene:
    """A few centimetres from frame to frame."""
    return make_scene(DemoSettings(laps=0.5, frame_rate_hz=40, width=384, height=216, seed=3))


@cache
def frames(stereo: bool) -> list[Frame]:
    street, found = scene(stereo), []
    for row in range(FRAMES):
        image, depth = take_picture(street, row)
        right = take_picture(street, row, BASELINE_M)[0] if stereo else None
        found.append(Frame(int(street.stamp_ns[row]), street.camera, image, None if stereo else depth, right))
    return found


def odometry_of(drive: list[Frame]) -> Odometry:
    found = visual_odometry(drive, drive[0].camera)
    assert found is not None
    return found


def blank(frame: Frame) -> Frame:
    return replace(frame, image=np.full_like(frame.image, 90))


def steps_off(odometry: Odometry, rows: np.ndarray) -> np.ndarray:
    """(T-1, 6) error of every step in the body that moves; `rows` (T,) are the frames of the poses."""
    truth = scene(stereo=False).world_from_body[rows]
    moved = se3.between(odometry.odom_from_body[:-1], odometry.odom_from_body[1:])
    return se3.log(se3.between(se3.between(truth[:-1], truth[1:]), moved))


@pytest.mark.parametrize("stereo", [False, True])
def test_the_body_is_followed_in_metres(stereo: bool) -> None:
    odometry = odometry_of(frames(stereo))
    assert odometry.stamp_ns.tolist() == [frame.stamp_ns for frame in frames(stereo)]
    assert not len(odometry.breaks)
    truth = scene(stereo).world_from_body[:FRAMES]
    path_m = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    off = se3.between(se3.between(truth[0], truth[-1]), se3.between(*odometry.odom_from_body[[0, -1]]))
    assert np.linalg.norm(off[:3, 3]) < 0.015 * path_m
    assert np.degrees(se3.angle(off)) < 1.0


@pytest.mark.parametrize("stereo", [False, True])
def test_steps_are_as_sure_as_their_covariance(stereo: bool) -> None:
    odometry = odometry_of(frames(stereo))
    assert odometry.covariance is not None
    assert odometry.covariance.shape == (FRAMES, 6, 6)
    squared = se3.mahalanobis2(steps_off(odometry, np.arange(FRAMES)), odometry.covariance[1:])
    assert np.median(squared) < 12.6  # chi-square, 6 degrees of freedom, 95 %
    sigma_m = np.sqrt(np.trace(odometry.covariance[:, 3:, 3:], axis1=1, axis2=2))
    assert np.median(sigma_m) < 0.2  # of steps of a metre


def test_the_same_frames_give_the_same_bytes() -> None:
    once, twice = (odometry_of(frames(stereo=False)[:8]) for _ in range(2))
    assert once.odom_from_body.tobytes() == twice.odom_from_body.tobytes()
    assert once.covariance is not None and twice.covariance is not None
    assert once.covariance.tobytes() == twice.covariance.tobytes()


def test_a_blurred_frame_is_passed_over() -> None:
    drive = [blank(frame) if row == 5 else frame for row, frame in enumerate(frames(stereo=False)[:10])]
    odometry = odometry_of(drive)
    assert drive[5].stamp_ns not in odometry.stamp_ns
    assert not len(odometry.breaks)
    assert np.abs(steps_off(odometry, np.array([0, 1, 2, 3, 4, 6, 7, 8, 9]))[:, 3:]).max() < 0.1


def test_of_frames_that_come_fast_those_between_are_followed_where_the_next_is_lost() -> None:
    street = slow()
    drive = [Frame(int(street.stamp_ns[row]), street.camera, *take_picture(street, row)) for row in range(13)]
    assert np.isin(street.stamp_ns[:13], odometry_of(drive).stamp_ns).nonzero()[0].tolist() == list(range(0, 13, 2))
    drive[4:7] = [blank(frame) for frame in drive[4:7]]
    assert np.isin(street.stamp_ns[:13], odometry_of(drive).stamp_ns).nonzero()[0].tolist() == [0, 2, 3, 7, 9, 11, 12]


def test_stamps_that_run_faster_than_the_camera_lose_no_frame_that_is_needed() -> None:
    drive = [replace(frame, stamp_ns=500_000 * row) for row, frame in enumerate(frames(stereo=False))]
    found = odometry_of(drive)
    assert not len(found.breaks)
    rows = found.stamp_ns // 500_000
    assert rows[-1] == FRAMES - 1 and np.diff(rows).max() <= 4
    assert np.abs(steps_off(found, rows)[:, 3:]).max() < 0.1


def test_the_drive_goes_on_as_another_piece() -> None:
    """Two seconds without a picture, after which the street looks otherwise: the pose is held there."""
    drive = [blank(frame) if 4 <= row < 16 else frame for row, frame in enumerate(frames(stereo=False))]
    odometry = odometry_of(drive)
    assert odometry.breaks.tolist() == [4]
    assert len(odometry.stamp_ns) == 8
    before, behind = odometry.odom_from_body[3:5]
    np.testing.assert_allclose(before, behind)


def test_a_dark_drive_has_none() -> None:
    assert visual_odometry([blank(frame) for frame in frames(stereo=False)[:3]], scene(stereo=False).camera) is None


def test_points_without_a_counterpart_are_unknown() -> None:
    image = frames(stereo=False)[0].image
    px = np.array([[100.0, 100.0], [200.0, 80.0]], np.float32)
    assert np.isnan(disparities(image, np.full_like(image, 90), px)).all()
    assert follow(image, image, px[:0], px[:0]).shape == (0, 2)
    np.testing.assert_allclose(follow(image, image, px, px), px, atol=1e-3)


def test_closures_do_not_make_odometry_of_the_same_images_surer_than_it_claims() -> None:
    """Keyframes' covariance of a drive back and forth, whose closures agree far better than the odometry claims."""
    count, claimed = 12, np.diag([0.01**2] * 3 + [0.1**2] * 3)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.concatenate([np.arange(6.0), np.arange(6.0)[::-1]])
    a, b = np.arange(6), np.arange(11, 5, -1)
    edges_a, edges_b = np.concatenate([np.arange(count - 1), a]), np.concatenate([np.arange(1, count), b])
    kind = [EdgeKind.ODOMETRY] * (count - 1) + [EdgeKind.LOOP] * 6
    information = np.tile(np.linalg.inv(claimed), (len(edges_a), 1, 1))
    ends = (edges_a.astype(np.int32), edges_b.astype(np.int32))
    graph = PoseGraph(poses, *ends, se3.between(poses[edges_a], poses[edges_b]), information, kind)
    sigmas = Sigmas(0.1, 0.1)
    solution = Solution(poses, np.ones(len(edges_a)), 0.0, 0.0, 0, True, "")
    refined = Refined(claimed_times(graph, sigmas), solution, sigmas, 1.0, None, np.zeros(0), None)
    solved = BackEndResult(None, refined, Trajectory(np.arange(count), poses), "increments", [])  # type: ignore[arg-type]
    own, shared = (keyframe_covariances(replace(solved, of_images=of_images)) for of_images in (False, True))
    assert own is not None and shared is not None
    ratio = np.sqrt(np.trace(shared[5, 3:, 3:]) / np.trace(own[5, 3:, 3:]))
    assert ratio > 3.0


def test_depth_at_a_fifth_of_the_rate_is_enough() -> None:
    """At moments that are not those of references, and none but NaN at others."""
    street, drive = slow(), list[Frame]()
    for row in range(50):
        image, depth = take_picture(street, row)
        depth = depth if row % 6 == 1 else np.full_like(depth, np.nan) if row % 2 else None
        drive.append(Frame(int(street.stamp_ns[row]), street.camera, image, depth))
    odometry = odometry_of(drive)
    assert not len(odometry.breaks)
    truth = street.world_from_body[np.searchsorted(street.stamp_ns, odometry.stamp_ns)]
    off = se3.between(se3.between(truth[0], truth[-1]), se3.between(*odometry.odom_from_body[[0, -1]]))
    assert np.linalg.norm(off[:3, 3]) < 0.02 * np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()


@pytest.mark.parametrize("without", [slice(0, None, 2), slice(1, None, 2), slice(3, 7)])
def test_frames_without_depth_are_followed_by_the_others(without: slice) -> None:
    """Depth at another rate, and none for a moment, as before a wall too near."""
    street, drive = slow(), list[Frame]()
    for row in range(FRAMES):
        image, depth = take_picture(street, row)
        if row in range(FRAMES)[without]:
            depth = None if without.step else np.full(image.shape, np.nan, np.float32)
        drive.append(Frame(int(street.stamp_ns[row]), street.camera, image, depth))
    odometry = odometry_of(drive)
    assert odometry.stamp_ns[-1] >= drive[-2].stamp_ns
    assert not len(odometry.breaks)
    truth = street.world_from_body[np.searchsorted(street.stamp_ns, odometry.stamp_ns)]
    off = se3.between(se3.between(truth[0], truth[-1]), se3.between(*odometry.odom_from_body[[0, -1]]))
    assert np.linalg.norm(off[:3, 3]) < 0.05 * np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()


def test_a_drive_that_stands_still_first_has_the_covariance_of_its_steps() -> None:
    """Variances that happen to grow are no reason to take them for those of the pose since the start."""
    odometry = odometry_of(frames(stereo=False)[:8])
    assert odometry.increments
    growing = np.eye(6) * np.linspace(1e-6, 1e-4, 8)[:, None, None]
    _, _, source = edge_covariance(replace(odometry, covariance=growing), odometry.stamp_ns, NoiseSettings())
    assert source == "increments"
    logged = replace(odometry, covariance=growing, increments=False)
    assert edge_covariance(logged, odometry.stamp_ns, NoiseSettings())[2] == "accumulated"
