"""The files of a drive: which they are, and how it is told that they are the same as before."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, cast

from vplog.remote import RemotePath

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def files_of(drive: Path | Sequence[Path]) -> list[Path]:
    """The files of a drive: of one log, or of a recording in several."""
    return list(drive) if isinstance(drive, list | tuple) else [cast("Path", drive)]


def hash_inputs(drive: Path | Sequence[Path]) -> dict[str, str]:
    """sha256 of every file of a log, by name; of remote ones what changes with them, as they are not read whole."""
    result: dict[str, str] = {}
    for own, file in _named(drive):
        name = str(file) if own in result else own
        if isinstance(file, RemotePath):
            result[name] = file.version()
            continue
        with file.open("rb") as stream:
            result[name] = hashlib.file_digest(stream, "sha256").hexdigest()
    return result


def look_of(drive: Path | Sequence[Path]) -> dict[str, str]:
    """What changes with every file of a log, by its full path, without reading one: length and times.

    The time of the last change of any kind counts too: a copy may bring its source's time of writing along.
    """
    look = {}
    for _, file in _named(drive):
        if isinstance(file, RemotePath):
            look[str(file)] = file.version()
        else:
            stat = file.stat()
            look[str(file.resolve())] = f"length {stat.st_size}, times {stat.st_mtime_ns} {stat.st_ctime_ns}"
    return look


def changed_s(drive: Path | Sequence[Path]) -> float:
    """When a file of a log on this machine was last changed in any way, in seconds since the epoch; 0 without files."""
    stats = [file.stat() for _, file in _named(drive) if not isinstance(file, RemotePath)]
    return max((max(stat.st_mtime, stat.st_ctime) for stat in stats), default=0.0)


def _named(drive: Path | Sequence[Path]) -> list[tuple[str, Path]]:
    return [
        (str(file.relative_to(path)) if path.is_dir() else file.name, file)
        for path in files_of(drive)
        for file in (sorted(one for one in path.rglob("*") if one.is_file()) if path.is_dir() else [path])
    ]
