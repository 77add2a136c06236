"""Records of the drives of a map's folder as its last writer found them, so that other commands open none of them.

    MAP/.drives.json.gz     of each run folder drive.json, and inode, length and time of its records and tables then

An entry counts while these files are those that they were, as in Git's index. The file may be removed at any time.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from vplog.errors import ResultError
from vplog.maps.storage.layout import RUN_TABLES, folder_name, is_drive_record
from vplog.storage.compressed_json import read_compressed, write_compressed

NAME = ".drives.json.gz"
_FILES = ("drive.json", *RUN_TABLES)
Entry = list[Any]
"""State of the files of a run folder, and its drive.json."""


def state_of(run: str) -> list[int] | None:
    """Inode, length and time of each record and table of a run folder; None where one is missing."""
    try:
        found = [os.stat(f"{run}/{name}") for name in _FILES]  # noqa: PTH116 (a third of the time of Path's)
    except OSError:
        return None
    return [value for one in found for value in (one.st_ino, one.st_size, one.st_mtime_ns)]


def read_catalogue(root: Path) -> dict[str, Entry]:
    """Entries by name of the run folder; none of a damaged file."""
    try:
        found = read_compressed(root / NAME)
    except ResultError:
        return {}
    if not isinstance(found, dict):
        return {}
    entries = {name: one for name, one in found.items() if isinstance(one, list) and len(one) == 2}
    return {
        name: one
        for name, one in entries.items()
        if isinstance(one[1], dict) and is_drive_record(one[1]) and folder_name(one[1]["drive"]) == name
    }


def write_catalogue(root: Path, entries: dict[str, Entry]) -> None:
    """Replace the catalogue. Raises ResultError."""
    write_compressed(root / NAME, entries)
