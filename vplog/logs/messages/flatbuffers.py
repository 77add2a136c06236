"""Foxglove messages as FlatBuffers (flatbuffers.dev/internals), without their schema, into the protobuf classes.

By names of fields rather than by the classes that Foxglove generates, which cut strings short that point outside.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from flatbuffers import encode, number_types
from flatbuffers.table import Table

from vplog.logs.messages.records import BadMessageError

if TYPE_CHECKING:
    from google.protobuf.message import Message as Proto

_MOST_BYTES = 2**28
"""Bytes of the entries of a vector together: they may share their bytes, so that a short message becomes a long one."""
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
    """Set a message from a FlatBuffer. Raises BadMessageError, struct.error, TypeError or ValueError where it points
    outside itself."""
    _fill(message, Table(data, encode.Get(number_types.UOffsetTFlags.packer_type, data, 0)))


def _fill(message: Any, table: Table) -> None:
    descriptor = message.DESCRIPTOR
    if descriptor.name == "Quaternion":
        message.w = 1.0  # the one default that is not zero
    for number, name in enumerate(_FIELDS[descriptor.full_name].split()):
        if offset := table.Offset(4 + 2 * number):  # behind the sizes of vtable and table; 0: the field has its default
            _set(message, descriptor.fields_by_name[name], table, offset)


def _set(message: Any, field: Any, table: Table, offset: int) -> None:
    kind, at = field.message_type and field.message_type.full_name, table.Pos + offset
    if field.is_repeated and kind:
        size, entries = 0, table.GetVectorAsNumpy(number_types.UOffsetTFlags, offset).tolist()
        for position, entry in enumerate(entries):
            one = getattr(message, field.name).add()
            _fill(one, Table(table.Bytes, table.Vector(offset) + 4 * position + entry))
            size += one.ByteSize()
            if size > _MOST_BYTES:
                raise BadMessageError(f"its {field.name} take more than {_MOST_BYTES // 2**20} MB")
    elif field.is_repeated:
        getattr(message, field.name).extend(table.GetVectorAsNumpy(number_types.Float64Flags, offset))
    elif kind == "google.protobuf.Timestamp":
        stamp = getattr(message, field.name)  # a struct: it lies in the table itself
        stamp.seconds, stamp.nanos = (table.Get(number_types.Uint32Flags, at + part) for part in (0, 4))
    elif kind:
        _fill(getattr(message, field.name), Table(table.Bytes, table.Indirect(at)))
    elif field.type in (field.TYPE_STRING, field.TYPE_BYTES):
        raw = table.GetVectorAsNumpy(number_types.Uint8Flags, offset).tobytes()
        setattr(message, field.name, raw.decode() if field.type == field.TYPE_STRING else raw)
    else:
        flags = {field.TYPE_DOUBLE: number_types.Float64Flags, field.TYPE_ENUM: number_types.Uint8Flags}
        setattr(message, field.name, table.Get(flags.get(field.type, number_types.Uint32Flags), at))
