"""Foxglove messages as FlatBuffers (flatbuffers.dev/internals), without their schema, into the protobuf classes.

By hand: the classes that Foxglove generates take 154 us for a PoseInFrame where this takes 66, and cut strings short
that point outside the buffer.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

from vplog.logs.messages.records import BadMessageError

if TYPE_CHECKING:
    from google.protobuf.message import Message as Proto

_FIELDS = {
    "foxglove.CompressedImage": "timestamp frame_id data format",
    "foxglove.CompressedVideo": "timestamp frame_id data format",
    "foxglove.RawImage": "timestamp frame_id width height encoding step data",
    "foxglove.CameraCalibration": "timestamp frame_id width height distortion_model D K R P",
    "foxglove.PoseInFrame": "timestamp frame_id pose",
    "foxglove.PosesInFrame": "timestamp frame_id poses",
    "foxglove.Odometry": (
        "timestamp frame_id body_frame_id pose linear_velocity angular_velocity pose_covariance velocity_covariance"
    ),
    "foxglove.LocationFix": (
        "timestamp frame_id latitude longitude altitude position_covariance position_covariance_type"
    ),
    "foxglove.LocationFixes": "fixes",
    "foxglove.PointCloud": "timestamp frame_id pose point_stride fields data",
    "foxglove.PackedElementField": "name offset type",
    "foxglove.FrameTransform": "timestamp parent_frame_id child_frame_id translation rotation",
    "foxglove.FrameTransforms": "transforms",
    "foxglove.Pose": "position orientation",
    "foxglove.Vector3": "x y z",
    "foxglove.Quaternion": "x y z w",
}
"""Fields of each table in order (github.com/foxglove/foxglove-sdk, schemas/flatbuffer), as far as they are read."""


def parse_flatbuffer(message: Proto, data: bytes) -> None:
    """Set a message from a FlatBuffer. Raises BadMessageError or struct.error where it points outside itself."""
    _fill(message, data, _follow(data, 0))


def _fill(message: Any, data: bytes, table: int) -> None:
    size = len(data)
    (back,) = struct.unpack_from("<i", data, table)
    vtable = table - back
    if not 0 <= vtable <= size - 4:
        raise BadMessageError("a table of it points outside")
    (length,) = struct.unpack_from("<H", data, vtable)
    descriptor = message.DESCRIPTOR
    if descriptor.name == "Quaternion":
        message.w = 1.0  # the one default that is not zero
    for number, name in enumerate(_FIELDS[descriptor.full_name].split()):
        slot = 4 + 2 * number  # behind the sizes of vtable and table
        offset = struct.unpack_from("<H", data, vtable + slot)[0] if slot + 2 <= length else 0
        if offset:  # 0: the field has its default
            _set(message, descriptor.fields_by_name[name], data, table + offset)


def _set(message: Any, field: Any, data: bytes, at: int) -> None:
    kind = field.message_type and field.message_type.full_name
    if field.is_repeated and kind:
        entries = _follow(data, at)
        for i in range(len(_vector(data, at, 4)) // 4):
            _fill(getattr(message, field.name).add(), data, _follow(data, entries + 4 + 4 * i))
    elif field.is_repeated:
        raw = _vector(data, at, 8)
        getattr(message, field.name).extend(struct.unpack(f"<{len(raw) // 8}d", raw))
    elif kind == "google.protobuf.Timestamp":
        stamp = getattr(message, field.name)
        stamp.seconds, stamp.nanos = struct.unpack_from("<II", data, at)  # a struct: it lies in the table itself
    elif kind:
        _fill(getattr(message, field.name), data, _follow(data, at))
    elif field.type in (field.TYPE_STRING, field.TYPE_BYTES):
        raw = _vector(data, at, 1)
        setattr(message, field.name, raw.decode() if field.type == field.TYPE_STRING else raw)
    else:
        layout = {field.TYPE_DOUBLE: "<d", field.TYPE_ENUM: "<B"}.get(field.type, "<I")
        setattr(message, field.name, struct.unpack_from(layout, data, at)[0])


def _follow(data: bytes, at: int) -> int:
    """Where the offset at a place leads: forward, within the buffer."""
    (offset,) = struct.unpack_from("<I", data, at)
    if not 0 < offset <= len(data) - at - 4:
        raise BadMessageError("an offset of it points outside")
    return at + offset


def _vector(data: bytes, at: int, item: int) -> bytes:
    start = _follow(data, at)
    (count,) = struct.unpack_from("<I", data, start)
    stop = start + 4 + count * item
    if stop > len(data):
        raise BadMessageError("a vector of it points outside")
    return data[start + 4 : stop]
