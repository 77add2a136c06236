"""Decoding of messages: raw bytes of a known type, in whatever encoding, become a record; poses many at once."""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from vplog.data import Floats, Ints
from vplog.logs.formats.container import Channel, RawData
from vplog.logs.messages.records import ENCODINGS, BadMessageError, PoseMessage, Record, nanoseconds, short_type
from vplog.logs.messages.ros import decode_ros

_NUMBERS = {
    "nav_msgs/Odometry": (7 + 36, 6 + 36),
    "geometry_msgs/PoseWithCovarianceStamped": (7 + 36, 0),
    "geometry_msgs/PoseStamped": (7, 0),
    "geometry_msgs/TransformStamped": (7, 0),
}
"""float64 at the end of a message: x y z, x y z w and a (6, 6) covariance; and those of a twist behind them."""
FRAME_ID_AT = 12
"""Bytes before the names of frames: CDR's encapsulation of 4 bytes or ROS 1's sequence number, then the stamp."""


def decode(channel: Channel, data: RawData | Record) -> Record:
    """The record of a message, the bytes of images views of `data` where they can be. Raises BadMessageError."""
    if not isinstance(data, bytes | memoryview):
        return data
    try:
        if ENCODINGS[channel.encoding] == "ros":
            return decode_ros(short_type(channel.type), channel.encoding, data)
        from vplog.logs.messages.foxglove import decode_foxglove

        return decode_foxglove(channel.type, channel.encoding, data)
    except BadMessageError:
        raise
    except Exception as error:  # the parsers raise anything on a stranger's bytes
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadMessageError(reason[:200]) from None


def stamp_of(channel: Channel, data: RawData | Record) -> int:
    """The header stamp in ns, of ROS without looking at the rest. Raises BadMessageError."""
    if channel.encoding in ("cdr", "ros1") and isinstance(data, bytes | memoryview):
        if len(data) < FRAME_ID_AT:
            raise BadMessageError(f"{len(data)} bytes are too few for a header")
        cdr, order = channel.encoding == "cdr", "<" if channel.encoding == "ros1" or data[1] == 1 else ">"
        at = 4 if cdr or short_type(channel.type) != "foxglove_msgs/CompressedVideo" else 0  # it has no std_msgs/Header
        return nanoseconds(*struct.unpack_from(f"{order}{'i' if cdr else 'I'}I", data, at))
    record = decode(channel, data)
    return 0 if isinstance(record, list) else record.stamp_ns


class Poses(NamedTuple):
    """Messages of one topic as they were logged."""

    stamp_ns: Ints
    """(K,)"""
    frame: str
    child: str
    """The frame that moves."""
    poses: Floats
    """(K, 7) x y z in m, x y z w."""
    covariances: Floats | None
    """(K, 36) the (6, 6) of each: translation first, axes of `frame`; None where the type has none."""
    twists: Floats | None = None
    """(K, 12) velocities and their variances, as PoseMessage.twist; None where the type has none."""


def read_poses(channel: Channel, messages: list[bytes]) -> Poses | None:
    """The poses of messages of any type; None where one is damaged or is no pose, or they name different frames."""
    try:
        if found := read_ros_poses(channel, messages):
            return found
        poses = [record for message in messages if isinstance(record := decode(channel, message), PoseMessage)]
    except BadMessageError:
        return None
    if len(poses) < len(messages):
        return None
    stamps, frames, children, positions, quaternions, covariances, twists = zip(*poses, strict=True)
    if len(set(frames)) > 1 or len(set(children)) > 1:
        return None
    numbers = np.concatenate([np.array(positions, np.float64), np.array(quaternions, np.float64)], axis=1)
    known = None if covariances[0] is None else np.array(covariances, np.float64)
    moving = None if twists[0] is None else np.array(twists, np.float64)
    return Poses(np.array(stamps, np.int64), frames[0], children[0], numbers, known, moving)


def read_ros_poses(channel: Channel, messages: list[bytes]) -> Poses | None:
    """The poses of messages in little-endian CDR or as ROS 1 packs them, equal but for stamps and numbers; None for
    anything else. One pose takes 0.1 us so, and 12 by `decode`. Raises BadMessageError where the first is damaged."""
    count, behind = _NUMBERS.get(short_type(channel.type), (0, 0))
    cdr, size = channel.encoding == "cdr", len(messages[0])
    at = size - 8 * (count + behind)
    if not count or not (cdr or channel.encoding == "ros1") or {*map(len, messages)} != {size}:
        return None
    first = decode(channel, messages[0])
    rows = np.frombuffer(b"".join(messages), np.uint8).reshape(-1, size)
    if not isinstance(first, PoseMessage) or (rows[:, FRAME_ID_AT:at] != rows[0, FRAME_ID_AT:at]).any():
        return None
    if cdr and (rows[:, :4] != (0, 1, 0, 0)).any():  # encapsulation: plain CDR, little endian, no options
        return None
    stamps = np.ascontiguousarray(rows[:, 4:FRAME_ID_AT]).view("<u4").astype(np.int64)
    if cdr and (stamps[:, 0] >= 2**31).any():  # negative
        return None
    numbers = np.ascontiguousarray(rows[:, at:]).view("<f8")
    if tuple(numbers[0, :3].tolist()) != first.position:  # padding at the end
        return None
    covariances = None if first.covariance is None else numbers[:, 7:count]
    twists = None if first.twist is None else numbers[:, [*range(count, count + 6), *range(count + 6, count + 42, 7)]]
    return Poses(stamps[:, 0] * 10**9 + stamps[:, 1], first.frame, first.child, numbers[:, :7], covariances, twists)
