"""Messages of images read where their bytes lie: all but a few of them are pixels.

A general decoder copies the pixels and builds what nothing asks for, which takes longer than finding them. Whatever is
not laid out just as expected is left to that decoder, which says what is wrong.
"""

from __future__ import annotations

import struct
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

from vplog.logs.messages.records import ImageMessage, kind_of, nanoseconds, short_type

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.logs.formats.container import Channel, Octets

    HeadReader = Callable[[Octets], tuple[Any, int, int] | None]

_U32, _TWO_U32 = struct.Struct("<I"), struct.Struct("<II")
_STAMPS = {True: struct.Struct("<4xiI"), False: struct.Struct("<4xII")}
"""By whether it is CDR: 4 bytes of encapsulation before the stamp; else ROS 1's sequence number."""
_PLAIN_CDR = b"\x00\x01\x00\x00"
"""Encapsulation: plain CDR, little endian, no options."""


class Located(NamedTuple):
    """An image message, with the place of its pixels or of its file in the message."""

    stamp_ns: int
    frame: str
    encoding: str
    start: int
    stop: int
    compressed: bool
    width: int = 0
    height: int = 0
    step: int = 0
    big_endian: bool = False


def locate_image(channel: Channel, data: Octets) -> Located | None:
    """The image in a message; None where it is of another type or encoding, or laid out otherwise.

    Raises BadMessageError where the stamp is out of range.
    """
    locate = _locator(channel)
    try:
        return None if locate is None else locate(data)
    except (struct.error, LookupError, UnicodeDecodeError):
        return None


def stamp_of_image(channel: Channel, data: Octets) -> int | None:
    """The stamp in ns of an image message, or None as above. Raises BadMessageError likewise."""
    read_head = _head_reader(channel)
    try:
        found = None if read_head is None else read_head(data)
    except LookupError:
        return None
    return None if found is None else nanoseconds(found[0].timestamp.seconds, found[0].timestamp.nanos)


def read_image(channel: Channel, data: Octets, copy: bool = True) -> ImageMessage | None:
    """The record that the general decoder gives, or None as above; without `copy`, its data are a view of the message.

    Raises BadMessageError likewise.
    """
    found = locate_image(channel, data)
    if found is None:
        return None
    view = memoryview(data)[found.start : found.stop]
    pixels = bytes(view) if copy else view
    return ImageMessage(found.stamp_ns, found.frame, found.encoding, pixels, *found[5:])


@lru_cache(maxsize=64)
def _locator(channel: Channel) -> Callable[[Octets], Located | None] | None:
    kind = short_type(channel.type)
    if channel.encoding in ("cdr", "ros1") and kind in ("sensor_msgs/Image", "sensor_msgs/CompressedImage"):
        return partial(_ros, cdr=channel.encoding == "cdr", raw=kind == "sensor_msgs/Image")
    read_head = _head_reader(channel)
    return None if read_head is None else partial(_protobuf, read_head=read_head)


@lru_cache(maxsize=64)
def _head_reader(channel: Channel) -> HeadReader | None:
    if channel.encoding != "protobuf" or kind_of(channel) != "image":
        return None
    from vplog.logs.messages.foxglove import head_reader

    return head_reader(channel.type)


def _ros(data: Octets, cdr: bool, raw: bool) -> Located | None:
    """sensor_msgs/CompressedImage, or Image where `raw`. CDR aligns numbers to their size, ROS 1 does not."""
    if cdr and data[:4] != _PLAIN_CDR:
        return None
    width = height = step = 0
    big_endian = False
    frame, at = _string(data, 12, cdr)
    if raw:
        height, width = _TWO_U32.unpack_from(data, at)
        at += 8
    encoding, at = _string(data, at, cdr, aligned=not raw)
    if raw:
        big_endian = bool(data[at])
        at += 1 + (-(at + 1) % 4 if cdr else 0)
        step = _U32.unpack_from(data, at)[0]
        at += 4
    start = at + 4
    stop = start + _U32.unpack_from(data, at)[0]
    if stop != len(data):
        return None
    stamp_ns = nanoseconds(*_STAMPS[cdr].unpack_from(data))
    return Located(stamp_ns, frame, encoding, start, stop, not raw, width, height, step, big_endian)


def _string(data: Octets, at: int, cdr: bool, aligned: bool = True) -> tuple[str, int]:
    """A string and where the next field begins: in CDR at a multiple of 4 bytes where that is `aligned`."""
    stop = at + 4 + _U32.unpack_from(data, at)[0]
    if cdr and (stop == at + 4 or data[stop - 1]):  # strings end with a zero in CDR only
        raise IndexError
    text = str(data[at + 4 : stop - cdr], "utf-8")
    return text, stop + (-stop % 4 if cdr and aligned else 0)


def _protobuf(data: Octets, read_head: HeadReader) -> Located | None:
    """foxglove.CompressedImage, CompressedVideo or RawImage."""
    found = read_head(data)
    if found is None:
        return None
    head, start, stop = found
    stamp_ns, frame = nanoseconds(head.timestamp.seconds, head.timestamp.nanos), head.frame_id
    if hasattr(head, "format"):
        return Located(stamp_ns, frame, head.format, start, stop, True)
    return Located(stamp_ns, frame, head.encoding, start, stop, False, head.width, head.height, head.step)
