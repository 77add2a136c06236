"""ROS messages, CDR (ROS 2) and ROS 1, through rosbags' decoders of the standard types."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from vplog.logs.messages.records import (
    CalibrationMessage,
    FixMessage,
    ImageMessage,
    PoseMessage,
    TransformMessage,
    nanoseconds,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from rosbags.typesys.store import Typestore

    from vplog.data import Floats
    from vplog.logs.messages.records import Record

_UNKNOWN_COVARIANCE = 0
"""NavSatFix.COVARIANCE_TYPE_UNKNOWN."""

_VIDEO = {
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": (
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data"
    ),
    "foxglove_msgs/msg/CompressedVideo": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format"
    ),
}
"""Types of video that ROS does not come with: github.com/ros-misc-utilities/ffmpeg_image_transport_msgs, and
docs.foxglove.dev/docs/sdk/schemas."""


@cache
def _store(encoding: str) -> Typestore:
    if encoding == "cdr":
        store = get_typestore(Stores.ROS2_HUMBLE)  # these types have one layout in every ROS 2 release
        for name, fields in _VIDEO.items():
            store.register(get_types_from_msg(fields, name))
        return store
    store = get_typestore(Stores.ROS1_NOETIC)
    transforms = "geometry_msgs/TransformStamped[] transforms"
    for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
        if name not in store.fielddefs:
            store.register(get_types_from_msg(transforms, name))
    return store


def decode_ros(kind: str, encoding: str, data: bytes) -> Record:
    """A record of type `sensor_msgs/Image` and so on. Raises whatever the decoder does on damaged bytes."""
    store = _store(encoding)
    name = kind.replace("/", "/msg/")
    message: Any = store.deserialize_cdr(data, name) if encoding == "cdr" else store.deserialize_ros1(data, name)
    return _READERS[kind](message)


def _stamp(message: Any) -> int:
    return nanoseconds(message.header.stamp.sec, message.header.stamp.nanosec)


def _image(message: Any) -> Record:
    return ImageMessage(
        _stamp(message), message.header.frame_id, message.encoding, message.data.tobytes(), False,
        message.width, message.height, message.step, bool(message.is_bigendian),
    )  # fmt: skip


def _compressed(message: Any) -> Record:
    return ImageMessage(_stamp(message), message.header.frame_id, message.format, message.data.tobytes(), True)


def _packet(message: Any) -> Record:
    return ImageMessage(_stamp(message), message.header.frame_id, message.encoding, message.data.tobytes(), True)


def _video(message: Any) -> Record:
    stamp_ns = nanoseconds(message.timestamp.sec, message.timestamp.nanosec)
    return ImageMessage(stamp_ns, message.frame_id, message.format, message.data.tobytes(), True)


def _calibration(message: Any) -> Record:
    # ROS 2 made the fields of ROS 1 lower case.
    d, k, p, r = (np.array(getattr(message, n if hasattr(message, n) else n.upper()), np.float64) for n in "dkpr")
    window, width, height = _window(message)
    k = window @ k.reshape(3, 3) if k.any() else k.reshape(3, 3)
    p = window @ p.reshape(3, 4) if p.any() else p.reshape(3, 4)
    return CalibrationMessage(
        _stamp(message), message.header.frame_id, width, height, message.distortion_model, d, k, p, r.reshape(3, 3)
    )


def _window(message: Any) -> tuple[Floats, int, int]:
    """(3, 3) from px of the full image to px of the images as they come, and the width and height of those.

    K and P are of the full image; roi says which part of it is sent, and binning how many px become one.
    """
    roi, x, y = message.roi, max(message.binning_x, 1), max(message.binning_y, 1)
    # Pixel centres are whole numbers, so a pixel of n begins half a pixel before the first of them.
    window = np.array([
        [1 / x, 0.0, (0.5 - roi.x_offset) / x - 0.5],
        [0.0, 1 / y, (0.5 - roi.y_offset) / y - 0.5],
        [0.0, 0.0, 1.0],
    ])  # fmt: skip
    return window, (roi.width or message.width) // x, (roi.height or message.height) // y


def _odometry(message: Any) -> Record:
    return _pose(message, message.pose.pose, message.child_frame_id, message.pose.covariance)


def _pose_stamped(message: Any) -> Record:
    return _pose(message, message.pose, "", None)


def _pose_with_covariance(message: Any) -> Record:
    return _pose(message, message.pose.pose, "", message.pose.covariance)


def _pose(message: Any, pose: Any, child: str, covariance: Any) -> PoseMessage:
    sigma = None if covariance is None else np.reshape(covariance, 36).astype(np.float64).tolist()
    p, q = pose.position, pose.orientation
    return PoseMessage(_stamp(message), message.header.frame_id, child, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w), sigma)


def _fix(message: Any) -> Record:
    covariance = np.reshape(message.position_covariance, (3, 3)).astype(np.float64)
    if message.position_covariance_type == _UNKNOWN_COVARIANCE:
        covariance = np.full((3, 3), np.nan)
    return FixMessage(
        _stamp(message), message.status.status >= 0, message.latitude, message.longitude, message.altitude, covariance,
        message.header.frame_id,
    )  # fmt: skip


def _transforms(message: Any) -> Record:
    return [
        TransformMessage(
            t.header.frame_id, t.child_frame_id, _xyz(t.transform.translation), _xyzw(t.transform.rotation), _stamp(t)
        )
        for t in message.transforms
    ]


def _one_transform(message: Any) -> Record:
    p, q = message.transform.translation, message.transform.rotation
    position, quaternion = (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)
    return PoseMessage(_stamp(message), message.header.frame_id, message.child_frame_id, position, quaternion, None)


def _xyz(v: Any) -> Floats:
    return np.array([v.x, v.y, v.z])


def _xyzw(q: Any) -> Floats:
    return np.array([q.x, q.y, q.z, q.w])


_READERS: dict[str, Callable[[Any], Record]] = {
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _compressed,
    "ffmpeg_image_transport_msgs/FFMPEGPacket": _packet,
    "foxglove_msgs/CompressedVideo": _video,
    "sensor_msgs/CameraInfo": _calibration,
    "nav_msgs/Odometry": _odometry,
    "geometry_msgs/PoseStamped": _pose_stamped,
    "geometry_msgs/PoseWithCovarianceStamped": _pose_with_covariance,
    "geometry_msgs/TransformStamped": _one_transform,
    "sensor_msgs/NavSatFix": _fix,
    "tf2_msgs/TFMessage": _transforms,
    "tf/tfMessage": _transforms,
}
