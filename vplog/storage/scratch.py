"""Temporary folders, files that appear whole or not at all, and folders of files as arrays sent between machines."""

from __future__ import annotations

import fcntl
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

import numpy as np

from vplog.data import Bytes
from vplog.errors import ResultError
from vplog.storage.folders import check_replaceable, is_below, regular_files

_PART = re.compile(r"\d+(-[0-9a-f]{8})?")
"""Number of the process that writes a file, which is not the only one of that number where containers share a disk."""
_PIECE_BYTES = 2**24
"""Bytes of a file sent at once: Ray's smallest store has 75 MiB and needs room for several; 16 MiB take 10 ms to
copy."""


def own_folder() -> Path:
    """This user's folder in the machine's temporary one. Raises ResultError where somebody else has made it."""
    folder = Path(tempfile.gettempdir()) / f"vplog-{os.getuid()}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        about = folder.lstat()
    except OSError as error:
        raise ResultError(f"Cannot make {folder}: {error.strerror}. Set TMPDIR to a folder with room.") from None
    if folder.is_symlink() or about.st_uid != os.getuid():
        raise ResultError(f"{folder} belongs to another user. Set TMPDIR to a folder of your own.")
    return folder


@contextmanager
def scratch(name: str, among: Path | None = None) -> Iterator[Path]:
    """A new folder for the time of the block, among others in the one given, which is there, or in `own_folder`. Those
    of processes that were killed are removed before and after. Raises ResultError."""
    among = among or own_folder()
    _sweep(among)
    try:
        folder = Path(tempfile.mkdtemp(prefix=f"{name}-{os.getpid()}-", dir=among))
        lock = (folder / ".new").open("w")
        fcntl.flock(lock, fcntl.LOCK_EX)
        (folder / ".new").rename(folder / ".lock")
    except OSError as error:
        raise ResultError(f"Cannot make a folder in {among}: {error.strerror}. Make room, or set TMPDIR.") from None
    with lock:  # goes with the process, however that ends
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            _sweep(among)  # a killed process may not have ended when the block began


def _sweep(among: Path) -> None:
    for path in filter(_is_left, among.glob("*/.lock")):
        shutil.rmtree(path.parent, ignore_errors=True)


def _is_left(path: Path) -> bool:
    with suppress(OSError), path.open("r+b") as lock:  # NFS locks what is open for writing alone
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # OSError where its process lives
        return True
    return False


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """A folder, with those above it, for a block; those made for it go again where they are empty at its end. Raises
    OSError where it cannot be made."""
    made = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        with suppress(OSError):  # it holds something
            for one in made:
                one.rmdir()


def copy_folder(folder: Path, target: Path, what: str, **how: Any) -> None:
    """Copy a folder, links as links; `how` is that of copytree. Raises ResultError, in one line, that names `what`."""
    try:
        shutil.copytree(folder, target, symlinks=True, **how)
    except OSError as error:
        shutil.rmtree(target, ignore_errors=True)
        why = str(error.args[0][0][2] if isinstance(error, shutil.Error) else error.strerror or error)
        raise ResultError(f"Cannot copy {what}: {why.rpartition('] ')[2].partition(': ')[0]}.") from None


def check_file_output(path: Path) -> None:
    """Raises ResultError, before any work, where a file to write has no folder or is one."""
    if not path.parent.is_dir():
        raise ResultError(f"Cannot write {path}: there is no folder {path.parent}. Make it, or choose another.")
    if path.is_dir():
        raise ResultError(f"Cannot write {path}: it is a folder. Name a file.")


@contextmanager
def replacing(path: Path, parents: bool = False) -> Iterator[BinaryIO]:
    """A binary stream that becomes `path` when the block ends well; what was there before stays until then. With
    `parents` the folders above it are made.

    The bytes go to a hidden file beside it, are synced, then renamed; such files of processes that were killed are
    removed. A link stays one: what it points to is replaced. A device or a pipe is written into. Raises ResultError
    where the folder cannot be written or the disk is full.
    """
    if not path.name:
        raise ResultError("The name of a file to write is empty. Give one with -o.")
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            with path.open("wb") as stream:
                yield stream
            return
        if parents:
            path.parent.mkdir(parents=True, exist_ok=True)
        path = path.resolve() if path.is_symlink() else path
        check_replaceable(path)
        _sweep_parts(path)
        part = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.part")
        try:
            with part.open("wb") as lock:
                with suppress(OSError):  # a file system without locks
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                with os.fdopen(lock.fileno(), "wb", closefd=False) as stream:  # SMB lets no other descriptor write
                    yield stream
                put_in_place(part, path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or str(error).splitlines()[0]
        raise ResultError(f"Cannot write {path}: {reason}. Free space or choose another folder with -o.") from None


def _sweep_parts(path: Path) -> None:
    begin, end = f".{path.name}.", ".part"
    for part in path.parent.glob(f"{escape(begin)}*{end}"):
        if _PART.fullmatch(part.name[len(begin) : -len(end)]) and _is_left(part):
            part.unlink(missing_ok=True)


def put_in_place(part: Path, path: Path) -> None:
    """Rename a file or a folder with its files to `path`, so that after a power cut what is there is whole: content is
    on the disk before the name is. Raises OSError."""
    sync_all(part)
    part.replace(path)
    sync(path.parent)


def sync_all(path: Path) -> None:
    """Have a file, or a folder with all that is in it, on the disk. Raises OSError."""
    names = list(regular_files(path))
    below = {*names, *(str(above) for name in names for above in PurePosixPath(name).parents), "."}
    for name in sorted(below):
        sync(path / name)


def sync(path: Path) -> None:
    """Have a file, or the names in a folder, on the disk. Raises OSError."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError:
        if not path.is_dir():  # some file systems know no fsync of folders
            raise
    finally:
        os.close(handle)


def files_in(folder: Path) -> list[str]:
    """Names of all files in a folder and below it, in order; without hidden ones."""
    return [name for name in regular_files(folder) if not any(part.startswith(".") for part in name.split("/"))]


def pieces(path: Path) -> Iterator[Bytes]:
    """The bytes of a file, a piece at a time; one empty piece of an empty file."""
    for start in range(0, max(path.stat().st_size, 1), _PIECE_BYTES):
        yield np.fromfile(path, np.uint8, _PIECE_BYTES, offset=start)


def write_pieces(folder: Path, name: str, parts: Iterable[Bytes]) -> None:
    """A file of a folder from its pieces. Raises ResultError."""
    if not is_below(name):
        raise ResultError(f"A worker gave back a file named {name!r}, which is not inside its folder.")
    with replacing(folder / name, parents=True) as stream:
        for part in parts:
            stream.write(part.data)
