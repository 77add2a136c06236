"""Files that are zstd-compressed as a whole (rosbag2's compression mode FILE), unpacked beside the drive's run."""

from __future__ import annotations

import shutil
from contextlib import contextmanager
from typing import TYPE_CHECKING

import zstandard

from vplog.errors import LogError
from vplog.logs.formats.compression import FREE_BYTES, MAX_RATIO
from vplog.storage.scratch import scratch

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from vplog.storage.remote_path import RemotePath

_BLOCK = 2**20
"""Bytes that are written at once."""
_SPARE = 2**30
"""Bytes of disk that are left free for others."""


@contextmanager
def fetched(path: RemotePath) -> Iterator[Path]:
    """A copy of a remote file for the time of the block. Raises LogError where the disk is too small."""
    with scratch("log") as folder:
        yield _fetch(path, folder)


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """A file with what `path` holds, for the time of the block. A cut one is unpacked as far as it goes.

    Raises LogError where it is no zstd data, would fill the disk, or claims more than its bytes justify.
    """
    with scratch("log") as folder:
        yield _unpack(path, folder)


def _fetch(path: RemotePath, folder: Path) -> Path:
    room, size = shutil.disk_usage(folder).free - _SPARE, path.stat().st_size
    if size > room:
        raise LogError(
            f"{path} has {size / 1e9:.1f} GB, {folder.parent} {room / 1e9:.1f} GB free. Set TMPDIR to a larger disk."
        )
    with path.open("rb") as file, (folder / path.name).open("wb") as out:
        shutil.copyfileobj(file, out, _BLOCK)
    return folder / path.name


def _unpack(path: Path, folder: Path) -> Path:
    target = folder / path.name.removesuffix(".zstd").removesuffix(".zst")
    most = max(FREE_BYTES, MAX_RATIO * path.stat().st_size)
    room = shutil.disk_usage(folder).free - _SPARE
    written = 0
    with path.open("rb") as file, target.open("wb") as out:
        stream = zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)
        while True:
            try:
                block = stream.read(_BLOCK)
            except zstandard.ZstdError as error:
                if not written:
                    raise LogError(f"{path} cannot be unpacked: {error}. Is the copy whole?") from None
                break  # what came before is a log that is cut here
            if not block:
                break
            written += out.write(block)
            if written > most:
                raise LogError(f"{path} unpacks to more than {MAX_RATIO} times its size, so it is no log.")
            if written > room:
                raise LogError(
                    f"{path} unpacks to more than the {room / 1e9:.1f} GB that are free in {folder.parent}. "
                    "Unpack it elsewhere with `zstd -d`, or set TMPDIR to a larger disk."
                )
    return target
