"""nav_msgs/Odometry, the message that drives have most of, read where its numbers lie.

A general decoder builds twenty objects for each; this takes a tenth of its time. Whatever is not laid out just as
expected is left to that decoder, which says what is wrong.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog.logs.messages import PoseMessage, nanoseconds, short_type

if TYPE_CHECKING:
    from vplog.logs.containers import Channel

_POSE = 7 + 36
"""Numbers of a pose with covariance: position, quaternion, 6 x 6; the twist behind it has one fewer, 6 + 36."""
_TWIST = 6 + 36


def read_odometry(channel: Channel, data: bytes) -> PoseMessage | None:
    """The pose of a nav_msgs/Odometry in little-endian CDR or as ROS 1 has it; None for anything else.

    Raises BadMessageError where the stamp is out of range.
    """
    if short_type(channel.type) != "nav_msgs/Odometry" or len(data) < 20:
        return None
    cdr = channel.encoding == "cdr"
    if cdr and data[:4] != b"\x00\x01\x00\x00":  # encapsulation: plain CDR, little endian, no options
        return None
    if not cdr and channel.encoding != "ros1":
        return None
    # CDR: stamp at byte 4. ROS 1: a sequence number, then the stamp, at byte 4 as well.
    seconds = int.from_bytes(data[4:8], "little", signed=cdr)
    stamp_ns = nanoseconds(seconds, int.from_bytes(data[8:12], "little"))
    position, names = 12, []
    for _ in range(2):
        length = int.from_bytes(data[position : position + 4], "little")
        stop = position + 4 + length
        if stop > len(data) or (cdr and (not length or data[stop - 1])):
            return None
        names.append(data[position + 4 : stop - cdr])  # strings end with a zero in CDR only
        # CDR aligns numbers to their size, counted from behind the encapsulation.
        position = stop + (-stop % 4 if cdr else 0)
    if cdr:
        position += -(position - 4) % 8
    if position + 8 * (_POSE + _TWIST) != len(data):
        return None
    try:
        frame, child = (name.decode("utf-8") for name in names)
    except UnicodeDecodeError:
        return None
    numbers = np.frombuffer(data, "<f8", _POSE, position)
    return PoseMessage(stamp_ns, frame, child, numbers[:3], numbers[3:7], numbers[7:].reshape(6, 6))
