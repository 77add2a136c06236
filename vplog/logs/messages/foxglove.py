"""Foxglove messages, protobuf, JSON and FlatBuffers (docs.foxglove.dev/docs/sdk/schemas), through Foxglove's classes.

The file's descriptors are not built: these types are fixed by their names, and a stranger's schema runs nothing.
"""

from __future__ import annotations

import base64
import json
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.logs.messages.flatbuffers import fill_flat
from vplog.logs.messages.records import (
    BadMessageError,
    CalibrationMessage,
    FixMessage,
    ImageMessage,
    PoseMessage,
    nanoseconds,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from google.protobuf.message import Message as Proto

    from vplog.data import Floats
    from vplog.logs.formats.container import Octets
    from vplog.logs.messages.records import Record

_UNKNOWN_COVARIANCE = 0
"""LocationFix.PositionCovarianceType.UNKNOWN."""
_LENGTH = 2
"""Wire type of protobuf's fields that are bytes behind their length (protobuf.dev/programming-guides/encoding)."""
_FIXED = {1: 8, 5: 4}
"""Bytes of the wire types that have always as many."""


def decode_foxglove(kind: str, encoding: str, data: Octets) -> Record:
    """A record of type `foxglove.RawImage` and so on; in protobuf, the bytes of images are a view of `data`. Raises
    BadMessageError or what the parsers raise."""
    message, read = _message_class(kind)(), _READERS[kind]
    if encoding == "json":
        _fill(message, json.loads(bytes(data)))
    elif encoding == "flatbuffer":
        fill_flat(message, bytes(data))
    else:
        at, start, stop = (read in (_raw, _compressed) and _find_data(message, data)) or (len(data), 0, len(data))
        message.ParseFromString(bytes(data[:at]) + bytes(data[stop:]))  # pixels the parser would copy twice
        if start and not message.data:
            image: Any = read(message)
            return image._replace(data=memoryview(data)[start:stop])
        if start:  # of a field that comes twice, the last one counts
            message.ParseFromString(bytes(data))
    return read(message)


@cache
def _message_class(kind: str) -> Any:
    name = kind.removeprefix("foxglove.")
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


def _find_data(message: Proto, data: Octets) -> tuple[int, int, int] | None:
    """Where the field `data` of an image lies in protobuf: its tag, first byte and end. None where it is left out."""
    tag, at = message.DESCRIPTOR.fields_by_name["data"].number << 3 | _LENGTH, 0
    try:
        while data[at] != tag:
            at = _skipped(data, at + 1, data[at])
        size, start = _varint(data, at + 1)
    except LookupError:
        return None
    return (at, start, start + size) if start + size <= len(data) else None


def _skipped(data: Octets, at: int, tag: int) -> int:
    """Where the value of a field ends that begins at `at`. Raises IndexError where the tag is of another message."""
    if tag >= 0x80:  # a field number above 15, which none of these types has
        raise IndexError
    if tag & 7 == _LENGTH:
        length, at = _varint(data, at)
        return at + length
    if tag & 7 == 0:
        return _varint(data, at)[1]
    return at + _FIXED[tag & 7]


def _varint(data: Octets, at: int) -> tuple[int, int]:
    """A number in groups of 7 bits, the lowest first, and where it ends. Raises IndexError where it does not."""
    value = shift = 0
    for position in range(at, at + 10):  # 64 bits
        byte = data[position]
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position + 1
        shift += 7
    raise IndexError


def _fill(message: Proto, tree: Any) -> None:
    """Set a message from Foxglove's JSON: times as {sec, nsec}, bytes as base64, enums as numbers."""
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


def _raw(m: Any) -> Record:
    return ImageMessage(_stamp(m), m.frame_id, m.encoding, m.data, False, m.width, m.height, m.step)


def _compressed(m: Any) -> Record:
    return ImageMessage(_stamp(m), m.frame_id, m.format, m.data, True)


def _calibration(m: Any) -> Record:
    return CalibrationMessage(
        _stamp(m), m.frame_id, m.width, m.height, m.distortion_model, np.array(m.D, np.float64),
        _matrix(m.K, (3, 3)), _matrix(m.P, (3, 4)), _matrix(m.R, (3, 3)),
    )  # fmt: skip


def _pose(m: Any) -> Record:
    return _placed(m, m.frame_id, "", m.pose.position, m.pose.orientation)


def _odometry(m: Any) -> Record:
    covariance = _matrix(m.pose_covariance, (6, 6)).ravel().tolist()
    return _placed(m, m.frame_id, m.body_frame_id, m.pose.position, m.pose.orientation, covariance)


def _transform(m: Any) -> PoseMessage:
    return _placed(m, m.parent_frame_id, m.child_frame_id, m.translation, m.rotation)


def _placed(m: Any, frame: str, child: str, p: Any, q: Any, covariance: list[float] | None = None) -> PoseMessage:
    return PoseMessage(_stamp(m), frame, child, (p.x, p.y, p.z), (q.x, q.y, q.z, q.w), covariance)


def _fix(m: Any) -> Record:
    known = m.position_covariance_type != _UNKNOWN_COVARIANCE
    covariance = _matrix(m.position_covariance, (3, 3)) if known else np.full((3, 3), np.nan)
    return FixMessage(_stamp(m), True, m.latitude, m.longitude, m.altitude, covariance, m.frame_id)


def _matrix(values: Any, shape: tuple[int, int]) -> Floats:
    """Zeros where the field was left out."""
    return np.array(values, np.float64).reshape(shape) if len(values) else np.zeros(shape)


_READERS: dict[str, Callable[[Any], Record]] = {
    "foxglove.RawImage": _raw,
    "foxglove.CompressedImage": _compressed,
    "foxglove.CompressedVideo": _compressed,
    "foxglove.CameraCalibration": _calibration,
    "foxglove.PoseInFrame": _pose,
    "foxglove.Odometry": _odometry,
    "foxglove.LocationFix": _fix,
    "foxglove.FrameTransform": lambda m: [_transform(m)],
    "foxglove.FrameTransforms": lambda m: [_transform(t) for t in m.transforms],
}
