"""Names of files and drives in a map, required fields of its records, and the keys of drives."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Annotated, Any, TypeVar
from urllib.parse import quote

import numpy as np
from pydantic import AfterValidator

from vplog.errors import NewerError, ResultError
from vplog.results import run_record, tables
from vplog.run.cache.code_hash import code_of
from vplog.storage.folders import is_below, numbered
from vplog.storage.json_records import CHECKSUM, canonical_json, key_of, plain

T = TypeVar("T")
FORMAT = run_record.FORMAT
"""Version of this layout. A reader refuses a newer one."""
TABLES = ("keyframes", "descriptors", "closures", "edges", "trajectory")
"""Data sets of a map: each is a file of this name in every run folder."""
RUN_TABLES = (*(f"{name}.parquet" for name in TABLES), "run.json")
"""Files of a run folder that are fetched from an object store to work with the drive: not its report and figures."""
HASH = re.compile(r"[0-9a-f]{64}")
"""Name of a library: sha256 over all that descriptors depend on."""
ADD_AGAIN = "compute the drive again: vplog batch LOG -o MAP"
"""Remedy for a damaged drive in messages."""
PICTURES = "pictures"
"""Field in drive.json of a folder of images without odometry: its places have no poses."""
PLACES_ONLY = "places_of"
"""Field in drive.json of a drive of which the map has the places alone: the file that they are from."""
DESCRIBED_WITH = "described_with"
"""Field in drive.json of a drive whose places were made with a larger library than the map has since it was condensed:
the hash of that one, by which its key and its joins are known."""
ABOUT = ("log", "tags", "truth")
"""Fields in drive.json of what is known of a drive: where its log is, texts by name, and its ground truth."""
_NOT_IN_KEY = (*ABOUT, "key", "earth", "format", "files", PICTURES, DESCRIBED_WITH)
"""Fields of drive.json that its key does not depend on."""
_MOST_NAME = 200
"""Characters of a drive's name in a file's; what stands around them takes up to thirty more."""


def folder_name(drive: str) -> str:
    """Name of a partition of a data set."""
    return f"drive={quoted(drive)}"


def quoted(drive: str) -> str:
    """A drive in a file's name: other characters than letters, digits and `_.-~` as in a URL, and the end of a long one
    as a hash, since most file systems take 255 bytes."""
    name = quote(drive, safe="")
    if len(name) <= _MOST_NAME:
        return name
    begins = re.sub(r"%[0-9A-F]?$", "", name[:_MOST_NAME])
    return f"{begins}~{hashlib.sha256(drive.encode()).hexdigest()[:16]}"


def _checked_below(name: str) -> str:
    if not is_below(name):
        raise ValueError(f"{name!r} is not below its folder")
    return name


Below = Annotated[str, AfterValidator(_checked_below)]
"""Name of something below the map's folder, in a record that may come from a stranger."""
_WANTED = {"drive": str, "log": str, "key": str, "library": str, "inputs": dict}


def is_drive_record(record: dict[str, Any]) -> bool:
    """Whether it has the fields of drive.json that are relied on."""
    return all(isinstance(record.get(name), kind) for name, kind in _WANTED.items())


def drive_record(folder: Path) -> dict[str, Any]:
    """drive.json of a run folder in a map. Raises ResultError."""
    record = run_record.read_run_json(folder / "drive.json")
    if not is_drive_record(record):
        raise ResultError(
            f"{folder}/drive.json lacks one of {', '.join(_WANTED)}. Move the folder out of the map, and {ADD_AGAIN}"
        )
    if folder.name.startswith("drive=") and folder.name != folder_name(record["drive"]):
        raise ResultError(
            f"{folder} holds drive {record['drive']!r}. Rename it, or move it out of the map, and {ADD_AGAIN}"
        )
    return record


def write_changed(path: Path, record: dict[str, Any]) -> bool:
    """Write a record; False where the file holds it already, which is left as it is. Raises ResultError."""
    try:
        if path.is_file() and run_record.read_run_json(path) == plain(record):
            return False
    except NewerError:
        raise
    except ResultError:  # damaged
        pass
    run_record.write_run_json(path, record)
    return True


def link(source: str | Path, target: str | Path) -> str | Path:
    """Give a file a second name, or copy it where the file system has no hard links; the name. No writer of a map
    changes a file, each replaces it. Raises OSError."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
    return target


def grouped(
    items: Iterable[T], size: Callable[[T], Any], most: int, alike: Callable[[T], Any] = lambda _: None
) -> Iterator[list[T]]:
    """The items for one file after the other, in their order: alike ones whose sizes, or arrays of sizes, add up to
    `most` or less. A larger one has a group of its own."""
    group, held = list[T](), 0
    for one in items:
        more = size(one)
        if group and (np.max(held + more) > most or alike(one) != alike(group[0])):
            yield group
            group, held = [], 0
        group.append(one)
        held = held + more
    if group:
        yield group


def sha256_of(path: Path) -> str:
    """sha256 of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def drive_names(names: list[str], logs: list[str], known: dict[str, dict[str, Any]], inputs: list[Any]) -> list[str]:
    """The ID of each log: that under which the map knows it, by its path or else by its content; else its name, with
    a number where others have the same. Logs given in the same order to an empty map get the same IDs."""
    result, taken = dict[int, str](), set[str]()
    for field, given in (("log", logs), ("inputs", inputs)):
        places: dict[str, list[str]] = {}
        for drive, record in known.items():
            places.setdefault(canonical_json(record[field]), []).append(drive)
        for at, name in enumerate(names):
            own = re.compile(re.escape(name) + r"(-\d+)?")
            found = places.get(canonical_json(given[at]), [])
            for drive in sorted(found, key=lambda drive: known[drive]["inputs"] != inputs[at]):
                if at not in result and drive not in taken and own.fullmatch(drive):
                    result[at] = drive
                    taken.add(drive)
    folders = {CHECKSUM, *map(str.casefold, known)}  # failures.json has drives for fields
    for at, name in enumerate(names):
        if at not in result:
            result[at] = numbered(name, name, folders) if name.casefold() in folders else name
            folders.add(result[at].casefold())
    return [result[at] for at in range(len(names))]


def free_name(drive: str, log: str, known: Collection[str]) -> str:
    """The ID of a drive from another map: its own, or where that is taken the log's name with the first free number, by
    which `drive_names` still knows it."""
    parts = re.fullmatch(r"(.+)-\d+", drive)
    return numbered(drive, parts[1] if parts and not PurePath(log).name.startswith(drive) else drive, known)


def renamed(record: dict[str, Any], drive: str) -> dict[str, Any]:
    """drive.json of the drive under another ID: with the key that a batch would give it."""
    own = _key(record) == record["key"]
    return {**record, "drive": drive, "key": _key({**record, "drive": drive}) if own else record["key"]}


def described_with(record: dict[str, Any]) -> str:
    """Hash of the library that a drive's places were made with."""
    return str(record.get(DESCRIBED_WITH, record["library"]))


def made_alike(known: dict[str, Any], record: dict[str, Any]) -> bool:
    """Whether a drive of a map is made from what a record names, be it with the library before it was condensed."""
    return bool(known["key"] == _key({**record, DESCRIBED_WITH: known.get(DESCRIBED_WITH, record["library"])}))


def _key(record: dict[str, Any]) -> str:
    made_from = {name: value for name, value in record.items() if name not in _NOT_IN_KEY}
    return key_of({**made_from, "library": described_with(record)})


def set_drive_id(path: Path, drive: str) -> None:
    """Give keyframes.parquet of a drive the ID that it has in the map. Raises ResultError."""
    about = tables.read_table_metadata(path)
    keyframes, world_from_body = tables.read_keyframes(path)
    covariance = tables.read_keyframe_covariance(path)
    tables.write_keyframes(path, replace(keyframes, drive=drive), world_from_body, about, covariance)


def code_hash() -> str:
    """sha256 over the files of the package that a run uses."""
    return code_of("vplog.pipeline")["code"]
