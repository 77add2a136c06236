"""RVL depth images (A. D. Wilson, Fast Lossless Depth Image Compression, ISS 2017), as compressedDepth has them.

Runs of zeros and of others take turns, each led by its length; of the others, differences to the one before follow.
Every number is a string of nibbles: three bits of value, lowest first, and a continuation bit.
"""

from __future__ import annotations

import struct

import numba
import numpy as np

from vplog.data import Bytes, Uint16s
from vplog.logs.messages.records import BadMessageError

_HEAD = struct.Struct("<II")
"""Columns and rows, before the words (compressed_depth_image_transport, codec.cpp)."""
_MOST_PIXELS = 2**24
"""px; depth cameras have up to 4 million, and a byte of RVL may claim any number."""


def decode_rvl(data: bytes) -> Uint16s:
    """(H, W) uint16. Raises BadMessageError."""
    if len(data) < _HEAD.size:
        raise BadMessageError(f"its {len(data)} bytes are too few for RVL")
    width, height = _HEAD.unpack_from(data)
    if not 0 < width * height <= _MOST_PIXELS:
        raise BadMessageError(f"{width} x {height} px are no size of a depth image")
    pixels = np.zeros(width * height, np.uint16)
    if not _decode(np.frombuffer(data, np.uint8, offset=_HEAD.size), pixels):
        raise BadMessageError(f"its {len(data)} bytes do not hold {width} x {height} px of RVL")
    return pixels.reshape(height, width)


@numba.njit(cache=True, nogil=True)
def _decode(data: Bytes, pixels: Uint16s) -> bool:
    nibbles = len(data) // 4 * 8  # whole little-endian words of 32 bits, highest nibble first
    at, done, depth, run, zeros = 0, 0, 0, 0, False
    while done < len(pixels):
        value, shift = 0, 0
        more = True
        while more:
            if at >= nibbles or shift > 30:
                return False
            byte = np.int64(data[at // 8 * 4 + 3 - at % 8 // 2])
            nibble = byte >> 4 if at % 2 == 0 else byte & 15
            value |= (nibble & 7) << shift
            shift += 3
            more = nibble & 8 != 0
            at += 1
        if run == 0:
            zeros = not zeros
            if value > len(pixels) - done:
                return False
            if zeros:
                done += value
            else:
                run = value
            continue
        depth += (value >> 1) ^ -(value & 1)
        pixels[done] = depth & 0xFFFF
        done += 1
        run -= 1
    return True
