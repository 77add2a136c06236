"""Odometry from whatever carries it: every pose type, chains of transforms, and a file beside the log."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from scipy.spatial.transform import Rotation, Slerp

from tests.logs.drives import START_NS, Written, matrices, matrix, store, write_foxglove, write_ros1, write_ros2
from vplog import logs
from vplog.data import Trajectory
from vplog.errors import LogError
from vplog.geometry.tum import write_tum
from vplog.logs import TopicChoice

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.stages import Log

COUNT, PERIOD_NS = 20, 100_000_000
RNG = np.random.default_rng(11)
STAMPS = START_NS + PERIOD_NS * np.arange(COUNT)
POSITION = np.cumsum(RNG.normal(size=(COUNT, 3)), axis=0)
TURN = Rotation.from_rotvec(np.cumsum(RNG.normal(scale=0.05, size=(COUNT, 3)), axis=0))
POSES = matrices(POSITION, TURN)
CAMERA = matrix(np.array([0.3, 0.0, 0.2]), Rotation.from_euler("xyz", [-1.5, 0.0, -1.5]))


def header(ros: int, stamp_ns: int, frame: str) -> Any:
    types = store(ros).types
    stamp = types["builtin_interfaces/msg/Time"](sec=int(stamp_ns // 10**9), nanosec=int(stamp_ns % 10**9))
    return types["std_msgs/msg/Header"](**({"seq": 0} if ros == 1 else {}), stamp=stamp, frame_id=frame)


def point(ros: int, kind: str, v: np.ndarray) -> Any:
    return store(ros).types[f"geometry_msgs/msg/{kind}"](**dict(zip("xyzw", map(float, v), strict=False)))


def transform(ros: int, stamp_ns: int, parent: str, child: str, pose: np.ndarray) -> Any:
    types = store(ros).types
    value = types["geometry_msgs/msg/Transform"](
        translation=point(ros, "Vector3", pose[:3, 3]),
        rotation=point(ros, "Quaternion", Rotation.from_matrix(pose[:3, :3]).as_quat()),
    )
    stamped = types["geometry_msgs/msg/TransformStamped"]
    return stamped(header=header(ros, stamp_ns, parent), child_frame_id=child, transform=value)


def tf(ros: int, topic: str, stamp_ns: int, *edges: tuple[str, str, np.ndarray]) -> Written:
    name = "tf2_msgs/msg/TFMessage"
    message = store(ros).types[name](transforms=[transform(ros, stamp_ns, *edge) for edge in edges])
    return Written(topic, name, int(stamp_ns), message)


def image(ros: int, stamp_ns: int) -> Written:
    data = np.frombuffer(cv2.imencode(".png", np.zeros((8, 10), np.uint8))[1].tobytes(), np.uint8)
    message = store(ros).types["sensor_msgs/msg/CompressedImage"](
        header=header(ros, stamp_ns, "camera"), format="png", data=data
    )
    return Written("/cam/image", "sensor_msgs/msg/CompressedImage", int(stamp_ns), message)


def pose_message(kind: str, stamp_ns: int, pose: np.ndarray) -> Any:
    """A ROS 2 message of one of the odometry types."""
    types = store(2).types
    if kind == "geometry_msgs/msg/TransformStamped":
        return transform(2, stamp_ns, "odom", "base_link", pose)
    value = types["geometry_msgs/msg/Pose"](
        position=point(2, "Point", pose[:3, 3]),
        orientation=point(2, "Quaternion", Rotation.from_matrix(pose[:3, :3]).as_quat()),
    )
    at = header(2, stamp_ns, "odom")
    if kind == "geometry_msgs/msg/PoseStamped":
        return types[kind](header=at, pose=value)
    full = types["geometry_msgs/msg/PoseWithCovariance"](pose=value, covariance=np.eye(6).ravel())
    if kind == "geometry_msgs/msg/PoseWithCovarianceStamped":
        return types[kind](header=at, pose=full)
    zero = point(2, "Vector3", np.zeros(3))
    twist = types["geometry_msgs/msg/TwistWithCovariance"](
        twist=types["geometry_msgs/msg/Twist"](linear=zero, angular=zero), covariance=np.zeros(36)
    )
    return types[kind](header=at, child_frame_id="base_link", pose=full, twist=twist)


@pytest.mark.parametrize(
    "kind",
    [
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/PoseStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TransformStamped",
    ],
)
def test_every_pose_type_of_ros(kind: str, tmp_path: Path) -> None:
    found = [
        Written("/pose", kind, int(t), pose_message(kind, int(t), pose))
        for t, pose in zip(STAMPS.tolist(), POSES, strict=True)
    ]
    odometry = logs.open(write_ros2(tmp_path / "drive", found)).odometry()
    assert odometry is not None
    np.testing.assert_array_equal(odometry.stamp_ns, STAMPS)
    np.testing.assert_allclose(odometry.odom_from_body, POSES, atol=1e-9)
    assert (odometry.covariance is not None) == ("Covariance" in kind or "Odometry" in kind)


def test_a_chain_of_moving_and_static_transforms(tmp_path: Path) -> None:
    """map -> odom (slow, moving) -> footprint (moving) -> base_link (static) -> camera; odom is what does not jump."""
    lift = matrix(np.array([0.0, 0.0, 0.4]), Rotation.identity())
    found = [tf(2, "/tf_static", START_NS, ("base_link", "camera", CAMERA), ("footprint", "base_link", lift))]
    for i, (stamp, pose) in enumerate(zip(STAMPS.tolist(), POSES, strict=True)):
        found.append(tf(2, "/tf", stamp, ("odom", "footprint", pose), ("base_link", "arm", POSES[-1 - i])))
        if i % 5 == 0:
            found.append(tf(2, "/tf", stamp, ("map", "odom", matrix(np.full(3, float(i)), Rotation.identity()))))
        found.append(image(2, stamp))
    log = logs.open(write_ros2(tmp_path / "drive", found))
    odometry = log.odometry()
    assert odometry is not None
    np.testing.assert_array_equal(odometry.stamp_ns, STAMPS)
    np.testing.assert_allclose(odometry.odom_from_body, POSES @ lift, atol=1e-9)
    np.testing.assert_allclose(log.camera().body_from_camera, CAMERA, atol=1e-9)
    assert "odom -> footprint -> base_link" in " ".join(log.warnings)


def test_links_of_different_rates_are_interpolated(tmp_path: Path) -> None:
    """world -> a at every fourth stamp, a -> base_link at every one: the first is interpolated along its geodesic."""
    slow = slice(0, COUNT, 4)
    found = []
    for i, stamp in enumerate(STAMPS.tolist()):
        if i % 4 == 0:
            found.append(tf(2, "/tf", stamp, ("world", "a", POSES[i])))
        found.append(tf(2, "/tf", stamp, ("a", "base_link", POSES[-1 - i])))
    odometry = logs.open(write_ros2(tmp_path / "drive", found)).odometry()
    assert odometry is not None
    inside = STAMPS <= START_NS + PERIOD_NS * 4 * ((COUNT - 1) // 4)
    np.testing.assert_array_equal(odometry.stamp_ns, STAMPS[inside])
    seconds = (STAMPS - START_NS) / 1e9
    turn = Slerp(seconds[slow], TURN[slow])(seconds[inside]).as_matrix()
    np.testing.assert_allclose(odometry.odom_from_body[:, :3, :3], turn @ POSES[::-1][inside][:, :3, :3], atol=1e-6)
    at_samples = slice(0, inside.sum(), 4)
    np.testing.assert_allclose(
        odometry.odom_from_body[at_samples], (POSES[inside] @ POSES[::-1][inside])[at_samples], atol=1e-9
    )


def test_transforms_that_never_change_are_static_in_logs_without_tf_static(tmp_path: Path) -> None:
    found = []
    for stamp, pose in zip(STAMPS.tolist(), POSES, strict=True):
        found.append(tf(1, "/tf", stamp, ("/world", "/base", pose), ("/base", "/camera", CAMERA)))
        found.append(image(1, stamp))
    log = logs.open(write_ros1(tmp_path / "drive.bag", found))
    odometry = log.odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body, POSES, atol=1e-9)
    np.testing.assert_allclose(log.camera().body_from_camera, CAMERA, atol=1e-9)


@pytest.mark.parametrize("source", ["found", "topic", "file"])
def test_mounts_on_tf_count_beside_static_ones_which_come_first(source: str, tmp_path: Path) -> None:
    """A camera driver's own frames on /tf_static, its mount again and again on /tf, as tf1's publisher has it."""
    mount, wrong = matrix(np.array([0.2, 0.1, 0.5]), Rotation.from_euler("z", 0.4)), POSES[3]
    kind = "nav_msgs/msg/Odometry"
    found = [tf(2, "/tf_static", START_NS, ("camera_link", "camera", CAMERA))]
    for stamp, pose in zip(STAMPS.tolist(), POSES, strict=True):
        found.append(Written("/odom", kind, stamp, pose_message(kind, stamp, pose)))
        edges = ("base_link", "camera_link", mount), ("camera_link", "camera", wrong), ("base_link", "wheel", pose)
        found += [tf(2, "/tf", stamp, *edges), image(2, stamp)]
    path, file = write_ros2(tmp_path / "drive", found), tmp_path / "odometry.tum"
    write_tum(file, Trajectory(STAMPS, POSES))
    choice = {"found": {}, "topic": {"odometry": "/odom"}, "file": {"odometry_file": file}}[source]
    log = logs.open(path, TopicChoice.model_validate(choice))
    np.testing.assert_allclose(log.camera().body_from_camera, mount @ CAMERA, atol=1e-9)
    assert next(topic.part for topic in log.info().topics if topic.name == "/tf") == "tf"


AHEAD = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
DRIVE = matrices(np.outer(np.arange(COUNT), [1.0, 0.1, 0.0]), Rotation.from_rotvec(np.zeros((COUNT, 3))))
"""Along x."""


def camera_placed(folder: Path, frame: str, mount: np.ndarray, poses: np.ndarray = DRIVE, **choice: Any) -> Log:
    kind = "nav_msgs/msg/Odometry"
    found = [tf(2, "/tf_static", START_NS, ("base_link", frame, mount))]
    for stamp, pose in zip(STAMPS.tolist(), poses, strict=True):
        found += [image(2, stamp), Written("/odom", kind, stamp, pose_message(kind, stamp, pose))]
        found[-2].message.header.frame_id = frame
    return logs.open(write_ros2(folder, found), TopicChoice(**choice))


@pytest.mark.parametrize("seed", range(6))
def test_a_camera_whose_frame_has_x_ahead_does_not_look_up(seed: int, tmp_path: Path) -> None:
    """As of usb_cam, placed by its position, yaw and some pitch; beside cameras that are as they are named."""
    rng = np.random.default_rng(seed)
    turn = Rotation.from_euler("ZY", [rng.uniform(-np.pi, np.pi), rng.uniform(-0.7, 0.7)])
    mount = matrix(rng.normal(size=3), turn)
    log = camera_placed(tmp_path / "link", "head_camera", mount)
    np.testing.assert_allclose(log.camera().body_from_camera, mount @ AHEAD, atol=1e-9)
    assert "head_camera looks up by the static transforms" in " ".join(log.warnings)
    down = mount @ matrix(np.zeros(3), Rotation.from_euler("x", np.pi))
    every = {"up_optical": mount, "ahead": mount @ AHEAD, "down": down}
    for frame, placed in every.items():
        log = camera_placed(tmp_path / frame, frame, placed)
        np.testing.assert_allclose(log.camera().body_from_camera, placed, atol=1e-9)
        assert "looks up" not in " ".join(log.warnings)
        assert ("down looks down by the static transforms" in " ".join(log.warnings)) == (frame == "down")
    along_z = DRIVE.copy()
    along_z[:, :3, 3] = DRIVE[:, [1, 2, 0], 3]
    log = camera_placed(tmp_path / "axes", "cam0", mount, along_z)  # a base_link with the axes of a camera
    np.testing.assert_allclose(log.camera().body_from_camera, mount, atol=1e-9)


def test_a_calibration_file_places_a_camera_that_does_look_up(tmp_path: Path) -> None:
    up = matrix(np.array([0.0, 0.0, 1.0]), Rotation.from_euler("z", 0.2))
    file = tmp_path / "sensor.yaml"
    file.write_text(
        f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: {up.ravel().tolist()}\nresolution: [10, 8]\n"
        "camera_model: pinhole\nintrinsics: [9, 9, 4.5, 3.5]\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [0, 0, 0, 0]\n"
    )
    log = camera_placed(tmp_path / "drive", "camera", np.eye(4), calibration_file=file)
    np.testing.assert_allclose(log.camera().body_from_camera, up, atol=1e-9)


@pytest.mark.parametrize("several", [False, True])
def test_foxglove_transforms(several: bool, tmp_path: Path) -> None:
    found = []
    for stamp, pose in zip(STAMPS.tolist(), POSES, strict=True):
        one = FrameTransform(parent_frame_id="odom", child_frame_id="robot")
        one.timestamp.seconds, one.timestamp.nanos = stamp // 10**9, stamp % 10**9
        for name, value in zip("xyz", pose[:3, 3], strict=True):
            setattr(one.translation, name, value)
        for name, value in zip("xyzw", Rotation.from_matrix(pose[:3, :3]).as_quat(), strict=True):
            setattr(one.rotation, name, value)
        message = FrameTransforms(transforms=[one]) if several else one
        found.append(Written("/tf", message.DESCRIPTOR.full_name, stamp, message))
    odometry = logs.open(write_foxglove(tmp_path / "drive.mcap", found, "protobuf")).odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body, POSES, atol=1e-9)


def test_odometry_comes_before_tf_unless_tf_is_asked_for(tmp_path: Path) -> None:
    found = []
    for stamp, pose in zip(STAMPS.tolist(), POSES, strict=True):
        found.append(tf(2, "/tf", stamp, ("odom", "base_link", pose)))
        kind = "nav_msgs/msg/Odometry"
        found.append(Written("/pose", kind, stamp, pose_message(kind, stamp, 2 * np.eye(4) + pose)))
    path = write_ros2(tmp_path / "drive", found)
    other = logs.open(path).odometry()
    assert other is not None
    assert not np.allclose(other.odom_from_body, POSES)
    odometry = logs.open(path, TopicChoice(odometry="/tf")).odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body, POSES, atol=1e-9)
    assert logs.open(path, TopicChoice(odometry="")).odometry() is None


def test_a_file_beside_the_log(tmp_path: Path) -> None:
    path = write_ros2(tmp_path / "drive", [image(2, stamp) for stamp in STAMPS.tolist()])
    assert logs.open(path).odometry() is None
    file = tmp_path / "odometry.tum"
    write_tum(file, Trajectory(STAMPS, POSES))
    odometry = logs.open(path, TopicChoice(odometry_file=file)).odometry()
    assert odometry is not None
    np.testing.assert_array_equal(odometry.stamp_ns, STAMPS)
    np.testing.assert_allclose(odometry.odom_from_body, POSES, atol=1e-8)
    folder = tmp_path / "images"
    folder.mkdir()
    for stamp in STAMPS.tolist():
        cv2.imwrite(str(folder / f"{stamp}.png"), np.zeros((8, 10), np.uint8))
    log = logs.open(folder, TopicChoice(odometry_file=file))
    np.testing.assert_array_equal(log.stamps(), STAMPS)
    assert log.odometry() is not None
    file.write_text("1 2 3\n")
    with pytest.raises(LogError, match=r"odometry\.tum:1 has 3 values instead of 8"):
        logs.open(path, TopicChoice(odometry_file=file))
    with pytest.raises(LogError, match="--odometry-file"):
        logs.open(path, TopicChoice(odometry_file=tmp_path / "missing.tum"))


def test_pose_in_frame(tmp_path: Path) -> None:
    found = []
    for stamp, pose in zip(STAMPS.tolist(), POSES, strict=True):
        message = PoseInFrame(frame_id="odom")
        message.timestamp.seconds, message.timestamp.nanos = stamp // 10**9, stamp % 10**9
        for name, value in zip("xyz", pose[:3, 3], strict=True):
            setattr(message.pose.position, name, value)
        for name, value in zip("xyzw", Rotation.from_matrix(pose[:3, :3]).as_quat(), strict=True):
            setattr(message.pose.orientation, name, value)
        found.append(Written("/pose", "foxglove.PoseInFrame", stamp, message))
    odometry = logs.open(write_foxglove(tmp_path / "drive.mcap", found, "json")).odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body, POSES, atol=1e-9)


def test_one_drive_recorded_in_ros1_and_ros2_moves_alike(shared_data: Path) -> None:
    """evo's example of a chain of transforms, as a bag and as db3."""
    data = shared_data / "logs"
    paths = [data / f"ros{i}/MichaelGrupp+evo/test/data/tf_example{end}" for i, end in ((1, ".bag"), (2, ""))]
    one, other = (logs.open(path).odometry() for path in paths)
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.stamp_ns, other.stamp_ns)
    np.testing.assert_allclose(one.odom_from_body, other.odom_from_body, atol=1e-12)
    assert len(one.stamp_ns) > 500


def test_standing_first_is_no_gap(tmp_path: Path) -> None:
    """As robots do before they drive: the transforms of that time count, though they are all alike."""
    stands = [*[POSES[0]] * 400, *POSES]
    found = []
    for row, pose in enumerate(stands):
        stamp = int(START_NS + PERIOD_NS * row)
        found += [tf(2, "/tf", stamp, ("odom", "base_link", pose)), image(2, stamp)]
    log = logs.open(write_ros2(tmp_path / "drive", found))
    (source,) = [one for one in log.info().odometry_sources if one.kind == "tf"]
    assert source.coverage == 1.0
    odometry = log.odometry()
    assert odometry is not None and np.diff(odometry.stamp_ns).max() <= 10**9
    assert not any("standing" in line or "covers" in line for line in log.warnings)


def test_a_node_that_was_restarted_is_a_break(tmp_path: Path) -> None:
    """In the log, after a gap in which any jump might be a motion."""
    found = []
    for row in [*range(400), *range(500, 800)]:
        stamp, x = int(START_NS + 50_000_000 * row), 0.05 * (row if row < 400 else row - 500)
        pose = matrix(np.array([x, 0.0, 0.0]), Rotation.identity())
        found += [tf(2, "/tf", stamp, ("odom", "base_link", pose)), image(2, stamp)]
    log = logs.open(write_ros2(tmp_path / "drive", found))
    odometry = log.odometry()
    assert odometry is not None
    assert odometry.breaks.tolist() == [400]
    assert any("starts again from its first pose" in line for line in log.warnings)
    assert odometry.odom_from_body[400, 0, 3] == pytest.approx(0.05 * 399)
