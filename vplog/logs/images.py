"""Pixels: an ImageMessage becomes a grey uint8 image or a depth image in metres."""

from __future__ import annotations

import re
import struct
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import simplejpeg

from vplog.logs.checksum import crc32
from vplog.logs.messages import BadMessageError

if TYPE_CHECKING:
    from vplog.data import Bytes, Float32s
    from vplog.logs.containers import Octets
    from vplog.logs.messages import ImageMessage

MAX_PIXELS = 2**26
"""px of a compressed image that are decoded (67 million: above the cameras of vehicles and robots)."""
MAX_PIXELS_PER_BYTE = 1100
"""px that a byte of a compressed image may claim: deflate, the tightest of PNG, reaches 1032 bytes per byte, baseline
and progressive JPEG stay below 512 px. WebP has no such limit; MAX_PIXELS alone bounds it."""
_DEPTH_HEADER = 12
"""Bytes before the PNG of compressedDepth: int32 format, float32 a and b (compressed_depth_image_transport)."""
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
"""Markers that a JPEG begins and ends with: ITU T.81, table B.1. Some cameras write more behind its end."""
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers that a frame starts with: ITU T.81, table B.1."""
_JPEG_MARKER = struct.Struct(">BBHxHH")
"""A marker and the length behind it; where a frame starts its precision, height and width: ITU T.81, figure B.3."""
_GREY = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
"""Of 16 bits, all that are there."""
_INVALID_MM = (0, 65535)
"""Depth values in mm that mean no measurement: 0 in ROS REP 118 and cameras' firmware, 65535 in 7-Scenes."""

_PNM_HEAD = 4096
"""Bytes in which a PNM file must have named its size; comments may stand before it."""

_LAYOUTS: dict[str, tuple[str, int, int | None]] = {
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "rgb8": ("u1", 3, cv2.COLOR_RGB2GRAY),
    "8UC3": ("u1", 3, cv2.COLOR_BGR2GRAY),
    "bgr8": ("u1", 3, cv2.COLOR_BGR2GRAY),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2GRAY),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2GRAY),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2GRAY),
    "mono16": ("u2", 1, None),
    "16UC1": ("u2", 1, None),
    "rgb16": ("u2", 3, cv2.COLOR_RGB2GRAY),
    "bgr16": ("u2", 3, cv2.COLOR_BGR2GRAY),
    "rgba16": ("u2", 4, cv2.COLOR_RGBA2GRAY),
    "bgra16": ("u2", 4, cv2.COLOR_BGRA2GRAY),
    "32FC1": ("f4", 1, None),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2GRAY_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2GRAY_YUY2),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2GRAY_YUY2),
    "nv12": ("u1", 1, None),
    "nv21": ("u1", 1, None),
    "nv24": ("u1", 1, None),
}
"""ROS encoding: type of a channel, channels, OpenCV's conversion to grey (8UC3 is BGR, as cv_bridge has it). Of nv12,
nv21 and nv24 the luma comes first, and it is the grey image; what follows is not read."""
_MOSAICS = {
    "rggb": cv2.COLOR_BayerBG2GRAY,
    "bggr": cv2.COLOR_BayerRG2GRAY,
    "gbrg": cv2.COLOR_BayerGR2GRAY,
    "grbg": cv2.COLOR_BayerGB2GRAY,
}
"""ROS names a mosaic by its first two rows, OpenCV by the second and third px of its second row."""
_LAYOUTS |= {f"bayer_{name}{8 * size}": (f"u{size}", 1, code) for name, code in _MOSAICS.items() for size in (1, 2)}
_COLOURS = {3: cv2.COLOR_BGR2GRAY, 4: cv2.COLOR_BGRA2GRAY}
"""As OpenCV decodes them."""
_DEPTH_ENCODINGS = ("16UC1", "32FC1")


def is_depth(message: ImageMessage) -> bool:
    """By encoding: 16UC1 or 32FC1, raw or in the format of compressedDepth (`16UC1; compressedDepth png`)."""
    if message.compressed:
        return "compresseddepth" in message.encoding.lower() or message.encoding.startswith(_DEPTH_ENCODINGS)
    return message.encoding in _DEPTH_ENCODINGS


def grey(message: ImageMessage) -> Bytes:
    """(H, W) uint8; of more bits the highest eight that are used. Raises BadMessageError."""
    if message.compressed:
        mosaic = _LAYOUTS.get(message.encoding.split(";", maxsplit=1)[0]) if "bayer" in message.encoding else None
        flags = _GREY if mosaic is None else cv2.IMREAD_UNCHANGED
        pixels, conversion = _imdecode(message.data, flags), None
        if mosaic is not None:  # some transports compress the mosaic as it is
            conversion = mosaic[2] if pixels.ndim == 2 else _COLOURS[pixels.shape[2]]
    else:
        pixels, conversion = _raw(message)
    if pixels.dtype == np.uint16:
        # cameras of 10, 12 and 14 bits fill the low bits of 16: the high byte alone would be black
        pixels = (pixels >> max(int(pixels.max()).bit_length() - 8, 0)).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise BadMessageError(f"encoding {message.encoding[:40]!r} is depth, not an image")
    try:
        return np.ascontiguousarray(pixels if conversion is None else cv2.cvtColor(pixels, conversion))
    except cv2.error:  # a mosaic or a row of shared colours of one px
        raise BadMessageError(f"{message.encoding[:40]!r} with {pixels.shape[1]} x {pixels.shape[0]} px") from None


def depth_m(message: ImageMessage) -> Float32s:
    """(H, W) float32 m, NaN where unknown: 16UC1 holds mm, 32FC1 m (ROS REP 118). Raises BadMessageError."""
    if not message.compressed:
        pixels, _ = _raw(message)
        return _metres(pixels, message.encoding)
    if message.data[:8] == _PNG:
        return _metres(_imdecode(message.data, cv2.IMREAD_UNCHANGED), message.encoding)
    if "rvl" in message.encoding.lower():
        from vplog.logs.rvl import decode_rvl  # numba loads here

        pixels = decode_rvl(bytes(message.data[_DEPTH_HEADER:]))
    else:
        pixels = _imdecode(message.data[_DEPTH_HEADER:], cv2.IMREAD_UNCHANGED)
    if not message.encoding.startswith("32FC1"):
        return _metres(pixels, message.encoding)
    # 32FC1 is stored as quantised inverse depth: raw = a / depth + b (compressed_depth_image_transport, codec.cpp).
    _, a, b = struct.unpack_from("<iff", message.data)
    if pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise BadMessageError("its PNG is not a 16-bit image")
    raw = pixels.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = np.float32(a) / (raw - np.float32(b))
    return np.where((pixels != 0) & np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan)).astype(np.float32)


def _metres(pixels: Any, encoding: str) -> Float32s:
    if pixels.ndim != 2 or pixels.dtype not in (np.uint16, np.float32):
        raise BadMessageError(f"{encoding[:40]!r} with {pixels.ndim} dimensions of {pixels.dtype} is not a depth image")
    if pixels.dtype == np.uint16:
        unknown = np.logical_or.reduce([pixels == value for value in _INVALID_MM])  # np.isin takes ten times as long
        return np.where(unknown, np.float32(np.nan), pixels * np.float32(0.001)).astype(np.float32)
    return np.where(np.isfinite(pixels) & (pixels > 0), pixels, np.float32(np.nan)).astype(np.float32)


def _raw(message: ImageMessage) -> tuple[Any, int | None]:
    """(H, W) or (H, W, C) pixels in native byte order without row padding, and the conversion to grey."""
    if message.encoding not in _LAYOUTS:
        raise BadMessageError(f"encoding {message.encoding[:40]!r} is not supported; these are: {', '.join(_LAYOUTS)}")
    kind, channels, conversion = _LAYOUTS[message.encoding]
    width, height = message.width, message.height
    row = width * channels * int(kind[1])
    step = message.step or row
    # The last row may come without its padding.
    if not (width and height) or step < row or step * (height - 1) + row > len(message.data):
        raise BadMessageError(f"{len(message.data)} bytes do not hold {width} x {height} px of {message.encoding}")
    dtype = np.dtype(kind).newbyteorder(">" if message.big_endian else "<")
    data = np.frombuffer(message.data, np.uint8)
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="))
    return (pixels if channels == 1 else pixels.reshape(height, width, channels)), conversion


def _imdecode(data: Octets, flags: int) -> Any:
    """Decoded after the size in the file's own header was found believable: by OpenCV; a JPEG to grey, of which drives
    are full, by the same library without OpenCV around it, a tenth faster."""
    if data[:2] != _JPEG:
        data = bytes(data)
    size = image_size(data)
    if size is None:
        raise BadMessageError(f"its {len(data)} bytes are not a whole JPEG, PNG, WebP, BMP or PNM image")
    if data[:8] == _PNG and not _png_is_sound(bytes(data)):
        raise BadMessageError("the checksum of its PNG does not match")
    limit = MAX_PIXELS if data[:4] == b"RIFF" else min(MAX_PIXELS, MAX_PIXELS_PER_BYTE * len(data))
    if size[0] * size[1] > limit:
        raise BadMessageError(f"{size[0]} x {size[1]} px are more than its {len(data)} bytes can hold")
    if flags == _GREY and data[:2] == _JPEG:
        try:
            return simplejpeg.decode_jpeg(data, colorspace="GRAY", strict=False)[:, :, 0]
        except ValueError:  # of four colours, or damaged in its head
            pass
    try:
        # IGNORE_ORIENTATION: calibration and odometry belong to the sensor's own rows.
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None:
        raise BadMessageError(f"its {len(data)} bytes are not an image that OpenCV decodes")
    return image


def image_size(data: Octets) -> tuple[int, int] | None:
    """Width and height that an image file claims in its header; None where it is of another kind or damaged."""
    if data[:2] == _JPEG:
        return _jpeg_size(data)
    size, data = None, bytes(data)
    if data.startswith(_PNG):
        size = _png_size(data)
    elif data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) >= 30:
        size = _webp_size(data)
    elif data[:2] == b"BM" and len(data) >= 26:
        size = tuple(abs(side) for side in struct.unpack_from("<ii", data, 18))  # rows from the top count negative
    elif match := re.match(rb"P[2356]\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s", data[:_PNM_HEAD]):
        size = int(match[1]), int(match[2])
    return None if size is None else (size[0], size[1])


def _png_size(data: bytes) -> tuple[int, int] | None:
    """None too where a chunk is longer than the file: OpenCV 5.0 allocates what it claims, up to 4 GB."""
    if data[12:16] != b"IHDR" or len(data) < 33:
        return None
    position = len(_PNG)
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        if kind == b"IEND":
            return struct.unpack_from(">II", data, 16)
        position += 12 + length  # length, type, data, CRC
    return None


def _png_is_sound(data: bytes) -> bool:
    """By the CRC of every chunk; OpenCV's decoder would find the same, and say so on stderr."""
    position, view = len(_PNG), memoryview(data)
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        stop = position + 8 + length
        if stop + 4 > len(data) or crc32(view[position + 4 : stop]) != int.from_bytes(data[stop : stop + 4], "big"):
            return False
        if kind == b"IEND":
            return True
        position = stop + 4
    return False


def _webp_size(data: bytes) -> tuple[int, int] | None:
    """developers.google.com/speed/webp/docs/riff_container; the sides of VP8 and VP8L have 14 bits."""
    if data[12:16] == b"VP8X":
        return 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little")
    if data[12:16] == b"VP8L":
        bits = int.from_bytes(data[21:25], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if data[12:16] == b"VP8 ":
        return int.from_bytes(data[26:28], "little") & 0x3FFF, int.from_bytes(data[28:30], "little") & 0x3FFF
    return None


def _jpeg_size(data: Octets) -> tuple[int, int] | None:
    position, last = 2, len(data) - _JPEG_MARKER.size
    while position <= last:
        begin, marker, length, height, width = _JPEG_MARKER.unpack_from(data, position)
        if begin != 0xFF:
            return None
        if marker == 0xFF:  # fill byte: ITU T.81, B.1.1.2
            position += 1
        elif marker in _JPEG_FRAMES:
            # Without an end marker behind this (thumbnails lie before it) the file is cut; OpenCV would grey the rest.
            ends = data[-2:] == _JPEG_END or bytes(data).rfind(_JPEG_END) > position
            return (width, height) if ends else None
        else:
            position += 2 + length
    return None
