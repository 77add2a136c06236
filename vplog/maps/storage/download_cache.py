"""What a user has read of maps on object stores, kept so that the next query asks for nothing but their manifests.

    CACHE/maps/objects/SHA256       files of drives and of libraries, by what is in them
    CACHE/maps/libraries/HASH.json  sha256 of each file of a library
    CACHE/maps/index/ID/...         the index of a map, by where the map is
    CACHE/maps/open/...             the folders of processes that read at the moment, with links to the above

Nothing in it is taken on trust: an object must have the hash that its manifest names, a library the hash that it is
called by, a part of an index its checksum. What does not is fetched or made anew. The folder may be removed at any
time.
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
from vplog.maps.storage.layout import HASH, sha256_of
from vplog.storage.remote_path import s3_place

if TYPE_CHECKING:
    from vplog.storage.remote_path import RemotePath

VARIABLE = "VPLOG_CACHE"
"""Of the environment: where the cache is, unless a verb is told."""
MOST_GB = 20.0
"""That it takes, in 10^9 bytes, unless a verb is told: the index and the descriptors of 80 million places at 240 bytes
each, and little of today's disks."""
_LEFT_OVER_S = 86_400.0
"""A half-written file of a process that was killed goes after a day: none takes that long."""
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
        """Have the file with this sha256 as `target`, which is not there yet; False where it is not at hand."""
        kept, part = self.root / "objects" / digest, target.with_name(f".{target.name}.part")
        try:
            part.unlink(missing_ok=True)
            os.utime(kept)
            _link(kept, part)
            if sha256_of(part) == digest:
                part.replace(target)
                return True
            kept.unlink(missing_ok=True)
        except OSError:
            pass
        part.unlink(missing_ok=True)
        return False

    def keep(self, digest: str, source: Path) -> None:
        """Keep a file that has this sha256. Where that cannot be it is read from afar another time."""
        kept = self.root / "objects" / digest
        part = kept.with_name(f".{digest}.{os.getpid()}-{threading.get_ident()}.part")
        with suppress(OSError):
            kept.parent.mkdir(parents=True, exist_ok=True)
            _link(source, part)
            part.replace(kept)
        with suppress(OSError):  # of a disk that is full; and of two links to one file a rename leaves both
            part.unlink(missing_ok=True)

    def take_library(self, digest: str, target: Path) -> bool:
        """Have the files of a library in a folder; False where one is not at hand."""
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
        record = self._record(digest)
        with suppress(OSError):
            record.parent.mkdir(parents=True, exist_ok=True)
            part = record.with_name(f".{record.name}.{os.getpid()}-{threading.get_ident()}.part")
            part.write_text(json.dumps({"files": files}))
            part.replace(record)

    def _record(self, digest: str) -> Path:
        return self.root / "libraries" / f"{digest}.json"

    def trim(self) -> None:
        """Remove what was not used for longest until the rest is within its bytes, and within half of what the disk
        would have free without it. What another process reads stays with that process until it ends."""
        found, total = [], 0
        for path in (file for name in ("objects", "libraries", "index") for file in (self.root / name).rglob("*")):
            with suppress(OSError):
                about = path.stat()
                if path.is_dir():
                    continue
                if path.suffix == ".part" and about.st_mtime < time.time() - _LEFT_OVER_S:
                    path.unlink(missing_ok=True)
                elif path.suffix != ".part":
                    found.append((about.st_mtime_ns, path, about.st_size))
                    total += about.st_size
        most = min(self.most_bytes, (total + shutil.disk_usage(self.root).free) // 2)
        for _, path, size in sorted(found):
            if total <= most:
                return
            with suppress(OSError):
                path.unlink(missing_ok=True)
                total -= size


def cache_in(folder: Path | None, most_gb: float | None = None) -> Cache | None:
    """The cache in this folder, or where none is named in the user's, of MOST_GB unless told; None where it may hold
    nothing, or where the user's cannot be made. Raises SettingsError where the folder named cannot be."""
    most_gb = MOST_GB if most_gb is None else most_gb
    if most_gb <= 0:
        return None
    place = folder or _users()
    if place is None:
        return None
    cache = Cache(place.absolute() / "maps", int(most_gb * 1e9))
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        cache.open_folders.mkdir(parents=True, exist_ok=True)
        owned = place.stat().st_uid == os.getuid() and os.access(cache.open_folders, os.W_OK)
        problem = "it belongs to another user"
    except OSError as error:
        owned, problem = False, error.strerror or str(error)
    if owned:
        return cache
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


def _link(source: Path, target: Path) -> None:
    """One file under two names; a copy where the file system has no such links. Raises OSError."""
    try:
        os.link(source, target)
    except FileNotFoundError:
        raise
    except OSError:
        shutil.copyfile(source, target)
