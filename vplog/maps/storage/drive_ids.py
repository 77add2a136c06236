"""What a drive of a map is called, and what its results depend on."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import replace
from functools import cache
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from vplog.cache.code_hash import code_of
from vplog.results import run_record, tables

if TYPE_CHECKING:
    from collections.abc import Collection
    from pathlib import Path


BESIDE = ("key", "log", "earth", "format", "files")
"""What of drive.json its key does not depend on."""


def drive_names(names: list[str], logs: list[str], known: dict[str, dict[str, Any]], inputs: list[Any]) -> list[str]:
    """The ID of each log: that under which the map knows it, by its path or else by its content; else its name, with
    a number where others have the same. Logs given in the same order to an empty map get the same IDs."""
    result: list[str | None] = [None] * len(names)
    taken: set[str] = set()
    for told, given in (("log", logs), ("inputs", inputs)):
        places: dict[str, list[str]] = {}
        for drive, record in known.items():
            places.setdefault(run_record.canonical_json(record[told]), []).append(drive)
        for at, name in enumerate(names):
            own = re.compile(re.escape(name) + r"(-\d+)?")
            found = places.get(run_record.canonical_json(given[at]), [])
            for drive in sorted(found, key=lambda drive: known[drive]["inputs"] != inputs[at]):
                if result[at] is None and drive not in taken and own.fullmatch(drive):
                    result[at] = drive
                    taken.add(drive)
    for at, name in enumerate(names):
        number, free = 2, name
        while result[at] is None:
            if free not in taken and free not in known:
                result[at] = free
                taken.add(free)
            free, number = f"{name}-{number}", number + 1
    return [drive for drive in result if drive is not None]


def free_name(drive: str, log: str, known: Collection[str]) -> str:
    """The ID of a drive from another map: its own, or where that is taken the log's name with the first free number.

    So numbered that `drive_names` still knows it by its log.
    """
    named = re.fullmatch(r"(.+)-\d+", drive)
    base = named[1] if named and not PurePath(log).name.startswith(drive) else drive
    number, free = 2, drive
    while free in known:
        free, number = f"{base}-{number}", number + 1
    return free


def renamed(record: dict[str, Any], drive: str) -> dict[str, Any]:
    """drive.json of the same drive under another ID: with the key that a batch would give it."""
    made_from = {name: value for name, value in record.items() if name not in BESIDE}
    if key_of(made_from) != record["key"]:
        return {**record, "drive": drive}
    return {**record, "drive": drive, "key": key_of({**made_from, "drive": drive})}


def name_keyframes(path: Path, drive: str) -> None:
    """Give keyframes.parquet of a drive the ID that it has in the map. Raises ResultError."""
    header = tables.read_metadata(path)
    keyframes, world_from_body = tables.read_keyframes(path)
    about = tables.TableMetadata(json.loads(header["vplog.settings"]), header["vplog.library"])
    covariance = tables.read_keyframe_covariance(path)
    tables.write_keyframes(path, replace(keyframes, drive=drive), world_from_body, about, covariance)


@cache
def code_hash() -> str:
    """sha256 over the files of the package that a run uses: a change of any of them counts as one of the result."""
    return code_of("vplog.pipeline")["code"]


def key_of(made_from: dict[str, Any]) -> str:
    """sha256 over all that a drive's results depend on."""
    return hashlib.sha256(run_record.canonical_json(made_from).encode()).hexdigest()
