"""Calibrations as ROS sends them, for images that are a window of the sensor or have binned pixels."""

from __future__ import annotations

import numpy as np
import pytest

from tests.logs.drives import store
from vplog.logs.calibrations.camera import pinhole
from vplog.logs.cameras import camera_of
from vplog.logs.formats.container import Channel, Message, Notes
from vplog.logs.gather import TopicCollector
from vplog.logs.messages.records import CalibrationMessage
from vplog.logs.messages.ros import decode_ros
from vplog.logs.topic_selection import Selection

K = np.array([[800.0, 0, 630.5], [0, 810.0, 470.25], [0, 0, 1]])


def decoded(ros: int, roi: tuple[int, int, int, int], binning: tuple[int, int], k: np.ndarray) -> CalibrationMessage:
    types = store(ros).types
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = types["std_msgs/msg/Header"](**({"seq": 0} if ros == 1 else {}), stamp=stamp, frame_id="c")
    x, y, width, height = roi
    region = types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=x, y_offset=y, width=width, height=height, do_rectify=False
    )
    p = np.column_stack([k, [-40.0, 0, 0] if k.any() else np.zeros(3)])
    matrices = {"D": np.zeros(5), "K": k.ravel(), "R": np.eye(3).ravel(), "P": p.ravel()}
    message = types["sensor_msgs/msg/CameraInfo"](
        header=header, width=1280, height=960, distortion_model="plumb_bob", binning_x=binning[0],
        binning_y=binning[1], roi=region,
        **{name.lower() if ros == 2 else name: value for name, value in matrices.items()},
    )  # fmt: skip
    name = "sensor_msgs/msg/CameraInfo"
    if ros == 2:
        data, encoding = store(2).serialize_cdr(message, name), "cdr"
    else:
        data, encoding = store(1).serialize_ros1(message, name), "ros1"
    found = decode_ros("sensor_msgs/CameraInfo", encoding, bytes(data))
    assert isinstance(found, CalibrationMessage)
    return found


@pytest.mark.parametrize("ros", [1, 2])
def test_the_full_image_is_as_logged(ros: int) -> None:
    for roi in ((0, 0, 0, 0), (0, 0, 1280, 960)):
        for binning in ((0, 0), (1, 1)):
            found = decoded(ros, roi, binning, K)
            np.testing.assert_array_equal(found.matrix, K)
            assert (found.width, found.height) == (1280, 960)
            assert found.projection[0, 3] == -40.0


@pytest.mark.parametrize("ros", [1, 2])
def test_a_window_and_binned_pixels(ros: int) -> None:
    """The image of a point is where its full-image pixel is in the window, by the areas that pixels cover."""
    found = decoded(ros, (100, 40, 800, 600), (2, 4), K)
    assert (found.width, found.height) == (400, 150)
    point = np.array([0.3, -0.2, 2.0])
    u, v, _ = K @ point / point[2]
    expected = [(u + 0.5 - 100) / 2 - 0.5, (v + 0.5 - 40) / 4 - 0.5]
    np.testing.assert_allclose((found.matrix @ point / point[2])[:2], expected)
    np.testing.assert_allclose(found.projection[:, :3], found.matrix)
    # the baseline does not change: P[0, 3] and the focal length scale alike
    assert found.projection[0, 3] / found.projection[0, 0] == pytest.approx(-40.0 / 800.0)


def test_an_uncalibrated_window_stays_uncalibrated() -> None:
    assert not decoded(2, (100, 40, 800, 600), (2, 2), np.zeros((3, 3))).matrix.any()


@pytest.mark.parametrize(
    ("name", "coefficients", "model", "count"),
    [
        ("plumb_bob", [0.1, 0.2, 0.01, 0.02, 0.3], "plumb_bob", 5),
        ("plumb_bob", [0.1, 0.2, 0.01, 0.02, 0.3, 0.1, 0.2, 0.3], "rational_polynomial", 8),
        ("plumb_bob", [0.1, 0.2, 0.01, 0.02, 0.0, 0.0, 0.0], "plumb_bob", 4),
        ("rational_polynomial", [0.1, 0.2, 0.01, 0.02, 0.3], "plumb_bob", 5),
        ("rational_polynomial", [0.1] * 14, "rational_polynomial", 14),
        ("", [0.1, 0.2, 0.01, 0.02], "plumb_bob", 4),
        ("Brown Conrady", [0.1, 0.2, 0.01, 0.02, 0.3], "plumb_bob", 5),
        ("equidistant", [0.1, 0.2, 0.01, 0.02], "equidistant", 4),
        ("equidistant", [0.1, 0.2, 0.01, 0.02, 0.0], "equidistant", 4),
        ("kannala_brandt4", [0.1, 0.2, 0.01, 0.02], "equidistant", 4),
        ("fisheye", [0.1, 0.2, 0.01, 0.02], "equidistant", 4),
        ("fov", [0.0, 0.0], "none", 0),
        ("plumb_bob", [0.0] * 5, "none", 0),
        ("equidistant", [0.0] * 4, "equidistant", 4),
    ],
)
def test_lenses_are_known_by_the_names_and_counts_of_drivers(
    name: str, coefficients: list[float], model: str, count: int
) -> None:
    calibration = CalibrationMessage(0, "", 1280, 960, name, np.array(coefficients), K, np.zeros((3, 4)))
    camera = camera_of("/cam", calibration, (1280, 960), Notes())
    assert camera.matrix is not None
    assert camera.distortion_model == model
    np.testing.assert_array_equal(camera.distortion, coefficients[:count])


@pytest.mark.parametrize(("name", "count"), [("fov", 1), ("equidistant", 5), ("plumb_bob", 6), ("equidistant", 3)])
def test_other_lenses_are_said(name: str, count: int) -> None:
    notes = Notes()
    calibration = CalibrationMessage(0, "", 1280, 960, name, np.full(count, 0.1), K, np.zeros((3, 4)))
    assert camera_of("/cam", calibration, (1280, 960), notes).matrix is None
    assert "which is none of plumb_bob, rational_polynomial, equidistant" in notes.lines[0]


def test_one_calibration_for_both_cameras_of_a_pair_is_that_of_each() -> None:
    left, right = (Channel(f"/{side}/image", "sensor_msgs/Image", "ros1") for side in ("left", "right"))
    info = Channel("/camera_info", "sensor_msgs/CameraInfo", "ros1")
    read = TopicCollector(Selection(image=left, right=right, camera_info=info, right_info=info))
    read.add(Message(info, 0, CalibrationMessage(1, "c", 1280, 960, "plumb_bob", np.zeros(5), K, np.zeros((3, 4))), ()))
    for part in ("image", "right"):
        (found,) = read.calibrations(info, part, Notes())
        np.testing.assert_array_equal(found.matrix, K)


@pytest.mark.parametrize("scale", [0.5, 1.0, 1.1, 2.0])
def test_a_calibration_without_a_size_is_that_of_images_with_its_centre(scale: float) -> None:
    """KITTI's calib.txt beside images of other sizes."""
    notes, size = Notes(), (round(1241 * scale), round(376 * scale))
    camera = camera_of("image_0", pinhole(np.full(2, 718.9), np.array([607.2, 185.2])), size, notes)
    assert (camera.matrix is not None) == (abs(scale - 1) < 0.2)
    assert (f"(607.2, 185.2) px is far from that of images of {size[0]} x {size[1]} px" in " ".join(notes.lines)) == (
        camera.matrix is None
    )


def test_a_calibration_without_a_size_is_that_of_cropped_images() -> None:
    """The bonnet below is cut off."""
    notes = Notes()
    assert camera_of("cam", pinhole(np.full(2, 700.0), np.array([640.0, 360.0])), (1280, 480), notes).matrix is not None
    assert not notes.lines


KITTI = (np.array([984.2, 980.8]), np.array([690.0, 233.2]), np.array([721.5, 721.5]), np.array([609.6, 172.9]))
"""Focal lengths and centres of K_00 and P_rect_00 of 26 September 2011."""


@pytest.mark.parametrize(
    ("focal", "centre", "rectified_focal", "rectified_centre", "rectified"),
    [
        (*KITTI, True),
        (np.array([959.8, 956.9]), np.array([696.0, 224.2]), *KITTI[2:], True),  # the colour camera's
        (KITTI[0], np.array([610.0, 190.0]), *KITTI[2:], False),
        (KITTI[0], KITTI[1], KITTI[2], np.array([671.0, 221.5]), False),  # a window of the sensor, by alpha 0
        (KITTI[0], KITTI[1], KITTI[0] / 3, np.array([644.0, 202.7]), False),  # and of a wide lens
        (KITTI[0], KITTI[1], np.zeros(2), np.zeros(2), False),
    ],
)
def test_rectified_images_beside_a_raw_calibration_have_its_projection(
    focal: np.ndarray, centre: np.ndarray, rectified_focal: np.ndarray, rectified_centre: np.ndarray, rectified: bool
) -> None:
    """As kitti2bag writes them; raw images have K and its distortion."""
    own, other = pinhole(focal, centre), pinhole(rectified_focal, rectified_centre)
    p = np.column_stack([other.matrix * (rectified_focal[0] > 0), np.zeros(3)])
    lens = np.array([-0.37, 0.2, 0.002, 0.001, -0.07])
    calibration = CalibrationMessage(0, "", 1242, 375, "plumb_bob", lens, own.matrix, p)
    camera = camera_of("/kitti/camera_gray_left/image_raw", calibration, (1242, 375), notes := Notes())
    assert camera.matrix is not None
    np.testing.assert_array_equal(camera.matrix, other.matrix if rectified else own.matrix)
    assert camera.distortion_model == ("none" if rectified else "plumb_bob")
    assert ["kitti2bag" in line for line in notes.lines] == [True] * rectified
