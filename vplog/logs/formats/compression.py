"""Chunks, messages and whole files unpacked, with bounded memory and as far as a cut one goes."""

from __future__ import annotations

import bz2
import io
import shutil
import threading
from contextlib import contextmanager

import lz4.frame
import zstandard

try:
    from isal.isal_zlib import crc32  # eight times as fast as Python 3.11's, which takes as long as unpacking JPEGs
except ImportError:  # no wheel for this processor
    from zlib import crc32

from collections.abc import Callable, Iterator
from pathlib import Path

from vplog.errors import LogError
from vplog.logs.formats.budget import Budget, max_unpacked
from vplog.logs.formats.container import RawData
from vplog.storage.remote_path import RemotePath
from vplog.storage.scratch import scratch

__all__ = ["BadChunkError", "crc32", "unpack", "unpack_zstd_message"]
KINDS = ("", "none", "lz4", "zstd", "bz2")
_BLOCK = 2**20
"""Bytes that are read at once."""
_SPARE = 2**30
"""Bytes of disk that are left free for others."""
_THREAD = threading.local()
"""A decompressor for each thread: to set up its tables takes as long as to unpack 0.5 MB."""


class BadChunkError(Exception):
    """A chunk that cannot be unpacked; the message is the reason."""

    def __init__(self, reason: str, data: bytes = b"") -> None:
        """`data` are the bytes that could be unpacked."""
        super().__init__(reason)
        self.data = data


def unpack(
    kind: str, data: bytes, size: int, partial: bool = False, charge: Callable[[int], None] = lambda _: None
) -> bytes:
    """Return the `size` bytes that `data` holds under `kind` (one of KINDS), or fewer if `partial` and the data are
    cut. `charge` gets the number of bytes before they are unpacked, and may raise. Raises BadChunkError if the kind is
    unknown, the size is more than the data justify, or the data are damaged."""
    if kind not in KINDS:
        raise BadChunkError(f"unknown compression {kind[:20]!r}")
    if kind in ("", "none"):
        charge(len(data))
        result = data
    elif not 0 <= size <= max_unpacked(len(data)):
        raise BadChunkError(f"{len(data)} bytes claim to unpack to {size}")
    else:
        charge(size)
        try:
            result = _DECODERS[kind](data, size + 1)  # one more, so that one that holds more than that shows
        except (RuntimeError, OSError, ValueError, EOFError, zstandard.ZstdError) as error:
            raise BadChunkError(str(error).splitlines()[0] if str(error) else type(error).__name__) from None
    if len(result) != size and not partial:
        raise BadChunkError(f"{len(result)} bytes instead of {size}")
    return result


def _zstd(data: bytes, most: int) -> bytes:
    try:
        # One frame, as most writers make it; -1 where it does not say its size, as those that stream leave it.
        if zstandard.frame_content_size(data) in (most - 1, -1):
            if not hasattr(_THREAD, "zstd"):
                _THREAD.zstd = zstandard.ZstdDecompressor()
            result = _THREAD.zstd.decompress(data, max_output_size=most)
            if len(result) == most - 1:
                return result
    except zstandard.ZstdError:
        pass  # what there is of a cut one comes out below
    parts, left = [], most
    with zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data), read_across_frames=True) as stream:
        while left and (part := stream.read(min(left, _BLOCK))):
            parts.append(part)
            left -= len(part)
    return b"".join(parts)


_DECODERS = {
    "zstd": _zstd,
    "lz4": lambda data, most: lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most),
    "bz2": lambda data, most: bz2.BZ2Decompressor().decompress(data, max_length=most),
}


def unpack_zstd_message(data: RawData, charge: Callable[[int], None] = lambda _: None) -> bytes:
    """Unpack one zstd frame that holds its own length, bounded and charged as by `unpack`. Raises BadChunkError."""
    try:
        size = zstandard.frame_content_size(data)
    except zstandard.ZstdError as error:
        raise BadChunkError(str(error)) from None
    if size < 0:
        raise BadChunkError("a message's zstd frame does not say its length")
    return unpack("zstd", bytes(data), size, charge=charge)


@contextmanager
def fetched(path: RemotePath) -> Iterator[Path]:
    """A copy of a remote file for the time of the block. Raises LogError where the disk is too small."""
    with scratch("log") as folder:
        room, size = shutil.disk_usage(folder).free - _SPARE, path.stat().st_size
        if size > room:
            sizes = f"{size / 1e9:.1f} GB, {folder.parent} {room / 1e9:.1f} GB free"
            raise LogError(f"{path} has {sizes}. Set TMPDIR to a larger disk.")
        with path.open("rb") as file, (folder / path.name).open("wb") as out:
            shutil.copyfileobj(file, out, _BLOCK)
        yield folder / path.name


@contextmanager
def unpacked(path: Path, budget: Budget) -> Iterator[Path]:
    """Yield a file with the content of a zstd file (rosbag2's compression mode FILE) for the time of the block. A cut
    file is unpacked as far as it goes. Raises LogError if it is no zstd data, would fill the disk, or unpacks to more
    than its budget."""
    with scratch("log") as folder:
        target = folder / path.name.removesuffix(".zstd").removesuffix(".zst")
        room = shutil.disk_usage(folder).free - _SPARE
        with path.open("rb") as file, target.open("wb") as out:
            stream = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
            try:
                while block := stream.read(_BLOCK):
                    out.write(block)
                    if out.tell() > budget.max_bytes:
                        raise budget.error()
                    if out.tell() > room:
                        raise LogError(
                            f"{path} unpacks to more than the {room / 1e9:.1f} GB that are free in {folder.parent}. "
                            "Unpack it elsewhere with `zstd -d`, or set TMPDIR to a larger disk."
                        )
            except zstandard.ZstdError as error:
                if not out.tell():  # else what came before is a log that is cut here
                    raise LogError(f"{path} cannot be unpacked: {error}. Is the copy whole?") from None
        yield target
