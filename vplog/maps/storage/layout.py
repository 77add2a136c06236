"""The names in a map, and what its records must say."""

from __future__ import annotations

import hashlib
import re
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from vplog.errors import ResultError
from vplog.results import run_record

if TYPE_CHECKING:
    from pathlib import Path

FORMAT = run_record.FORMAT
"""Version of this layout. A reader refuses a newer one."""
TABLES = ("keyframes", "descriptors", "closures", "edges", "trajectory")
"""Data sets of a map: each is a file of this name in every run folder."""
AT_HAND = (*(f"{name}.parquet" for name in TABLES), "run.json")
"""Of a run folder on an object store, what those who work with drives have fetched: all but pictures and reports."""
HASH = re.compile(r"[0-9a-f]{64}")
"""How a library is called: the sha256 of all that descriptors depend on."""


ADD_AGAIN = "compute the drive again: vplog batch LOG -o MAP"
"""What to do about a drive that is damaged: nothing that may still be of use is removed for it."""
_MOST_NAME = 200
"""Characters of a drive's name in a file's; what stands around them takes up to thirty more."""


def folder_name(drive: str) -> str:
    """What a partition of a data set is called."""
    return f"drive={quoted(drive)}"


def quoted(drive: str) -> str:
    """A drive in a file's name: other characters than letters, digits and `_.-~` as in a URL, the end of what is very
    long as a hash: a name has 255 bytes on most file systems, and a letter beyond ASCII takes six to twelve."""
    name = quote(drive, safe="")
    if len(name) <= _MOST_NAME:
        return name
    begins = re.sub(r"%[0-9A-F]?$", "", name[:_MOST_NAME])
    return f"{begins}~{hashlib.sha256(drive.encode()).hexdigest()[:16]}"


def drive_record(folder: Path) -> dict[str, Any]:
    """drive.json of a run folder in a map. Raises ResultError."""
    return sound_record(run_record.read_run_json(folder / "drive.json"), folder)


def sound_record(record: dict[str, Any], folder: Path) -> dict[str, Any]:
    """What drive.json of `folder` says, checked. Raises ResultError."""
    wanted = {"drive": str, "log": str, "key": str, "library": str, "inputs": dict}
    if any(not isinstance(record.get(name), kind) for name, kind in wanted.items()):
        raise ResultError(
            f"{folder}/drive.json lacks one of {', '.join(wanted)}. Move the folder out of the map, and {ADD_AGAIN}"
        )
    if folder.name.startswith("drive=") and folder.name != folder_name(record["drive"]):
        raise ResultError(
            f"{folder} holds drive {record['drive']!r}. Rename it, or move it out of the map, and {ADD_AGAIN}"
        )
    return record


def sha256_of(path: Path) -> str:
    """Of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
