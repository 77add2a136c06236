"""A file of the stage cache: what a stage came to, with what tells whether it is that, and whole."""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

_MAGIC = b"VPLOGST1"
_HEAD = struct.Struct("<8s32sQI")
"""Magic with the version of the format, key, bytes that follow, their CRC-32: it is there against damage, and is summed
up at 2.8 GB/s where sha256 takes eight times as long."""
ENDING = ".stage"
"""Of the files of a cache: what else is in its folder is not touched."""
INPUTS = "inputs.json"
"""Name of the file with the identity and hashes of the log that a cache is of."""
CACHE_FILES = (f"*{ENDING}", ".*.part", INPUTS)
"""Glob patterns of all files of a cache; the parts are what a killed run was writing."""
_BLOCK_BYTES = 2**20
"""Read at once of a file that is only checked."""
CONTENT_AT = _HEAD.size
"""Where the content of a file begins."""


class DamagedError(Exception):
    """A file of the cache is not what its name says. Never leaves the cache."""


class AbsentError(Exception):
    """There is no such file in the cache."""


def file_name(stage: str, key: str) -> str:
    """The first 128 bits of the key tell files apart; the whole key is in the file."""
    return f"{stage}-{key[:32]}{ENDING}"


def sealed(key: str, content: bytes) -> bytes:
    """A file of the cache: the content with what tells whether it is whole."""
    return _HEAD.pack(_MAGIC, bytes.fromhex(key), len(content), zlib.crc32(content)) + content


def content_of(data: bytes, key: str) -> memoryview:
    """What `sealed` was given. Raises DamagedError where that is not what is there."""
    content = memoryview(data)[_HEAD.size :]
    _check_head(data[: _HEAD.size], key, len(content), lambda: zlib.crc32(content))
    return content


def check_file(path: Path, key: str | None = None) -> None:
    """Read a file through, but keep nothing of it. Its key is not asked for where None is given.

    Raises DamagedError where it is not whole, and AbsentError where there is none.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEAD.size)

            def summed() -> int:
                total = 0
                while block := stream.read(_BLOCK_BYTES):
                    total = zlib.crc32(block, total)
                return total

            _check_head(head, key, path.stat().st_size - _HEAD.size, summed)
    except FileNotFoundError:
        raise AbsentError from None
    except OSError as error:
        raise DamagedError(error.strerror or str(error)) from None


def _check_head(head: bytes, key: str | None, length: int, checksum: Callable[[], int]) -> None:
    if len(head) < _HEAD.size or head[: len(_MAGIC)] != _MAGIC:
        raise DamagedError("another version wrote it")
    _, own, told, summed = _HEAD.unpack(head)
    if key is not None and own != bytes.fromhex(key):
        raise DamagedError("it belongs to another result")
    if told != length:
        raise DamagedError(f"it holds {length} bytes instead of {told}")
    if checksum() != summed:
        raise DamagedError("its checksum does not match")
