"""Decoding of messages: raw bytes of a known type, in whatever encoding, become a record."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from vplog.logs.messages.records import ENCODINGS, BadMessageError, nanoseconds, short_type
from vplog.logs.messages.ros import decode_ros

if TYPE_CHECKING:
    from vplog.logs.formats.container import Channel, Octets
    from vplog.logs.messages.records import Record

_STAMPS = {
    ("cdr", True): struct.Struct("<4xiI"),
    ("cdr", False): struct.Struct(">4xiI"),
    ("ros1", True): struct.Struct("<4xII"),
}
"""Stamps in the headers of ROS, by encoding and whether it is little endian: CDR has 4 bytes of encapsulation before
them, ROS 1 a sequence number."""


def decode(channel: Channel, data: Octets) -> Record:
    """The record that a message holds, the bytes of images views of `data` where they can be.

    Raises BadMessageError.
    """
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


def stamp_of(channel: Channel, data: Octets) -> int:
    """The header stamp in ns, of ROS without looking at the rest. Raises BadMessageError."""
    if channel.encoding in ("cdr", "ros1"):
        if len(data) < 12:
            raise BadMessageError(f"{len(data)} bytes are too few for a header")
        little = channel.encoding == "ros1" or data[1] == 1
        return nanoseconds(*_STAMPS[channel.encoding, little].unpack_from(data))
    record = decode(channel, data)
    return 0 if isinstance(record, list) else record.stamp_ns
