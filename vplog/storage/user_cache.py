"""The user's own cache: one folder for all calls, within a bound, whose least recently used files go first."""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from vplog.errors import SettingsError

VARIABLE = "VPLOG_CACHE"
"""Environment variable that names the cache, unless a verb does."""
DEFAULT_GB = 20.0
"""Default size in 10^9 bytes: the index and the descriptors of 80 million places at 240 bytes each, the features of
60,000 images, and little of today's disks."""
_LEFT_OVER_S = 86_400.0
"""Age of a half-written file of a process that was killed: no download takes a day."""
_OURS = re.compile(r"\.?([a-z]+-)?[0-9a-f]{32}([0-9a-f]{32})?(\..*)?")
"""Names of cache entries, which are hashes. All else in the folders of a cache that a user named is the user's."""


def max_bytes(max_gb: float | None) -> int:
    return int((DEFAULT_GB if max_gb is None else max_gb) * 1e9)


def cache_folder(folder: Path | None, name: str, max_gb: float | None = None) -> Path | None:
    """The folder `name` of the cache in `folder` or, where none is given, of the user's; it is made.

    None where the cache may hold nothing, or the user's cannot be made. Raises SettingsError where `folder` cannot be
    used.
    """
    place = _user_cache() if folder is None else Path(folder)
    if max_bytes(max_gb) <= 0 or place is None:
        return None
    found, problem = place.absolute() / name, "it belongs to another user"
    try:
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        found.mkdir(exist_ok=True)
        if place.stat().st_uid == os.getuid() and os.access(found, os.W_OK):
            return found
    except OSError as error:
        problem = error.strerror or str(error)
    if folder is None:
        return None
    raise SettingsError(f"Cannot use the cache {folder}: {problem}. Choose another folder with --cache.")


def _user_cache() -> Path | None:
    """The user's cache folder, by the XDG Base Directory Specification, 0.8."""
    if named := os.environ.get(VARIABLE):
        return Path(named)
    if (named := os.environ.get("XDG_CACHE_HOME")) and Path(named).is_absolute():
        return Path(named) / "vplog"
    try:
        return Path.home() / ".cache" / "vplog"
    except RuntimeError:  # a user without a home
        return None


def trim(folders: Iterable[Path], most_bytes: int) -> None:
    """Remove least recently used files below these folders until the rest is within `most_bytes`, and within half of
    what the disk would have free without it. Other processes keep their links and open files until they end."""
    found, free = [], 0
    for folder in folders:
        with suppress(OSError):
            free = shutil.disk_usage(folder).free
        for path in folder.rglob("*"):
            if not _OURS.fullmatch(path.relative_to(folder).parts[0]):
                continue
            with suppress(OSError):
                about = path.stat()
                if path.suffix == ".part" and about.st_mtime < time.time() - _LEFT_OVER_S:
                    path.unlink(missing_ok=True)
                elif path.suffix != ".part" and not path.is_dir():
                    found.append((about.st_mtime_ns, path, about.st_size))
    total = sum(size for *_, size in found)
    most = min(most_bytes, (total + free) // 2)
    for _, path, size in sorted(found):
        if total <= most:
            return
        with suppress(OSError):
            path.unlink(missing_ok=True)
            total -= size
