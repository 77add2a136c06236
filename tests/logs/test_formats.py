"""The same drive in every format gives the same data."""

from __future__ import annotations

import dataclasses
import struct
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType
from scipy.spatial.transform import Rotation

from tests.logs.drives import (
    FRAMES,
    HEIGHT,
    START_NS,
    WIDTH,
    D,
    Drive,
    K,
    foxglove_messages,
    png,
    ros_messages,
    store,
    write_foxglove,
    write_ros1,
    write_ros2,
)
from vplog import logs
from vplog.errors import LogError
from vplog.logs.formats.container import Channel
from vplog.logs.image_folder import stamps_of
from vplog.logs.messages.decode import decode, read_poses, read_ros_poses
from vplog.logs.messages.records import PoseMessage
from vplog.logs.recorded_log import RecordedLog
from vplog.logs.topic_selection import TopicChoice
from vplog.stages import Log

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

DRIVE = Drive()
ROS: dict[str, Callable[[Path], Path]] = {
    "ros2-mcap": lambda p: write_ros2(p / "drive", ros_messages(DRIVE, 2)),
    "ros2-mcap-file": lambda p: write_ros2(p / "drive", ros_messages(DRIVE, 2)) / "drive.mcap",
    "ros2-db3": lambda p: write_ros2(p / "drive", ros_messages(DRIVE, 2), "sqlite3"),
    "ros2-db3-file": lambda p: write_ros2(p / "drive", ros_messages(DRIVE, 2), "sqlite3") / "drive.db3",
    "ros2-db3-zstd": lambda p: write_ros2(p / "drive", ros_messages(DRIVE, 2), "sqlite3", compression="message"),
    "ros1": lambda p: write_ros1(p / "drive.bag", ros_messages(DRIVE, 1)),
    "ros1-bz2": lambda p: write_ros1(p / "drive.bag", ros_messages(DRIVE, 1), "bz2"),
    "ros1-lz4": lambda p: write_ros1(p / "drive.bag", ros_messages(DRIVE, 1), "lz4"),
}
FOXGLOVE: dict[str, Callable[[Path], Path]] = {
    "protobuf": lambda p: write_foxglove(p / "drive.mcap", foxglove_messages(DRIVE), "protobuf"),
    "json": lambda p: write_foxglove(p / "drive.mcap", foxglove_messages(DRIVE), "json"),
    "lz4": lambda p: write_foxglove(
        p / "drive.mcap", foxglove_messages(DRIVE), "protobuf", compression=CompressionType.LZ4, chunk_size=4096
    ),
    "no-chunks": lambda p: write_foxglove(p / "drive.mcap", foxglove_messages(DRIVE), "json", use_chunking=False),
    "no-index": lambda p: write_foxglove(
        p / "drive.mcap", foxglove_messages(DRIVE), "json", use_statistics=False, use_summary_offsets=False,
        repeat_channels=False, repeat_schemas=False, chunk_size=4096,
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", [*ROS, *FOXGLOVE])
def test_what_every_format_gives_back(kind: str, tmp_path: Path) -> None:
    log = logs.open((ROS | FOXGLOVE)[kind](tmp_path))
    assert isinstance(log, Log)
    assert log.name == "drive"
    np.testing.assert_array_equal(log.stamps(), DRIVE.stamp_ns)
    camera = log.camera()
    np.testing.assert_array_equal(camera.matrix, K)
    np.testing.assert_array_equal(camera.distortion, D)
    assert (camera.distortion_model, camera.width, camera.height) == ("plumb_bob", WIDTH, HEIGHT)
    np.testing.assert_allclose(camera.body_from_camera, DRIVE.body_from_camera, atol=1e-12)
    frames = list(log.frames(log.stamps()))
    assert [frame.stamp_ns for frame in frames] == DRIVE.stamp_ns.tolist()
    with ThreadPoolExecutor(3) as pool:
        np.testing.assert_array_equal([f.image for f in pool.map(lambda f: f.decode(), frames)], DRIVE.images)
    odometry = log.odometry()
    assert odometry is not None
    np.testing.assert_array_equal(odometry.stamp_ns, DRIVE.stamp_ns)
    np.testing.assert_allclose(odometry.odom_from_body, DRIVE.odom_from_body, atol=1e-12)
    info = log.info()
    assert (info.start_ns, info.end_ns) == (DRIVE.stamp_ns[0], DRIVE.stamp_ns[-1])  # header stamps, not log times
    assert info.messages == sum(topic.count for topic in info.topics)
    assert {topic.role for topic in info.topics if topic.used} >= {"image", "camera_info", "odometry", "gps"}


@pytest.mark.parametrize("kind", ROS)
def test_ros_covariance_depth_and_fixes(kind: str, tmp_path: Path) -> None:
    log = logs.open(ROS[kind](tmp_path))
    odometry, gps = log.odometry(), log.gps()
    assert odometry is not None
    assert odometry.covariance is not None
    # Sampled, not derived: shifts and turns in the fixed axes, seen from the body.
    rng = np.random.default_rng(0)
    for i in (0, 3):
        noise = rng.multivariate_normal(np.zeros(6), DRIVE.covariance[i] * 1e-4, 20_000)
        turn = Rotation.from_quat(DRIVE.quaternion[i])
        phi = (turn.inv() * Rotation.from_rotvec(noise[:, 3:]) * turn).as_rotvec()
        seen = np.cov(np.hstack([phi, turn.inv().apply(noise[:, :3])]).T) * 1e4
        assert np.abs(seen - odometry.covariance[i]).max() < 0.05 * np.abs(DRIVE.covariance[i]).max()
    frame = next(iter(log.frames(log.stamps()[2:3]))).decode()
    assert frame.depth is not None
    assert frame.depth.dtype == np.float32
    assert np.isnan(frame.depth[0, :2]).all()
    np.testing.assert_allclose(frame.depth[1:], DRIVE.depth_mm[2, 1:] / 1000.0, rtol=1e-6)
    assert gps is not None
    np.testing.assert_array_equal(gps.stamp_ns, np.delete(DRIVE.stamp_ns, 1))  # the second has no fix
    np.testing.assert_array_equal(gps.latitude_deg, np.delete(DRIVE.latitude, 1))
    np.testing.assert_array_equal(np.isnan(gps.covariance).all((1, 2)), [False, True, False, False])
    np.testing.assert_array_equal(gps.covariance[0], np.diag([1.0, 4.0, 9.0]))


@pytest.mark.parametrize("odometry", [None, "visual", "gps"])
def test_the_antenna_is_placed_whatever_gives_the_odometry(odometry: str | None, tmp_path: Path) -> None:
    messages = ros_messages(DRIVE, 2)
    for m in messages:
        if m.topic == "/fix":
            m.message.header.frame_id = "camera"
    gps = logs.open(write_ros2(tmp_path / "drive", messages), TopicChoice(odometry=odometry)).gps()
    assert gps is not None
    assert gps.antenna_m is not None
    np.testing.assert_allclose(gps.antenna_m, DRIVE.body_from_camera[:3, 3])


def test_bag_folder_and_its_file_give_the_same(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", ros_messages(DRIVE, 2))
    a, b = logs.open(folder), logs.open(folder / "drive.mcap")
    assert (a.info().kind, b.info().kind) == ("ros2-mcap", "mcap")
    for x, y in ((a.camera(), b.camera()), (a.odometry(), b.odometry()), (a.gps(), b.gps())):
        assert x is not None
        assert y is not None
        for field in dataclasses.fields(x):
            np.testing.assert_array_equal(getattr(x, field.name), getattr(y, field.name))
    (folder / "metadata.yaml").unlink()
    assert logs.open(folder).info().topics == a.info().topics


def test_split_bag_is_one_drive(tmp_path: Path) -> None:
    messages = ros_messages(DRIVE, 2)
    (tmp_path / "drive").mkdir()
    for number, part in enumerate((messages[:16], messages[16:])):
        file = write_ros2(tmp_path / f"part{number}", part) / f"part{number}.mcap"
        file.rename(tmp_path / "drive" / f"drive_{number}.mcap")
    log = logs.open(tmp_path / "drive")
    np.testing.assert_array_equal(log.stamps(), DRIVE.stamp_ns)
    images = [frame.decode().image for frame in log.frames(log.stamps())]
    np.testing.assert_array_equal(images, DRIVE.images)


@pytest.mark.parametrize(
    ("names", "stamps", "note"),
    [
        (["frame2", "frame10", "frame1"], [0, 100_000_000, 200_000_000], "not times"),
        (["000002", "000010", "000001"], [0, 100_000_000, 200_000_000], "not times"),
        (["1600000000.5", "1600000001.25", "1600000000.25"], [250_000_000, 500_000_000, 1_250_000_000], ""),
        ([str(START_NS + 20), str(START_NS + 30), str(START_NS + 10)], [10, 20, 30], ""),
        (["1600000000002", "1600000000003", "1600000000001"], [1_000_000, 2_000_000, 3_000_000], ""),
    ],
)
def test_image_folder(names: list[str], stamps: list[int], note: str, tmp_path: Path) -> None:
    for i, name in enumerate(names):
        (tmp_path / f"{name}.png").write_bytes(png(np.full((4, 6), i, np.uint8)))
    (tmp_path / "notes.txt").write_text("not an image")
    log = logs.open(tmp_path)
    assert isinstance(log, Log)
    assert log.info().kind == "images"
    start = 0 if note else START_NS
    np.testing.assert_array_equal(log.stamps() - start, stamps)
    assert [int(f.decode().image[0, 0]) for f in log.frames(log.stamps())] == [2, 0, 1]
    assert "not times" not in " ".join(log.warnings)  # nothing is compared with them
    assert (log.camera().matrix, log.camera().width, log.odometry()) == (None, 6, None)
    truth = tmp_path.parent / f"{tmp_path.name}.tum"
    truth.write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    assert note in " ".join(logs.open(tmp_path, TopicChoice(odometry_file=truth)).warnings)


@pytest.mark.parametrize(
    ("count", "unit", "width"),
    [("s", 10**9, 10), ("ms", 10**6, 13), ("us", 10**3, 16), ("ns", 1, 19), ("ns", 1, 20), ("us", 10**3, 20),
     ("ms", 10**6, 20), ("s", 10**9, 20), ("ns", 1, 0)],
)  # fmt: skip
def test_whole_numbers_in_the_years_of_cameras_are_times(count: str, unit: int, width: int) -> None:
    rng = np.random.default_rng([unit, width])
    for year_s in (0.7e9, 1.4e9, 1.7e9, 4.0e9):
        since_1970 = int(year_s * 10**9 / unit) + np.cumsum(rng.integers(1, 10**11 // unit + 2, 20))
        names = [str(value).zfill(width) for value in since_1970.tolist()]
        assert stamps_of(names) == [value * unit for value in since_1970.tolist()], count


@pytest.mark.parametrize("width", [0, 6, 10, 13, 16, 19, 20])
@pytest.mark.parametrize("step", [1, 2, 5, 10, 100, 1000])
def test_counters_are_no_times_however_wide(width: int, step: int) -> None:
    for first in (0, 1, 42, 1000):
        names = [str(first + step * i).zfill(width) for i in range(30)]
        assert stamps_of(names) is None


@pytest.mark.parametrize("unit", [1, 1000])
@pytest.mark.parametrize("width", [0, 16, 20])
def test_us_and_ns_since_a_start_are_told_by_the_period(unit: int, width: int) -> None:
    rng = np.random.default_rng([unit, width])
    for rate_hz in (0.3, 1, 10, 15, 29.97, 60, 120, 190):
        period = 1e9 / rate_hz / unit
        values = rng.integers(0, 5 * 10**14 // unit) + np.cumsum(period * rng.uniform(0.98, 1.02, 25)).astype(np.int64)
        names = [str(value).zfill(width) for value in values.tolist()]
        assert stamps_of(names) == [value * unit for value in values.tolist()]


def test_names_of_phones_are_dates_with_times() -> None:
    names = ["PXL_20230512_235959999", "PXL_20230513_000000099~2", "PXL_20230513_000001000.MP"]
    assert stamps_of(names) == [1683935999999000000, 1683936000099000000, 1683936001000000000]
    assert stamps_of([f"PXL_20230512_1430{second}123" for second in range(10, 60, 7)]) is not None
    assert stamps_of([f"PXL_20230512_143015123_{row:04}" for row in range(1, 9)]) is None  # frames of one clip
    assert stamps_of([*names, "a picture"]) is None


def test_numbers_that_no_clock_has_count_the_images(tmp_path: Path) -> None:
    assert stamps_of(["9" * 20, "9" * 19 + "8"]) is None
    assert stamps_of(["00000000000000000007"]) is None
    assert stamps_of([str(START_NS), "left"]) is None
    assert stamps_of(["²1", "²2"]) is None
    for name in ("²2", "²10", "²1"):
        (tmp_path / f"{name}.png").write_bytes(png(np.full((4, 6), 1, np.uint8)))
    assert len(logs.open(tmp_path).stamps()) == 3


def test_damaged_images_of_a_folder_keep_their_time_and_are_counted(tmp_path: Path) -> None:
    for i in range(6):
        (tmp_path / f"{i}.png").write_bytes(png(np.full((4, 6), i, np.uint8)))
    (tmp_path / "0.png").write_bytes((tmp_path / "0.png").read_bytes()[:20])  # the head of an image
    (tmp_path / "2.png").write_bytes(b"")
    (tmp_path / "4.png").write_bytes(b"no image")
    log = logs.open(tmp_path)
    assert isinstance(log, RecordedLog)
    assert log.camera().width == 6
    np.testing.assert_array_equal(log.stamps(), np.array([0, 1, 3, 5]) * 100_000_000)
    for frame in log.frames(log.stamps()):
        if frame.stamp_ns:
            assert int(frame.decode().image[0, 0]) * 100_000_000 == frame.stamp_ns
        else:
            with pytest.raises(LogError, match="cannot be decoded"):
                frame.decode()
    assert {loss.reason: (loss.messages, loss.of) for loss in log.losses} == {
        "empty_image": (2, 6),
        "undecodable_image": (1, 6),
    }


def test_frames_are_given_in_order_of_time_and_only_those_asked_for(tmp_path: Path) -> None:
    log = logs.open(ROS["ros1"](tmp_path))
    asked = log.stamps()[[3, 1]]
    assert [frame.stamp_ns for frame in log.frames(asked)] == sorted(asked.tolist())
    with pytest.raises(LogError, match="no frame at 5 ns"):
        list(log.frames(np.array([5])))


def test_undecodable_image_names_topic_and_stamp(tmp_path: Path) -> None:
    messages = foxglove_messages(DRIVE)
    next(m for m in messages if m.topic == "/cam/image" and m.stamp_ns > START_NS).message.data = b"\xff\xd8\xffnothing"
    log = logs.open(write_foxglove(tmp_path / "a.mcap", messages, "protobuf"))
    decoded = 0
    for frame in log.frames(log.stamps()):
        if frame.stamp_ns == DRIVE.stamp_ns[1]:
            with pytest.raises(LogError, match=f"/cam/image at {frame.stamp_ns} ns"):
                frame.decode()
        else:
            decoded += frame.decode().image.shape == (HEIGHT, WIDTH)
    assert decoded == FRAMES - 1


def test_jpeg_orientation_is_ignored(tmp_path: Path) -> None:
    # One TIFF entry, big endian: tag 0x112 (orientation), type SHORT, count 1, value 6 (a quarter turn).
    tiff = b"MM" + struct.pack(">HIHHHIHHI", 42, 8, 1, 0x112, 3, 1, 6, 0, 0)
    exif = b"\xff\xe1" + struct.pack(">H", 8 + len(tiff)) + b"Exif\x00\x00" + tiff
    jpeg = cv2.imencode(".jpg", np.zeros((8, 16), np.uint8))[1].tobytes()
    turned = jpeg[:2] + exif + jpeg[2:]
    image = cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    assert image.shape == (16, 8)
    (tmp_path / "a.jpg").write_bytes(turned)
    log = logs.open(tmp_path)
    assert next(iter(log.frames(log.stamps()))).decode().image.shape == (8, 16)


@given(st.text(max_size=9), st.text(max_size=9), st.integers(0, 2**31 - 1), st.integers(1, 2))
@settings(deadline=None)
def test_odometry_read_in_place_is_what_the_general_decoder_reads(frame: str, child: str, sec: int, ros: int) -> None:
    m = next(m for m in ros_messages(DRIVE, ros) if m.topic == "/odom")
    m.message.header.frame_id, m.message.child_frame_id, m.message.header.stamp.sec = frame, child, sec
    encode = store(2).serialize_cdr if ros == 2 else store(1).serialize_ros1
    data = bytes(encode(m.message, m.type))
    channel = Channel("/odom", "nav_msgs/msg/Odometry", "cdr" if ros == 2 else "ros1")
    expected = decode(channel, data)
    assert isinstance(expected, PoseMessage)
    later = data[:4] + struct.pack("<I", sec // 2) + data[8:]
    found = read_ros_poses(channel, [data, later])
    assert found is not None
    assert found[1:3] == expected[1:3]
    assert found.stamp_ns.tolist() == [expected.stamp_ns, expected.stamp_ns - (sec - sec // 2) * 10**9]
    assert expected.covariance is not None
    assert found.covariances is not None
    for pose, covariance in zip(found.poses, found.covariances, strict=True):
        np.testing.assert_array_equal(pose, [*expected.position, *expected.quaternion])
        np.testing.assert_array_equal(covariance, expected.covariance)
    for other in (data[:-1], data + b"0000", data[:20], b"\x01" + data[1:] if ros == 2 else b""):
        assert read_poses(channel, [data, other]) is None
