"""nav_msgs/Odometry, the message that drives have most of, read where its numbers lie.

A general decoder builds twenty objects for each; this takes a tenth of its time. Whatever is not laid out just as
expected is left to that decoder, which says what is wrong.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from vplog.logs.messages import PoseMessage, nanoseconds, short_type

if TYPE_CHECKING:
    from vplog.logs.containers import Channel

_POSE = 7 + 36
"""Numbers of a pose with covariance: position, quaternion, 6 x 6; the twist behind it has one fewer, 6 + 36."""
_TWIST = 6 + 36
_MOST_NAMED = 4096
"""Bytes that the names of both frames may take here."""


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
    numbers_at = len(data) - 8 * (_POSE + _TWIST)
    names = _names(data[12:numbers_at], cdr) if 12 < numbers_at < _MOST_NAMED else None
    if names is None:
        return None
    numbers = np.frombuffer(data, "<f8", _POSE, numbers_at)
    return PoseMessage(stamp_ns, names[0], names[1], numbers[:3], numbers[3:7], numbers[7:].reshape(6, 6))


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
