"""A user's cache of maps on object stores, so that the next query reads nothing but its manifest.

    CACHE/maps/objects/SHA256   files of drives and of libraries, by content
    CACHE/maps/index/ID/...     the index of a map, by where the map is
    CACHE/maps/open/...         the folders of processes that read at the moment, with links to the above

Nothing in it is taken on trust: an object must have the hash that the manifest names, a segment of an index its
checksum; else it is fetched or made again. The folder may be removed at any time.
"""

from __future__ import annotations

import hashlib
import os
import threading
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vplog.maps.storage.layout import link, sha256_of
from vplog.storage.remote_path import RemotePath, s3_place
from vplog.storage.user_cache import cache_folder, max_bytes, trim


@dataclass(frozen=True)
class Cache:
    """A user's cache of maps, for one process."""

    root: Path
    max_bytes: int

    @property
    def open_folders(self) -> Path:
        return self.root / "open"

    def index_of(self, place: RemotePath, as_of: str = "") -> Path:
        """The folder for the index of the map at this place, or of what it was at a version or a time."""
        name = f"{s3_place()} {place}{as_of and f'@{as_of}'}"
        return self.root / "index" / hashlib.sha256(name.encode()).hexdigest()[:32]

    def fetch_to(self, digest: str, target: Path) -> bool:
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
        """Link a file that has this sha256 into the cache. Where that fails it is fetched again another time."""
        path = self.root / "objects" / digest
        part = path.with_name(f".{digest}.{os.getpid()}-{threading.get_ident()}.part")
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            link(source, part)
            part.replace(path)
        with suppress(OSError):  # of a disk that is full; and of two links to one file a rename leaves both
            part.unlink(missing_ok=True)

    def trim(self) -> None:
        """Remove least recently used files until the rest is within `max_bytes`, and within half of what the disk
        would have free without it. Other processes keep their links until they end."""
        trim([self.root / name for name in ("objects", "index")], self.max_bytes)


def cache_in(folder: Path | None, max_gb: float | None = None) -> Cache | None:
    """The cache in this folder or, where none is named, in the user's; of DEFAULT_GB by default. None where it may hold
    nothing, or where the user's cannot be made. Raises SettingsError where the folder named cannot be used."""
    place = cache_folder(folder, "maps", max_gb)
    if place is None:
        return None
    cache = Cache(place, max_bytes(max_gb))
    cache.open_folders.mkdir(parents=True, exist_ok=True)
    return cache
