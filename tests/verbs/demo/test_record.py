"""The demo log is a real ROS 2 MCAP: independent readers find in it what the drive says."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from vplog.errors import ResultError
from vplog.execution.execution import Execution
from vplog.geometry.se3 import rotation
from vplog.verbs.demo import SMALL, make_drive, route
from vplog.verbs.demo.record import (
    CAMERA_INFO,
    DEPTH,
    DEPTH_INFO,
    GPS,
    IMAGE,
    ODOMETRY,
    TF_STATIC,
    TYPES,
    Demo,
)
from vplog.verbs.demo.scene import make_scene, take_picture

if TYPE_CHECKING:
    from pathlib import Path

SETTINGS = SMALL.model_copy(update={"width": 320, "height": 180, "laps": 0.3, "depth": True})


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Demo:
    return make_drive(tmp_path_factory.mktemp("demo"), SETTINGS, Execution(2))


@pytest.fixture(scope="module")
def messages(drive: Demo) -> dict[str, list[tuple[int, Any]]]:
    """Log time and message by topic, as rosbags reads them."""
    result: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([drive.log]) as reader:
        for connection, log_ns, raw in reader.messages():
            assert connection.msgtype == TYPES[connection.topic]
            message = reader.deserialize(raw, connection.msgtype)
            result.setdefault(connection.topic, []).append((log_ns, message))
    return result


def stamp_ns(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def test_all_topics_are_there_with_a_message_for_every_stamp(drive: Demo, messages: dict) -> None:
    assert set(messages) == {IMAGE, CAMERA_INFO, DEPTH, DEPTH_INFO, GPS, ODOMETRY, TF_STATIC}
    for topic in (IMAGE, CAMERA_INFO, DEPTH, DEPTH_INFO):
        assert [stamp_ns(m) for _, m in messages[topic]] == drive.stamp_ns.tolist()
    assert [stamp_ns(m) for _, m in messages[ODOMETRY]] == route.odometry_stamps(SETTINGS).tolist()
    assert len(messages[TF_STATIC]) == 1


def test_messages_are_logged_2_to_30_ms_late_and_in_order(drive: Demo, messages: dict) -> None:
    for topic in set(messages) - {TF_STATIC}:
        for log_ns, message in messages[topic]:
            assert 2_000_000 <= log_ns - stamp_ns(message) <= 30_000_000
    with drive.log.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        times = [m.log_time for _, _, m in reader.iter_messages(log_time_order=False)]
        summary = reader.get_summary()
    assert times == sorted(times)
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(times)
    assert {c.compression for c in summary.chunk_indexes} == {"zstd"}


def test_images_are_the_rendered_ones(drive: Demo, messages: dict) -> None:
    scene = make_scene(SETTINGS)
    for frame in (0, 3):
        rendered, depth = take_picture(scene, frame)
        image = cv2.imdecode(messages[IMAGE][frame][1].data, cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert image.shape == (SETTINGS.height, SETTINGS.width)
        assert np.abs(image.astype(int) - rendered).mean() < 5  # JPEG
        data = messages[DEPTH][frame][1].data
        mm = cv2.imdecode(data[12:], cv2.IMREAD_UNCHANGED)
        assert mm is not None
        assert mm.dtype == np.uint16
        known = np.isfinite(depth)
        assert (mm[~known] == 0).all()
        np.testing.assert_allclose(mm[known] / 1000, depth[known], atol=0.00051)


def test_calibration_and_mounting_are_the_drives(drive: Demo, messages: dict) -> None:
    info = messages[CAMERA_INFO][0][1]
    assert drive.camera.matrix is not None
    np.testing.assert_array_equal(info.k.reshape(3, 3), drive.camera.matrix)
    assert (info.width, info.height) == (drive.camera.width, drive.camera.height)
    transform = messages[TF_STATIC][0][1].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("base_link", "camera_optical")
    assert info.header.frame_id == "camera_optical"
    q, t = transform.transform.rotation, transform.transform.translation
    np.testing.assert_allclose(
        rotation(np.array([q.x, q.y, q.z, q.w])), drive.camera.body_from_camera[:3, :3], atol=1e-12
    )
    np.testing.assert_array_equal([t.x, t.y, t.z], drive.camera.body_from_camera[:3, 3])


def test_odometry_has_a_usable_covariance_and_starts_at_its_origin(messages: dict) -> None:
    first = messages[ODOMETRY][0][1]
    assert (first.pose.pose.position.x, first.pose.pose.orientation.w) == (0, 1)
    covariance = first.pose.covariance.reshape(6, 6)
    assert (np.linalg.eigvalsh(covariance) > 0).all()


def test_truth_covers_every_frame_and_sample(drive: Demo) -> None:
    lines = [line.split() for line in drive.truth.read_text().splitlines()[1:]]
    truth = {int(line[0].replace(".", "")): np.array(line[1:], float) for line in lines}
    assert list(truth) == sorted(truth)
    assert set(route.odometry_stamps(SETTINGS).tolist()) | set(drive.stamp_ns.tolist()) == set(truth)
    for stamp, pose in zip(drive.stamp_ns.tolist(), drive.world_from_body, strict=True):
        np.testing.assert_allclose(truth[stamp][:3], pose[:3, 3], atol=1e-9)
        np.testing.assert_allclose(rotation(truth[stamp][3:]), pose[:3, :3], atol=1e-8)


def test_the_number_of_threads_does_not_change_a_byte(drive: Demo, tmp_path: Path) -> None:
    again = make_drive(tmp_path, SETTINGS, Execution())
    assert again.log.read_bytes() == drive.log.read_bytes()
    assert again.truth.read_bytes() == drive.truth.read_bytes()


def test_a_folder_that_cannot_be_made_is_a_known_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultError, match="Choose another folder"):
        make_drive(tmp_path / "file", SETTINGS)
