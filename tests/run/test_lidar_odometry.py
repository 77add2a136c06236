"""Odometry of a lidar that is driven through a room of planes and boxes, from its scans alone to a run."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from scipy.spatial import KDTree

from tests.logs.drives import Written, store, write_ros2
from vplog import logs
from vplog.data import Lidar, Odometry, Scan
from vplog.errors import LogError
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.pipeline import load_pipeline, run
from vplog.run.lidar_odometry import lidar_odometry, range_of, step_residuals
from vplog.run.odometry import source_of
from vplog.testing import pictures
from vplog.verbs.info import preflight, preflight_lines

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Floats

SCANS, PERIOD_S, POINTS = 20, 0.1, 4000
START_NS = 1_600_000_000_000_000_000
ROOM = np.array([[-9.0, -6.0, 0.0], [9.0, 6.0, 4.0]])
NOISE_M = 0.01
BODY_FROM_LIDAR = se3.pose(se3.so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.3, 0.0, 1.5]))
"""Mounted across, on a mast."""
QUICK = ("features.max_features=300", "propose.per_query=1", "pictures.closures=0", "pictures.megapixels=0")
needs_kiss_icp = pytest.mark.skipif(find_spec("kiss_icp") is None, reason="kiss-icp is not installed")


def world_from_body(seconds: Floats) -> Floats:
    """From rest into a bend of 3 m radius."""
    way = 0.6 * np.asarray(seconds) ** 2
    yaw = way / 3.0
    turn = se3.so3_exp(yaw[:, None] * np.array([0.0, 0.0, 1.0]))
    return se3.pose(turn, np.stack([3 * np.sin(yaw) - 2, -3 * np.cos(yaw), np.zeros_like(yaw)], axis=1))


def boxes() -> Floats:
    """(B, 2, 3) low and high corners of furniture along the walls."""
    rng = np.random.default_rng(7)
    side = rng.uniform(0.3, 0.9, (24, 3))
    centre = rng.uniform(ROOM[0] + 1, ROOM[1] - 1, (24, 3)) * [1.0, 1.0, 0.5]
    centre = centre[np.linalg.norm(centre[:, :2], axis=1) > 4.5]
    return np.stack([centre - side[: len(centre)], centre + side[: len(centre)]], axis=1)


def cast(origin: Floats, direction: Floats) -> Floats:
    """(K,) m to the first surface from (K, 3) along (K, 3), by slabs."""
    with np.errstate(divide="ignore"):
        distance = np.maximum(*((wall - origin) / direction for wall in ROOM)).min(axis=1)
        for low, high in boxes():
            one, other = (low - origin) / direction, (high - origin) / direction
            near, far = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
            distance = np.where((near < far) & (near > 0), np.minimum(distance, near), distance)
    return distance


@cache
def scans() -> tuple[Scan, ...]:
    """As a turning lidar measures while it moves, the time of every point beside it; its pattern does not repeat, as
    rings on bare walls would hold a registration of points where it was."""
    since, found = np.linspace(0, PERIOD_S, POINTS, endpoint=False), []
    angle, rng = 2 * np.pi * since / PERIOD_S, np.random.default_rng(1)
    for number in range(SCANS):
        tilt = rng.uniform(-0.45, 0.45, POINTS)
        ray = np.stack([np.cos(tilt) * np.cos(angle), np.cos(tilt) * np.sin(angle), np.sin(tilt)], axis=1)
        pose = world_from_body(number * PERIOD_S + since) @ BODY_FROM_LIDAR
        distance = cast(pose[:, :3, 3], np.einsum("kij,kj->ki", pose[:, :3, :3], ray))
        points = ray * (distance + rng.normal(0, NOISE_M, POINTS))[:, None]
        found.append(Scan(START_NS + round(number * PERIOD_S * 1e9), points, since))
    return tuple(found)


def odometry_of(drive: Any) -> Odometry:
    found = lidar_odometry(drive, range_of(scans()[::5]), Lidar("/points", np.zeros(0, np.int64), BODY_FROM_LIDAR))
    assert found is not None
    return found


def steps_off(odometry: Odometry) -> tuple[Floats, float]:
    """(T-1, 6) error of every step of the body, and the way in m."""
    truth = world_from_body((odometry.stamp_ns - START_NS) / 1e9)
    step = se3.between(truth[:-1], truth[1:])
    moved = se3.between(odometry.odom_from_body[:-1], odometry.odom_from_body[1:])
    return se3.log(se3.between(step, moved)), float(np.linalg.norm(step[:, :3, 3], axis=1).sum())


@needs_kiss_icp
def test_the_body_is_followed_and_steps_are_as_sure_as_their_covariance() -> None:
    odometry = odometry_of(scans())
    assert len(odometry.stamp_ns) == SCANS
    assert not len(odometry.breaks)
    off, way_m = steps_off(odometry)
    truth = world_from_body((odometry.stamp_ns[[0, -1]] - START_NS) / 1e9)
    end = se3.between(se3.between(*truth), se3.between(*odometry.odom_from_body[[0, -1]]))
    assert np.linalg.norm(end[:3, 3]) < 0.03 * way_m
    assert odometry.covariance is not None
    squared = se3.mahalanobis2(off, odometry.covariance[1:])
    assert np.median(squared) < 12.6  # chi-square, 6 degrees of freedom, 95 %
    assert np.sqrt(np.trace(odometry.covariance[1:, 3:, 3:], axis1=1, axis2=2)).max() < 0.3


@needs_kiss_icp
def test_the_same_scans_give_the_same_bytes() -> None:
    once, twice = (odometry_of(scans()[:8]) for _ in range(2))
    assert once.odom_from_body.tobytes() == twice.odom_from_body.tobytes()
    assert once.covariance is not None and twice.covariance is not None
    assert once.covariance.tobytes() == twice.covariance.tobytes()


@needs_kiss_icp
def test_scans_that_match_nothing_are_passed_over_and_a_gap_begins_a_piece() -> None:
    far = np.random.default_rng(3).normal((15.0, 15.0, 0.0), 1.0, (POINTS, 3))
    drive = [replace(scan, points=far) if row == 5 else scan for row, scan in enumerate(scans())]
    drive[2] = replace(drive[2], points=np.zeros((0, 3)), seconds=np.zeros(0))
    drive[12:] = [replace(scan, stamp_ns=scan.stamp_ns + 2 * 10**9) for scan in drive[12:]]
    odometry = odometry_of(drive)
    assert len(odometry.stamp_ns) == SCANS - 2
    assert odometry.breaks.tolist() == [10]
    np.testing.assert_allclose(*odometry.odom_from_body[9:11])
    off, _ = steps_off(replace(odometry, stamp_ns=odometry.stamp_ns[:10], odom_from_body=odometry.odom_from_body[:10]))
    assert np.abs(off[:, 3:]).max() < 0.05


def test_the_way_along_a_tunnel_is_unknown() -> None:
    rng = np.random.default_rng(5)
    angle, along = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(-8, 8, 3000)
    points = np.stack([along, 3 * np.cos(angle), 3 * np.sin(angle)], axis=1)
    found = step_residuals(KDTree(points), points + rng.normal(0, 0.01, points.shape), np.eye(4), 0.5)
    assert found is not None
    sigma = np.sqrt(np.diag(found.covariance))
    assert sigma[3] > 20 * sigma[4:].max()
    assert sigma[0] > 20 * sigma[1:3].max()  # and the turn about it


def written(path: Path) -> Path:
    """The drive as a bag: clouds, images of places, and the transforms between the sensors."""
    t = store(2).types

    def header(stamp_ns: int, frame: str) -> Any:
        stamp = t["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return t["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)

    def transform(child: str, pose: Floats) -> Any:
        xyzw = dict(zip("xyzw", map(float, se3.quaternion(pose[:3, :3])), strict=True))
        place = t["geometry_msgs/msg/Vector3"](**dict(zip("xyz", map(float, pose[:3, 3]), strict=True)))
        value = t["geometry_msgs/msg/Transform"](translation=place, rotation=t["geometry_msgs/msg/Quaternion"](**xyzw))
        placed = {"header": header(START_NS, "base_link"), "child_frame_id": child}
        return t["geometry_msgs/msg/TransformStamped"](**placed, transform=value)

    camera = se3.pose(se3.so3_exp(np.array([0.0, 0.3, 0.0])), np.array([1.0, 0.0, 1.0]))
    both = [transform("lidar", BODY_FROM_LIDAR), transform("camera", camera)]
    found = [Written("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, t["tf2_msgs/msg/TFMessage"](transforms=both))]
    layout = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
    kinds = zip(layout.names or (), (0, 4, 8, 12), (7, 7, 7, 6), strict=True)
    fields = [t["sensor_msgs/msg/PointField"](name=n, offset=at, datatype=kind, count=1) for n, at, kind in kinds]
    for number, scan in enumerate(scans()):
        cloud = np.zeros(POINTS, layout)
        for axis, column in zip("xyz", scan.points.T, strict=True):
            cloud[axis] = column
        cloud["t"] = np.zeros(0) if scan.seconds is None else scan.seconds * 1e9
        message = t["sensor_msgs/msg/PointCloud2"](
            header=header(scan.stamp_ns, "lidar"), height=1, width=POINTS, fields=fields, is_bigendian=False,
            point_step=16, row_step=16 * POINTS, data=cloud.view(np.uint8), is_dense=True,
        )  # fmt: skip
        found.append(Written("/points", "sensor_msgs/msg/PointCloud2", scan.stamp_ns, message))
        stamp_ns = scan.stamp_ns + round(PERIOD_S * 1e9)
        data = cv2.imencode(".png", pictures.texture(number))[1].ravel()
        image = t["sensor_msgs/msg/CompressedImage"](header=header(stamp_ns, "camera"), format="png", data=data)
        found.append(Written("/image/compressed", "sensor_msgs/msg/CompressedImage", stamp_ns, image))
    return write_ros2(path, found)


@needs_kiss_icp
def test_a_log_without_odometry_runs_by_its_lidar(tmp_path: Path) -> None:
    path, settings = written(tmp_path / "bag"), load_pipeline("default", QUICK)
    found = preflight(path).record
    assert (found["lidar_odometry"], found["ready"]) == ("used", True)
    assert ("odometry", "lidar: the run computes it from the scans") in [*preflight_lines(found)]
    assert [topic["part"] for topic in found["topics"] if topic["name"] == "/points"] == ["lidar"]
    done = run(path, tmp_path / "run", settings, execution=Execution(2))
    assert done.record["stages"]["odometry"]["result"] == "computed"
    assert done.record["noise"] == "increments"
    assert any("that of its lidar /points is used" in line for line in done.record["warnings"])
    by_scans = odometry_of(scans())
    np.testing.assert_allclose(done.odometry.odom_from_body, by_scans.odom_from_body, atol=0.005)
    np.testing.assert_allclose(done.odometry.stamp_ns, by_scans.stamp_ns, atol=1000)
    assert done.camera.body_from_camera[0, 3] == pytest.approx(1.0)
    again = run(path, tmp_path / "run", settings, execution=Execution(1))
    assert again.record["stages"]["odometry"]["result"] == "reused"
    assert again.odometry.odom_from_body.tobytes() == done.odometry.odom_from_body.tobytes()


def test_it_is_named_by_source_or_topic_and_what_it_needs_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path / "bag")
    for choice in (None, "lidar", "/points"):
        topics = logs.TopicChoice(odometry=choice)
        assert source_of(logs.open(path, topics), topics) == "lidar"
    for choice in ("gps", ""):
        topics = logs.TopicChoice(odometry=choice)
        with pytest.raises(LogError, match="--odometry lidar takes it from /points"):
            source_of(logs.open(path, topics), topics)
    for name in ("kiss_icp", "kiss_icp.config"):
        monkeypatch.setitem(sys.modules, name, None)
    problems = preflight(path).record["problems"]
    assert problems == ["Odometry of a lidar needs KISS-ICP, which is not installed. Install it: pip install kiss-icp"]
    with pytest.raises(LogError, match="pip install"):
        odometry_of(scans())


@needs_kiss_icp
def test_a_lidar_at_less_than_a_hertz_is_registered() -> None:
    """As a log that was thinned has it."""
    slow = [replace(scan, stamp_ns=START_NS + 20 * (scan.stamp_ns - START_NS), seconds=None) for scan in scans()]
    stamps = np.array([scan.stamp_ns for scan in slow])
    found = lidar_odometry(slow, range_of(scans()[::5]), Lidar("/points", stamps, BODY_FROM_LIDAR))
    assert found is not None and not len(found.breaks)
    assert len(found.stamp_ns) > 0.9 * SCANS


@needs_kiss_icp
def test_times_of_points_that_are_shares_of_a_turn_do_not_move_the_scan() -> None:
    """0 to 1, which might be seconds but for the period."""
    shares = [replace(scan, seconds=scan.seconds / PERIOD_S) for scan in scans()[:4] if scan.seconds is not None]
    stamps = np.array([scan.stamp_ns for scan in shares])
    found = lidar_odometry(shares, range_of(scans()[::5]), Lidar("/points", stamps, BODY_FROM_LIDAR))
    assert found is not None
    np.testing.assert_array_equal(found.stamp_ns, stamps)
