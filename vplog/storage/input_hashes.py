"""The files of a drive, their sha256, lengths and times."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

from vplog.errors import LogError
from vplog.storage.folders import is_unicode
from vplog.storage.remote_path import RemotePath

_BLOCK_BYTES = 2**20
"""Read at once: hashing one takes a millisecond."""


def files_of(drive: Path | Sequence[Path]) -> list[Path]:
    """The files of a drive: of one log, or of a recording in several."""
    return list(drive) if isinstance(drive, list | tuple) else [cast("Path", drive)]


def hash_inputs(drive: Path | Sequence[Path], progress: Callable[[int], None] = lambda _: None) -> dict[str, str]:
    """sha256 of every file of a log, by name; of remote ones what changes with them, as they are not read whole.

    `progress` gets the bytes of every block read; what it raises ends the reading.
    """
    result: dict[str, str] = {}
    for own, file in _named(drive):
        name = str(file) if own in result else own
        name = f"{name} ({len(result) + 1})" if name in result else name  # URLs that differ in their queries alone
        if isinstance(file, RemotePath):
            result[name] = file.version()
            continue
        with file.open("rb") as stream:
            digest, block = hashlib.sha256(), memoryview(bytearray(_BLOCK_BYTES))
            while count := stream.readinto(block):
                digest.update(block[:count])
                progress(count)
        result[name] = digest.hexdigest()
    return result


def bytes_of(drive: Path | Sequence[Path], *, remote: bool = False) -> int:
    """Length of the files of a log on this machine, or with `remote` of all of them. Raises OSError."""
    return sum(file.stat().st_size for _, file in _named(drive) if remote or not isinstance(file, RemotePath))


def stat_signature(drive: Path | Sequence[Path]) -> dict[str, str]:
    """Length and times of every file of a log, by its full path, which change with the file.

    The time of the last change of any kind counts too: a copy may bring its source's time of writing along.
    """
    signature = {}
    for _, file in _named(drive):
        if isinstance(file, RemotePath):
            signature[str(file) if str(file) not in signature else f"{file} ({len(signature) + 1})"] = file.version()
        else:
            stat = file.stat()
            signature[str(file.resolve())] = f"length {stat.st_size}, times {stat.st_mtime_ns} {stat.st_ctime_ns}"
    return signature


def changed_s(drive: Path | Sequence[Path]) -> float:
    """When a file of a log on this machine was last changed in any way, in seconds since the epoch; 0 without files."""
    stats = [file.stat() for _, file in _named(drive) if not isinstance(file, RemotePath)]
    return max((max(stat.st_mtime, stat.st_ctime) for stat in stats), default=0.0)


def _named(drive: Path | Sequence[Path]) -> list[tuple[str, Path]]:
    """The files of a log, with their names in it. Raises LogError where one is not UTF-8."""
    named = [
        (str(file.relative_to(path)) if path.is_dir() else file.name, file)
        for path in files_of(drive)
        for file in (sorted(_below(path)) if path.is_dir() else [path])
    ]
    if wrong := [file for name, file in named if not is_unicode(name)]:
        raise LogError(f"{wrong[0]} has a name that is not UTF-8, which records are. Rename it.")
    return named


def _below(folder: Path) -> list[Path]:
    """The files in a folder and in those below it, behind links too, as logs are read, but each folder once: a link may
    lead back to one that holds it."""
    if isinstance(folder, RemotePath):
        return [one for one in folder.rglob("*") if one.is_file()]
    found, real = list[Path](), folder.resolve()
    visited = {*map(str, real.parents)}
    for place, folders, names in os.walk(folder, followlinks=True):
        if (own := os.path.realpath(place)) in visited:
            folders.clear()
            continue
        visited.add(own)
        folders.sort()
        found += [file for name in names if (file := Path(place, name)).is_file()]
    return found
