"""A user's cache of maps on object stores, so that the next query reads nothing but their manifests.

    CACHE/maps/objects/SHA256       files of drives and of libraries, by content
    CACHE/maps/libraries/HASH.json  sha256 of each file of a library
    CACHE/maps/index/ID/...         the index of a map, by where the map is
    CACHE/maps/open/...             the folders of processes that read at the moment, with links to the above

Nothing in it is taken on trust: an object must have the hash that its manifest names, a library the hash that it is
called by, a segment of an index its checksum; else it is fetched or made again. The folder may be removed at any time.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vplog.errors import SettingsError
from vplog.maps.storage.layout import HASH, link, sha256_of
from vplog.storage.remote_path import s3_place

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.storage.remote_path import RemotePath

VARIABLE = "VPLOG_CACHE"
"""Environment variable that names the cache, unless a verb does."""
MOST_GB = 20.0
"""Default size in 10^9 bytes: the index and the descriptors of 80 million places at 240 bytes each, and little of
today's disks."""
_LEFT_OVER_S = 86_400.0
"""Age of a half-written file of a process that was killed: no download takes a day."""
_RECORD_BYTES = 10**5
"""Longest record of a library's few files."""


@dataclass(frozen=True)
class Cache:
    """A user's cache of maps, for one process."""

    root: Path
    most_bytes: int

    @property
    def open_folders(self) -> Path:
        return self.root / "open"

    def index_of(self, place: RemotePath) -> Path:
        """The folder for the index of the map at this place."""
        return self.root / "index" / hashlib.sha256(f"{s3_place()} {place}".encode()).hexdigest()[:32]

    def take(self, digest: str, target: Path) -> bool:
        """Link the file with this sha256 to `target`, which is not there yet; False where the cache lacks it."""
        cached, part = self.root / "objects" / digest, target.with_name(f".{target.name}.part")
        try:
            part.unlink(missing_ok=True)
            os.utime(cached)
            link(cached, part)
            if sha256_of(part) == digest:
                part.replace(target)
                return True
            cached.unlink(missing_ok=True)
        except OSError:
            pass
        part.unlink(missing_ok=True)
        return False

    def keep(self, digest: str, source: Path) -> None:
        """Keep a file that has this sha256. Where that fails it is fetched again another time."""
        _replace(self.root / "objects" / digest, lambda part: link(source, part))

    def take_library(self, digest: str, target: Path) -> bool:
        """Link the files of a library into a folder; False where one is missing."""
        record = self._record(digest)
        try:
            target.mkdir(parents=True, exist_ok=True)
            data = record.read_bytes()
            os.utime(record)
            files = json.loads(data)["files"] if len(data) <= _RECORD_BYTES else {}
            sound = "library.json" in files and all(
                name == Path(name).name and HASH.fullmatch(content) for name, content in files.items()
            )
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return False
        return sound and all(self.take(content, target / name) for name, content in files.items())

    def keep_library(self, digest: str, files: dict[str, str], source: Path) -> None:
        """Keep the files of a library, whose sha256 are given by name."""
        for name, content in files.items():
            self.keep(content, source / name)
        _replace(self._record(digest), lambda part: part.write_text(json.dumps({"files": files})))

    def _record(self, digest: str) -> Path:
        return self.root / "libraries" / f"{digest}.json"

    def trim(self) -> None:
        """Remove least recently used files until the rest is within `most_bytes`, and within half of what the disk
        would have free without it. Other processes keep their links until they end."""
        found = []
        for path in (file for name in ("objects", "libraries", "index") for file in (self.root / name).rglob("*")):
            with suppress(OSError):
                about = path.stat()
                if path.suffix == ".part" and about.st_mtime < time.time() - _LEFT_OVER_S:
                    path.unlink(missing_ok=True)
                elif path.suffix != ".part" and not path.is_dir():
                    found.append((about.st_mtime_ns, path, about.st_size))
        total = sum(size for *_, size in found)
        most = min(self.most_bytes, (total + shutil.disk_usage(self.root).free) // 2)
        for _, path, size in sorted(found):
            if total <= most:
                return
            with suppress(OSError):
                path.unlink(missing_ok=True)
                total -= size


def _replace(path: Path, write: Callable[[Path], object]) -> None:
    """A file as `write` makes it, whole or not at all; nothing where the disk refuses."""
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.part")
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write(part)
        part.replace(path)
    with suppress(OSError):  # of a disk that is full; and of two links to one file a rename leaves both
        part.unlink(missing_ok=True)


def cache_in(folder: Path | None, most_gb: float | None = None) -> Cache | None:
    """The cache in this folder or, where none is named, in the user's; of MOST_GB by default. None where it may hold
    nothing, or where the user's cannot be made. Raises SettingsError where the folder named cannot be used."""
    most_gb = MOST_GB if most_gb is None else most_gb
    place = folder or _users()
    if most_gb <= 0 or place is None:
        return None
    cache, problem = Cache(place.absolute() / "maps", int(most_gb * 1e9)), "it belongs to another user"
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        cache.open_folders.mkdir(parents=True, exist_ok=True)
        if place.stat().st_uid == os.getuid() and os.access(cache.open_folders, os.W_OK):
            return cache
    except OSError as error:
        problem = error.strerror or str(error)
    if folder is None:
        return None
    raise SettingsError(f"Cannot use the cache {folder}: {problem}. Choose another folder with --cache.")


def _users() -> Path | None:
    """By the XDG Base Directory Specification, 0.8."""
    if named := os.environ.get(VARIABLE):
        return Path(named)
    if (named := os.environ.get("XDG_CACHE_HOME")) and Path(named).is_absolute():
        return Path(named) / "vplog"
    try:
        return Path.home() / ".cache" / "vplog"
    except RuntimeError:  # a user without a home
        return None
