"""The drive as a robot would record it: a ROS 2 MCAP file, and beside it the truth as a TUM trajectory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from vplog.data import Bytes, Camera, Float32s, Floats, Trajectory
from vplog.errors import ResultError
from vplog.execution.cores import allowed
from vplog.execution.execution import Execution
from vplog.geometry.se3 import quaternion
from vplog.geometry.tum import write_tum
from vplog.verbs.demo import route
from vplog.verbs.demo.scene import BODY_FRAME, CAMERA_FRAME, REAR_FRAME, Scene, make_scene, rear_mount, take_picture
from vplog.verbs.demo.settings import DemoSettings

IMAGE = "/camera/image_raw/compressed"
CAMERA_INFO = "/camera/camera_info"
DEPTH = "/camera/depth/image_raw/compressedDepth"
DEPTH_INFO = "/camera/depth/camera_info"
LEFT = "/camera/left/image_raw/compressed"
"""The image of a drive with a stereo pair."""
LEFT_INFO = "/camera/left/camera_info"
RIGHT = "/camera/right/image_raw/compressed"
RIGHT_INFO = "/camera/right/camera_info"
REAR = "/rear/image_raw/compressed"
REAR_INFO = "/rear/camera_info"
ODOMETRY = "/odom"
GPS = "/gps/fix"
IMU = "/imu/data"
IMU_FRAME = "imu_link"
TF_STATIC = "/tf_static"
_IMAGE_TYPE, _CALIBRATION_TYPE = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
TYPES = {
    **dict.fromkeys((IMAGE, DEPTH, LEFT, RIGHT, REAR), _IMAGE_TYPE),
    **dict.fromkeys((CAMERA_INFO, DEPTH_INFO, LEFT_INFO, RIGHT_INFO, REAR_INFO), _CALIBRATION_TYPE),
    ODOMETRY: "nav_msgs/msg/Odometry",
    GPS: "sensor_msgs/msg/NavSatFix",
    IMU: "sensor_msgs/msg/Imu",
    TF_STATIC: "tf2_msgs/msg/TFMessage",
}
_DELAY_NS = (2_000_000, 30_000_000)
"""A message is logged this long after its stamp: drivers and transport take their time."""
_CHUNK_BYTES = 1 << 20
"""Uncompressed size of a chunk; about ten frames."""
_MARKED_BYTES = 100
"""Bytes in which a demo's file has its mark: in the log behind 8 bytes of magic, 17 of a header, and `ros2`."""
_TYPES = get_typestore(Stores.ROS2_HUMBLE)


@dataclass(frozen=True, eq=False)
class Demo(Scene):
    """A recorded demo drive."""

    log: Path
    truth: Path
    """TUM trajectory, world_from_body at every odometry sample and every frame."""


def make_drive(folder: Path, settings: DemoSettings | None = None, execution: Execution | None = None) -> Demo:
    """Write `folder`/drive.mcap and `folder`/truth.tum; the recorded drive.

    Frames are rendered on all cores where `execution` is None. Raises ResultError where the folder cannot be written.
    """
    settings = settings or DemoSettings()
    scene = make_scene(settings)
    log, truth = folder / "drive.mcap", folder / "truth.tum"
    stamp_ns = np.union1d(route.odometry_stamps(settings), scene.stamp_ns)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _check_own(log, b"vplog demo")
        _check_own(truth, b"(world_from_body)")
        write_tum(truth, Trajectory(stamp_ns, route.world_from_body(settings, stamp_ns)))
        _write_log(log, settings, scene, execution or Execution(allowed()))
    except OSError as error:
        raise ResultError(f"Cannot write the demo drive to {folder}: {error}. Choose another folder.") from None
    return Demo(**vars(scene), log=log, truth=truth)


def _check_own(path: Path, mark: bytes) -> None:
    """Raises ResultError where a file exists that no demo has written, by its first bytes."""
    if path.exists():
        with path.open("rb") as stream:
            begins = stream.read(_MARKED_BYTES)
        if begins and mark not in begins:
            raise ResultError(f"{path} is not of a demo. Choose another folder with -o.")


def _write_log(path: Path, settings: DemoSettings, scene: Scene, execution: Execution) -> None:
    """All messages in the order in which they reach the recorder."""
    messages = [*_mounting(scene), *_odometry(settings), *_fixes(settings), *_imu(settings), *_frames(scene, execution)]
    delays = np.random.default_rng([settings.seed, 5]).integers(*_DELAY_NS, len(messages), endpoint=True).tolist()
    delays = [_DELAY_NS[0] if topic == IMU else delay for (topic, _, _), delay in zip(messages, delays, strict=True)]
    logged = sorted((stamp + delay, i) for i, ((_, stamp, _), delay) in enumerate(zip(messages, delays, strict=True)))
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="vplog demo")
        topics = dict.fromkeys(topic for topic, _, _ in messages)
        schemas = {
            name: writer.register_schema(name, "ros2msg", _TYPES.generate_msgdef(name, ros_version=2)[0].encode())
            for name in dict.fromkeys(TYPES[topic] for topic in topics)
        }
        channels = {topic: writer.register_channel(topic, "cdr", schemas[TYPES[topic]]) for topic in topics}
        sequence = dict.fromkeys(topics, 0)
        for log_time, i in logged:
            topic, stamp, message = messages[i]
            sequence[topic] += 1
            data = bytes(_TYPES.serialize_cdr(message, TYPES[topic]))
            writer.add_message(channels[topic], log_time, data, stamp, sequence[topic])
        writer.finish()


def _message(name: str, **fields: Any) -> Any:
    """A message of a type with these fields, nested ones as dicts; the others are 0 or empty."""

    def value(kind: Nodetype, about: Any, given: Any) -> Any:
        if kind == Nodetype.NAME:
            return _message(about, **(given or {}))
        if given is not None:
            return given
        return np.zeros(about[1]) if kind != Nodetype.BASE else "" if about[0] == "string" else 0

    types = {field: value(*kind, fields.get(field)) for field, kind in _TYPES.fielddefs[name][1]}
    return _TYPES.types[name](**types)


def _header(stamp_ns: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def _pose(world_from_frame: Floats, translation: str, rotation: str) -> dict[str, Any]:
    point, turn = world_from_frame[:3, 3], quaternion(world_from_frame[:3, :3])
    return {name: dict(zip("xyzw", v.tolist(), strict=False)) for name, v in ((translation, point), (rotation, turn))}


def _mounting(scene: Scene) -> Iterator[tuple[str, int, Any]]:
    mounts = {CAMERA_FRAME: scene.camera.body_from_camera}
    if scene.settings.rear_camera:
        mounts[REAR_FRAME] = rear_mount(scene.camera)
    if scene.settings.imu_rate_hz:
        mounts[IMU_FRAME] = route.IMU_MOUNT
    stamped = [
        _message(
            "geometry_msgs/msg/TransformStamped", header=_header(route.START_NS, BODY_FRAME), child_frame_id=frame,
            transform=_pose(mount, "translation", "rotation"),
        )
        for frame, mount in mounts.items()
    ]  # fmt: skip
    yield TF_STATIC, route.START_NS, _message(TYPES[TF_STATIC], transforms=stamped)


def _odometry(settings: DemoSettings) -> Iterator[tuple[str, int, Any]]:
    """Poses with a constant covariance: what one second of driving adds, biases included; translation first."""
    poses = route.odometry(settings, np.random.default_rng([settings.seed, 6]))
    rate = settings.odometry_rate_hz
    turn2, step2 = settings.odometry_turn_noise_rad**2 * rate, settings.odometry_step_noise_m**2 * rate
    along2 = (settings.odometry_scale_error * settings.speed_m_s) ** 2
    variances = step2 + along2, step2, step2, turn2, turn2, turn2 + settings.odometry_yaw_bias_rad_s**2
    for stamp, pose in zip(route.odometry_stamps(settings).tolist(), poses, strict=True):
        at = {"pose": _pose(pose, "position", "orientation"), "covariance": np.diag(variances).ravel()}
        fields = {"header": _header(stamp, "odom"), "child_frame_id": BODY_FRAME, "pose": at}
        yield ODOMETRY, stamp, _message(TYPES[ODOMETRY], **fields)


def _fixes(settings: DemoSettings) -> Iterator[tuple[str, int, Any]]:
    stamp_ns = route.stamps(settings, settings.gps_rate_hz)
    fixes = route.gps(settings, stamp_ns, np.random.default_rng([settings.seed, 7]))
    variance = np.diag(np.array([1.0, 1.0, 4.0]) * settings.gps_sigma_m**2).ravel()
    known = {"status": {"status": 0, "service": 1}, "position_covariance": variance, "position_covariance_type": 2}
    # a fix, by GPS; COVARIANCE_TYPE_DIAGONAL_KNOWN
    for stamp, fix in zip(stamp_ns.tolist(), fixes.tolist(), strict=True):
        fields = dict(zip(("latitude", "longitude", "altitude"), fix, strict=True))
        yield GPS, stamp, _message(TYPES[GPS], header=_header(stamp, BODY_FRAME), **known, **fields)


def _imu(settings: DemoSettings) -> Iterator[tuple[str, int, Any]]:
    stamp_ns = route.stamps(settings, settings.imu_rate_hz)
    gyro, accel = route.imu(settings, stamp_ns, np.random.default_rng([settings.seed, 10]))
    for stamp, *measured in zip(stamp_ns.tolist(), gyro.tolist(), accel.tolist(), strict=True):
        rate, moved = (dict(zip("xyz", axes, strict=True)) for axes in measured)
        header = _header(stamp, IMU_FRAME)
        yield IMU, stamp, _message(TYPES[IMU], header=header, angular_velocity=rate, linear_acceleration=moved)


def _frames(scene: Scene, execution: Execution) -> Iterator[tuple[str, int, Any]]:
    """Image, calibration and, if enabled, depth, the right and the rear image of every frame."""
    settings, baseline_m = scene.settings, scene.settings.stereo_baseline_m

    def jpeg(image: Bytes) -> Bytes:
        return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 88])[1].ravel()

    def encoded(frame: int) -> tuple[Bytes, Bytes | None, Bytes | None, Bytes | None]:
        image, depth = take_picture(scene, frame)
        right = jpeg(take_picture(scene, frame, baseline_m)[0]) if baseline_m else None
        rear = jpeg(take_picture(scene, frame, rear=True)[0]) if settings.rear_camera else None
        return jpeg(image), _compressed_depth(depth) if settings.depth else None, right, rear

    count = len(scene.stamp_ns)
    # One frame first: numba compiles in one thread while the others would only wait for it.
    frames = chain([encoded(0)], execution.map(encoded, range(1, count)))
    rendered = execution.counted("render", frames, count)
    for stamp, (left, depth, right, rear) in zip(scene.stamp_ns.tolist(), rendered, strict=True):
        jpegs = "mono8; jpeg compressed mono8"
        topics = (LEFT, LEFT_INFO) if baseline_m else (IMAGE, CAMERA_INFO)
        for (topic, calibration), data, kind, right_m in (
            (topics, left, jpegs, 0.0),
            ((DEPTH, DEPTH_INFO), depth, "16UC1; compressedDepth png", 0.0),
            ((RIGHT, RIGHT_INFO), right, jpegs, baseline_m),
            ((REAR, REAR_INFO), rear, jpegs, 0.0),
        ):
            if data is not None:
                header = _header(stamp, REAR_FRAME if topic == REAR else CAMERA_FRAME)
                yield topic, stamp, _message(_IMAGE_TYPE, header=header, format=kind, data=data)
                yield calibration, stamp, _calibration(header, scene.camera, right_m)


def _compressed_depth(depth: Float32s) -> Bytes:
    """The 12 bytes of ROS's compressed_depth_image_transport (unused), then a 16-bit PNG.

    Depth is in mm; 0 is unknown: sky, or beyond what 16 bits hold.
    """
    mm = np.nan_to_num(depth * 1000, nan=0.0)
    mm = np.where(mm > 65534, 0, np.round(mm)).astype(np.uint16)  # 65535 means invalid to some readers
    return np.concatenate([np.zeros(12, np.uint8), cv2.imencode(".png", mm)[1].ravel()])


def _calibration(header: dict[str, Any], camera: Camera, right_m: float = 0.0) -> Any:
    """The CameraInfo of the camera, or of its twin so far to the right: the fourth column of P holds the baseline."""
    matrix: Floats = camera.matrix  # type: ignore[assignment]
    p = np.hstack([matrix, [[-matrix[0, 0] * right_m], [0.0], [0.0]]])
    return _message(
        _CALIBRATION_TYPE, header=header, height=camera.height, width=camera.width,
        distortion_model=camera.distortion_model, d=camera.distortion, k=matrix.ravel(), r=np.eye(3).ravel(),
        p=p.ravel(),
    )  # fmt: skip
