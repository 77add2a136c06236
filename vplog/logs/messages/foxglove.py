"""Foxglove messages, protobuf, JSON and FlatBuffers (docs.foxglove.dev/docs/sdk/schemas), through Foxglove's classes.

The file's descriptors are not built: these types are fixed by their names, and a stranger's schema runs nothing.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Floats
from vplog.geometry import se3
from vplog.logs.formats.container import RawData
from vplog.logs.messages.flatbuffers import parse_flatbuffer
from vplog.logs.messages.records import (
    BadMessageError,
    CalibrationMessage,
    CloudMessage,
    FixesMessage,
    FixMessage,
    ImageMessage,
    PoseMessage,
    Record,
    nanoseconds,
)

if TYPE_CHECKING:
    from google.protobuf.message import Message as Proto

_UNKNOWN_COVARIANCE = 0
"""LocationFix.PositionCovarianceType.UNKNOWN."""
_NUMBER_TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}
"""PackedElementField.NumericType."""


def decode_foxglove(kind: str, encoding: str, data: RawData) -> Record:
    """A record of type `foxglove.RawImage` and so on. Raises BadMessageError or what the parsers raise."""
    message = _message_class(kind)()
    if encoding == "json":
        _fill(message, json.loads(bytes(data)))
    elif encoding == "flatbuffer":
        parse_flatbuffer(message, bytes(data))
    else:
        message.ParseFromString(bytes(data))
    return _READERS[kind](message)


@cache
def _message_class(kind: str) -> Any:
    name = kind.removeprefix("foxglove.")
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


def _fill(message: Proto, tree: Any) -> None:
    """Set a message from Foxglove's JSON: times as {sec, nsec}, bytes as base64, enums as numbers.

    protobuf's json_format has times as text and takes five times as long.
    """
    if not isinstance(tree, dict):
        raise BadMessageError(f"{message.DESCRIPTOR.name} is not a JSON object")
    if message.DESCRIPTOR.full_name == "google.protobuf.Timestamp":
        tree = {"seconds": tree.get("sec", 0), "nanos": tree.get("nsec", tree.get("nanosec", 0))}
    for descriptor in message.DESCRIPTOR.fields:
        value = tree.get(descriptor.name)
        if value is None:
            continue
        if descriptor.is_repeated:
            if not isinstance(value, list):
                raise BadMessageError(f"{descriptor.name} is not a JSON array")
            field = getattr(message, descriptor.name)
            if descriptor.message_type:
                for item in value:
                    _fill(field.add(), item)
            else:
                field.extend(value)
        elif descriptor.message_type:
            _fill(getattr(message, descriptor.name), value)
        elif descriptor.type == descriptor.TYPE_BYTES:
            setattr(message, descriptor.name, _bytes(value))
        else:
            setattr(message, descriptor.name, value)


def _bytes(value: Any) -> bytes:
    try:
        return base64.b64decode(value, validate=True)
    except (TypeError, ValueError):
        raise BadMessageError("its data are not base64") from None


def _stamp(message: Any) -> int:
    return nanoseconds(message.timestamp.seconds, message.timestamp.nanos)


def _calibration(m: Any) -> Record:
    return CalibrationMessage(
        _stamp(m), m.frame_id, m.width, m.height, m.distortion_model, np.array(m.D, np.float64),
        _matrix(m.K, (3, 3)), _matrix(m.P, (3, 4)), _matrix(m.R, (3, 3)),
    )  # fmt: skip


def _poses(m: Any) -> Record:
    """The last pose is that of the message's time."""
    if not m.poses:
        raise BadMessageError("it holds no pose")
    return _placed(m, m.frame_id, "", m.poses[-1].position, m.poses[-1].orientation)


def _odometry(m: Any) -> Record:
    covariance = _matrix(m.pose_covariance, (6, 6)).ravel().tolist()
    found = _placed(m, m.frame_id, m.body_frame_id, m.pose.position, m.pose.orientation, covariance)
    linear, angular = m.linear_velocity, m.angular_velocity
    variances = _matrix(m.velocity_covariance, (6, 6)).ravel()[::7]
    return found._replace(twist=(linear.x, linear.y, linear.z, angular.x, angular.y, angular.z, *variances.tolist()))


def _transforms(found: Any) -> Record:
    return [_placed(m, m.parent_frame_id, m.child_frame_id, m.translation, m.rotation) for m in found]


def _placed(m: Any, frame: str, child: str, p: Any, q: Any, covariance: list[float] | None = None) -> PoseMessage:
    return PoseMessage(_stamp(m), frame, child, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w), covariance)


def _fix(m: Any) -> FixMessage:
    known = m.position_covariance_type != _UNKNOWN_COVARIANCE
    covariance = _matrix(m.position_covariance, (3, 3)) if known else np.full((3, 3), np.nan)
    return FixMessage(_stamp(m), True, m.latitude, m.longitude, m.altitude, covariance, m.frame_id)


def _fixes(m: Any) -> Record:
    found = [_fix(one) for one in m.fixes]
    return FixesMessage(found[0].stamp_ns if found else 0, found)


def _cloud(m: Any) -> Record:
    p, q = m.pose.position, m.pose.orientation
    turn = np.array([q.x, q.y, q.z, q.w])
    placed = se3.pose(se3.rotation(turn), np.array([p.x, p.y, p.z])) if turn.any() else None
    typed = [(one.name, one.offset, "<" + _NUMBER_TYPES[one.type]) for one in m.fields if one.type in _NUMBER_TYPES]
    count = len(m.data) // m.point_stride if m.point_stride else 0
    size = m.point_stride, count * m.point_stride
    return CloudMessage(_stamp(m), m.frame_id, count, 1, *size, typed, m.data, placed)


def _matrix(values: Any, shape: tuple[int, int]) -> Floats:
    """Zeros where the field was left out."""
    return np.array(values, np.float64).reshape(shape) if len(values) else np.zeros(shape)


_READERS: dict[str, Callable[[Any], Record]] = {
    "foxglove.RawImage": lambda m: ImageMessage(
        _stamp(m), m.frame_id, m.encoding, m.data, False, m.width, m.height, m.step
    ),
    **dict.fromkeys(
        ("foxglove.CompressedImage", "foxglove.CompressedVideo"),
        lambda m: ImageMessage(_stamp(m), m.frame_id, m.format, m.data, True),
    ),
    "foxglove.CameraCalibration": _calibration,
    "foxglove.PoseInFrame": lambda m: _placed(m, m.frame_id, "", m.pose.position, m.pose.orientation),
    "foxglove.PosesInFrame": _poses,
    "foxglove.Odometry": _odometry,
    "foxglove.PointCloud": _cloud,
    "foxglove.LocationFix": _fix,
    "foxglove.LocationFixes": _fixes,
    "foxglove.FrameTransform": lambda m: _transforms([m]),
    "foxglove.FrameTransforms": lambda m: _transforms(m.transforms),
}
