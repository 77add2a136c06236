"""A map on disk: finished drives as folders that appear whole, described with one library, read by anyone at any time.

    MAP/map.json                               format, library, settings
    MAP/libraries/HASH/                        the references that all places are described with
    MAP/runs/drive=ID/                         the run folder of a drive, with drive.json: what it was made from
    MAP/keyframes/drive=ID/keyframes.parquet   its tables as data sets, partitioned by drive as DuckDB and Spark have
    MAP/descriptors/... closures/... edges/... trajectory/...   it; hard links to the run folder's files
    MAP/failures.json                          drives that could not be run, each with its error

A drive is in the map when its run folder is: that is one rename. Its tables are links: no byte is stored twice, both
names always show the same bytes (every writer here replaces a file and never changes one), and one look at the inode
tells whether a link is missing. Removing a drive is removing its folders: `rm -r MAP/*/drive=ID`.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import shutil
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import vplog
from vplog.errors import LibraryError, ResultError, SettingsError
from vplog.results import run_record
from vplog.results.atomic import replacing

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

FORMAT = 1
"""Version of this layout. A reader refuses another one."""
TABLES = ("keyframes", "descriptors", "closures", "edges", "trajectory")
"""Data sets of a map: each is a file of this name in every run folder."""
_HASH = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Head:
    """map.json."""

    library: str | None
    """Hash of the library; None before there is one."""
    settings: dict[str, Any]
    """Every setting of the last batch."""


@dataclass(frozen=True)
class Store:
    """The names in a map."""

    root: Path

    @property
    def staging(self) -> Path:
        """Where a writer makes what it renames in; hidden, on the same file system."""
        return self.root / ".staging"

    def run(self, drive: str) -> Path:
        return self.root / "runs" / folder_name(drive)

    def table(self, name: str, drive: str) -> Path:
        return self.root / name / folder_name(drive) / f"{name}.parquet"

    def library(self, digest: str) -> Path:
        return self.root / "libraries" / digest

    def drives(self) -> dict[str, dict[str, Any]]:
        """drive.json of every finished drive, by ID in order. Raises ResultError where one cannot be read."""
        found = [drive_record(folder) for folder in sorted(self.root.glob("runs/drive=*")) if folder.is_dir()]
        return {record["drive"]: record for record in sorted(found, key=lambda record: record["drive"])}

    def failures(self) -> dict[str, dict[str, Any]]:
        """Log and error of each drive that failed when it was last tried, by ID."""
        path = self.root / "failures.json"
        return run_record.read_run_json(path) if path.exists() else {}

    def head(self) -> Head:
        """map.json. Raises ResultError where the folder is no map, or one of another version."""
        path = self.root / "map.json"
        if not path.is_file():
            raise ResultError(
                f"{self.root} is not a map: it has no map.json. Make one: vplog batch LOG... -o {self.root}"
            )
        record = run_record.read_run_json(path)
        if record.get("format") != FORMAT:
            raise ResultError(
                f"{path} is of format {record.get('format')!r}, and this vplog reads {FORMAT}. Use the vplog that made "
                f"it ({record.get('vplog')!r})."
            )
        library, settings = record.get("library"), record.get("settings")
        known = library is None or (isinstance(library, str) and _HASH.fullmatch(library))
        if not known or not isinstance(settings, dict):
            raise ResultError(f"{path} has no sound library or settings. Run `vplog batch` again to write it anew.")
        return Head(library, settings)

    def write_head(self, head: Head) -> None:
        """map.json, unless it says that already."""
        record = {"format": FORMAT, "vplog": vplog.__version__, "library": head.library, "settings": head.settings}
        _write_changed(self.root / "map.json", record)

    def write_failures(self, failures: dict[str, dict[str, Any]]) -> None:
        _write_changed(self.root / "failures.json", dict(sorted(failures.items())))


def folder_name(drive: str) -> str:
    """What a partition of a data set is called; other characters than letters, digits and `_.-~` as in a URL."""
    return f"drive={quote(drive, safe='')}"


def drive_record(folder: Path) -> dict[str, Any]:
    """drive.json of a run folder in a map. Raises ResultError."""
    record = run_record.read_run_json(folder / "drive.json")
    wanted = {"drive": str, "log": str, "key": str, "library": str, "inputs": dict}
    if any(not isinstance(record.get(name), kind) for name, kind in wanted.items()):
        raise ResultError(f"{folder}/drive.json lacks one of {', '.join(wanted)}. Remove the folder and run again.")
    if folder.name.startswith("drive=") and folder.name != folder_name(record["drive"]):
        raise ResultError(f"{folder} holds drive {record['drive']!r}. Remove the folder and run again.")
    return record


def _write_changed(path: Path, record: dict[str, Any]) -> None:
    """Write JSON, or leave the file as it is where it holds the same: a finished map is not touched."""
    if path.is_file() and run_record.read_run_json(path) == run_record.plain(record):
        return
    run_record.write_run_json(path, record)


@contextmanager
def writing(root: Path) -> Iterator[Store]:
    """The map for one writer, made where it is not there yet; the lock goes with the process that holds it.

    What a writer that was killed had finished is put in; what it had not is removed. Raises SettingsError where the
    folder holds other things, or where another process writes.
    """
    store = Store(root)
    if root.is_dir() and not (root / "map.json").exists():
        others = [path.name for path in root.iterdir() if not path.name.startswith(".")]
        if others:
            raise SettingsError(f"{root} holds other things ({others[0]}), not a map. Choose another folder with -o.")
    try:
        root.mkdir(parents=True, exist_ok=True)
        lock = (root / ".lock").open("a")
    except OSError as error:
        raise SettingsError(f"Cannot make the map {root}: {error.strerror}. Choose another folder with -o.") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SettingsError(
                f"Another `vplog batch` is writing to {root}. Wait for it to end, or choose another folder with -o."
            ) from None
        except OSError as error:  # file systems without locks
            raise SettingsError(f"Cannot lock {root}/.lock: {error.strerror}. Choose another folder with -o.") from None
        _settle(store)
        yield store
        shutil.rmtree(store.staging, ignore_errors=True)


def _settle(store: Store) -> None:
    """Put in what a killed writer had finished: a folder with drive.json, which is written last."""
    for folder in sorted(store.staging.glob("*/drive.json")):
        record = drive_record(folder.parent)
        if not store.run(record["drive"]).exists():
            publish(store, record["drive"], folder.parent)
    shutil.rmtree(store.staging, ignore_errors=True)
    store.staging.mkdir(parents=True, exist_ok=True)
    for drive in store.drives():
        link_tables(store, drive)


def publish(store: Store, drive: str, made: Path) -> None:
    """Make a finished run folder the drive's, in place of the one it may have, and link its tables."""
    run, replaced = store.run(drive), store.staging / f"replaced-{os.getpid()}"
    try:
        run.parent.mkdir(exist_ok=True)
        if run.exists():
            shutil.rmtree(replaced, ignore_errors=True)
            run.rename(replaced)
            (replaced / "drive.json").unlink()  # so that nobody takes it for a new one
        made.rename(run)
    except OSError as error:
        raise ResultError(f"Cannot put {drive} into {store.root}: {error.strerror}.") from None
    shutil.rmtree(replaced, ignore_errors=True)
    link_tables(store, drive)


def link_tables(store: Store, drive: str) -> None:
    """Each table of the run folder under its data set; a copy on file systems without hard links."""
    for name in TABLES:
        source, path = store.run(drive) / f"{name}.parquet", store.table(name, drive)
        if not source.is_file():
            raise ResultError(f"{source} is not there. Remove {store.run(drive)} and run again.")
        if path.exists() and (path.samefile(source) or _same_copy(source, path)):
            continue
        part = store.staging / f"{name}-{os.getpid()}.parquet"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            part.unlink(missing_ok=True)
            os.link(source, part)
            part.replace(path)
        except OSError:  # no hard links here; what else is wrong, the copy says
            with replacing(path) as stream, source.open("rb") as whole:
                shutil.copyfileobj(whole, stream)


def _same_copy(source: Path, path: Path) -> bool:
    """Whether a file that is no link holds the same, told by its bytes."""
    return source.stat().st_size == path.stat().st_size and sha256_of(source) == sha256_of(path)


def sha256_of(path: Path) -> str:
    """Of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def add_library(store: Store, made: Path, digest: str) -> Path:
    """Make a folder in staging the library of this hash; it stays as it is where the map has it."""
    folder = store.library(digest)
    if not _HASH.fullmatch(digest):
        raise LibraryError(f"{made} has no sound hash ({digest[:20]!r}). Build the library anew.")
    try:
        folder.parent.mkdir(exist_ok=True)
        if not folder.exists():
            made.rename(folder)
    except OSError as error:
        raise ResultError(f"Cannot put the library into {store.root}: {error.strerror}.") from None
    return folder
