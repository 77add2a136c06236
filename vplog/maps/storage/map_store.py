"""A map: finished drives that appear whole, described with one library, read by anyone at any time.

    MAP/map.json                               format, library, settings
    MAP/libraries/HASH/                        the references that all places are described with
    MAP/runs/drive=ID/                         the run folder of a drive, with drive.json: what it was made from
    MAP/keyframes/drive=ID/keyframes.parquet   its tables as data sets, partitioned by drive as DuckDB and Spark have
    MAP/descriptors/... closures/... edges/... trajectory/...   it; hard links to the run folder's files
    MAP/failures.json                          drives that could not be run, each with its error
    MAP/removed.json                           drives that are being removed, while that is not done
    MAP/.drives.json.gz                       drives as the last writer found them (catalogue.py)
    MAP/delta/                                 the data sets as Delta Lake tables, once they are asked for (delta.py)

A drive is in the map when its run folder is: that is one rename (local.py); on an object store, when the newest
snapshot names it (remote_map.py). No byte is stored twice, and both names of a table always show the same bytes, since
every writer here replaces a file and never changes one. Naming drives in removed.json removes them all in one step;
their files are deleted afterwards, by the next writer where this one is killed.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

from vplog.errors import LibraryError, ResultError, SettingsError, VplogError
from vplog.maps.storage import delta, local, upload
from vplog.maps.storage.contents import Head, Store, common_library
from vplog.maps.storage.damage import UnreachableError, damaged_table
from vplog.maps.storage.download_cache import Cache
from vplog.maps.storage.layout import HASH, RUN_TABLES, TABLES, folder_name
from vplog.maps.storage.remote_map import Mirror
from vplog.results import run_record
from vplog.storage.folders import check_regular, regular_files
from vplog.storage.object_store import STORES
from vplog.storage.remote_path import RemotePath, check_writable
from vplog.storage.scratch import put_in_place, scratch

__all__ = ["TABLES", "Head", "Store", "add_library", "common_library", "folder_name", "publish", "reading", "remove"]
__all__ += ["RUN_TABLES", "annotate", "writing"]


@contextmanager
def reading(root: Path, cache: Cache | None = None, as_of: str | None = None) -> Iterator[Store]:
    """A map, local or on an object store, for those who only read it; with a cache, what is read of the latter stays
    there for the next one. The latter also as of a version or a time. Raises ResultError, also where something in it is
    not its own file, and SettingsError where it was not there then."""
    if not isinstance(root, RemotePath):
        if as_of is not None:
            raise SettingsError(f"{root} is a folder, which has no older versions. Leave out --as-of.")
        check_regular(root, "map.json")
        yield Store(root)
        return
    if root.scheme not in STORES:
        raise ResultError(f"{root} is no map: a web server lists no folders. A map is a folder, s3://, gs:// or az://.")
    try:
        with scratch("map", None if cache is None else cache.open_folders) as folder:
            mirror = Mirror(root, folder, cache, as_of=as_of)
            yield Store(folder, mirror)
    finally:
        if cache is not None:
            cache.trim()


@contextmanager
def writing(root: Path, *, there: bool = False) -> Iterator[Store]:
    """The map for a writer, made where it is not there yet; drives that a killed writer had finished are put in.

    A folder has one writer at a time, an object store any number. Raises SettingsError where the folder holds other
    things, or where another process writes, and ResultError, with nothing made, where the map is to be `there` and is
    not.
    """
    if there:
        with reading(root) as store:
            store.head()
    if isinstance(root, RemotePath):
        with _writing_remote(root) as store:
            yield store
        return
    with local.locked(root):
        store = Store(root)
        _finish_removals(store)
        local.recover(store)
        yield store
        shutil.rmtree(store.staging, ignore_errors=True)
        store.write_catalogue()
        follow_with_delta(store)


@contextmanager
def _writing_remote(root: RemotePath) -> Iterator[Store]:
    check_writable(root)
    with scratch("map") as folder:
        try:
            mirror = Mirror(root, folder, writable=True)
            upload.begin(mirror)
        except UnreachableError as error:
            raise SettingsError(f"{error} Choose another place with -o.") from None
        store = Store(folder, mirror)
        store.staging.mkdir()
        try:
            yield store
        except BaseException:  # verified closures stay
            with suppress(VplogError, OSError):
                upload.send_rest(mirror)
            raise
        upload.finish(mirror)
        follow_with_delta(store)


def follow_with_delta(store: Store, patience_s: float = 0.0, *, begin: bool = False, compact: bool = False) -> Any:
    """Bring the Delta tables of a map that is written to up to its drives, where it has some, or is to `begin`; as
    `delta.update`. Raises ResultError."""
    if not begin and not delta.is_present(store):
        return None
    if store.mirror is None:
        return delta.update(store, patience_s, compact=compact)
    with reading(cast("Path", store.mirror.remote)) as newest:  # others write, too
        return delta.update(newest, patience_s, compact=compact)


def publish(store: Store, drive: str, made: Path, sent: upload.SentRun | None = None) -> str:
    """Make a finished run folder, with its drive.json, the drive's, in place of the one it may have; its georeference
    is added to drive.json. One that was `sent` to a map on a store need not be here. Returns the ID of the drive in the
    map: another one where another writer has meanwhile put another drive of that ID into a map on a store. Raises
    ResultError; then the map has the drive as before.
    """
    store.damaged.pop(drive, None)
    if store.mirror is None:
        local.publish(store, drive, made)
    else:
        sent = sent or upload.send_run(store.mirror.remote, made, time.time())
        drive = upload.publish(store.mirror, drive, sent, made)
    with suppress(ResultError):  # the drive is in the map; the tables follow at the writer's end
        follow_with_delta(store, delta.PATIENCE_S)
    return drive


def annotate(store: Store, drive: str, about: dict[str, Any]) -> None:
    """Note fields of drive.json that nothing else of the drive depends on (`layout.ABOUT`), if they are others now.
    Raises ResultError."""
    record = store.record(drive)
    if {**record, **about} == record:
        return
    if store.mirror is None:
        path = store.root / "runs" / folder_name(drive) / "drive.json"
        run_record.write_run_json(path, {**record, **about})
    else:
        upload.annotate(store.mirror, drive, about)


def remove(store: Store, drives: Sequence[str]) -> None:
    """Take drives out with all that bears their names, and forget their failures: all of them or none, whatever ends
    this. Raises ResultError, which says whether they are out."""
    if store.mirror is not None:
        upload.remove(store.mirror, drives)
        return
    named = f"{', '.join(drives)} {'is' if len(drives) == 1 else 'are'}"
    local.check_removable(store, drives)
    store.write_removed(drives)
    try:
        _finish_removals(store)
    except ResultError as error:
        out = f"{error} {named} removed from {store}; the next command that writes to it deletes the rest of the files."
        # of a drive that failed there is its failure alone
        if all((store.root / "runs" / folder_name(one)).is_dir() or one in store.failures() for one in drives):
            with suppress(ResultError):  # where that cannot be taken back they are out
                store.write_removed([])
                out = f"{error} {named} in {store} as before."
        raise ResultError(out) from None


def _finish_removals(store: Store) -> None:
    """Remove the files of drives whose removal is decided. Raises ResultError; of a folder they are as they were."""
    drives = store.removed()
    if not drives:
        return
    try:
        local.remove_drives(store, drives)
    except OSError as error:
        where = error.filename or store
        raise ResultError(f"Cannot remove {where}: {error.strerror}. Check its permissions.") from None
    if store.failures().keys() & set(drives):
        store.update_failures(dict.fromkeys(drives))
    store.write_removed([])


def add_library(store: Store, made: Path, digest: str) -> Path:
    """Make a folder in staging the library of this hash; it stays as it is where the map has it."""
    if not HASH.fullmatch(digest):
        raise LibraryError(f"{made} has no valid hash ({digest[:20]!r}). Build it again: vplog library")
    for name in regular_files(made):
        if name.endswith(".parquet") and damaged_table(made / name):
            raise LibraryError(
                f"{name} of library {digest[:12]} is damaged, so it is not put into {store}. Copy it back first."
            )
    folder = store.library(digest)
    try:
        folder.parent.mkdir(exist_ok=True)
        if not folder.exists():
            put_in_place(made, folder)
    except OSError as error:
        raise ResultError(f"Cannot put the library into {store}: {error.strerror}.") from None
    if store.mirror is not None:
        upload.send_library(store.mirror, digest)
    return folder
