"""Calibration from a file beside the log, in each of the formats that calibration tools write."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.logs.drives import HEIGHT, WIDTH, Drive, Written, ros_messages, write_ros2
from tests.logs.test_odometry_kinds import header, message
from tests.logs.test_rectification import BASELINE_M, PINHOLES, RIGHT_FROM_LEFT, SIZE, check, drive
from vplog import logs
from vplog.errors import LogError
from vplog.logs import TopicChoice
from vplog.logs.calibration_file import camera_for, read_calibrations
from vplog.logs.cameras import camera_of
from vplog.logs.formats.container import Notes

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.stages import Log

K = [[150.0, 0.0, 31.0], [0.0, 151.0, 22.0], [0.0, 0.0, 1.0]]
D = [-0.1, 0.02, 0.001, -0.002, 0.0]


def matrix(rows: Any) -> dict:
    array = np.array(rows, float)
    return {"rows": array.shape[0], "cols": array.size // array.shape[0], "data": array.ravel().tolist()}


def camera_info() -> dict:
    """As camera_calibration writes it."""
    return {
        "image_width": WIDTH, "image_height": HEIGHT, "camera_name": "front", "distortion_model": "plumb_bob",
        "camera_matrix": matrix(K), "distortion_coefficients": matrix([D]),
        "rectification_matrix": matrix(np.eye(3)), "projection_matrix": matrix(np.column_stack([K, np.zeros(3)])),
    }  # fmt: skip


def kalibr(rostopics: tuple[str, str] = ("/cam0/image_raw", "/cam1/image_raw")) -> dict:
    return {
        f"cam{i}": {
            "camera_model": "pinhole", "intrinsics": [150.0 + i, 151.0, 31.0, 22.0], "distortion_model": "radtan",
            "distortion_coeffs": D[:4], "resolution": [WIDTH, HEIGHT], "rostopic": topic,
            **({"T_cn_cnm1": RIGHT_FROM_LEFT.tolist()} if i else {}),
        }
        for i, topic in enumerate(rostopics)
    }  # fmt: skip


def write(path: Path, tree: Any) -> Path:
    path.write_text(yaml.safe_dump(tree))
    return path


def test_camera_info_takes_the_place_of_the_logs_own(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "drive", ros_messages(Drive(), 2))
    file = write(tmp_path / "front.yaml", camera_info())
    camera = logs.open(path, TopicChoice(calibration_file=file)).camera()
    np.testing.assert_array_equal(camera.matrix, K)
    np.testing.assert_array_equal(camera.distortion, D)
    assert camera.distortion_model == "plumb_bob"
    np.testing.assert_allclose(camera.body_from_camera, Drive().body_from_camera, atol=1e-9)  # still the log's
    with pytest.raises(LogError, match="--camera-info-topic or the file"):
        logs.open(path, TopicChoice(calibration_file=file, camera_info="/cam/camera_info"))


@pytest.mark.parametrize("name", ["front", "cam"])
def test_a_file_of_one_camera_is_of_that_in_use_and_of_those_it_names(name: str, tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "drive", ros_messages(Drive(), 2))
    topics = TopicChoice(calibration_file=write(tmp_path / "one.yaml", camera_info() | {"camera_name": name}))
    further = logs.open(path, topics.of_camera("/cam/image/compressed"))
    used = logs.open(path, topics)
    assert np.array_equal(np.asarray(used.camera().matrix), K)
    assert np.array_equal(np.asarray(further.camera().matrix), K) == (name == "cam")
    assert further.camera().matrix is not None
    assert ("that of the log is used" in " ".join(further.warnings)) == (name == "front")


def test_a_calibration_of_another_topic_is_said(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "drive", ros_messages(Drive(), 2))
    for topic in ("/cam0/image_raw", "/cam/image"):
        chain = {"cam0": kalibr((topic, ""))["cam0"]}
        log = logs.open(path, TopicChoice(calibration_file=write(tmp_path / "chain.yaml", chain)))
        log.camera()
        assert (f"The calibration is of {topic}" in " ".join(log.warnings)) == (topic == "/cam0/image_raw")


def test_a_folder_of_images_is_calibrated_by_a_file(tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(2):
        cv2.imwrite(str(folder / f"{i}.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    placed = np.eye(4)
    placed[:3, 3] = 0.1, 0.2, 0.3
    sensor = {
        "sensor_type": "camera", "T_BS": matrix(placed), "rate_hz": 20, "resolution": [WIDTH, HEIGHT],
        "camera_model": "pinhole", "intrinsics": [150.0, 151.0, 31.0, 22.0],
        "distortion_model": "radial-tangential", "distortion_coefficients": D[:4],
    }  # fmt: skip
    camera = logs.open(folder, TopicChoice(calibration_file=write(tmp_path / "sensor.yaml", sensor))).camera()
    np.testing.assert_array_equal(camera.matrix, K)
    np.testing.assert_array_equal(camera.body_from_camera, placed)
    uncalibrated = camera_info() | {"camera_matrix": matrix(np.zeros((3, 3)))}
    log = logs.open(folder, TopicChoice(calibration_file=write(tmp_path / "zero.yaml", uncalibrated)))
    assert log.camera().matrix is None
    assert "K[0] = 0" in " ".join(log.warnings)


@pytest.mark.parametrize("fisheye", [0, 1])
def test_opencvs_sample_marks_fisheye_lenses(fisheye: int, tmp_path: Path) -> None:
    """It writes no distortion_model (opencv/samples/cpp/tutorial_code/calib3d/camera_calibration)."""
    tree = {"fisheye_model": fisheye, "camera_matrix": matrix(K), "distortion_coefficients": matrix([D[:4]])}
    (camera,) = read_calibrations(write(tmp_path / "out_camera_data.xml.yaml", tree))
    found = camera_of("camera", camera.calibration, (WIDTH, HEIGHT), Notes())
    assert found.distortion_model == ("equidistant" if fisheye else "plumb_bob")


def test_kalibrs_camchain_by_topic_and_by_name(tmp_path: Path) -> None:
    path = write(tmp_path / "camchain.yaml", kalibr())
    cameras = read_calibrations(path)
    assert camera_for(cameras, "/cam1/image_raw", path).calibration.matrix[0, 0] == 151.0
    assert camera_for(cameras, "/cam0/image_raw/compressed", path).calibration.matrix[0, 0] == 150.0
    assert camera_for(cameras, "/rig/cam1/image", path).name == "cam1"
    with pytest.raises(LogError, match=r"cam0 \(/cam0/image_raw\), cam1"):
        camera_for(cameras, "/front", path)
    assert cameras[1].from_first is not None
    np.testing.assert_allclose(cameras[1].from_first, RIGHT_FROM_LEFT, atol=1e-6)
    assert (cameras[0].calibration.model, len(cameras[0].calibration.distortion)) == ("plumb_bob", 4)


def test_where_the_camera_sits_is_the_logs_word_first(tmp_path: Path) -> None:
    tree = kalibr()
    tree["cam0"]["T_cam_imu"] = np.linalg.inv(RIGHT_FROM_LEFT).tolist()
    topics = TopicChoice(calibration_file=write(tmp_path / "chain.yaml", {"cam0": tree["cam0"]}))
    drive, placed = Drive(), write_ros2(tmp_path / "placed", ros_messages(Drive(), 2))
    assert np.allclose(logs.open(placed, topics).camera().body_from_camera, drive.body_from_camera, atol=1e-9)
    found = [m for m in ros_messages(drive, 2) if m.topic != "/tf_static"]
    bare = logs.open(write_ros2(tmp_path / "bare", found), topics)
    np.testing.assert_allclose(bare.camera().body_from_camera, RIGHT_FROM_LEFT, atol=1e-9)


def imu_messages(frame: str, gravity: float) -> list[Written]:
    kind, values = "sensor_msgs/msg/Imu", {"angular_velocity": {"x": 0.1}, "linear_acceleration": {"z": gravity}}
    stamps = Drive().stamp_ns.tolist()
    return [Written("/imu", kind, stamp, message(kind, header=header(stamp, frame), **values)) for stamp in stamps]


def with_imu(folder: Path, found: list[Written], frame: str = "imu", gravity: float = 9.8, **more: Any) -> Log:
    """A log with an IMU of this frame, and the file that Kalibr makes of the two, with `more` of its camera."""
    tree = {"cam0": kalibr()["cam0"] | {"T_cam_imu": np.linalg.inv(RIGHT_FROM_LEFT).tolist(), **more}}
    ordered = sorted([*found, *imu_messages(frame, gravity)], key=lambda m: m.stamp_ns)
    file = write(folder / "chain.yaml", tree)
    return logs.open(write_ros2(folder / "drive", ordered), TopicChoice(calibration_file=file))


@pytest.mark.parametrize("gravity", [9.8, 0.0])
def test_kalibrs_imu_is_the_logs_where_no_transform_places_it(gravity: float, tmp_path: Path) -> None:
    """Unless it is a gyroscope alone."""
    found = [m for m in ros_messages(Drive(), 2) if m.topic not in ("/tf_static", "/odom", "/fix")]
    log = with_imu(tmp_path, found, gravity=gravity)
    imu = log.imu()
    if not gravity:
        assert imu is None
        assert "/imu: it does not measure both turns and accelerations" in " ".join(log.warnings)
        return
    assert imu is not None
    np.testing.assert_allclose(imu.body_from_imu, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(log.camera().body_from_camera, RIGHT_FROM_LEFT, atol=1e-9)
    assert "/imu is taken to be the IMU of the calibration." in log.warnings


@pytest.mark.parametrize(("placed", "frame"), [("imu", "imu"), ("", "base_link"), ("", "imu")])
def test_kalibrs_imu_is_placed_on_the_body_of_the_odometry(placed: str, frame: str, tmp_path: Path) -> None:
    """By the transforms, by its frame, or with a note."""
    drive, found = Drive(), ros_messages(Drive(), 2)
    found[0].message.transforms[1].child_frame_id = placed
    found = found if placed else found[1:]
    log = with_imu(tmp_path, found, frame)
    body_from_imu = drive.body_from_camera if placed else np.eye(4)
    np.testing.assert_allclose(log.camera().body_from_camera, body_from_imu @ RIGHT_FROM_LEFT, atol=1e-9)
    assert ("calibration's IMU is taken to be base_link" in " ".join(log.warnings)) == (not placed and frame == "imu")


@pytest.mark.parametrize("shift_s", [0.025, -0.004, 0.0])
def test_kalibrs_time_shift_puts_the_imu_on_the_cameras_clock(shift_s: float, tmp_path: Path) -> None:
    """t_imu = t_cam + timeshift_cam_imu."""
    found = [m for m in ros_messages(Drive(), 2) if m.topic not in ("/tf_static", "/odom", "/fix")]
    imu = with_imu(tmp_path, found, timeshift_cam_imu=shift_s).imu()
    assert imu is not None
    np.testing.assert_array_equal(Drive().stamp_ns - imu.stamp_ns, round(shift_s * 1e9))
    chain = {"cam0": kalibr()["cam0"] | {"timeshift_cam_imu": 1e12}}
    with pytest.raises(LogError, match="longer than an hour"):
        read_calibrations(write(tmp_path / "long.yaml", chain))


def test_the_body_of_a_data_sets_calibration_is_that_of_the_odometry(tmp_path: Path) -> None:
    """It is no IMU that the log's transforms place elsewhere on that body; which one Kalibr's is, a line says."""
    found = ros_messages(Drive(), 2)
    found[0].message.transforms[1].child_frame_id = "imu"
    log = with_imu(tmp_path, found)
    log.camera()
    assert "The calibration's IMU is taken to be that of /imu." in log.warnings
    sensor = kalibr()["cam0"] | {"T_BS": matrix(RIGHT_FROM_LEFT)}
    for tree in (sensor, {"cameras": [sensor | {"focal_length": [150, 151], "principal_point": [31, 22]}]}):
        file = write(tmp_path / "sensor.yaml", tree)
        log = logs.open(tmp_path / "drive", TopicChoice(calibration_file=file))
        assert log.odometry() is not None
        np.testing.assert_allclose(log.camera().body_from_camera, RIGHT_FROM_LEFT, atol=1e-9)


def orb_slam(**more: Any) -> dict:
    """Settings of a pair whose Camera.fx is of the rectified images, in the form of ORB-SLAM 2."""
    shared = {"Camera.fx": 140.0, "Camera.fy": 140.0, "Camera.cx": 30.0, "Camera.cy": 20.0, "Camera.bf": 14.0}
    sides = {}
    for side, (fx, shift) in {"LEFT": (150.0, 0.0), "RIGHT": (152.0, -14.0)}.items():
        sides |= {
            f"{side}.height": HEIGHT, f"{side}.width": WIDTH, f"{side}.D": matrix([D]), f"{side}.R": matrix(np.eye(3)),
            f"{side}.K": matrix([[fx, 0, 31], [0, 151, 22], [0, 0, 1]]),
            f"{side}.P": matrix([[140, 0, 30, shift], [0, 140, 20, 0], [0, 0, 1, 0]]),
        }  # fmt: skip
    return shared | sides | more


def test_orb_slams_raw_lenses_are_those_of_the_images(tmp_path: Path) -> None:
    path = write(tmp_path / "EuRoC.yaml", orb_slam(Tbc=matrix(RIGHT_FROM_LEFT)))
    left, right = read_calibrations(path)
    np.testing.assert_array_equal(left.calibration.matrix, K)
    np.testing.assert_array_equal(left.calibration.distortion, D)
    assert right.calibration.projection[0, 3] == -14.0
    assert (left.calibration.width, left.calibration.height) == (WIDTH, HEIGHT)
    assert left.body_from_camera is not None
    np.testing.assert_allclose(left.body_from_camera, RIGHT_FROM_LEFT, atol=1e-9)
    for topic in ("cam1", "/stereo/right/image_raw", "image_1"):
        assert camera_for([left, right], topic, path) is right
    assert camera_for([left, right], "/cam0/image_raw", path) is left
    with pytest.raises(LogError, match="LEFT, RIGHT"):
        camera_for([left, right], "/front", path)


def test_the_imu_of_openvins_and_of_orb_slam_3(tmp_path: Path) -> None:
    chain = kalibr()
    for part, placed in zip(chain.values(), (np.eye(4), np.linalg.inv(RIGHT_FROM_LEFT)), strict=True):
        part |= {"T_imu_cam": placed.tolist()}
    chain["cam1"].pop("T_cn_cnm1")
    _, second = read_calibrations(write(tmp_path / "kalibr_imucam_chain.yaml", chain))
    assert second.body_from_camera is not None
    assert second.from_first is not None
    np.testing.assert_allclose(second.body_from_camera, np.linalg.inv(RIGHT_FROM_LEFT), atol=1e-6)
    np.testing.assert_allclose(second.from_first, RIGHT_FROM_LEFT, atol=1e-6)
    numbers = {"fx": 150.0, "fy": 151.0, "cx": 31.0, "cy": 22.0}
    tree = {f"{name}.{one}": value for name in ("Camera1", "Camera2") for one, value in numbers.items()}
    tree |= {"IMU.T_b_c1": matrix(RIGHT_FROM_LEFT), "Stereo.T_c1_c2": matrix(np.linalg.inv(RIGHT_FROM_LEFT))}
    first, second = read_calibrations(write(tmp_path / "orb3.yaml", tree))
    assert first.body_from_camera is not None
    assert second.from_first is not None
    np.testing.assert_allclose(first.body_from_camera, RIGHT_FROM_LEFT, atol=1e-6)
    np.testing.assert_allclose(second.from_first, RIGHT_FROM_LEFT, atol=1e-6)


@pytest.mark.parametrize("baseline", [{"Camera.bf": 15.0}, {"Stereo.b": 0.1}])
def test_a_baseline_in_the_settings_of_orb_slam_makes_a_rectified_pair(tmp_path: Path, baseline: dict) -> None:
    tree = {"Camera.fx": 150.0, "Camera.fy": 150.0, "Camera.cx": 31.0, "Camera.cy": 22.0} | baseline
    path = write(tmp_path / "pair.yaml", tree)
    left, right = read_calibrations(path)
    assert right.from_first is not None
    np.testing.assert_allclose(right.from_first[:3], [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0]])
    assert camera_for([left, right], "/stereo/right/image_rect", path) is right
    assert camera_for([left, right], "/front", path) is left  # both have the same calibration
    (alone,) = read_calibrations(write(tmp_path / "depth.yaml", tree | {"DepthMapFactor": 5000.0}))
    assert alone.depth_per_m == 5000.0


def test_camchain_makes_a_pair_without_any_calibration_in_the_log(tmp_path: Path) -> None:
    names = ("/stereo/left/image_raw", "/stereo/right/image_raw")
    tree = kalibr(names)
    for part, lens in zip(tree.values(), PINHOLES, strict=True):
        fx, fy, cx, cy = lens.matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        part |= {"intrinsics": [fx, fy, cx, cy], "distortion_coeffs": lens.distortion[:4].tolist()}
        part["resolution"] = list(SIZE)
    path = drive(tmp_path, PINHOLES, RIGHT_FROM_LEFT)
    log = logs.open(path, TopicChoice(calibration_file=write(tmp_path / "camchain.yaml", tree)))
    check(log)
    assert log.camera().baseline_m == pytest.approx(BASELINE_M, abs=1e-6)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "not a mapping"),
        ("- 1", "not a mapping"),
        ("a: [", "not YAML"),
        ("a: 1", "neither camera_matrix nor intrinsics"),
        ("camera_matrix: {data: [1, 2]}", "where 9 numbers"),
        ("intrinsics: [1, 2, 3, .nan]", "where 4 numbers"),
        ("camera_model: omni\nintrinsics: [1, 2, 3, 4]", "camera_model 'omni'"),
        ("intrinsics: [1, 2, 3, 4]\ndistortion_model: fov", "distortion_model 'fov'"),
        ("intrinsics: [1, 2, 3, 4]\nresolution: [1, -5]", "not an image size"),
        ("intrinsics: [1, 2, 3, 4]\nT_BS: [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]", "not rigid"),
        ("a: &a [1]\nb: &b [*a, *a]\nintrinsics: [*b, *b]", "where 4 numbers"),
    ],
)
def test_what_is_no_calibration_is_said_in_a_line(text: str, why: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(LogError) as error:
        read_calibrations(path)
    assert why in str(error.value)
    assert "\n" not in str(error.value)


TREES = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["camera_matrix", "intrinsics", "cam0", "data", "T_cn_cnm1", "resolution"]), inner
        )
    ),
    max_leaves=12,
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(TREES)
def test_any_yaml_is_cameras_or_a_known_error(tmp_path: Path, tree: Any) -> None:
    path = write(tmp_path / "any.yaml", tree)
    try:
        assert all(np.isfinite(camera.calibration.matrix).all() for camera in read_calibrations(path))
    except LogError as error:
        assert "any.yaml" in str(error)
