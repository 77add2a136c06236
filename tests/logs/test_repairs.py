"""What is repaired or left out, and the warning that says so."""

from __future__ import annotations

from array import array
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tests.logs.drives import LATENCY_NS, Drive, foxglove_messages, ros_messages, write_foxglove, write_ros2
from vplog import logs
from vplog.data import Odometry
from vplog.geometry import se3
from vplog.logs.cameras import AHEAD, body_from_camera, camera_of
from vplog.logs.formats.container import Notes
from vplog.logs.messages.records import CalibrationMessage, PoseMessage
from vplog.logs.stamps import Stamps, increasing, nearest
from vplog.logs.tf_odometry import FrameTree
from vplog.logs.tracks import PoseTrack

if TYPE_CHECKING:
    from pathlib import Path

QUARTER = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
"""A quarter turn about z."""


def stamps(header_ns: list[int], log_ns: list[int]) -> Stamps:
    return Stamps(array("q", header_ns), array("q", log_ns))


def track(*messages: PoseMessage) -> tuple[Odometry | None, str]:
    notes, poses = Notes(), PoseTrack("/odom")
    for message in messages:
        poses.add(message, message.stamp_ns + 5)
    return poses.finish(notes), " ".join(notes.lines)


def pose(stamp_ns: int, covariance: Any = None, **fields: Any) -> PoseMessage:
    values: dict[str, Any] = {"position": np.ones(3), "quaternion": QUARTER} | fields
    values["covariance"] = None if covariance is None else np.ravel(covariance)
    return PoseMessage(stamp_ns, "odom", "base_link", **values)


@given(st.lists(st.integers(0, 50), max_size=30))
def test_stamps_increase_and_the_first_of_equals_is_kept(stamps: list[int]) -> None:
    notes = Notes()
    stamp_ns, rows = increasing(np.array(stamps, np.int64), "/t", notes)
    assert stamp_ns.tolist() == sorted(set(stamps))
    assert rows.tolist() == [stamps.index(s) for s in sorted(set(stamps))]
    assert any("out of order" in line for line in notes.lines) == any(b < a for a, b in pairwise(stamps))


def test_header_stamps_that_are_all_zero_give_way_to_log_times() -> None:
    notes = Notes()
    stamp_ns, rows = stamps([0, 0], [7, 9]).order("/t", notes)
    assert (stamp_ns.tolist(), rows.tolist()) == ([7, 9], [0, 1])
    assert "log times" in notes.lines[0]
    stamp_ns, rows = stamps([0, 5 * 10**9], [7 * 10**9, 9 * 10**9]).order("/t", notes)
    assert (stamp_ns.tolist(), rows.tolist()) == ([5 * 10**9], [1])
    assert "Lost: 1 message without a header stamp, at t=7.000 s: /t 1." in notes.lines


def test_pairs_are_nearest_within_half_a_period() -> None:
    stamps, depth = np.array([0, 100, 200, 300]), np.array([49, 160, 351])
    assert nearest(stamps, depth).tolist() == [0, -1, 1, -1]
    assert nearest(stamps, np.zeros(0, np.int64)).tolist() == [-1] * 4


@given(arrays(np.int64, st.integers(2, 20), elements=st.integers(0, 1000), unique=True), st.data())
def test_pairs_agree_with_every_distance(stamps: np.ndarray, data: st.DataObject) -> None:
    other = np.sort(data.draw(arrays(np.int64, st.integers(1, 20), elements=st.integers(0, 1000), unique=True)))
    stamps = np.sort(stamps)
    limit = np.median(np.diff(stamps)) / 2
    for stamp, row in zip(stamps, nearest(stamps, other), strict=True):
        gaps = np.abs(other - stamp)
        assert (row == -1) == (gaps.min() > limit)
        assert row == -1 or gaps[row] == gaps.min()


def test_unusable_poses_are_dropped() -> None:
    bad = (
        pose(2, position=np.array([np.nan, 0, 0])),
        pose(3, quaternion=np.zeros(4)),
        pose(4, position=np.full(3, np.inf)),
        pose(4, position=np.full(3, 1e300)),
        pose(4, quaternion=np.full(4, 1e300)),
    )
    odometry, notes = track(pose(1), *bad, pose(5, quaternion=2 * QUARTER))
    assert odometry is not None
    assert odometry.stamp_ns.tolist() == [1, 5]
    np.testing.assert_allclose(odometry.odom_from_body[0], odometry.odom_from_body[1])
    assert "5 poses" in notes
    assert track(*bad)[0] is None


def test_covariance_turns_into_the_body() -> None:
    """Looking left along odom's y, the uncertainty in odom's y is the one ahead."""
    logged = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    odometry, notes = track(pose(1, logged))
    assert odometry is not None
    assert odometry.covariance is not None
    np.testing.assert_allclose(odometry.covariance[0], np.diag([0.2, 0.1, 0.3, 2.0, 1.0, 3.0]), atol=1e-12)
    assert notes == ""


@pytest.mark.parametrize(
    "bad", [np.zeros((6, 6)), np.full((6, 6), np.nan), np.diag([-1.0, 0, 0, 0, 0, 0]), np.diag([1.0, 1, 1, 1, 1, -2])]
)
def test_covariance_that_no_noise_has_is_unknown(bad: np.ndarray) -> None:
    odometry, notes = track(pose(1, bad), pose(2, np.eye(6)))
    assert odometry is not None
    assert odometry.covariance is not None
    np.testing.assert_array_equal(np.isnan(odometry.covariance).all((1, 2)), [True, False])
    assert "1 covariance " in notes
    odometry, notes = track(pose(1, bad), pose(2, bad))
    assert odometry is not None
    assert odometry.covariance is None
    assert "no usable covariance" in notes


def test_frames_chain_through_any_depth_and_both_directions() -> None:
    rng = np.random.default_rng(2)
    edges = [("base", "mast"), ("mast", "head"), ("mount", "head"), ("mount", "camera"), ("mast", "other")]
    given_ = {e: (rng.normal(size=3).tolist(), rng.normal(size=4).tolist()) for e in edges}
    tree = FrameTree([PoseMessage(0, a, f"/{b}", *given_[a, b], None) for a, b in edges])

    def chain(*frames: str) -> np.ndarray:
        steps = [tree.between(a, b) for a, b in pairwise(frames)]
        assert all(step is not None for step in steps)
        return np.linalg.multi_dot([np.eye(4), *(step for step in steps if step is not None)])

    steps = chain("base", "mast", "head") @ np.linalg.inv(chain("mount", "head")) @ chain("mount", "camera")
    np.testing.assert_allclose(chain("base", "camera"), steps, atol=1e-12)
    np.testing.assert_allclose(chain("camera", "base", "camera"), np.eye(4), atol=1e-12)
    assert tree.between("base", "nowhere") is None
    assert FrameTree([PoseMessage(0, "a", "b", np.zeros(3).tolist(), np.zeros(4).tolist(), None)]).dropped == 1


def going(*way: float) -> Odometry:
    """Twenty metres, straight but for a little of every axis."""
    steps = np.outer(np.arange(20), way) + np.random.default_rng(0).normal(0, 0.01, (20, 3))
    return Odometry(np.arange(20), se3.pose(np.tile(np.eye(3), (20, 1, 1)), steps), None)


def turning(axis: int) -> Odometry:
    """Along x, turning about an axis."""
    twist = np.zeros((20, 6))
    twist[:, 3], twist[:, axis] = 1.0, 0.05
    steps = se3.exp(twist)
    poses = [steps[0]]
    for step in steps[1:]:
        poses.append(poses[-1] @ step)
    return Odometry(np.arange(20), np.array(poses), None)


X, Y, Z = going(1, 0, 0), going(0.5, 1, 0.5), going(0, 0, 1)
"""Odometries: a vehicle's, one carried by hand, a camera's own."""


@pytest.mark.parametrize(
    ("body", "frame", "placed", "odometry", "axis", "warned"),
    [
        ("base_link", "camera", True, X, "x", True),
        ("base_link", "camera", False, X, "x", True),
        ("robot/base_footprint", "camera", False, Y, "x", True),
        ("base_link", "camera", False, Z, "z", True),
        ("base_link", "camera", False, None, "x", True),
        ("base_link", "", True, X, "x", True),
        ("vehicle", "camera", False, X, "x", True),
        ("vehicle", "camera", False, Y, "z", True),
        ("base_link", "base_link", False, X, "z", False),
        ("", "camera", False, X, "x", True),
        ("", "camera", False, Y, "z", False),
        ("", "camera", False, turning(2), "x", True),
        ("", "camera", False, turning(1), "z", False),  # of a camera that looks aside
        ("", "camera", False, going(-1, 0, 0), "z", False),
        ("left_optical_frame", "camera", False, X, "z", True),
        ("", "", False, Z, "z", False),
    ],
)
def test_a_camera_without_a_chain_to_the_body_looks_ahead(
    body: str, frame: str, placed: bool, odometry: Odometry | None, axis: str, warned: bool
) -> None:
    """By REP 103 along a body's x, or as the odometry goes; a warning unless the log names no frames."""
    tree = FrameTree([PoseMessage(0, "base_link", "lidar", (1.0, 1.0, 1.0), QUARTER.tolist(), None)] if placed else [])
    found = body_from_camera(tree, body, frame, notes := Notes(), odometry)
    np.testing.assert_array_equal(found, AHEAD if axis == "x" else np.eye(4))
    assert [f"look along its {axis}" in line for line in notes.lines] == [True] * warned


def test_a_base_link_of_the_static_transforms_is_the_body_that_odometry_does_not_name() -> None:
    tree = FrameTree([PoseMessage(0, "base_link", "lidar", (1.0, 1.0, 1.0), QUARTER.tolist(), None)])
    found = body_from_camera(tree, "", "lidar", notes := Notes())
    np.testing.assert_array_equal(found[:3, 3], np.ones(3))
    assert "base_link" in notes.lines[0]


@pytest.mark.parametrize(("change", "count"), [((0.0, 0.001, 0.0), 0), ((0.0, 0.02, 0.0), 2)])
def test_a_mount_that_changes_is_said(change: tuple[float, ...], count: int) -> None:
    """That of another sensor is nobody's concern."""
    unit = (0.0, 0.0, 0.0, 1.0)
    moves = [((0.0, 0.0, 0.0), unit), (change, unit), (change, QUARTER.tolist() if count else unit)]
    mounts = [PoseMessage(0, "base_link", child, *move, None) for child in ("mast", "lidar") for move in moves]
    tree = FrameTree([*mounts, PoseMessage(0, "mast", "camera", (0.0, 0.0, 0.0), unit, None)])
    body_from_camera(tree, "base_link", "camera", notes := Notes())
    assert [f"base_link -> mast changes {count} times" in line for line in notes.lines] == [True] * bool(count)


def calibration(model: str = "plumb_bob", distortion: Any = (), **fields: Any) -> CalibrationMessage:
    matrix = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
    projection = np.array([[90.0, 0, 49, 0], [0, 90, 39, 0], [0, 0, 1, 0]])
    values: dict[str, Any] = {"width": 100, "height": 80, "matrix": matrix, "projection": projection} | fields
    return CalibrationMessage(0, "camera", model=model, distortion=np.array(distortion, float), **values)


def test_calibration_models_and_what_counts_as_uncalibrated() -> None:
    def made(message: CalibrationMessage | None, name: str = "/cam/image", size: tuple[int, int] = (100, 80)) -> tuple:
        camera = camera_of(name, message, size, notes)
        return camera.distortion_model, len(camera.distortion), camera.matrix is not None

    notes = Notes()
    assert made(calibration(distortion=[0.1, 0, 0, 0, 0])) == ("plumb_bob", 5, True)
    assert made(calibration(distortion=np.zeros(5))) == ("none", 0, True)
    assert made(calibration("equidistant", [0.1, 0, 0, 0])) == ("equidistant", 4, True)
    assert made(calibration("rational_polynomial", 0.1 * np.ones(8))) == ("rational_polynomial", 8, True)
    assert made(calibration("", [0.1, 0, 0, 0, 0])) == ("plumb_bob", 5, True)
    assert not notes.lines
    assert made(None) == ("none", 0, False)
    assert made(calibration(matrix=np.zeros((3, 3)))) == ("none", 0, False)
    assert made(calibration("omnidirectional", [0.1, 0.2])) == ("none", 0, False)
    assert made(calibration(), size=(100, 40)) == ("none", 0, False)
    assert len(notes.lines) == 3
    assert made(calibration(distortion=[0.1, 0, 0, 0, 0]), "/cam/image_rect/compressed") == ("none", 0, True)
    assert camera_of("/cam/image_rect", calibration(), (100, 80), notes).matrix[0, 0] == 90  # type: ignore[index]


def test_calibration_of_another_size_is_scaled() -> None:
    camera = camera_of("/cam/image", calibration(), (50, 40), notes := Notes())
    assert camera.matrix is not None
    # The corner of the image, half a pixel before the first centre, keeps its ray.
    ray = np.linalg.solve(calibration().matrix, [-0.5, -0.5, 1])
    np.testing.assert_allclose(camera.matrix @ ray, [-0.5, -0.5, 1])
    assert "scaled" in notes.lines[0]


def test_repairs_in_a_whole_log(tmp_path: Path) -> None:
    messages = ros_messages(Drive(), 2)
    images = [m for m in messages if m.topic == "/cam/image/compressed"]
    images[3].message.header.stamp, images[4].message.header.stamp = (
        images[4].message.header.stamp,
        images[3].message.header.stamp,
    )
    images[1].message.header.stamp = images[0].message.header.stamp
    for m in messages:
        if m.topic in ("/odom", "/tf_static"):
            (m.message.transforms if m.topic == "/tf_static" else [m.message])[0].header.stamp.__dict__.update(
                sec=0, nanosec=0
            )
    log = logs.open(write_ros2(tmp_path / "drive", messages))
    drive = Drive()
    np.testing.assert_array_equal(log.stamps(), np.delete(drive.stamp_ns, 1))
    decoded = [frame.decode().image for frame in log.frames(log.stamps())]
    np.testing.assert_array_equal(decoded, drive.images[[0, 2, 4, 3]])
    odometry = log.odometry()
    assert odometry is not None
    np.testing.assert_array_equal(odometry.stamp_ns, drive.stamp_ns + LATENCY_NS)
    notes = " ".join(log.warnings)
    assert "out of order" in notes
    assert "Lost: 1 message with the same stamp as an earlier one, at t=0.100 s: /cam/image/compressed 1 of 5." in notes
    assert "/odom has no header stamps" in notes


def test_depth_of_another_size_is_not_used(tmp_path: Path) -> None:
    messages = ros_messages(Drive(), 2)
    for m in messages:
        if m.topic == "/cam/depth":
            m.message.height //= 2
    log = logs.open(write_ros2(tmp_path / "drive", messages))
    assert "Depth is not used" in " ".join(log.info().warnings)
    assert next(iter(log.frames(log.stamps()))).decode().depth is None


def test_messages_that_do_not_decode_are_counted(tmp_path: Path) -> None:
    messages = [m for m in foxglove_messages(Drive()) if m.topic != "/fix"]
    path = write_foxglove(tmp_path / "a.mcap", messages, "json", use_chunking=False)
    data = path.read_bytes()
    at = data.rindex(b'{"timestamp"', 0, data.rindex(b'"pose"'))
    path.write_bytes(data[:at] + b"#" + data[at + 1 :])
    log = logs.open(path)
    odometry = log.odometry()
    assert odometry is not None
    assert len(odometry.stamp_ns) == 4
    assert "Lost: 1 message that cannot be decoded, at t=0.400 s: /pose 1 of 5." in log.warnings
