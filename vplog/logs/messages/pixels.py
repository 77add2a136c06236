"""Pixels: an ImageMessage becomes a grey uint8 image or a depth image in metres."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from vplog.data import Bytes, Float32s
from vplog.logs.formats.container import RawData
from vplog.logs.messages.records import BadMessageError, ImageMessage
from vplog.storage.image_file import MAX_PIXELS, BadImageError, decode_image, image_size

_DEPTH_HEADER = 12
"""Bytes before the PNG of compressedDepth: int32 format, float32 a and b (compressed_depth_image_transport)."""
_CLIPPED = 0.002
"""Share of pixels beyond black, and beyond white: hot and dead ones and glints, of 1000 px two."""
_SAMPLED = 16
"""Images that the levels of a drive are taken from: day and night, sun and tunnel are among them."""
_LEAST_UNKNOWN = 0.001
"""Share of px without measurement that depth images have at least; a camera has a few dead ones in a million."""
_INVALID_MM = 65535
"""Depth in mm that means no measurement in 7-Scenes; 0 does in ROS REP 118 and cameras' firmware."""
_LAYOUTS: dict[str, tuple[str, int, str]] = {
    **dict.fromkeys(("mono8", "8UC1", "nv12", "nv21", "nv24"), ("u1", 1, "GRAY2{}")),
    **dict.fromkeys(("mono16", "16UC1"), ("u2", 1, "GRAY2{}")),
    **{f"{kind}{8 * size}": (f"u{size}", len(kind), f"{kind.upper()}2{{}}")
       for kind in ("rgb", "bgr", "rgba", "bgra") for size in (1, 2)},
    **{f"{8 * size}UC{count}": (f"u{size}", count, f"{kind}2{{}}")
       for count, kind in ((3, "BGR"), (4, "BGRA")) for size in (1, 2)},
    "16SC1": ("i2", 1, "GRAY2{}"),
    "32FC1": ("f4", 1, "GRAY2{}"),
    "64FC1": ("f8", 1, "GRAY2{}"),
    **dict.fromkeys(("yuv422", "uyvy"), ("u1", 2, "YUV2{}_UYVY")),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), ("u1", 2, "YUV2{}_YUY2")),
    **{f"bayer_{name}{8 * size}": (f"u{size}", 1, f"Bayer{code}2{{}}")
       for name, code in (("rggb", "BG"), ("bggr", "RG"), ("gbrg", "GR"), ("grbg", "GB")) for size in (1, 2)},
}  # fmt: skip
"""ROS encoding: type of a channel, channels, OpenCV's conversion to GRAY or RGB (8UC3 is BGR, as cv_bridge has it). Of
nv12, nv21 and nv24 the luma comes first, and it is the grey image; what follows is not read. ROS names a mosaic by its
first two rows, OpenCV by the second and third px of its second row."""
_COLOURS = {3: "BGR2{}", 4: "BGRA2{}"}
"""As OpenCV decodes them."""
_DEPTH_ENCODINGS = ("16UC1", "16SC1", "32FC1", "64FC1")
_SIXTEEN_BITS = "16UC1"
"""Depth in mm, or what a thermal camera counts."""


def is_depth(message: ImageMessage) -> bool:
    """By encoding: one of _DEPTH_ENCODINGS, raw or in the format of compressedDepth (`16UC1; compressedDepth png`)."""
    if message.compressed:
        return "compresseddepth" in message.encoding.lower() or message.encoding.startswith(_DEPTH_ENCODINGS)
    return message.encoding in _DEPTH_ENCODINGS


def is_image(message: ImageMessage) -> bool:
    """Whether `grey` knows the encoding: of raw pixels those of _LAYOUTS that are not depth alone."""
    known = message.encoding == _SIXTEEN_BITS or message.encoding in _LAYOUTS.keys() - set(_DEPTH_ENCODINGS)
    return message.compressed or known


def may_be_thermal(message: ImageMessage) -> bool:
    """Whether it has 16 bits that may be a thermal camera's counts: depth has px without measurement (ROS REP 118),
    where nothing reflects and at edges; every px of a camera counts."""
    if not message.encoding.startswith(_SIXTEEN_BITS) or "compresseddepth" in message.encoding.lower():
        return False
    try:
        unknown = np.isnan(depth_m(message)).mean()
    except BadMessageError:
        return False
    return bool(unknown < _LEAST_UNKNOWN)


class Levels(NamedTuple):
    """Values of 16 bits that become black and white: cameras of 10 to 14 bits fill the low ones, thermal ones a few."""

    black: int
    white: int

    def apply(self, pixels: Any) -> Bytes:
        """uint8 of uint16: linear from black to white, and clipped."""
        return _grey_table(self)[pixels]


@lru_cache(maxsize=16)
def _grey_table(levels: Levels) -> Bytes:
    """(65536,) uint8."""
    spread = (np.arange(2**16) - levels.black) * (255 / (levels.white - levels.black))
    return np.clip(np.rint(spread), 0, 255).astype(np.uint8)


def levels_of(messages: Iterable[ImageMessage]) -> Levels | None:
    """The levels that all but _CLIPPED of the pixels lie within; a grey is one value at least, so that noise is not
    stretched. None where the first image that decodes has not 16 bits."""
    counts = np.zeros(2**16, np.int64)
    for message in messages:
        with suppress(BadMessageError):
            pixels, _ = _pixels(message)
            if pixels.dtype == np.uint16:
                shown = pixels[..., :3] if pixels.ndim > 2 else pixels  # no alpha
                counts += np.bincount(shown.ravel(), minlength=2**16)
            elif not counts.any():
                break
    if not counts.any():
        return None
    share = np.cumsum(counts) / counts.sum()
    black, white = (int(np.searchsorted(share, at)) for at in (_CLIPPED, 1 - _CLIPPED))
    return Levels(black, max(white, black + 255))


def spread(count: int) -> int:
    """The step at which _SAMPLED images, about, lie over a drive of `count`."""
    return max(-(-count // _SAMPLED), 1)


def grey(message: ImageMessage, levels: Levels | None = None, least_px: int = MAX_PIXELS) -> Bytes:
    """(H, W) uint8; of 16 bits by the `levels` of the topic, or by its own. `least_px` as in `decode_image`. Raises
    BadMessageError."""
    return _converted(message, levels, *_pixels(message, least_px=least_px), "GRAY")


def values(message: ImageMessage) -> Any:
    """(H, W) as they come, such as labels; the grey of colours. Raises BadMessageError."""
    pixels, conversion = _pixels(message)
    return pixels if pixels.ndim == 2 else _converted(message, None, pixels, conversion, "GRAY")


def rgb(message: ImageMessage, levels: Levels | None = None, least_px: int = MAX_PIXELS) -> Bytes:
    """(H, W, 3) uint8 red, green, blue; three times the grey where it has no colour. As `grey`."""
    return message.rgb() if message.rgb else _converted(message, levels, *_pixels(message, True, least_px), "RGB")


def _converted(message: ImageMessage, levels: Levels | None, pixels: Any, conversion: str, to: str) -> Bytes:
    if pixels.dtype == np.uint16:
        pixels = (levels or levels_of([message]) or Levels(0, 2**16 - 1)).apply(pixels)
    if pixels.dtype != np.uint8:
        raise BadMessageError(f"encoding {message.encoding[:40]!r} is depth, not an image")
    try:
        if not conversion.startswith(f"{to}2"):
            pixels = cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion.format(to)}"))
        return np.ascontiguousarray(pixels, np.uint8)
    except cv2.error:  # a mosaic or a row of shared colours of one px
        raise BadMessageError(f"{message.encoding[:40]!r} with {pixels.shape[1]} x {pixels.shape[0]} px") from None


def _pixels(message: ImageMessage, colour: bool = False, least_px: int = MAX_PIXELS) -> tuple[Any, str]:
    """(H, W) or (H, W, C) pixels of as many bits as they come in, and OpenCV's conversion of them; those of image files
    are grey already without `colour`."""
    if not message.compressed:
        return _raw(message)
    mosaic = _LAYOUTS.get(message.encoding.split(";", maxsplit=1)[0]) if "bayer" in message.encoding else None
    pixels = _imdecode(message.data, colour or mosaic is not None, least_px)
    if pixels.ndim > 2:
        return pixels, _COLOURS[pixels.shape[2]]
    return pixels, mosaic[2] if mosaic else "GRAY2{}"  # some transports compress the mosaic


def depth_m(message: ImageMessage) -> Float32s:
    """(H, W) float32 m, NaN where unknown: 16UC1 and 16SC1 hold mm, 32FC1 and 64FC1 m (ROS REP 118). Raises
    BadMessageError."""
    if not message.compressed:
        pixels, _ = _raw(message)
        return _metres(pixels, message.encoding)
    if image_size(message.data):  # without the header of compressedDepth: PNG, or TIFF, which holds metres, too
        return _metres(_imdecode(message.data, unchanged=True), message.encoding)
    if "rvl" in message.encoding.lower():
        from vplog.logs.messages.rvl import decode_rvl  # numba loads here

        pixels = decode_rvl(bytes(message.data[_DEPTH_HEADER:]))
    else:
        pixels = _imdecode(message.data[_DEPTH_HEADER:], unchanged=True)
    if not message.encoding.startswith("32FC1"):
        return _metres(pixels, message.encoding)
    # 32FC1 is stored as quantised inverse depth: raw = a / depth + b (compressed_depth_image_transport, codec.cpp).
    _, a, b = struct.unpack_from("<iff", message.data)
    if pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise BadMessageError("its PNG is not a 16-bit image")
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = np.float32(a) / (pixels.astype(np.float32) - np.float32(b))
    return np.where((pixels != 0) & np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan)).astype(np.float32)


def scaled_depth_m(data: RawData, per_m: float) -> Float32s:
    """(H, W) float32 m of an image file of 16 bits with `per_m` counts of a metre, NaN where unknown. Raises
    BadMessageError."""
    return _metres(_imdecode(data, unchanged=True), "16UC1") * np.float32(1000.0 / per_m)


def _metres(pixels: Any, encoding: str) -> Float32s:
    if pixels.ndim != 2 or pixels.dtype not in (np.uint16, np.int16, np.float32, np.float64):
        raise BadMessageError(f"{encoding[:40]!r} with {pixels.ndim} dimensions of {pixels.dtype} is not a depth image")
    if pixels.dtype in (np.uint16, np.int16):
        known = (pixels > 0) & (pixels != _INVALID_MM) if pixels.dtype == np.uint16 else pixels > 0
        return np.where(known, pixels * np.float32(0.001), np.float32(np.nan)).astype(np.float32)
    return np.where(np.isfinite(pixels) & (pixels > 0), pixels, np.nan).astype(np.float32)


def _raw(message: ImageMessage) -> tuple[Any, str]:
    """(H, W) or (H, W, C) pixels in native byte order without row padding, and OpenCV's conversion of them."""
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


def _imdecode(data: RawData, unchanged: bool = False, least_px: int = MAX_PIXELS) -> Any:
    """The pixels of an image file, as `decode_image` gives them. Raises BadMessageError."""
    try:
        return decode_image(data, unchanged, least_px)
    except BadImageError as error:
        raise BadMessageError(str(error)) from None
