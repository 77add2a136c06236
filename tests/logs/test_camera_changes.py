"""Cameras as logs have them: thermal ones beside depth, calibrations that come late, sizes and windows that change."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from tests.logs.drives import PERIOD_NS, START_NS, Drive, Written, ros_messages, store, write_ros1, write_ros2
from vplog import logs
from vplog.errors import LogError
from vplog.logs.topic_selection import TopicChoice

if TYPE_CHECKING:
    from pathlib import Path

RNG = np.random.default_rng(8)
SIZE = (160, 120)
INFO = "/cam/camera_info"
K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
_BLURRED = cv2.GaussianBlur(RNG.random((120, 160)), (0, 0), 3)
SCENE = (255 * (_BLURRED - _BLURRED.min()) / np.ptp(_BLURRED)).astype(np.uint8)
TYPES = {"16UC1": np.uint16, "16SC1": np.int16, "32FC1": np.float32, "64FC1": np.float64, "32SC1": np.int32}


def header(ros: int, stamp: int, frame: str) -> Any:
    types = store(ros).types
    time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return types["std_msgs/msg/Header"](**({"seq": 0} if ros == 1 else {}), stamp=time, frame_id=frame)


def image(pixels: np.ndarray, number: int, topic: str, encoding: str = "mono8", ros: int = 2) -> Written:
    stamp = START_NS + number * PERIOD_NS
    message = store(ros).types["sensor_msgs/msg/Image"](
        header=header(ros, stamp, topic.split("/")[1]), height=pixels.shape[0], width=pixels.shape[1],
        encoding=encoding, is_bigendian=0, step=pixels.shape[1] * pixels.itemsize,
        data=np.frombuffer(pixels.tobytes(), np.uint8),
    )  # fmt: skip
    return Written(topic, "sensor_msgs/msg/Image", stamp, message)


def info(matrix: np.ndarray, size: tuple[int, int], number: int, ros: int = 2, **roi: int) -> Written:
    stamp, types = START_NS + number * PERIOD_NS, store(ros).types
    window = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False} | roi
    fields = {"D": np.zeros(5), "K": matrix.ravel(), "R": np.eye(3).ravel(), "P": np.zeros(12)}
    fields = {name.lower() if ros == 2 else name: value for name, value in fields.items()}
    message = types["sensor_msgs/msg/CameraInfo"](
        header=header(ros, stamp, "cam"), height=size[1], width=size[0], distortion_model="plumb_bob", **fields,
        binning_x=0, binning_y=0, roi=types["sensor_msgs/msg/RegionOfInterest"](**window),
    )  # fmt: skip
    return Written(INFO, "sensor_msgs/msg/CameraInfo", stamp, message)


def written(path: Path, messages: list[Written], ros: int = 2) -> Path:
    return write_ros2(path, messages) if ros == 2 else write_ros1(path.with_suffix(".bag"), messages)


def decoded(log: Any) -> list[np.ndarray]:
    return [frame.decode().image for frame in log.frames(log.stamps())]


@pytest.mark.parametrize("topic", ["/thermal/image_raw", "/cam/image_raw"])
def test_a_thermal_camera_is_a_camera(topic: str, tmp_path: Path) -> None:
    counts = (29_000 + 4 * SCENE.astype(np.uint16)).astype(np.uint16)
    counts[5, 5] = 0  # a dead px
    path = written(tmp_path / "drive", [image(counts, i, topic, "16UC1") for i in range(5)])
    for choice in (TopicChoice(), TopicChoice(image=topic)):
        found = decoded(logs.open(path, choice))
        assert len(found) == 5
        assert np.corrcoef(found[0].ravel(), SCENE.ravel())[0, 1] > 0.99
        assert len(np.unique(found[0])) > 150


@pytest.mark.parametrize("encoding", ["16UC1", "16SC1", "32FC1", "64FC1"])
def test_depth_of_any_type_is_depth(encoding: str, tmp_path: Path) -> None:
    """With px that were not measured, under a name that says nothing."""
    unit = 1000 if encoding.startswith("16") else 1
    metres = 1 + SCENE / 100
    metres[20:30] = 0
    messages = [image((metres * unit).astype(TYPES[encoding]), i, "/x/data", encoding) for i in range(9)]
    messages += [image(SCENE, i, "/y/data") for i in range(4)]
    messages = sorted(messages, key=lambda m: m.stamp_ns)
    log = logs.open(written(tmp_path / "unknown", messages))
    assert {topic.name: topic.role for topic in log.info().topics} == {"/x/data": "depth", "/y/data": "image"}
    assert next(iter(log.frames(log.stamps()[:1]))).decode().depth is None, "metres without a focal length"
    assert "Depth is not used: camera /y/data is not calibrated. Give its --calibration." in log.warnings
    log = logs.open(written(tmp_path / "drive", [info(K, SIZE, 0), *messages]), TopicChoice(camera_info=INFO))
    frame = next(iter(log.frames(log.stamps()[:1]))).decode()
    assert frame.depth is not None
    np.testing.assert_allclose(frame.depth[40:], metres[40:], atol=1e-3)
    assert np.isnan(frame.depth[20:30]).all()


def test_sixteen_bits_registered_to_a_camera_are_depth(tmp_path: Path) -> None:
    """Of a renderer, whose depth has no px without measurement; its frame is the camera's."""
    messages = [image(1000 + SCENE.astype(np.uint16), i, "/cam/z", "16UC1") for i in range(5)]
    messages += [image(SCENE, i, "/cam/image") for i in range(5)]
    log = logs.open(written(tmp_path / "drive", messages))
    assert {topic.name: topic.role for topic in log.info().topics} == {"/cam/z": "depth", "/cam/image": "image"}


@pytest.mark.parametrize("encoding", ["png", "mono16; png compressed"])
def test_a_png_of_16_bits_is_depth_by_its_name(encoding: str, tmp_path: Path) -> None:
    messages = []
    for i in range(5):
        for topic, pixels in (("/a/depth/image", 1000 + SCENE.astype(np.uint16)), ("/b/image", SCENE)):
            file = np.frombuffer(cv2.imencode(".png", pixels)[1].tobytes(), np.uint8)
            of = encoding if "depth" in topic else "png"
            stamp = START_NS + i * PERIOD_NS
            message = store(2).types["sensor_msgs/msg/CompressedImage"](
                header=header(2, stamp, "cam"), format=of, data=file
            )
            messages.append(Written(topic, "sensor_msgs/msg/CompressedImage", stamp, message))
    log = logs.open(written(tmp_path / "drive", [info(K, SIZE, 0), *messages]))
    assert {topic.name: topic.role for topic in log.info().topics if topic.name != INFO} == {
        "/a/depth/image": "depth",
        "/b/image": "image",
    }
    frame = next(iter(log.frames(log.stamps()[:1]))).decode()
    assert frame.depth is not None
    np.testing.assert_allclose(frame.depth, 1 + SCENE / 1000, atol=1e-6)


def test_depth_that_is_asked_for_as_the_image_is_not_its_own_depth(tmp_path: Path) -> None:
    holes = (20 * SCENE.astype(np.uint16)).astype(np.uint16)
    holes[:30] = 0
    path = written(tmp_path / "drive", [image(holes, i, "/cam/depth", "16UC1") for i in range(3)])
    with pytest.raises(LogError, match=r"thermal camera's, take it with --image-topic /cam/depth\."):
        logs.open(path).camera()
    log = logs.open(path, TopicChoice(image="/cam/depth"))
    assert len(decoded(log)) == 3
    assert log.info().warnings == []


def test_an_encoding_that_cannot_be_decoded_is_chosen_last(tmp_path: Path) -> None:
    labels = [image(SCENE.astype(np.int32), i, "/a/labels", "32SC1") for i in range(9)]
    path = written(tmp_path / "drive", labels + [image(SCENE, i, "/b/image") for i in range(3)])
    np.testing.assert_array_equal(decoded(logs.open(path))[0], SCENE)


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("late", [1, 15])
def test_the_first_calibration_that_is_set_is_the_cameras(ros: int, late: int, tmp_path: Path) -> None:
    messages = [image(SCENE, i, "/cam/image", ros=ros) for i in range(20)]
    messages += [info(K if i >= late else np.zeros((3, 3)), SIZE, i, ros) for i in range(20)]
    log = logs.open(written(tmp_path / "drive", sorted(messages, key=lambda m: m.stamp_ns), ros))
    matrix = log.camera().matrix
    assert matrix is not None
    np.testing.assert_allclose(matrix, K)
    (line,) = [line for line in log.warnings if "not set" in line]
    assert f"The first {late} calibration" in line
    assert "/cam/camera_info" in line


def test_a_calibration_of_nan_is_not_set(tmp_path: Path) -> None:
    bad = K.copy()
    bad[0, 2] = np.nan
    messages = [image(SCENE, i, "/cam/image") for i in range(6)] + [info(K if i else bad, SIZE, i) for i in range(6)]
    matrix = logs.open(written(tmp_path / "drive", sorted(messages, key=lambda m: m.stamp_ns))).camera().matrix
    assert matrix is not None
    np.testing.assert_allclose(matrix, K)


@pytest.mark.parametrize(("stamped", "late_ns"), [(False, None), (True, None), (True, 3_000_000), (True, -(10**18))])
def test_a_calibration_holds_from_its_image_on(stamped: bool, late_ns: int | None, tmp_path: Path) -> None:
    """A lens that zooms, by a driver that stamps nothing, or the calibrations not as the images."""
    doubled = np.diag([2, 2, 1]) @ K
    messages = [image(SCENE, i, "/cam/image") for i in range(8)]
    messages += [info(K if i < 4 else doubled, SIZE, i) for i in range(8)]
    for message in messages:
        of_image = message.topic == "/cam/image"
        if of_image and stamped:
            continue
        stamp_ns = 0 if of_image or late_ns is None else message.stamp_ns + late_ns
        message.message.header.stamp.__dict__.update(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    log = logs.open(written(tmp_path / "drive", sorted(messages, key=lambda m: m.stamp_ns)))
    zoomed = [not np.array_equal(one, SCENE) for one in decoded(log)]
    assert zoomed == [False] * 4 + [True] * 4


def test_calibrations_that_are_never_set_are_said(tmp_path: Path) -> None:
    messages = [image(SCENE, i, "/cam/image") for i in range(3)] + [info(np.zeros((3, 3)), SIZE, i) for i in range(3)]
    log = logs.open(written(tmp_path / "drive", messages))
    assert log.camera().matrix is None
    assert any("is not set" in line and "uncalibrated" in line for line in log.warnings)


def test_images_of_another_size_are_brought_to_the_cameras(tmp_path: Path) -> None:
    """Half the size from the fourth image on, by binning, with and without a calibration that says so."""
    half = cv2.resize(SCENE, (80, 60), interpolation=cv2.INTER_AREA)
    halved = np.diag([0.5, 0.5, 1]) @ K
    halved[:2, 2] = (K[:2, 2] + 0.5) / 2 - 0.5
    for said in (False, True):
        messages = [image(SCENE if i < 4 else half, i, "/cam/image") for i in range(8)]
        messages += [info(*((halved, (80, 60)) if said and i >= 4 else (K, SIZE)), i) for i in range(8)]
        log = logs.open(written(tmp_path / f"drive{said}", sorted(messages, key=lambda m: m.stamp_ns)))
        images = decoded(log)
        np.testing.assert_array_equal(images[0], SCENE)
        assert {one.shape for one in images} == {SCENE.shape}
        assert np.abs(images[-1].astype(int) - SCENE).mean() < 3
        assert any("change their size" in line and "160 x 120" in line for line in log.warnings)


def test_a_window_that_moves_keeps_rays(tmp_path: Path) -> None:
    """The sensor sends another part of itself: what is seen stays where the first calibration has it."""
    windows = [(0, 0, 120, 90), (40, 30, 120, 90)]
    messages = []
    for i in range(8):
        x, y, width, height = windows[i >= 4]
        part = np.ascontiguousarray(SCENE[y : y + height, x : x + width])
        messages.append(info(K, SIZE, i, x_offset=x, y_offset=y, width=width, height=height))
        messages.append(image(part, i, "/cam/image"))
    images = decoded(logs.open(written(tmp_path / "drive", messages)))
    np.testing.assert_array_equal(images[0], SCENE[:90, :120])
    np.testing.assert_array_equal(images[-1][30:, 40:], SCENE[30:90, 40:120])


def test_depth_of_another_size_is_left_out_and_counted(tmp_path: Path) -> None:
    depth = 1000 + 10 * SCENE.astype(np.uint16)
    depth[:9] = 0
    messages = [image(SCENE, i, "/cam/image") for i in range(8)]
    messages += [image(depth if i < 4 else depth[:60].copy(), i, "/cam/depth", "16UC1") for i in range(8)]
    messages += [info(K, SIZE, 0)]
    log: Any = logs.open(written(tmp_path / "drive", sorted(messages, key=lambda m: m.stamp_ns)))
    with_depth = [frame.decode().depth is not None for frame in log.frames(log.stamps())]
    assert with_depth == [True] * 4 + [False] * 4
    assert [(loss.topic, loss.messages) for loss in log.account.losses] == [("/cam/depth", 4)]
    assert "/cam/depth has 160 x 60 px where the image has 160 x 120" in log.account.sentences[0]


@pytest.mark.parametrize("kind", ["png", "tiff", "pgm"])
def test_levels_of_sixteen_bits_are_one_where_the_first_image_is_damaged(kind: str, tmp_path: Path) -> None:
    messages = []
    for i, gain in enumerate((1, 5, 10, 20)):
        file = b"no image" * 200 if not i else cv2.imencode(f".{kind}", gain * SCENE.astype(np.uint16))[1].tobytes()
        stamp = START_NS + i * PERIOD_NS
        message = store(2).types["sensor_msgs/msg/CompressedImage"](
            header=header(2, stamp, "cam"), format=f"mono16; {kind}", data=np.frombuffer(file, np.uint8)
        )
        messages.append(Written("/cam/image", "sensor_msgs/msg/CompressedImage", stamp, message))
    log = logs.open(written(tmp_path / "drive", messages))
    means = [frame.decode().image.mean() for frame in log.frames(log.stamps()[1:])]
    np.testing.assert_allclose(np.divide(means, means[-1]), [5 / 20, 10 / 20, 1], atol=0.05)


def test_images_of_another_shape_are_left_out_and_counted(tmp_path: Path) -> None:
    messages = [image(SCENE if i < 4 else SCENE[:, :100].copy(), i, "/cam/image") for i in range(8)]
    log: Any = logs.open(written(tmp_path / "drive", messages))
    lost = 0
    for frame in log.frames(log.stamps()):
        try:
            assert frame.decode().image.shape == SCENE.shape
        except LogError as error:
            assert "100 x 120 px among those of 160 x 120" in str(error)
            lost += 1
    assert lost == 4
    assert [(loss.topic, loss.messages) for loss in log.account.losses] == [("/cam/image", 4)]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_storage_file_whose_messages_are_packed_is_read_without_its_folder(storage: str, tmp_path: Path) -> None:
    drive = Drive()
    folder = write_ros2(tmp_path / "drive", ros_messages(drive, 2), storage, compression=True)
    (file,) = [file for file in folder.iterdir() if file.suffix in (".mcap", ".db3")]
    alone = file.rename(tmp_path / file.name)
    log: Any = logs.open(alone)
    np.testing.assert_array_equal(log.stamps(), drive.stamp_ns)
    np.testing.assert_array_equal(decoded(log), drive.images)
    odometry = log.odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body, drive.odom_from_body)
    assert log.account.losses == []
