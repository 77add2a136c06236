"""sensor_msgs/NavSatFix read where its numbers lie. Whatever is not laid out just as expected is left to the general
decoder, which takes ten times as long and says what is wrong."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import numpy as np

from vplog.logs.messages.records import FixMessage, nanoseconds, short_type

if TYPE_CHECKING:
    from vplog.logs.formats.container import Channel, Octets

_HEADS = {"cdr": struct.Struct("<4xiII"), "ros1": struct.Struct("<4xIII")}
"""Stamp and length of the frame's name, behind CDR's encapsulation or ROS 1's sequence number."""
_NUMBERS = struct.Struct("<12dB")
"""Latitude, longitude, altitude, covariance (3, 3), and what is known of it, at the end of the message."""
_UNKNOWN_COVARIANCE = 0
"""NavSatFix.COVARIANCE_TYPE_UNKNOWN."""


def read_fix(channel: Channel, data: Octets) -> FixMessage | None:
    """A fix in little-endian CDR or as ROS 1 has it; None for anything else.

    Raises BadMessageError where the stamp is out of range.
    """
    head, cdr = _HEADS.get(channel.encoding), channel.encoding == "cdr"
    numbers_at = len(data) - _NUMBERS.size
    if head is None or numbers_at < head.size or short_type(channel.type) != "sensor_msgs/NavSatFix":
        return None
    if cdr and data[:4] != b"\x00\x01\x00\x00":  # encapsulation: plain CDR, little endian, no options
        return None
    seconds, nanos, length = head.unpack_from(data)
    status_at = head.size + length
    # The status is a byte and 2 bytes of service; CDR aligns numbers to their size, behind 4 bytes of encapsulation.
    service_at = status_at + 1 + (-(status_at + 1) % 2 if cdr else 0)
    if service_at + 2 + (-(service_at - 2) % 8 if cdr else 0) != numbers_at:
        return None
    if cdr and (not length or data[status_at - 1]):  # strings end with a zero in CDR only
        return None
    try:
        frame = str(data[head.size : status_at - cdr], "utf-8")
    except UnicodeDecodeError:
        return None
    latitude, longitude, altitude, *covariance, kind = _NUMBERS.unpack_from(data, numbers_at)
    known = np.array(covariance).reshape(3, 3) if kind != _UNKNOWN_COVARIANCE else np.full((3, 3), np.nan)
    valid = data[status_at] < 0x80  # signed: below zero is no fix
    return FixMessage(nanoseconds(seconds, nanos), valid, latitude, longitude, altitude, known, frame)
