"""A map: finished drives that appear whole, described with one library, read by anyone at any time.

    MAP/map.json                               format, library, settings
    MAP/libraries/HASH/                        the references that all places are described with
    MAP/runs/drive=ID/                         the run folder of a drive, with drive.json: what it was made from
    MAP/keyframes/drive=ID/keyframes.parquet   its tables as data sets, partitioned by drive as DuckDB and Spark have
    MAP/descriptors/... closures/... edges/... trajectory/...   it; hard links to the run folder's files
    MAP/failures.json                          drives that could not be run, each with its error
    MAP/removed.json                           drives that are being removed, while that is not done

A drive is in the map when its run folder is: that is one rename (local.py); on an object store, when its manifest is
(mirror.py). Its tables are links: no byte is stored twice, both names always show the same bytes (every writer here
replaces a file and never changes one), and one look at the inode tells whether a link is missing. Drives are removed
by naming them in removed.json, one step that decides for all of them; then their files go, by the next writer where
this one is killed.
"""

from __future__ import annotations

import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import unquote

import pyarrow as pa

import vplog
from vplog.errors import LibraryError, NewerError, ResultError, VplogError
from vplog.folders import check_regular, regular_files
from vplog.maps import local
from vplog.maps.damage import check_at_hand, hashes_of, reading_drive
from vplog.maps.earth import earth_from_plain, earth_of_made, earth_of_run
from vplog.maps.layout import ADD_AGAIN, AT_HAND, FORMAT, HASH, TABLES, drive_record, folder_name
from vplog.parquet_bounds import check_version, read_footer
from vplog.remote import RemotePath, check_writable
from vplog.results import run_record
from vplog.scratch import files_in, put_in_place, scratch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from vplog.maps.cache import Cache
    from vplog.maps.mirror import Mirror
    from vplog.results.shown import Earth

    T = TypeVar("T")

__all__ = [
    "TABLES", "Head", "Store", "add_library", "folder_name", "one_library", "other_library", "publish", "reading",
    "remove", "row_count", "writing",
]  # fmt: skip

_TRIES, _PAUSE_S = 6, 0.02
"""A drive is read again where it was replaced while it was read, after a pause that doubles: 1.3 s in all. A batch
replaces each once, and a rename takes less than a millisecond."""


@dataclass(frozen=True)
class Head:
    """map.json."""

    library: str | None
    """Hash of the library; None before there is one."""
    settings: dict[str, Any]
    """Every setting of the last batch."""


@dataclass(frozen=True)
class Store:
    """The names in a map. Of one on an object store `root` is a local folder, where `run`, `table` and `library` put
    what they are asked for."""

    root: Path
    mirror: Mirror | None = None
    """None for a map that is a folder."""
    damaged: dict[str, str] = field(default_factory=dict)
    """Drives that `drives` leaves out, and why."""

    def __str__(self) -> str:
        """As its user calls it."""
        return str(self.root if self.mirror is None else self.mirror.remote)

    @property
    def index(self) -> Path:
        """Where its index is; of a map on an object store that of the reader alone, in the cache if there is one."""
        if self.mirror is not None and self.mirror.cache is not None:
            return self.mirror.cache.index_of(self.mirror.remote)
        return self.root / "index"

    @property
    def staging(self) -> Path:
        """Where a writer makes what it renames in; hidden, on the same file system."""
        return self.root / ".staging"

    def run(self, drive: str) -> Path:
        """The run folder; of a map on a store with its tables and run.json alone (`whole` has the rest)."""
        if self.mirror is not None:
            self.mirror.fetch(drive, AT_HAND)
        return self.root / "runs" / folder_name(drive)

    def file(self, drive: str, name: str) -> Path:
        """One file of the run folder, where it has one of this name."""
        if self.mirror is not None:
            self.mirror.fetch(drive, [name])
        return self.root / "runs" / folder_name(drive) / name

    def whole(self, drive: str) -> Path:
        """The run folder with all that is in it."""
        if self.mirror is not None:
            self.mirror.fetch(drive, self.sizes(drive))
        return self.root / "runs" / folder_name(drive)

    def forget(self, drive: str) -> None:
        """Of a map on a store, free the disk of what was asked for of a drive."""
        if self.mirror is not None:
            self.mirror.forget(drive)

    def table(self, name: str, drive: str) -> Path:
        """One table of a drive, under its data set; of a map on a store, in the run folder."""
        if self.mirror is not None:
            return self.file(drive, f"{name}.parquet")
        return self.root / name / folder_name(drive) / f"{name}.parquet"

    def library(self, digest: str) -> Path:
        if self.mirror is not None:
            self.mirror.library(digest)
        return self.root / "libraries" / digest

    def sizes(self, drive: str) -> dict[str, int]:
        """Bytes of each file of a run folder, by name."""
        if self.mirror is not None:
            return {name: about["bytes"] for name, about in self.mirror.manifests[drive]["files"].items()}
        run = self.run(drive)
        return {name: (run / name).lstat().st_size for name in regular_files(run)}

    def is_whole(self, drive: str) -> bool:
        """Whether all of a drive is where it was, though its removal may be decided. Of one that failed nothing is."""
        if self.mirror is None:
            return (self.root / "runs" / folder_name(drive)).is_dir() or drive in self.failures()
        return drive in self.mirror.manifests or drive in self.failures()

    def rows(self, name: str, drive: str) -> int:
        """Rows of a table of a drive, by its footer. Raises DamagedDriveError."""
        if self.mirror is not None:
            return int(self.mirror.manifests[drive]["files"].get(f"{name}.parquet", {}).get("rows", 0))
        with reading_drive(drive):
            return row_count(self.run(drive) / f"{name}.parquet")

    def earth(self, drive: str) -> Earth | None:
        """Where on earth a drive is, None where nothing says so. Raises DamagedDriveError."""
        with reading_drive(drive):
            about = drive_record(self.root / "runs" / folder_name(drive))
            return earth_from_plain(about["earth"]) if "earth" in about else earth_of_run(self.whole(drive))

    def keep(self) -> None:
        """Of a map on an object store, send what was made so far beside drives; a folder has it already. Where that
        fails it is sent another time; raises SettingsError where another writer has the map now."""
        if self.mirror is not None:
            from vplog.maps.sending import send_rest

            if self.mirror.lock is not None:
                self.mirror.lock.check()
            with suppress(ResultError):
                send_rest(self.mirror)

    def drives(self) -> dict[str, dict[str, Any]]:
        """drive.json of every finished drive, by ID in order, but for those that are damaged. Raises NewerError."""
        removed = set(map(folder_name, self.removed()))
        found = dict[str, dict[str, Any]]()
        for folder in sorted(self.root.glob("runs/drive=*")):
            if folder.name in removed or not (folder / "drive.json").is_file():
                continue
            try:
                record = self._sound_record(folder)
            except NewerError:
                raise
            except ResultError as error:
                self.damaged.setdefault(_drive_of(folder), str(error))
            else:
                if record["drive"] not in self.damaged:
                    found[record["drive"]] = record
        return dict(sorted(found.items()))

    def _sound_record(self, folder: Path) -> dict[str, Any]:
        """drive.json of a run folder whose tables are there. Raises ResultError."""
        record = drive_record(folder)
        if self.mirror is None:
            try:
                check_at_hand(folder, record)
            except ResultError:
                if _identity(folder) is None:
                    raise
                record = drive_record(folder)  # of a folder that was replaced meanwhile
                check_at_hand(folder, record)
        return record

    def read(self, drive: str, of: Callable[[Path], T], names: Iterable[str] = AT_HAND) -> T:
        """What a function makes of these files of the run folder, all of one state of the drive: of the folder that a
        writer put in place of another meanwhile, it is asked again. Raises ResultError."""
        folder = self.root / "runs" / folder_name(drive)
        if self.mirror is not None:
            self.mirror.fetch(drive, names)
            return of(folder)  # of one generation, always
        for number in range(_TRIES):
            time.sleep(_PAUSE_S * (2**number - 1))
            before = _identity(folder)
            try:
                found = of(folder)
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
            raise ResultError(f"{path} is damaged. Move it away: the drives that it named are in the map then.")
        return drives

    def write_removed(self, drives: Sequence[str]) -> None:
        """Decide that these drives are removed; none: that this is done."""
        self._write("removed.json", {"drives": list(drives)})
        if not drives:
            with suppress(OSError):
                (self.root / "removed.json").unlink()

    def failures(self) -> dict[str, dict[str, Any]]:
        """Log and error of each drive that failed when it was last tried, by ID."""
        path = self.root / "failures.json"
        found = run_record.read_run_json(path) if path.exists() else {}
        if any(not isinstance(told, dict) or not isinstance(told.get("error"), str) for told in found.values()):
            raise ResultError(f"{path} is damaged. Move it away: the next batch tries what failed again.")
        return found

    def head(self) -> Head:
        """map.json. Raises ResultError where the folder is no map, or one of another version."""
        path = self.root / "map.json"
        if not path.is_file():
            if (self.root / "run.json").is_file():
                raise ResultError(f"{self} is the folder of one run, not a map. Make one: vplog batch LOG... -o MAP")
            raise ResultError(f"{self} is not a map: it has no map.json. Make one: vplog batch LOG... -o {self}")
        record = run_record.read_run_json(path)
        check_version(path, record.get("format"), FORMAT, record.get("vplog"))
        library, settings = record.get("library"), record.get("settings")
        known = library is None or (isinstance(library, str) and HASH.fullmatch(library))
        if not known or not isinstance(settings, dict):
            raise ResultError(f"{path} lacks a valid library or settings. Run `vplog batch` again.")
        return Head(library, settings)

    def write_head(self, head: Head) -> None:
        """map.json, unless it says that already."""
        record = {"format": FORMAT, "vplog": vplog.__version__, "library": head.library, "settings": head.settings}
        self._write("map.json", record)

    def write_failures(self, failures: dict[str, dict[str, Any]]) -> None:
        self._write("failures.json", dict(sorted(failures.items())))

    def _write(self, name: str, record: dict[str, Any]) -> None:
        """Write JSON, or leave the file as it is where it holds the same: a finished map is not touched."""
        path = self.root / name
        if path.is_file() and run_record.read_run_json(path) == run_record.plain(record):
            return
        run_record.write_run_json(path, record, checksum=name != "failures.json")  # whose keys are drives
        if self.mirror is not None:
            from vplog.maps.sending import write_json

            write_json(self.mirror, name)


@contextmanager
def reading(root: Path, cache: Cache | None = None) -> Iterator[Store]:
    """A map, local or on an object store, for those who only read it; with a cache, what is read of the latter stays
    there for the next one. Raises ResultError, also where something in it is not its own file."""
    if not isinstance(root, RemotePath):
        check_regular(root, "map.json")
        yield Store(root)
        return
    from vplog.maps.mirror import Mirror

    if root.scheme not in ("s3", "gs"):
        raise ResultError(f"{root} is no map: a web server lists no folders. A map is a folder, s3:// or gs://.")
    try:
        with scratch("map", None if cache is None else cache.open_folders) as folder:
            yield Store(folder, Mirror(root, folder, cache=cache))
    finally:
        if cache is not None:
            cache.trim()


@contextmanager
def writing(root: Path) -> Iterator[Store]:
    """The map for one writer, made where it is not there yet.

    What a writer that was killed had finished is put in; what it had not is removed. Raises SettingsError where the
    folder holds other things, or where another process writes.
    """
    if isinstance(root, RemotePath):
        with _writing_remote(root) as store:
            yield store
        return
    with local.locked(root):
        store = Store(root)
        _sweep(store)
        local.settle(store)
        yield store
        local.clear(store)


@contextmanager
def _writing_remote(root: RemotePath) -> Iterator[Store]:
    from vplog.maps import bucket_lock, sending
    from vplog.maps.mirror import Mirror

    check_writable(root)
    with bucket_lock.held(root) as lock, scratch("map") as folder:
        mirror = Mirror(root, folder, lock)
        store = Store(folder, mirror)
        _sweep(store)
        sending.begin(mirror)
        mirror.rest()
        store.staging.mkdir()
        try:
            yield store
        except BaseException:  # what was verified of closures stays
            with suppress(VplogError, OSError):
                sending.send_rest(mirror)
            raise
        sending.send_rest(mirror)


def publish(store: Store, drive: str, made: Path) -> None:
    """Make a finished run folder, with its drive.json, the drive's, in place of the one it may have. Where it is on
    earth is noted with it. Raises ResultError; then the map has the drive as before.
    """
    about = {**drive_record(made), "format": FORMAT}
    about.pop("files", None)  # of the map that it comes from
    if "earth" not in about:
        about["earth"] = earth_of_made(made)
    store.damaged.pop(drive, None)
    if store.mirror is None:
        about["files"] = hashes_of(made, [name for name in files_in(made) if name != "drive.json"])
    run_record.write_run_json(made / "drive.json", about, checksum=True)
    if store.mirror is None:
        local.publish(store, drive, made)
        return
    from vplog.maps import sending

    sending.publish(store.mirror, drive, made)


def relocate(store: Store, drive: str, log: str) -> None:
    """Note where the log of a drive is now; nothing else of the drive depends on it. Raises ResultError."""
    run = store.root / "runs" / folder_name(drive)
    if store.mirror is None:
        run_record.write_run_json(run / "drive.json", {**drive_record(run), "log": log}, checksum=True)
        return
    from vplog.maps import sending

    sending.relocate(store.mirror, drive, log)


def remove(store: Store, drives: Sequence[str]) -> None:
    """Take drives out with all that bears their names, and forget their failures: all of them or none, whatever ends
    this. Raises ResultError, which says whether they are out."""
    named = f"{', '.join(drives)} {'is' if len(drives) == 1 else 'are'}"
    if store.mirror is None:
        local.check_removable(store, drives)
    store.write_removed(drives)
    try:
        _sweep(store)
    except ResultError as error:
        out = f"{error} {named} out of {store}; the next command that writes to it deletes what is left of the files."
        if all(map(store.is_whole, drives)):
            with suppress(ResultError):  # where that cannot be taken back they are out
                store.write_removed([])
                out = f"{error} {named} in {store} as before."
        raise ResultError(out) from None


def _sweep(store: Store) -> None:
    """Remove the files of drives whose removal is decided. Raises ResultError; of a folder they are as they were."""
    drives = store.removed()
    if not drives:
        return
    if store.mirror is None:
        try:
            local.take_out(store, drives)
        except OSError as error:
            where = error.filename or store
            raise ResultError(f"Cannot remove {where}: {error.strerror}. Check its permissions.") from None
    else:
        from vplog.maps import sending

        for drive in drives:
            sending.remove(store.mirror, drive)
    kept = {drive: told for drive, told in store.failures().items() if drive not in drives}
    if kept != store.failures():
        store.write_failures(kept)
    store.write_removed([])


def add_library(store: Store, made: Path, digest: str) -> Path:
    """Make a folder in staging the library of this hash; it stays as it is where the map has it."""
    if not HASH.fullmatch(digest):
        raise LibraryError(f"{made} has no valid hash ({digest[:20]!r}). Build it again: vplog library")
    folder = store.library(digest)
    try:
        folder.parent.mkdir(exist_ok=True)
        if not folder.exists():
            put_in_place(made, folder)
    except OSError as error:
        raise ResultError(f"Cannot put the library into {store}: {error.strerror}.") from None
    if store.mirror is not None:
        from vplog.maps.sending import send_library

        send_library(store.mirror, digest)
    return folder


def other_library(store: Store, drive: str, found: str, wanted: str | None) -> str:
    """Why a drive's places may not be mixed with those of the map, in one line."""
    return (
        f"{drive} in {store} was described with library {found[:12]}, and the map's is {str(wanted)[:12]}: their "
        f"places do not compare. Describe it with that library too: add its log with `vplog batch`."
    )


def one_library(store: Store) -> tuple[str, dict[str, dict[str, Any]]]:
    """The library of a map, and its drives, all described with it. Raises LibraryError where one is not, and
    ResultError where there is none."""
    head, drives = store.head(), store.drives()
    if head.library is None or not drives:
        raise ResultError(f"{store} has no finished drive yet. Add some: vplog batch LOG... -o {store}")
    for drive, about in drives.items():
        if about["library"] != head.library:
            raise LibraryError(other_library(store, drive, about["library"], head.library))
    return head.library, drives


def row_count(path: Path) -> int:
    """Rows of a table, by its footer. Raises ResultError."""
    try:
        return read_footer(path).num_rows
    except (OSError, ValueError, pa.ArrowException) as error:
        raise ResultError(
            f"{path} cannot be read: {str(error).splitlines()[0]} Check its permissions, or {ADD_AGAIN}"
        ) from None


def _drive_of(folder: Path) -> str:
    """The drive of a damaged run folder: by its drive.json, else by its name."""
    try:
        return str(drive_record(folder)["drive"])
    except ResultError:
        return unquote(folder.name.removeprefix("drive="))


def _identity(run: Path) -> tuple[int, int, int] | None:
    """Of the folder that has the name now; None where there is none."""
    try:
        found = (run / "drive.json").stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino, found.st_mtime_ns
