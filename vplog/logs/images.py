"""Pixels: an ImageMessage becomes a grey uint8 image or a depth image in metres."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vplog.image_file import PNG, BadImageError, decode_image
from vplog.logs.messages import BadMessageError

if TYPE_CHECKING:
    from vplog.data import Bytes, Float32s
    from vplog.logs.containers import Octets
    from vplog.logs.messages import ImageMessage

_DEPTH_HEADER = 12
"""Bytes before the PNG of compressedDepth: int32 format, float32 a and b (compressed_depth_image_transport)."""
_INVALID_MM = (0, 65535)
"""Depth values in mm that mean no measurement: 0 in ROS REP 118 and cameras' firmware, 65535 in 7-Scenes."""
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
        pixels, conversion = _imdecode(message.data, unchanged=mosaic is not None), None
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
    if message.data[:8] == PNG:
        return _metres(_imdecode(message.data, unchanged=True), message.encoding)
    if "rvl" in message.encoding.lower():
        from vplog.logs.rvl import decode_rvl  # numba loads here

        pixels = decode_rvl(bytes(message.data[_DEPTH_HEADER:]))
    else:
        pixels = _imdecode(message.data[_DEPTH_HEADER:], unchanged=True)
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


def _imdecode(data: Octets, unchanged: bool = False) -> Any:
    """The pixels of an image file, as `decode_image` gives them. Raises BadMessageError."""
    try:
        return decode_image(data, unchanged)
    except BadImageError as error:
        raise BadMessageError(str(error)) from None
