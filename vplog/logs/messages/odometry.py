"""Poses, the messages that drives have most of, many at once: those of ROS in a hundredth of the time of one by one."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vplog.logs.messages.decode import decode
from vplog.logs.messages.records import BadMessageError, PoseMessage, short_type

if TYPE_CHECKING:
    from vplog.data import Floats, Ints
    from vplog.logs.formats.container import Channel

_NUMBERS = {
    "nav_msgs/Odometry": (7 + 36, 6 + 36),
    "geometry_msgs/PoseWithCovarianceStamped": (7 + 36, 0),
    "geometry_msgs/PoseStamped": (7, 0),
    "geometry_msgs/TransformStamped": (7, 0),
}
"""float64 at the end of a message: x y z, x y z w and a (6, 6) covariance; and those of a twist behind them."""
_HEAD = 12
"""Bytes before the names of frames: CDR's encapsulation of 4 bytes or ROS 1's sequence number, then the stamp."""


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
    try:
        found = read_ros_poses(channel, messages)
        records = [] if found else [decode(channel, message) for message in messages]
    except BadMessageError:
        return None
    if found is not None:
        return found
    poses = [record for record in records if isinstance(record, PoseMessage)]
    if len(poses) < len(messages):
        return None
    stamps, frames, children, positions, quaternions, covariances = zip(*poses, strict=True)
    if len(set(frames)) > 1 or len(set(children)) > 1:
        return None
    numbers = np.concatenate([np.array(positions, np.float64), np.array(quaternions, np.float64)], axis=1)
    known = None if covariances[0] is None else np.array(covariances, np.float64)
    return Poses(np.array(stamps, np.int64), frames[0], children[0], numbers, known)


def read_ros_poses(channel: Channel, messages: list[bytes]) -> Poses | None:
    """The poses of messages in little-endian CDR or as ROS 1 packs them, equal but for stamps and numbers.

    None for anything else, and where a stamp is out of range. Raises BadMessageError where the first is damaged.
    """
    count, behind = _NUMBERS.get(short_type(channel.type), (0, 0))
    cdr, size = channel.encoding == "cdr", len(messages[0])
    at = size - 8 * (count + behind)
    if not count or not (cdr or channel.encoding == "ros1") or {*map(len, messages)} != {size}:
        return None
    first = decode(channel, messages[0])
    rows = np.frombuffer(b"".join(messages), np.uint8).reshape(-1, size)
    if not isinstance(first, PoseMessage) or (rows[:, _HEAD:at] != rows[0, _HEAD:at]).any():
        return None
    if cdr and (rows[:, :4] != (0, 1, 0, 0)).any():  # encapsulation: plain CDR, little endian, no options
        return None
    stamps = np.ascontiguousarray(rows[:, 4:_HEAD]).view("<u4").astype(np.int64)
    if cdr and (stamps[:, 0] >= 2**31).any():  # negative
        return None
    numbers = np.ascontiguousarray(rows[:, at : at + 8 * count]).view("<f8")
    if tuple(numbers[0, :3].tolist()) != first.position:  # padding at the end
        return None
    covariances = None if first.covariance is None else numbers[:, 7:]
    return Poses(stamps[:, 0] * 10**9 + stamps[:, 1], first.frame, first.child, numbers[:, :7], covariances)
