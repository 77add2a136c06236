"""Decoding of messages: raw bytes of a known type, in whatever encoding, become one of five records."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from vplog.logs.messages.image_views import read_image, stamp_of_image
from vplog.logs.messages.navsatfix import read_fix
from vplog.logs.messages.records import ENCODINGS, BadMessageError, nanoseconds, short_type

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
    """The record that a message holds. Raises BadMessageError."""
    record = read_image(channel, data) or read_fix(channel, data)
    return decode_generally(channel, bytes(data)) if record is None else record


def decode_generally(channel: Channel, data: bytes) -> Record:
    """The record by the decoders of whole messages, copied. Raises BadMessageError."""
    try:
        if ENCODINGS[channel.encoding] == "ros":
            from vplog.logs.messages.ros import decode_ros

            return decode_ros(short_type(channel.type), channel.encoding, data)
        from vplog.logs.messages.foxglove import decode_foxglove

        return decode_foxglove(channel.type, channel.encoding, data)
    except BadMessageError:
        raise
    except Exception as error:  # generated decoders raise anything on a stranger's bytes
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadMessageError(reason[:200]) from None


def stamp_of(channel: Channel, data: Octets) -> int:
    """The header stamp in ns without decoding the rest where the encoding allows. Raises BadMessageError."""
    if channel.encoding in ("cdr", "ros1"):
        if len(data) < 12:
            raise BadMessageError(f"{len(data)} bytes are too few for a header")
        little = channel.encoding == "ros1" or data[1] == 1
        return nanoseconds(*_STAMPS[channel.encoding, little].unpack_from(data))
    if (stamp_ns := stamp_of_image(channel, data)) is not None:
        return stamp_ns
    record = decode_generally(channel, bytes(data))
    return 0 if isinstance(record, list) else record.stamp_ns
