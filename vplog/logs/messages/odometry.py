"""Odometry, the messages that drives have most of, many at once; nav_msgs/Odometry where its numbers lie.

A general decoder builds twenty objects for each; this takes a hundredth of its time. Whatever is not laid out just as
expected is left to that decoder, which says what is wrong.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vplog.logs.messages.decode import decode_generally
from vplog.logs.messages.records import BadMessageError, PoseMessage, nanoseconds, short_type

if TYPE_CHECKING:
    from vplog.data import Floats, Ints
    from vplog.logs.formats.container import Channel

_POSE = 7 + 36
"""Numbers of a pose with covariance: position, quaternion, 6 x 6; the twist behind it has one fewer, 6 + 36."""
_TWIST = 6 + 36
_MOST_NAMED = 4096
"""Bytes that the names of both frames may take here."""
_HEAD = 12
"""Bytes before the names: CDR's encapsulation of 4 bytes or ROS 1's sequence number, then the stamp."""


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


def read_poses(channel: Channel, messages: list[bytes]) -> Poses | None:
    """The poses of messages of any type; None where they cannot be taken together: one is damaged or is no pose, or
    they name different frames."""
    found = read_odometry(channel, messages) or _read_poses_in_frame(channel, messages)
    if found is not None:
        return found
    try:
        records = [decode_generally(channel, message) for message in messages]
    except BadMessageError:
        return None
    poses = [record for record in records if isinstance(record, PoseMessage)]
    if len(poses) < len(messages):
        return None
    stamps, frames, children, positions, quaternions, covariances = zip(*poses, strict=True)
    if len(set(frames)) > 1 or len(set(children)) > 1:
        return None
    numbers = np.concatenate([np.array(positions, np.float64), np.array(quaternions, np.float64)], axis=1)
    known = None if covariances[0] is None else np.array(covariances, np.float64)
    return Poses(np.array(stamps, np.int64), frames[0], children[0], numbers, known)


def read_odometry(channel: Channel, messages: list[bytes]) -> Poses | None:
    """The poses of messages of nav_msgs/Odometry in little-endian CDR or as ROS 1 has it.

    None for anything else, where the messages name different frames, and where a stamp is out of range.
    """
    size = len(messages[0])
    numbers_at = size - 8 * (_POSE + _TWIST)
    if not _is_odometry(channel) or not _HEAD < numbers_at < _MOST_NAMED or {*map(len, messages)} != {size}:
        return None
    rows = np.frombuffer(b"".join(messages), np.uint8).reshape(-1, size)
    cdr = channel.encoding == "cdr"
    if cdr and (rows[:, :4] != (0, 1, 0, 0)).any():  # encapsulation: plain CDR, little endian, no options
        return None
    names = _names(messages[0][_HEAD:numbers_at], cdr)
    if names is None or (rows[:, _HEAD:numbers_at] != rows[0, _HEAD:numbers_at]).any():
        return None
    stamps = np.ascontiguousarray(rows[:, 4:_HEAD]).view("<u4").astype(np.int64)
    if cdr and (stamps[:, 0] >= 2**31).any():  # negative
        return None
    numbers = np.ascontiguousarray(rows[:, numbers_at : numbers_at + 8 * _POSE]).view("<f8")
    return Poses(stamps[:, 0] * 10**9 + stamps[:, 1], *names, numbers[:, :7], numbers[:, 7:])


def _read_poses_in_frame(channel: Channel, messages: list[bytes]) -> Poses | None:
    """The poses of messages of foxglove.PoseInFrame in protobuf; None as above, and for damaged ones."""
    if channel.encoding != "protobuf" or channel.type != "foxglove.PoseInFrame":
        return None
    from vplog.logs.messages.foxglove import DecodeError, PoseInFrame

    stamps, numbers = [], []
    one: Any = PoseInFrame()
    try:
        frame = one.FromString(messages[0]).frame_id
        for data in messages:
            one.ParseFromString(data)
            if one.frame_id != frame:
                return None
            stamps.append(nanoseconds(one.timestamp.seconds, one.timestamp.nanos))
            p, q = one.pose.position, one.pose.orientation
            numbers.append((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    except (DecodeError, BadMessageError):
        return None
    return Poses(np.array(stamps, np.int64), frame, "", np.array(numbers, np.float64), None)


@lru_cache(maxsize=16)
def _is_odometry(channel: Channel) -> bool:
    return short_type(channel.type) == "nav_msgs/Odometry" and channel.encoding in ("cdr", "ros1")


@lru_cache(maxsize=16)
def _names(data: bytes, cdr: bool) -> tuple[str, str] | None:
    """Frame and child frame, the same in every message of a topic; None where the bytes are not two strings alone."""
    position, names = 0, []
    for _ in range(2):
        length = int.from_bytes(data[position : position + 4], "little")
        stop = position + 4 + length
        if stop > len(data) or (cdr and (not length or data[stop - 1])):
            return None
        names.append(data[position + 4 : stop - cdr])  # strings end with a zero in CDR only
        # CDR aligns numbers to their size, counted from behind its 4 bytes of encapsulation and 8 of stamp.
        position = stop + (-stop % 4 if cdr else 0)
    if position + (-(position + 8) % 8 if cdr else 0) != len(data):
        return None
    try:
        return names[0].decode("utf-8"), names[1].decode("utf-8")
    except UnicodeDecodeError:
        return None
