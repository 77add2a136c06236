"""Visual odometry with an IMU, on drawn drives: metres and their sigma, gravity, gaps, and IMUs that are left out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from vplog import logs
from vplog.data import Camera, Floats, Imu, Ints, Odometry
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.logs.topic_selection import TopicChoice
from vplog.odometry.imu_graph import GRAVITY
from vplog.odometry.inertial import SURE, Inertial, with_imu
from vplog.verbs.demo.record import IMU, make_drive
from vplog.verbs.demo.settings import SMALL

MOUNT = np.array([[0, 0, 1, 1.2], [-1, 0, 0, 0.1], [0, -1, 0, 1.4], [0, 0, 0, 1.0]])
CAMERA = Camera("camera", np.eye(3), "none", np.zeros(0), 640, 480, MOUNT)
RATE_HZ, FRAME_RATE_HZ, SECONDS = 100, 5, 30.0


@dataclass(frozen=True, eq=False)
class Drive:
    """A drawn drive."""

    odometry: Odometry
    imu: Imu
    truth: Floats
    """(F, 4, 4) world_from_body at the frames."""
    log_scale: float
    """Of m in a unit, the median."""


def draw(seed: int, excitation: float = 1.0, metric: bool = False, gap: tuple[int, int] | None = None) -> Drive:
    """A car that changes speed and direction, the more the larger the excitation; frames of `gap` are lost."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, SECONDS, 1.0 / RATE_HZ)

    def smooth(size: float, period_s: float) -> CubicSpline:
        knots = int(SECONDS / period_s) + 3
        return CubicSpline(np.linspace(-1.0, SECONDS + 1.0, knots), rng.normal(0.0, size * excitation, knots))

    speed, yaw_rate = rng.uniform(2.0, 10.0), smooth(0.2, 5.0)
    faster, angles = smooth(0.25, 6.0), [yaw_rate.antiderivative(), smooth(0.01, 1.5), smooth(0.01, 1.5)]
    height = smooth(0.01, 0.6)
    fine = np.arange(-0.5, SECONDS + 0.5, 0.005)
    moving = (speed * np.exp(faster(fine)))[:, None] * np.stack([np.cos(angles[0](fine)), np.sin(angles[0](fine))], 1)
    track = CubicSpline(fine, moving).antiderivative()

    def pose_at(at: Floats) -> Floats:
        turned = Rotation.from_euler("ZYX", np.stack([angle(at) for angle in angles], axis=1)).as_matrix()
        return se3.pose(turned, np.column_stack([track(at), height(at)]))

    body_from_imu = se3.pose(Rotation.random(rng=rng).as_matrix(), rng.normal(0.0, 0.3, 3))
    before, here, behind = (pose_at(time_s + shift) @ body_from_imu for shift in (-0.001, 0.0, 0.001))
    gyro = se3.log(se3.between(before, behind))[:, :3] / 0.002
    moved = (behind + before - 2.0 * here)[:, :3, 3] / 1e-6 + [0.0, 0.0, GRAVITY]
    accel = np.einsum("kji,kj->ki", here[:, :3, :3], moved)
    gyro = gyro + rng.normal(0.0, 0.005, 3) + rng.normal(0.0, 0.005, gyro.shape)
    accel = accel + rng.normal(0.0, 0.1, 3) + rng.normal(0.0, 0.06, accel.shape)
    stamp_ns = 10**18 + np.round(time_s * 1e9).astype(np.int64)

    at = np.arange(0.31, SECONDS - 0.5, 1.0 / FRAME_RATE_HZ)
    kept = np.ones(len(at), bool)
    if gap is not None:
        kept[gap[0] : gap[1]] = False
    at, truth = at[kept], pose_at(at[kept])
    steps = se3.log(se3.between(truth[:-1] @ MOUNT, truth[1:] @ MOUNT))
    way = np.linalg.norm(steps[:, 3:], axis=1, keepdims=True)
    steps[:, :3] += rng.normal(0.0, 3e-4, (len(way), 3))
    steps[:, 3:] += rng.normal(0.0, 1.0, (len(way), 3)) * (0.003 * way + 0.001)
    log_scale = np.zeros(len(way))
    if not metric:
        log_scale = rng.normal(0.0, 0.7) + np.cumsum(rng.normal(0.0, 0.01, len(way)) * np.sqrt(way[:, 0]))
    steps = se3.exp(steps)
    steps[:, :3, 3] *= np.exp(-log_scale)[:, None]
    breaks = np.zeros(0, np.int64) if gap is None else np.array([gap[0]])
    steps[breaks - 1] = np.eye(4)
    cameras = [se3.pose(Rotation.random(rng=rng).as_matrix(), np.zeros(3))]
    for step in steps:
        cameras.append(cameras[-1] @ step)
    covariance = np.tile(np.diag([3e-4**2] * 3 + [0.003**2] * 3), (len(at), 1, 1))
    frames_ns = 10**18 + np.round(at * 1e9).astype(np.int64)
    odometry = Odometry(
        frames_ns, MOUNT @ np.stack(cameras) @ se3.inverse(MOUNT), covariance, breaks=breaks, metric=metric
    )
    return Drive(odometry, Imu("/imu", stamp_ns, gyro, accel, body_from_imu), truth, float(np.median(log_scale)))


def found(drive: Drive) -> Inertial:
    result = with_imu(drive.odometry, drive.imu, CAMERA)
    assert not isinstance(result, str), result
    return result


def tilt_deg(poses: Floats, truth: Floats) -> Floats:
    """(F,) angle between their verticals."""
    return np.degrees(np.arccos((poses[:, 2, :3] * truth[:, 2, :3]).sum(axis=1).clip(-1.0, 1.0)))


def error_m(poses: Floats, truth: Floats) -> float:
    aligned, _ = se3.umeyama(poses[:, :3, 3], truth[:, :3, 3])
    off = se3.transform(aligned, poses[:, :3, 3]) - truth[:, :3, 3]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


@pytest.mark.parametrize("seed", range(3))
def test_a_drive_that_accelerates_has_gravity_and_metres(seed: int) -> None:
    drive = draw(seed)
    result = found(drive)
    assert result.odometry.metric
    off = np.log(result.scale) - drive.log_scale
    assert abs(off) < 0.05 and abs(off) < 3.0 * result.sigma
    assert np.median(tilt_deg(result.odometry.odom_from_body, drive.truth)) < 0.3
    way_m = np.linalg.norm(np.diff(drive.truth[:, :3, 3], axis=0), axis=1).sum()
    assert error_m(result.odometry.odom_from_body, drive.truth) < 0.02 * way_m


@pytest.mark.parametrize("seed", range(3))
def test_a_steady_drive_has_no_metres(seed: int) -> None:
    """At constant speed straight on, any speed explains the IMU."""
    drive = draw(seed, excitation=0.0)
    result = found(drive)
    assert not result.odometry.metric
    assert result.sigma > SURE
    own = [np.linalg.norm(np.diff(one.odom_from_body[:, :3, 3], axis=0), axis=1) for one in
           (drive.odometry, result.odometry)]  # fmt: skip
    assert np.median(own[1]) == pytest.approx(np.median(own[0]), rel=0.1)


@pytest.mark.parametrize(("excitation", "metric"), [(0.1, False), (0.3, True)])
def test_metres_are_as_sure_as_their_sigma(excitation: float, metric: bool) -> None:
    for seed in range(10, 13):
        drive = draw(seed, excitation)
        result = found(drive)
        assert result.odometry.metric == metric
        assert not metric or abs(np.log(result.scale) - drive.log_scale) < 3.0 * result.sigma


@pytest.mark.parametrize("metric", [False, True])
def test_a_gap_is_bridged(metric: bool) -> None:
    drive = draw(5, metric=metric, gap=(70, 80))
    result = found(drive)
    assert result.bridged == 1
    assert not len(result.odometry.breaks)
    assert (
        error_m(result.odometry.odom_from_body, drive.truth)
        < 2.0
        < error_m(drive.odometry.odom_from_body * 1.0, drive.truth)
    )
    moved = se3.between(*result.odometry.odom_from_body[[69, 70]])
    off = se3.log(se3.between(se3.between(*drive.truth[[69, 70]]), moved)[None])
    assert result.odometry.covariance is not None
    assert se3.mahalanobis2(off, result.odometry.covariance[70:71])[0] < 16.8  # chi-square, 6 dof, 99 %


def test_metres_of_depth_stay() -> None:
    drive = draw(6, metric=True)
    result = found(drive)
    assert (result.scale, result.sigma) == (pytest.approx(1.0, abs=1e-4), 0.0)
    before, after = (error_m(one.odom_from_body, drive.truth) for one in (drive.odometry, result.odometry))
    assert after < max(before, 0.3)


def turned(imu: Imu, angle: float) -> Imu:
    return replace(imu, body_from_imu=imu.body_from_imu @ se3.exp(np.array([0.0, 0.0, angle, 0.0, 0.0, 0.0])))


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (lambda imu: turned(imu, np.pi / 2), "mount"),
        (lambda imu: replace(imu, gyro=np.degrees(imu.gyro)), "mount"),
        (lambda imu: replace(imu, accel=imu.accel / GRAVITY), "median of 1 m/s"),
        (lambda imu: replace(imu, stamp_ns=imu.stamp_ns[:50], gyro=imu.gyro[:50], accel=imu.accel[:50]), "less than"),
        (lambda imu: replace(imu, stamp_ns=imu.stamp_ns + 10**12), "less than"),
    ],
)
def test_an_imu_that_is_something_else_is_left_out(other, why: str) -> None:
    drive = draw(2)
    result = with_imu(drive.odometry, other(drive.imu), CAMERA)
    assert isinstance(result, str)
    assert why in result


def without(imu: Imu, first: int, last: int) -> Imu:
    kept: Ints = np.delete(np.arange(len(imu.stamp_ns)), np.arange(first, last))
    return replace(imu, stamp_ns=imu.stamp_ns[kept], gyro=imu.gyro[kept], accel=imu.accel[kept])


def test_a_hole_in_the_imu_is_no_motion() -> None:
    drive = draw(3)
    result = found(replace(drive, imu=without(drive.imu, 1000, 1400)))
    assert abs(np.log(result.scale) - drive.log_scale) < 0.05


def test_the_imu_of_a_log_is_read(tmp_path: Path) -> None:
    drive = make_drive(tmp_path, SMALL.model_copy(update={"imu_rate_hz": 50.0, "laps": 0.2}), Execution(1))
    imu = logs.open(drive.log, TopicChoice(odometry="visual")).imu()
    assert imu is not None and imu.name == IMU
    assert np.median(np.linalg.norm(imu.accel, axis=1)) == pytest.approx(GRAVITY, rel=0.15)
    np.testing.assert_allclose(imu.body_from_imu[:3, 3], [-0.4, 0.2, 0.3], atol=1e-9)
    assert logs.open(drive.log).imu() is None  # its odometry is used
    assert logs.open(drive.log, TopicChoice(odometry="visual", imu="")).imu() is None
