"""The drives, records and files of a map, by name, wherever the map is."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

from vplog.errors import LibraryError, NewerError, ResultError, nearest_path
from vplog.maps.geo_bounds import earth_from_record
from vplog.maps.storage import damage
from vplog.maps.storage.catalogue import Entry, read_catalogue, state_of, write_catalogue
from vplog.maps.storage.damage import DamagedDriveError, UnreachableError, reading_drive
from vplog.maps.storage.layout import FORMAT, HASH, RUN_TABLES, drive_record, folder_name, write_changed
from vplog.maps.storage.remote_map import Mirror
from vplog.maps.storage.upload import send_rest, update_failures, write_head
from vplog.results import run_record
from vplog.results.geo import Earth
from vplog.storage.folders import disk_bytes, names_in, regular_files
from vplog.storage.parquet_limits import check_version
from vplog.version import __version__

T = TypeVar("T")

_TRIES, _PAUSE_S = 6, 0.02
"""Reads of a drive that is replaced meanwhile, with a pause that doubles: 1.3 s in all. A batch replaces each drive
once, and a rename takes less than a millisecond."""


@dataclass(frozen=True)
class Head:
    """map.json."""

    library: str | None
    """Hash of the library; None before there is one."""
    settings: dict[str, Any]
    """Every setting of the last batch."""


@dataclass(frozen=True)
class Store:
    """A map. Of one on an object store `root` is a local folder, into which files are fetched on demand."""

    root: Path
    mirror: Mirror | None = None
    """None for a map that is a folder."""
    damaged: dict[str, str] = field(default_factory=dict)
    """Drives that are left out of `drives` and of answers, and why."""
    uncatalogued: set[str] = field(default_factory=set)
    """Run folders of a map's folder that its catalogue did not have as they are."""

    def __str__(self) -> str:
        """The map's path or URL."""
        return str(self.root if self.mirror is None else self.mirror.remote)

    @property
    def index(self) -> Path:
        """Folder of the index; of a map on an object store it is the reader's own, in the cache if there is one."""
        if self.mirror is not None and self.mirror.cache is not None:
            return self.mirror.cache.index_of(self.mirror.remote, self.mirror.manifest.as_of or "")
        return self.root / "index"

    @property
    def staging(self) -> Path:
        """Hidden folder on the map's file system, where a writer makes what it then renames into the map."""
        return self.root / ".staging"

    def run(self, drive: str, names: Iterable[str] = RUN_TABLES) -> Path:
        """The run folder; of a map on an object store a local one, into which these of its files are fetched."""
        if self.mirror is not None:
            self.mirror.fetch(drive, names)
        return self.root / "runs" / folder_name(drive)

    def file(self, drive: str, name: str) -> Path:
        """One file of the run folder, where it has one of this name."""
        return self.run(drive, [name]) / name

    def full_run(self, drive: str) -> Path:
        """The run folder with all files."""
        return self.run(drive, () if self.mirror is None else self.sizes(drive))

    def evict(self, drive: str) -> None:
        """Free the disk of what was fetched of a drive."""
        if self.mirror is not None:
            self.mirror.evict(drive)

    def library(self, digest: str, names: Collection[str] = ()) -> Path:
        """The folder of a library; of a map on an object store a local one, into which its files are fetched."""
        if self.mirror is not None:
            self.mirror.library(digest, names)
        return self.root / "libraries" / digest

    def sizes(self, drive: str) -> dict[str, int]:
        """Bytes of each file of a run folder, by name."""
        if self.mirror is not None:
            return {name: about["bytes"] for name, about in self.mirror.drives[drive]["files"].items()}
        run = self.run(drive)
        return {name: (run / name).lstat().st_size for name in regular_files(run)}

    def bytes_stored(self) -> int:
        """Return the size of all files of the map: on disk with all hard links of a file counted once, as `du` has it,
        or in an object store. Files of older versions in an object store are not counted."""
        if self.mirror is None:
            return disk_bytes(self.root)
        now = self.mirror.manifest.now
        groups = [*now["libraries"].values(), now["rest"], *(one["files"] for one in self.mirror.drives.values())]
        return sum(about["bytes"] for files in groups for about in files.values())

    def damaged_files(self, drive: str) -> list[str]:
        """A line for each file of a drive that is not as it was written; of a map on a store, by what the store says of
        them. Raises UnreachableError."""
        return damage.damaged_files(self.run(drive)) if self.mirror is None else self.mirror.damaged_files(drive)

    def rows(self, name: str, drive: str) -> int:
        """Rows of a table of a drive, by its footer. Raises DamagedDriveError."""
        if self.mirror is not None:
            return int(self.mirror.drives[drive]["files"].get(f"{name}.parquet", {}).get("rows", 0))
        with reading_drive(drive):
            return damage.rows_of(self.run(drive) / f"{name}.parquet")

    def earth(self, drive: str) -> Earth | None:
        """The georeference of a drive, None where it has none. Raises DamagedDriveError."""
        with reading_drive(drive):
            return earth_from_record(self.record(drive).get("earth"))

    def record(self, drive: str) -> dict[str, Any]:
        """drive.json of a drive. Raises ResultError."""
        if self.mirror is None:
            return drive_record(self.root / "runs" / folder_name(drive))
        if drive not in self.mirror.drives:
            raise ResultError(f"{self} has no drive {drive!r}.")
        return self.mirror.drives[drive]["record"]

    def figures(self, drive: str) -> dict[str, Any]:
        """run.json of a drive; of a map on a store its counts, totals and warnings. Raises ResultError."""
        known = None if self.mirror is None else self.mirror.drives[drive]["run"]
        return known or run_record.read_run_json(self.file(drive, "run.json"))

    @property
    def exists(self) -> bool:
        """Whether there is a map yet."""
        return (self.root / "map.json").exists() if self.mirror is None else self.mirror.exists

    def flush(self) -> None:
        """Upload what was written so far beside drives to a map on an object store; where that fails, later.
        Raises LostRaceError where another writer has changed the same."""
        if self.mirror is not None:
            with suppress(UnreachableError):
                send_rest(self.mirror)

    def names_beside(self, folder: str) -> set[str]:
        """Names in a folder beside drives, as `joins`."""
        found = set(names_in(self.root / folder))
        return found if self.mirror is None else found | self.mirror.names_below(folder)

    def fetch_beside(self, names: Iterable[str]) -> None:
        """Fetch files beside drives that a map on an object store has. Raises ResultError."""
        if self.mirror is not None and (wanted := list(names)):
            self.mirror.rest(wanted)

    def has_beside(self, name: str) -> bool:
        """Whether there is a file beside drives of this name."""
        there = self.mirror is not None and name not in self.mirror.held and name in self.mirror.manifest.now["rest"]
        return there or (self.root / name).is_file()

    def remove_beside(self, name: str) -> None:
        """Remove a file beside drives, or a folder of such."""
        if self.mirror is not None:
            self.mirror.drop(name)
        if (path := self.root / name).is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)

    def drives(self) -> dict[str, dict[str, Any]]:
        """drive.json of every finished drive, by ID in order, but for those that are damaged. Raises NewerError."""
        if self.mirror is not None:
            known = self.mirror.drives
            return {drive: known[drive]["record"] for drive in sorted(known) if drive not in self.damaged}
        removed = set(map(folder_name, self.removed()))
        found = dict[str, dict[str, Any]]()
        for name in names_in(self.root / "runs"):
            if name in removed or not name.startswith("drive="):
                continue
            state, (known, record) = state_of(f"{self.root}/runs/{name}"), self._catalogue.get(name, (None, {}))
            if state is None or state != known:
                folder = self.root / "runs" / name
                if not any((folder / one).exists() for one in ("drive.json", *RUN_TABLES)):
                    continue
                try:
                    record = self._checked_record(folder)
                except NewerError:
                    raise
                except ResultError as error:
                    self.damaged.setdefault(_drive_of(folder), str(error))
                    continue
                self.uncatalogued.add(name)
                if state is not None:
                    self._catalogue[name] = [state, record]
            if record["drive"] not in self.damaged:
                found[record["drive"]] = record
        return dict(sorted(found.items()))

    @cached_property
    def _catalogue(self) -> dict[str, Entry]:
        return read_catalogue(self.root)

    def write_catalogue(self) -> None:
        """Note the drives of a map's folder as they are, for commands to come."""
        there = set(map(folder_name, self.drives()))
        if gone := self._catalogue.keys() - there:
            for name in gone:
                del self._catalogue[name]
        if gone or self.uncatalogued:
            write_catalogue(self.root, self._catalogue)

    def _checked_record(self, folder: Path) -> dict[str, Any]:
        """drive.json of a run folder whose tables are there. Raises ResultError."""
        record = drive_record(folder)
        try:
            damage.check_run_tables(folder, record)
        except ResultError:
            if _identity(folder) is None:
                raise
            record = drive_record(folder)  # of a folder that was replaced meanwhile
            damage.check_run_tables(folder, record)
        return record

    def read(self, drive: str, reader: Callable[[Path], T], names: Iterable[str] = RUN_TABLES) -> T:
        """The result of `reader` on the run folder with these files, all of one state of the drive: it is called again
        where a writer replaced the folder meanwhile. Raises ResultError."""
        folder = self.run(drive, names)
        if self.mirror is not None:
            return reader(folder)  # of one snapshot, always
        for number in range(_TRIES):
            time.sleep(_PAUSE_S * (2**number - 1))
            before = _identity(folder)
            try:
                found = reader(folder)
            except ResultError:
                if before is not None and _identity(folder) == before:
                    with reading_drive(drive):
                        raise
                continue
            if before is not None and _identity(folder) == before:
                return found
        raise ResultError(f"{folder} is being replaced or removed. Run again when that is done.")

    def removed(self) -> list[str]:
        """Drives whose removal is decided and not done yet. Raises ResultError."""
        path = self.root / "removed.json"
        drives = run_record.read_run_json(path).get("drives") if path.exists() else []
        if not isinstance(drives, list) or not all(isinstance(drive, str) for drive in drives):
            raise ResultError(f"{path} is damaged. Move it out of the map: the drives that it named are in it then.")
        return drives

    def write_removed(self, drives: Sequence[str]) -> None:
        """Decide that these drives are removed; none: that this is done."""
        write_changed(self.root / "removed.json", {"drives": list(drives)})
        if not drives:
            with suppress(OSError):
                (self.root / "removed.json").unlink()

    def failures(self) -> dict[str, dict[str, Any]]:
        """Log and error of each drive that failed when it was last tried, by ID; none where the record is damaged."""
        return self.failures_or_damage()[0]

    def failures_or_damage(self) -> tuple[dict[str, dict[str, Any]], str]:
        """`failures`, and why it is not known what failed; empty where it is."""
        if self.mirror is not None:
            return self.mirror.manifest.now["failures"], ""
        path = self.root / "failures.json"
        try:
            found = run_record.read_run_json(path) if path.exists() else {}
        except NewerError:
            raise
        except ResultError:
            found = {"": {}}
        if any(not isinstance(one, dict) or not isinstance(one.get("error"), str) for one in found.values()):
            return {}, f"{path} is damaged, so it is not known what failed. The next batch writes it again."
        return found, ""

    def head(self) -> Head:
        """map.json. Raises ResultError where the folder is no map, or one of another version."""
        if self.mirror is not None and self.exists:
            return Head(self.mirror.manifest.now["library"], self.mirror.manifest.now["settings"])
        path = self.root / "map.json"
        if not path.is_file():
            if (self.root / "run.json").is_file():
                raise ResultError(f"{self} is the folder of one run, not a map. Make one: vplog batch LOG... -o MAP")
            if self.root.is_file():
                raise ResultError(f"{self} is a file, not a map. Make one: vplog batch LOG... -o MAP")
            wrong = f"{self} is not a map: it has no map.json.{nearest_path(self.root)}"
            raise ResultError(f"{wrong} Make one: vplog batch LOG... -o {self}")
        record = run_record.read_run_json(path)
        check_version(path, record.get("format"), FORMAT, record.get("vplog"))
        library, settings = record.get("library"), record.get("settings")
        known = library is None or (isinstance(library, str) and HASH.fullmatch(library))
        if not known or not isinstance(settings, dict):
            raise ResultError(f"{path} lacks a valid library or settings. Write it again: vplog batch LOG -o {self}")
        return Head(library, settings)

    def recovered_head(self) -> Head:
        """`head`; where map.json is damaged, the library and settings that all drives have in common. Raises
        ResultError where they have none."""
        try:
            return self.head()
        except NewerError:
            raise
        except ResultError:
            if self.mirror is not None or not (self.root / "map.json").is_file():
                raise
            drives = self.drives()
            found = [run_record.read_run_json(self.run(drive) / "run.json").get("settings") for drive in drives]
            libraries = {about["library"] for about in drives.values()}
            if len(libraries) != 1 or not isinstance(found[0], dict) or any(one != found[0] for one in found):
                raise
            return Head(libraries.pop(), found[0])

    def write_head(self, head: Head) -> None:
        """Write map.json, unless it holds that already."""
        if self.mirror is not None:
            if not self.exists or self.head() != head:
                write_head(self.mirror, head.library, head.settings)
            return
        record = {"format": FORMAT, "vplog": __version__, "library": head.library, "settings": head.settings}
        write_changed(self.root / "map.json", record)  # a finished map is not touched

    def update_failures(self, changes: dict[str, dict[str, Any] | None]) -> None:
        """Note why drives failed; None: that they did not."""
        if self.mirror is not None:
            update_failures(self.mirror, changes)
            return
        known = self.failures() | changes
        if known or (self.root / "failures.json").exists():
            failures = {drive: known[drive] for drive in sorted(known) if known[drive] is not None}
            write_changed(self.root / "failures.json", failures)


def skip_damaged(store: Store, work: Callable[[], T]) -> T:
    """The result of `work` on a map, which is called again without each drive that it finds damaged."""
    while True:
        try:
            return work()
        except DamagedDriveError as error:
            if error.drive in store.damaged:
                raise
            store.damaged[error.drive] = str(error)


def damage_warnings(store: Store) -> list[str]:
    """A warning for each damaged drive of a map, with the remedy that fits a map."""
    why = "" if store.mirror is None else store.mirror.rest_damage
    dropped = f"{why}: the joint graphs are dropped. Join the drives again: vplog map join {store}"
    return [dropped] * bool(why) + [
        f"{drive} is damaged and left out: {why.partition('. ')[0].rstrip('.')}. "
        f"Compute it again from its log: vplog batch LOG -o {store}"
        for drive, why in sorted(store.damaged.items())
    ]


def library_mismatch(store: Store, drive: str, found: str, wanted: str | None) -> str:
    """Why a drive's places may not be mixed with those of the map, in one line."""
    return (
        f"{drive} in {store} was described with library {found[:12]}, and the map's is {str(wanted)[:12]}: their "
        f"places do not compare. Describe it with that library too: add its log with `vplog batch`."
    )


def common_library(store: Store) -> tuple[str, dict[str, dict[str, Any]]]:
    """The library of a map, and its drives, all described with it. Raises LibraryError where one is not, and
    ResultError where there is none."""
    head, drives = store.head(), store.drives()
    if head.library is None or not drives:
        raise ResultError(f"{store} has no finished drive yet. Add some: vplog batch LOG... -o {store}")
    for drive, about in drives.items():
        if about["library"] != head.library:
            raise LibraryError(library_mismatch(store, drive, about["library"], head.library))
    return head.library, drives


def _drive_of(folder: Path) -> str:
    """The drive of a damaged run folder: by its drive.json, else by its name."""
    try:
        return str(drive_record(folder)["drive"])
    except ResultError:
        return unquote(folder.name.removeprefix("drive="))


def _identity(run: Path) -> tuple[int, int, int] | None:
    """Identity of the folder that has the name now; None where there is none."""
    try:
        found = (run / "drive.json").stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_mtime_ns
