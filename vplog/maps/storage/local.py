"""Drives put into and taken out of a map's folder, each by one rename."""

from __future__ import annotations

import ctypes
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from vplog.errors import ResultError, SettingsError
from vplog.maps.storage.contents import Store
from vplog.maps.storage.damage import complete_record
from vplog.maps.storage.layout import ADD_AGAIN, TABLES, drive_record, folder_name, sha256_of
from vplog.results import staging
from vplog.storage.folders import check_regular, regular_files
from vplog.storage.scratch import replacing, sync, sync_all

_HERE, _EXCHANGE = -100, 2
"""AT_FDCWD and RENAME_EXCHANGE of renameat2(2)."""


@contextmanager
def locked(root: Path) -> Iterator[None]:
    """The folder for one writer, made where it is not there; the lock goes with the process that holds it."""
    if root.is_dir() and not os.path.lexists(root / "map.json"):
        others = [path.name for path in root.iterdir() if not path.name.startswith(".")]
        if others:
            raise SettingsError(f"{root} holds other things ({others[0]}), not a map. Choose another folder with -o.")
    check_regular(root)
    with staging.locked(root, name=".lock", needed=True):
        try:
            yield
        finally:
            if not (root / "map.json").exists():  # nothing came of it
                shutil.rmtree(root / ".staging", ignore_errors=True)


def recover(store: Store) -> None:
    """Put in what a killed writer had finished: a folder with drive.json, which is written last. Drives that are being
    removed are taken out first, so what is left of them here is tables without a run folder."""
    for file in sorted(store.staging.glob("*/drive.json")):
        try:
            drive = drive_record(file.parent)["drive"]
        except ResultError:
            continue
        if all((file.parent / f"{name}.parquet").is_file() for name in TABLES) and not store.run(drive).exists():
            publish(store, drive, file.parent)
    shutil.rmtree(store.staging, ignore_errors=True)
    store.staging.mkdir(parents=True, exist_ok=True)
    for name in TABLES:
        for left in store.root.glob(f"{name}/drive=*"):
            if not (store.root / "runs" / left.name).exists():
                shutil.rmtree(left, ignore_errors=True)
    for drive in store.drives():
        try:
            link_tables(store, drive, folder_name(drive) not in store.uncatalogued)
        except ResultError as error:
            store.damaged[drive] = str(error)


def publish(store: Store, drive: str, made: Path) -> None:
    """Make a finished run folder the drive's, in place of the one it may have, and link its tables.

    A reader finds the old folder or the new one: they change places in one step where the system can (Linux, on all
    its usual file systems), else there is neither for a moment.
    """
    complete_record(made, hashed=True)
    run, replaced = store.run(drive), store.staging / f"replaced-{os.getpid()}"
    try:
        run.parent.mkdir(exist_ok=True)
        shutil.rmtree(replaced, ignore_errors=True)
        sync_all(made)
        if not run.exists():
            made.rename(run)
        elif exchange_folders(made, run):
            made.rename(replaced)
        else:
            run.rename(replaced)
            (replaced / "drive.json").unlink(missing_ok=True)  # so that no writer takes it for a new one
            made.rename(run)
        sync(run.parent)
    except OSError as error:
        raise ResultError(f"Cannot put {drive} into {store.root}: {error.strerror}.") from None
    shutil.rmtree(replaced, ignore_errors=True)
    try:
        link_tables(store, drive)
    except ResultError:  # the drive is in the map; the next writer links its tables, of which none stays as it was
        for name in TABLES:
            shutil.rmtree(store.root / name / folder_name(drive), ignore_errors=True)


def exchange_folders(one: Path, other: Path) -> bool:
    """Let two folders change their names in one step; False where the system cannot."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    return rename is not None and rename(_HERE, os.fsencode(one), _HERE, os.fsencode(other), _EXCHANGE) == 0


def link_tables(store: Store, drive: str, catalogued: bool = False) -> None:
    """Link each table of the run folder into its data set, MAP/NAME/drive=ID; a copy where there are no hard links,
    which of a drive that is `catalogued`, so was linked before, is not read again."""
    for name in TABLES:
        source = store.run(drive) / f"{name}.parquet"
        path = store.root / name / folder_name(drive) / source.name
        with suppress(OSError):  # they are not both there
            if path.samefile(source):
                continue
            alike = path.stat().st_size == source.stat().st_size  # copies, on a file system without links
            if alike and (catalogued or sha256_of(path) == sha256_of(source)):
                continue
        if not source.is_file():
            raise ResultError(f"{source} is not there. Copy it back, or {ADD_AGAIN}")
        part = store.staging / f"{name}-{os.getpid()}.parquet"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            part.unlink(missing_ok=True)
            os.link(source, part)
            part.replace(path)
        except OSError:  # no hard links here; any other error is raised by the copy
            with replacing(path, parents=True) as stream, source.open("rb") as whole:
                shutil.copyfileobj(whole, stream)


def check_removable(store: Store, drives: Sequence[str]) -> None:
    """Raises ResultError where this user may not remove a folder of these drives."""
    for path in [folder for drive in drives for folder in store.root.glob(f"*/{folder_name(drive)}")]:
        below = {above for name in regular_files(path) for above in PurePosixPath(name).parents}
        for folder in [path.parent, path, *(path / above for above in below)]:
            if not os.access(folder, os.W_OK | os.X_OK):
                raise ResultError(
                    f"Cannot remove {', '.join(drives)} from {store}: no permission to change {folder}. The map is as "
                    "it was. Ask the owner of that folder for the permission, or let the owner remove the drive."
                )


def remove_drives(store: Store, drives: Sequence[str]) -> None:
    """Rename the run folders of drives out of the data set, all or none, then remove them and all that bears their
    names. Raises OSError; the drives are as they were where that is at a rename."""
    moved: list[tuple[Path, Path]] = []
    try:
        for number, drive in enumerate(drives):
            run, gone = store.root / "runs" / folder_name(drive), store.staging / f"gone-{os.getpid()}-{number}"
            if run.exists():
                gone.parent.mkdir(parents=True, exist_ok=True)
                run.rename(gone)
                moved.append((run, gone))
    except OSError:
        for run, gone in moved:
            gone.rename(run)
        raise
    for folder in store.staging.glob("gone-*"):  # those of a writer that was killed, too
        shutil.rmtree(folder)
    for drive in drives:
        for folder in store.root.glob(f"*/{folder_name(drive)}"):  # its cache, too
            shutil.rmtree(folder)
