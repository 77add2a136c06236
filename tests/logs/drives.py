"""One small drive, written by other people's writers in every format that vplog reads."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from mcap_protobuf.schema import build_file_descriptor_set
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from pathlib import Path

START_NS = 1_600_000_000_000_000_000
FRAMES = 5
PERIOD_NS = 100_000_000
LATENCY_NS = 7_000_000
"""Log times are later than header stamps by this."""
K = np.array([[200.0, 0, 31.5], [0, 210.0, 23.5], [0, 0, 1]])
D = np.array([0.1, -0.2, 0.001, 0.002, 0.05])
WIDTH, HEIGHT = 64, 48


@cache
def store(ros: int) -> Any:
    if ros == 2:
        return get_typestore(Stores.ROS2_JAZZY)
    result = get_typestore(Stores.ROS1_NOETIC)
    result.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return result


@dataclass
class Written:
    """One message of a drive before it is encoded."""

    topic: str
    type: str
    stamp_ns: int
    message: Any


class Drive:
    """The values that every format must give back."""

    def __init__(self) -> None:
        rng = np.random.default_rng(3)
        self.images = rng.integers(0, 256, (FRAMES, HEIGHT, WIDTH), np.uint8)
        self.depth_mm = rng.integers(1, 9000, (FRAMES, HEIGHT, WIDTH)).astype(np.uint16)
        self.depth_mm[:, 0, 0], self.depth_mm[:, 0, 1] = 0, 65535
        self.stamp_ns = START_NS + PERIOD_NS * np.arange(FRAMES)
        self.position = rng.normal(size=(FRAMES, 3))
        self.quaternion = Rotation.from_rotvec(rng.normal(size=(FRAMES, 3))).as_quat()
        a = rng.normal(size=(FRAMES, 6, 6))
        self.covariance = a @ a.transpose(0, 2, 1) * 1e-3
        self.latitude = 48.0 + 1e-5 * np.arange(FRAMES)
        self.mast_from_base = (np.array([-0.5, 0.1, -1.0]), Rotation.from_euler("z", 0.3))
        self.mast_from_camera = (np.array([0.2, 0.0, 0.1]), Rotation.from_euler("xyz", [-1.5, 0.0, -1.5]))

    @property
    def odom_from_body(self) -> np.ndarray:
        return matrices(self.position, Rotation.from_quat(self.quaternion))

    @property
    def body_from_camera(self) -> np.ndarray:
        return np.linalg.inv(matrix(*self.mast_from_base)) @ matrix(*self.mast_from_camera)


def matrix(position: np.ndarray, rotation: Rotation) -> np.ndarray:
    return matrices(position[None], rotation)[0]


def matrices(position: np.ndarray, rotation: Rotation) -> np.ndarray:
    result = np.tile(np.eye(4), (len(position), 1, 1))
    result[:, :3, :3], result[:, :3, 3] = rotation.as_matrix(), position
    return result


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def ros_messages(drive: Drive, ros: int) -> list[Written]:
    """The drive as ROS messages in order of their log times."""
    t = store(ros).types

    def new(name: str, **fields: Any) -> Any:
        return t[name](**fields)

    def header(stamp_ns: int, frame: str) -> Any:
        stamp = new("builtin_interfaces/msg/Time", sec=int(stamp_ns // 10**9), nanosec=int(stamp_ns % 10**9))
        return new("std_msgs/msg/Header", **({"seq": 0} if ros == 1 else {}), stamp=stamp, frame_id=frame)

    def vector(kind: str, v: np.ndarray) -> Any:
        return new(f"geometry_msgs/msg/{kind}", **dict(zip("xyzw", map(float, v), strict=False)))

    def transform(parent: str, child: str, position: np.ndarray, rotation: Rotation) -> Any:
        value = new(
            "geometry_msgs/msg/Transform",
            translation=vector("Vector3", position),
            rotation=vector("Quaternion", rotation.as_quat()),
        )
        frames = {"header": header(START_NS, parent), "child_frame_id": child}
        return new("geometry_msgs/msg/TransformStamped", **frames, transform=value)

    def twist() -> Any:
        zero = vector("Vector3", np.zeros(3))
        value = new("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        return new("geometry_msgs/msg/TwistWithCovariance", twist=value, covariance=np.zeros(36))

    def camera_info(stamp_ns: int) -> Any:
        fields = {"D": D, "K": K.ravel(), "R": np.eye(3).ravel(), "P": np.zeros(12)}
        fields = {name.lower() if ros == 2 else name: value for name, value in fields.items()}
        roi = new("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return new(
            "sensor_msgs/msg/CameraInfo", header=header(stamp_ns, "camera"), height=HEIGHT, width=WIDTH,
            distortion_model="plumb_bob", **fields, binning_x=0, binning_y=0, roi=roi,
        )  # fmt: skip

    tree = [transform("mast", "base_link", *drive.mast_from_base), transform("mast", "camera", *drive.mast_from_camera)]
    found = [Written("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, new("tf2_msgs/msg/TFMessage", transforms=tree))]
    for i, stamp in enumerate(drive.stamp_ns.tolist()):
        found.append(Written("/cam/camera_info", "sensor_msgs/msg/CameraInfo", stamp, camera_info(stamp)))
        data = np.frombuffer(png(drive.images[i]), np.uint8)
        image = new("sensor_msgs/msg/CompressedImage", header=header(stamp, "camera"), format="png", data=data)
        found.append(Written("/cam/image/compressed", "sensor_msgs/msg/CompressedImage", stamp, image))
        depth = new(
            "sensor_msgs/msg/Image", header=header(stamp + 5_000_000, "camera"), height=HEIGHT, width=WIDTH,
            encoding="16UC1", is_bigendian=0, step=2 * WIDTH, data=drive.depth_mm[i].view(np.uint8).ravel(),
        )  # fmt: skip
        found.append(Written("/cam/depth", "sensor_msgs/msg/Image", stamp, depth))
        pose = new(
            "geometry_msgs/msg/Pose",
            position=vector("Point", drive.position[i]),
            orientation=vector("Quaternion", drive.quaternion[i]),
        )
        with_covariance = new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=drive.covariance[i].ravel())
        odometry = new(
            "nav_msgs/msg/Odometry", header=header(stamp, "odom"), child_frame_id="base_link",
            pose=with_covariance, twist=twist(),
        )  # fmt: skip
        found.append(Written("/odom", "nav_msgs/msg/Odometry", stamp, odometry))
        status = new("sensor_msgs/msg/NavSatStatus", status=-1 if i == 1 else 0, service=1)
        fix = new(
            "sensor_msgs/msg/NavSatFix", header=header(stamp, "gps"), status=status, latitude=float(drive.latitude[i]),
            longitude=11.0, altitude=500.0, position_covariance=np.diag([1.0, 4.0, 9.0]).ravel(),
            position_covariance_type=0 if i == 2 else 2,
        )  # fmt: skip
        found.append(Written("/fix", "sensor_msgs/msg/NavSatFix", stamp, fix))
    return found


def write_ros2(path: Path, messages: list[Written], storage: str = "mcap", **options: Any) -> Path:
    """A bag folder; `storage` mcap or sqlite3; `compression` message."""
    plugin = rosbag2.StoragePlugin.MCAP if storage == "mcap" else rosbag2.StoragePlugin.SQLITE3
    writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    if options.get("compression"):
        writer.set_compression(rosbag2.CompressionMode.MESSAGE, rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for m in messages:
            if m.topic not in connections:
                connections[m.topic] = writer.add_connection(m.topic, m.type, typestore=store(2))
            data = store(2).serialize_cdr(m.message, m.type)
            writer.write(connections[m.topic], m.stamp_ns + LATENCY_NS, data)
    return path


def write_ros1(path: Path, messages: list[Written], compression: str = "") -> Path:
    writer = rosbag1.Writer(path)
    writer.chunk_threshold = 4096  # bytes: several chunks in a small drive
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
    with writer:
        connections: dict[str, Any] = {}
        for m in messages:
            if m.topic not in connections:
                connections[m.topic] = writer.add_connection(m.topic, m.type, typestore=store(1))
            writer.write(connections[m.topic], m.stamp_ns + LATENCY_NS, store(1).serialize_ros1(m.message, m.type))
    return path


def foxglove_messages(drive: Drive) -> list[Written]:
    found = []
    for name, (position, rotation) in (("base_link", drive.mast_from_base), ("camera", drive.mast_from_camera)):
        t = FrameTransform(parent_frame_id="mast", child_frame_id=name)
        _stamp(t, START_NS)
        _set(t.translation, position)
        _set(t.rotation, rotation.as_quat())
        found.append(Written("/static", "foxglove.FrameTransform", START_NS, t))
    for i, stamp in enumerate(drive.stamp_ns.tolist()):
        image = CompressedImage(frame_id="camera", data=png(drive.images[i]), format="png")
        calibration = CameraCalibration(
            frame_id="camera", width=WIDTH, height=HEIGHT, distortion_model="plumb_bob", D=D, K=K.ravel()
        )
        pose = PoseInFrame(frame_id="odom")
        _set(pose.pose.position, drive.position[i])
        _set(pose.pose.orientation, drive.quaternion[i])
        fix = LocationFix(
            latitude=drive.latitude[i], longitude=11.0, altitude=500.0,
            position_covariance=np.diag([1.0, 4.0, 9.0]).ravel(), position_covariance_type=0 if i == 2 else 2,  # type: ignore[arg-type]
        )  # fmt: skip
        for topic, m in (("/cam/info", calibration), ("/cam/image", image), ("/pose", pose), ("/fix", fix)):
            _stamp(m, stamp)
            found.append(Written(topic, m.DESCRIPTOR.full_name, stamp, m))
    return found


def write_foxglove(path: Path, messages: list[Written], encoding: str, **options: Any) -> Path:
    """An MCAP file, `encoding` protobuf or json; `options` go to the writer."""
    with path.open("wb") as file:
        writer = McapWriter(file, **options)
        writer.start()
        channels: dict[str, int] = {}
        for m in messages:
            if m.topic not in channels:
                schema = build_file_descriptor_set(type(m.message)).SerializeToString()
                name, data = ("protobuf", schema) if encoding == "protobuf" else ("jsonschema", b"{}")
                schema_id = writer.register_schema(m.type, name, data)
                channels[m.topic] = writer.register_channel(m.topic, encoding, schema_id)
            data = m.message.SerializeToString() if encoding == "protobuf" else json.dumps(_json(m.message)).encode()
            time_ns = m.stamp_ns + LATENCY_NS
            writer.add_message(channels[m.topic], log_time=time_ns, data=data, publish_time=m.stamp_ns)
        writer.finish()
    return path


def write_raw(path: Path, messages: list[tuple[str, str, str, int, bytes]]) -> Path:
    """An MCAP file of bytes as they are: topic, type, encoding, log time, data."""
    with path.open("wb") as file:
        writer = McapWriter(file, compression=CompressionType.NONE)
        writer.start()
        channels: dict[tuple, int] = {}
        for topic, kind, encoding, log_ns, data in messages:
            if (topic, kind) not in channels:
                channels[topic, kind] = writer.register_channel(topic, encoding, writer.register_schema(kind, "", b""))
            writer.add_message(channels[topic, kind], log_time=log_ns, data=data, publish_time=log_ns)
        writer.finish()
    return path


def _stamp(message: Any, stamp_ns: int) -> None:
    message.timestamp.seconds, message.timestamp.nanos = stamp_ns // 10**9, stamp_ns % 10**9


def _set(message: Any, values: np.ndarray) -> None:
    for name, value in zip("xyzw", values, strict=False):
        setattr(message, name, value)


def _json(message: Any) -> Any:
    """Foxglove's JSON: times as {sec, nsec}, bytes as base64."""
    if message.DESCRIPTOR.full_name == "google.protobuf.Timestamp":
        return {"sec": message.seconds, "nsec": message.nanos}
    return {field.name: _json_value(value) for field, value in message.ListFields()}


def _json_value(value: Any) -> Any:
    if hasattr(value, "DESCRIPTOR"):
        return _json(value)
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    return value if isinstance(value, str | int | float) else [_json_value(item) for item in value]
