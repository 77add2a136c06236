"""The records that messages of known types become, whatever their encoding."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vplog.data import Bytes, Floats
from vplog.logs.formats.container import Channel, RawData


class BadMessageError(Exception):
    """The bytes of a message do not fit its type."""


class ImageMessage(NamedTuple):
    """One image."""

    stamp_ns: int
    frame: str
    encoding: str
    """ROS name of the pixel layout (`mono8`, `16UC1`, ...); the format string where compressed."""
    data: RawData
    """A view of the message, where its encoding has the bytes as they are."""
    compressed: bool
    width: int = 0
    height: int = 0
    step: int = 0
    """Bytes per row, padding included; 0 where compressed."""
    big_endian: bool = False
    rgb: Callable[[], Bytes] | None = None
    """(H, W, 3) uint8 where `data` is the luma of an image in colour."""


@dataclass(frozen=True, eq=False)
class CalibrationMessage:
    stamp_ns: int
    frame: str
    width: int
    height: int
    model: str
    distortion: Floats
    matrix: Floats
    """(3, 3) of the image as the sensor gives it; all zero where uncalibrated."""
    projection: Floats
    """(3, 4) of the rectified image; all zero where unknown."""
    rotation: Floats = field(default_factory=lambda: np.eye(3))
    """(3, 3) rectified_from_camera of a stereo pair; the identity or all zero without one."""

    def equals(self, other: CalibrationMessage) -> bool:
        """Whether all but the stamp is equal."""
        mine, theirs = vars(self) | {"stamp_ns": 0}, vars(other) | {"stamp_ns": 0}
        return all(np.array_equal(mine[name], theirs[name]) for name in mine)

    @property
    def is_set(self) -> bool:
        """Not so where a driver has no calibration: ROS has zeros then (sensor_msgs/CameraInfo), others NaN."""
        return any(np.isfinite(k).all() and k[0, 0] > 0 for k in (self.matrix, self.projection))


class PoseMessage(NamedTuple):
    """A pose or a transform, of plain numbers: drives have more of these than of anything else."""

    stamp_ns: int
    frame: str
    child: str
    """The frame that moves; empty where the type has none."""
    position: Sequence[float]
    """x y z in m."""
    quaternion: Sequence[float]
    """x y z w, as logged."""
    covariance: Sequence[float] | None
    """The 36 numbers of a (6, 6) as logged: translation first, axes of `frame`; None where the type has none."""
    twist: Sequence[float] | None = None
    """Velocities of the body in its own axes, linear in m/s, then angular in rad/s, and the six variances of these as
    logged; None where the type has none. Of a type in GEOMETRY, before it is multiplied by that."""


class PathMessage(NamedTuple):
    """The poses of a drive up to now."""

    stamp_ns: int
    poses: list[PoseMessage]


class ImuMessage(NamedTuple):
    stamp_ns: int
    frame: str
    gyro: Sequence[float]
    """rad/s about the axes of `frame`."""
    accel: Sequence[float]
    """m/s^2 along them."""


@dataclass(frozen=True, eq=False)
class FixMessage:
    stamp_ns: int
    valid: bool
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    covariance: Floats
    """(3, 3) m^2 east-north-up; NaN where unknown by its covariance type."""
    frame: str
    """Frame of the antenna."""
    sentence: str = ""
    """Type of the NMEA sentence that it is of."""


class CloudMessage(NamedTuple):
    """Points, as they lie in a message."""

    stamp_ns: int
    frame: str
    width: int
    """Points in a row."""
    height: int
    step: int
    """Bytes of a point."""
    row_step: int
    """Bytes of a row, padding included."""
    fields: list[tuple[str, int, str]]
    """Name, offset in the point, and numpy's type of each."""
    data: RawData
    """A view of the message, where its encoding has the bytes as they are."""
    frame_from_cloud: Floats | None = None
    """(4, 4) where the points are not placed in `frame` itself."""


class FixesMessage(NamedTuple):
    """Several fixes."""

    stamp_ns: int
    fixes: list[FixMessage]


Record = (
    ImageMessage
    | CalibrationMessage
    | PoseMessage
    | PathMessage
    | ImuMessage
    | CloudMessage
    | FixMessage
    | FixesMessage
    | list[PoseMessage]
)

NMEA = "nmea_msgs/Sentence"
"""The type of sentences of satellite receivers, several of which are one fix."""
_KINDS = {
    "sensor_msgs/Image": "image",
    "sensor_msgs/CompressedImage": "image",
    "foxglove.CompressedImage": "image",
    "foxglove.RawImage": "image",
    "foxglove.CompressedVideo": "image",
    "foxglove_msgs/CompressedVideo": "image",
    "ffmpeg_image_transport_msgs/FFMPEGPacket": "image",
    "sensor_msgs/CameraInfo": "camera_info",
    "foxglove.CameraCalibration": "camera_info",
    "nav_msgs/Odometry": "odometry",
    "geometry_msgs/PoseStamped": "odometry",
    "geometry_msgs/PoseWithCovarianceStamped": "odometry",
    "geometry_msgs/TransformStamped": "odometry",
    "geometry_msgs/Pose2D": "odometry",
    "geometry_msgs/TwistStamped": "odometry",
    "geometry_msgs/TwistWithCovarianceStamped": "odometry",
    "nav_msgs/Path": "odometry",
    "px4_msgs/VehicleOdometry": "odometry",
    "ackermann_msgs/AckermannDriveStamped": "odometry",
    "sensor_msgs/JointState": "odometry",
    "sensor_msgs/Imu": "imu",
    "sensor_msgs/PointCloud2": "lidar",
    "foxglove.PointCloud": "lidar",
    "foxglove.PoseInFrame": "odometry",
    "foxglove.PosesInFrame": "odometry",
    "foxglove.Odometry": "odometry",
    "sensor_msgs/NavSatFix": "gps",
    "foxglove.LocationFix": "gps",
    "foxglove.LocationFixes": "gps",
    "gps_common/GPSFix": "gps",
    "gps_msgs/GPSFix": "gps",
    NMEA: "gps",
    "tf2_msgs/TFMessage": "tf",
    "tf/tfMessage": "tf",
    "foxglove.FrameTransform": "tf",
    "foxglove.FrameTransforms": "tf",
}
TWISTS = ("geometry_msgs/TwistStamped", "geometry_msgs/TwistWithCovarianceStamped")
"""Types with velocities and no pose."""
WHEELS = "sensor_msgs/JointState"
"""The type with a turn rate for each wheel."""
GEOMETRY = {"ackermann_msgs/AckermannDriveStamped": ("wheelbase_m",), WHEELS: ("wheel_radius_m", "track_m")}
"""Types whose velocities need measures of the vehicle, by their names in TopicChoice."""
ENCODINGS = {"cdr": "ros", "ros1": "ros", "protobuf": "foxglove", "json": "foxglove", "flatbuffer": "foxglove"}


def kind_of(channel: Channel) -> str:
    """`image`, `camera_info`, `odometry`, `gps`, `imu`, `lidar`, `tf`, or `` for what vplog has no use for or cannot
    decode."""
    family = ENCODINGS.get(channel.encoding)
    name = short_type(channel.type)
    if family is None or name.startswith("foxglove.") != (family == "foxglove"):
        return ""
    return _KINDS.get(name, "")


def short_type(name: str) -> str:
    """`sensor_msgs/msg/Image` as ROS 1 wrote it: `sensor_msgs/Image`."""
    return name.replace("/msg/", "/")


def nanoseconds(seconds: int, nanos: int) -> int:
    """One stamp. Raises BadMessageError where it is negative or does not fit 64 bits."""
    stamp_ns = seconds * 1_000_000_000 + nanos
    if not 0 <= stamp_ns < 2**63:
        raise BadMessageError(f"stamp {seconds}.{nanos:09d} s is out of range")
    return stamp_ns
