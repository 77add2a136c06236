"""Image files: their size by their own header, and their pixels, in bounded memory and without output on stderr.

libpng and libjpeg print warnings to stderr, in OpenCV too. So JPEGs are decoded by simplejpeg, which raises
instead, and OpenCV is given only PNGs that libpng does not warn of.
"""

from __future__ import annotations

import math
import re
import struct
import zlib as stored_zlib
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import simplejpeg

try:
    from isal import isal_zlib as zlib  # which stores no blocks
except ImportError:  # no wheel for this processor
    import zlib


cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # errors of files are raised here

MAX_PIXELS = 2**28
"""px of a compressed image that are decoded (268 million: above the 200 of phones)."""
MAX_PIXELS_PER_BYTE = 1100
"""px that a byte of a compressed image may claim: deflate, the tightest of PNG, reaches 1032 bytes per byte, baseline
and progressive JPEG stay below 512 px. WebP has no such limit; a quarter of MAX_PIXELS bounds it."""
PNG = b"\x89PNG\r\n\x1a\n"
JPEG, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
"""Markers that a JPEG begins and ends with: ITU T.81, table B.1. Some cameras write more behind its end."""
_JPEG_SCAN, _JPEG_SEQUENTIAL = 0xDA, (0xC0, 0xC1)
"""Marker that a scan starts with, and those of frames whose samples are coded once: ITU T.81, table B.1."""
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers that a frame starts with: ITU T.81, table B.1."""
_JPEG_ALONE = {0x00, 0x01, *range(0xD0, 0xDA)}
"""Markers without a length: ITU T.81, B.1.1.3. None belongs between the start of the file and the first scan."""
_JPEG_MARKER = struct.Struct(">BBHxHH")
"""A marker and the length behind it; where a frame starts its precision, height and width: ITU T.81, figure B.3."""
_TIFF_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
_TIFF_SHORT = 3
"""Type of the numbers of 16 bits: TIFF 6.0, section 2."""
_TIFF_WIDTHS, _TIFF_HEIGHTS, _TIFF_BITS = (256, 322), (257, 323), 258
"""Tags of the size of the image and of the tiles that it is decoded in, and of the bits of a sample: TIFF 6.0, sections
3 and 15."""
_DECODED_SAMPLES = 4 * 5
"""Samples in memory for each pixel that is decoded to grey and to colour, at most: four of a pixel, five times. The
largest that was measured is 3.5 times (a PNG with alpha), and 4.7 times of 16-bit grey, whose levels are counted."""
_SCAN_START, _MOST_SCANS = b"\xff\xda", 500
"""Start of a scan, which is nowhere within one; a progressive JPEG has ten, and each takes a pass over all blocks."""
_SIMPLEJPEG_ERRORS = (ValueError, KeyError)
"""Exceptions of simplejpeg; a KeyError where the header names a sampling of colours that it does not know."""
_PNM_HEAD = 4096
"""Bytes in which a PNM file must have named its size; comments may stand before it."""
_PNM_SIZE = re.compile(rb"P[2356]\s+(?:#[^\r\n]*[\r\n]\s*)*(\d{1,9})\s+(?:#[^\r\n]*[\r\n]\s*)*(\d{1,9})\s")
"""Width and height of a PNM file. A comment ends where OpenCV ends it: at a carriage return, too."""
_PNG_SAMPLES = {0: (1, (1, 2, 4, 8, 16)), 2: (3, (8, 16)), 3: (1, (1, 2, 4, 8)), 4: (2, (8, 16)), 6: (4, (8, 16))}
"""Samples of a px and bits that each may have, by colour type: PNG 1.2, 4.1.1."""
_PNG_PALETTE = 3
"""The colour type whose px are numbers of colours in PLTE."""
_ADAM7 = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
"""First column and row of each pass of an interlaced image, and its steps in x and y: PNG 1.2, 8.2."""
_PIECE_BYTES = 2**24
"""Bytes of a PNG's pixels that are unpacked at once."""
_LAST_FILTER = 4
"""Paeth; every row begins with its filter: PNG 1.2, 6."""


class BadImageError(ValueError):
    """Bytes that are no image, or no whole one; the message is the reason."""


def decode_image(data: bytes | memoryview, unchanged: bool = False, least_px: int = MAX_PIXELS) -> Any:
    """Return the pixels of an image file: (H, W) grey of 8 bits, or of 16 if the file has as many.

    `unchanged`: (H, W) or (H, W, C) as OpenCV orders colours.
    `least_px`: a JPEG is decoded at a reduced size that still has so many pixels: M/8 of its size, with 0 < M <= 4.
    Raises BadImageError if the size in the header is implausible or the pixels are not whole.
    """
    if data[:2] != JPEG:
        data = bytes(data)
    size = image_size(data)
    if size is None:
        raise BadImageError(f"its {len(data)} bytes are not a whole JPEG, PNG, WebP, BMP, TIFF or PNM image")
    limit = MAX_PIXELS // 4 if data[:4] == b"RIFF" else min(MAX_PIXELS, MAX_PIXELS_PER_BYTE * len(data))
    if not 0 < size[0] * size[1] <= limit:
        raise BadImageError(f"{size[0]} x {size[1]} px are more than the {limit} that are read of {len(data)} bytes")
    if data[:2] == JPEG:
        return _decode_jpeg(data, size, unchanged, least_px)
    encoded = _checked_png(bytes(data)) if data[:8] == PNG else data
    flags = cv2.IMREAD_UNCHANGED if unchanged else cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    try:
        # IGNORE_ORIENTATION: calibration and odometry belong to the sensor's own rows.
        image = cv2.imdecode(np.frombuffer(encoded, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        image = None
    if image is None:
        raise BadImageError(f"its {len(data)} bytes are not an image that OpenCV decodes")
    if not unchanged and image.dtype not in (np.uint8, np.uint16):
        raise BadImageError(f"its samples are {image.dtype}; write 8 or 16 bits without a sign")
    return image


def image_size(data: bytes | memoryview) -> tuple[int, int] | None:
    """Width and height that an image file claims in its header; None where it is of another kind or damaged."""
    if data[:2] == JPEG:
        return _jpeg_size(data)
    data = bytes(data)
    if data.startswith(PNG):
        return _png_size(data)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) >= 30:
        return _webp_size(data)
    if data[:2] == b"BM" and len(data) >= 26:
        width, height = struct.unpack_from("<ii", data, 18)
        return abs(width), abs(height)  # rows from the top count negative
    if data[:4] in _TIFF_ORDERS:
        return _tiff_size(data)
    found = _PNM_SIZE.match(data[:_PNM_HEAD])
    return (int(found[1]), int(found[2])) if found else None


def decoding_bytes(data: bytes | memoryview, least_px: int = MAX_PIXELS) -> int:
    """Return the largest memory in bytes that decoding an image file to grey and to colour takes, by its header.
    Return 0 if it is no image. `least_px` as in `decode_image`."""
    if (size := image_size(data)) is None:
        return 0
    decoded, sample, coefficients = size[0] * size[1], 1, 0
    if data[:2] == JPEG:  # libjpeg keeps 16 bits of every coefficient of a JPEG of several scans
        decoded, coefficients = min(decoded, max(4 * least_px, decoded // 64)), 2 * 4 * decoded
    elif data[:8] == PNG:
        sample = 1 + data[24] // 16
    elif bytes(data[:4]) in _TIFF_ORDERS:
        sample = -(-max(_tiff_tags(bytes(data)).get(_TIFF_BITS, 1), 8) // 8)
    elif data[:1] == b"P":
        sample = 2
    return decoded * _DECODED_SAMPLES * sample + coefficients


def is_lossy(data: bytes | memoryview) -> bool:
    """Whether a file's kind blurs edges: JPEG, and WebP but for its lossless one."""
    return data[:2] == JPEG or (data[:4] == b"RIFF" and b"VP8L" not in bytes(data))


def _decode_jpeg(data: bytes | memoryview, size: tuple[int, int], unchanged: bool, least_px: int) -> Any:
    marker, at = next((one for one in _jpeg_segments(data) if one[0] in _JPEG_FRAMES), (0, len(data) - 5))
    if marker not in _JPEG_SEQUENTIAL and bytes(data).count(_SCAN_START) > _MOST_SCANS:
        raise BadImageError(f"its JPEG has more than {_MOST_SCANS} scans")
    if (bits := data[at + 4]) != 8:
        raise BadImageError(f"its JPEG has {bits} bits a sample; write 8, or 16 as PNG")
    has_end = _has_end(data, at)
    data = data if has_end else bytes(data) + _JPEG_END
    share = math.sqrt(min(least_px / (size[0] * size[1]), 1.0))
    how: dict[str, Any] = {
        "strict": not has_end,  # a warning then means that samples are missing
        "min_width": math.ceil(size[0] * share), "min_height": math.ceil(size[1] * share), "min_factor": 2,
    }  # fmt: skip
    try:
        if unchanged and simplejpeg.decode_jpeg_header(data, strict=not has_end)[2] != "Gray":
            return simplejpeg.decode_jpeg(data, colorspace="BGR", **how)
        return simplejpeg.decode_jpeg(data, colorspace="GRAY", **how)[:, :, 0]
    except _SIMPLEJPEG_ERRORS as error:
        reason = error
    try:  # four inks, which programs for print write inverted: their product is the colour
        inks = simplejpeg.decode_jpeg(data, colorspace="CMYK", **how)
    except _SIMPLEJPEG_ERRORS:
        raise BadImageError(f"its JPEG is damaged ({str(reason).rstrip('.')})") from None
    colours = cv2.multiply(inks[:, :, :3], cv2.merge([inks[:, :, 3]] * 3), scale=1 / 255)
    return cv2.cvtColor(colours, cv2.COLOR_RGB2BGR if unchanged else cv2.COLOR_RGB2GRAY)


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Type of each chunk, and where it starts and stops, up to IEND. Ends before a chunk that is not whole."""
    position = len(PNG)
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        stop = position + 12 + length  # length, type, data, CRC
        if stop > len(data):
            return
        yield kind, position, stop
        if kind == b"IEND":
            return
        position = stop


def _png_size(data: bytes) -> tuple[int, int] | None:
    """None too where a chunk is longer than the file: OpenCV 5.0 allocates what it claims, up to 4 GB."""
    if data[12:16] != b"IHDR" or len(data) < 33:
        return None
    *_, (kind, _, _) = [(b"", 0, 0), *_png_chunks(data)]
    return struct.unpack_from(">II", data, 16) if kind == b"IEND" else None


def _checked_png(data: bytes) -> bytearray:
    """Return the PNG with its pixels unpacked, as stored blocks, and with nothing beside them but its palette: not the
    gamma and primaries. Raises BadImageError if libpng would find fault with it. The pixels are in memory once."""
    view = memoryview(data)
    found: dict[bytes, list[memoryview]] = {b"IHDR": [], b"PLTE": [], b"IDAT": []}
    for kind, start, stop in _png_chunks(data):
        if kind in found:
            found[kind].append(view[start + 8 : stop - 4])
            if zlib.crc32(view[start + 4 : stop - 4]) != int.from_bytes(view[stop - 4 : stop], "big"):
                raise BadImageError("the checksum of its PNG does not match")
    width, height, bits, colour, compression, filters, interlaced = struct.unpack_from(">IIBBBBB", data, 16)
    samples, depths = _PNG_SAMPLES.get(colour, (0, ()))
    if bits not in depths or compression or filters or interlaced > 1:
        raise BadImageError(f"its PNG has {bits} bits in colour type {colour}, or a coding, that PNG does not know")
    passes = _ADAM7 if interlaced else ((0, 0, 1, 1),)
    sizes = [(-(-max(width - x, 0) // dx), -(-max(height - y, 0) // dy)) for x, y, dx, dy in passes]
    rows = [(tall, 1 + -(-wide * samples * bits // 8)) for wide, tall in sizes if wide and tall]
    checked = bytearray(PNG + data[8:33])
    if colour == _PNG_PALETTE:
        colours = b"".join(found[b"PLTE"])[: 3 << bits]
        if not colours or len(colours) % 3:
            raise BadImageError("its PNG has no whole palette")
        checked += _png_chunk(b"PLTE", colours)
    packer = stored_zlib.compressobj(0)
    for piece in _inflated(b"".join(found[b"IDAT"]), rows):
        checked += _png_chunk(b"IDAT", packer.compress(piece))
    checked += _png_chunk(b"IDAT", packer.flush()) + _png_chunk(b"IEND", b"")
    return checked


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    return b"".join([struct.pack(">I", len(data)), kind, data, struct.pack(">I", zlib.crc32(data, zlib.crc32(kind)))])


def _inflated(packed: bytes, rows: list[tuple[int, int]]) -> Iterator[bytes]:
    """Unpack the rows of a zlib stream, piece by piece. `rows`: for each pass how many, and how many bytes each. What
    more the stream holds is left out. Raises BadImageError if it is not whole or a row has no filter that PNG knows."""
    unpacker, stops = zlib.decompressobj(), np.cumsum([count * length for count, length in rows]).tolist()
    at, size = 0, stops[-1]
    while at < size:
        try:
            piece = unpacker.decompress(packed, min(size - at, _PIECE_BYTES))
        except zlib.error:  # pyrefly: ignore[not-a-type]
            piece = b""
        filters = [
            piece[max(stop - count * length - at, (stop - at) % length) : max(stop - at, 0) : length]
            for stop, (count, length) in zip(stops, rows, strict=True)
        ]
        if not piece or max(b"".join(filters), default=0) > _LAST_FILTER:
            raise BadImageError("the pixels of its PNG do not unpack to its size")
        packed, at = unpacker.unconsumed_tail, at + len(piece)
        yield piece


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


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """Return the size of the image, or of its tiles if these are larger."""
    tags = _tiff_tags(data)
    if not {_TIFF_WIDTHS[0], _TIFF_HEIGHTS[0]} <= tags.keys():
        return None
    width, height = (max(tags.get(tag, 0) for tag in sides) for sides in (_TIFF_WIDTHS, _TIFF_HEIGHTS))
    return width, height


def _tiff_tags(data: bytes) -> dict[int, int]:
    """Return the first number of each tag of the first directory, the largest of a tag that occurs several times."""
    order, tags = _TIFF_ORDERS[data[:4]], dict[int, int]()
    if len(data) < 8:
        return tags
    (start,) = struct.unpack_from(order + "I", data, 4)
    count = int.from_bytes(data[start : start + 2], "little" if order == "<" else "big")
    for at in range(start + 2, min(start + 2 + 12 * count, len(data) - 11), 12):
        tag, kind, numbers = struct.unpack_from(order + "HHI", data, at)
        value = at + 8
        if kind == _TIFF_SHORT and numbers > 2:  # then they stand elsewhere
            (value,) = struct.unpack_from(order + "I", data, value)
        if value + 4 <= len(data):
            (number,) = struct.unpack_from(order + ("H" if kind == _TIFF_SHORT else "I"), data, value)
            tags[tag] = max(number, tags.get(tag, 0))
    return tags


def _jpeg_segments(data: bytes | memoryview) -> Iterator[tuple[int, int]]:
    """Marker and offset of each segment up to the first scan; ends before one that is not whole."""
    position, last = 2, len(data) - _JPEG_MARKER.size
    while position <= last:
        begin, marker, length, _, _ = _JPEG_MARKER.unpack_from(data, position)
        if begin != 0xFF or marker in _JPEG_ALONE:
            return
        if marker == 0xFF:  # fill byte: ITU T.81, B.1.1.2
            position += 1
            continue
        yield marker, position
        if marker == _JPEG_SCAN:
            return
        position += 2 + length


def _has_end(data: bytes | memoryview, at: int) -> bool:
    """Whether an end marker lies behind the frame's header `at` (thumbnails lie before it)."""
    return data[-2:] == _JPEG_END or bytes(data).rfind(_JPEG_END) > at


def _jpeg_size(data: bytes | memoryview) -> tuple[int, int] | None:
    """None too where it is cut: without an end marker the samples can be whole only if one scan has them all."""
    size, components, can_lack_end = None, 0, False
    for marker, at in _jpeg_segments(data):
        if marker in _JPEG_FRAMES and size is None:
            *_, height, width = _JPEG_MARKER.unpack_from(data, at)
            size, components, can_lack_end = (width, height), data[at + 9 : at + 10], marker in _JPEG_SEQUENTIAL
            if _has_end(data, at):
                return size
        elif marker == _JPEG_SCAN:
            return size if can_lack_end and data[at + 4 : at + 5] == components else None
    return None
