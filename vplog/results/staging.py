"""The results in a folder change as a whole: they are written in a staging folder inside it, then committed.

Inside, since a rename is atomic within one file system alone, and since the folder itself may be `.`, a link, a mount
point, or below a folder that cannot be written. The commit is one rename. After it files are moved into place, and what
a killed process has not moved the next one moves (`recover`). Files that are no results stay where they are.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import TextIO

from vplog.errors import ResultError, SettingsError
from vplog.storage.parquet_limits import check_file
from vplog.storage.scratch import files_in, made_folder, put_in_place, replacing

_LOCK, _STAGING, _COMMITTED = ".vplog-lock", ".vplog-staging", ".vplog-committed"
_STALE = ".stale.json"
"""In a committed folder: names of the files that the results before had and these have not."""


@contextmanager
def staged(out: Path, begin: Callable[[], Sequence[str]]) -> Iterator[Path]:
    """A folder whose files become those of `out` when the block ends well; else `out` stays as it was.

    `begin` is called when `out`, which is made where it is not there, has no other writer. It may refuse, and gives
    glob patterns of the results that an earlier writer may have left there. Raises SettingsError or ResultError.
    """
    staging = out / _STAGING
    with locked(out):
        if (out / _COMMITTED).exists():
            _move(out)
        results = begin()
        shutil.rmtree(staging, ignore_errors=True)  # of a process that was killed
        staging.mkdir()
        try:
            yield staging
            _commit(out, results)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
        _move(out)


def check_contents(out: Path, what: str, ours: bool) -> None:
    """Raises SettingsError where a folder, which is there, has files to see and is not `ours`, a `what`."""
    if not ours and any(not file.name.startswith(".") for file in out.iterdir()):
        raise SettingsError(f"{out} is a folder with other things in it, not {what}. Choose another with -o.")


def recover(out: Path) -> None:
    """Finish what a writer of `out`, or of the folder it is in, was killed at: committed results are moved into place.

    Raises VplogError.
    """
    for folder in (out, out.absolute().parent):
        if (folder / _COMMITTED).exists():
            with locked(folder, wait=True):
                if (folder / _COMMITTED).exists():
                    _move(folder)


@contextmanager
def locked(out: Path, wait: bool = False, name: str = _LOCK, needed: bool = False) -> Iterator[None]:
    """`out`, made where it is not there, for one process at a time, on file systems that have locks. Raises
    SettingsError, also where there are none and they are `needed`."""
    path = out / name
    while True:
        with ExitStack() as stack:
            try:
                stack.enter_context(made_folder(out))
                lock = stack.enter_context(path.open("a"))
            except OSError as error:
                what = f"Cannot make the folder {out} or write in it: {error.strerror}."
                raise SettingsError(f"{what} Check its permissions, or choose another.") from None
            if not _has(lock, path, wait, needed):
                continue  # another process had it, and has removed it
            stack.callback(path.unlink, missing_ok=True)
            yield
            return


def _has(lock: TextIO, path: Path, wait: bool, needed: bool) -> bool:
    """Lock an open file; whether it is still the one at `path`. Raises SettingsError where another process holds the
    lock."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        return os.path.samestat(os.fstat(lock.fileno()), path.stat())
    except BlockingIOError:
        raise SettingsError(
            f"Another vplog process is writing to {path.parent}. Wait for it to end, or choose another folder."
        ) from None
    except FileNotFoundError:
        return False
    except OSError as error:  # a file system without locks
        if needed:
            raise SettingsError(f"Cannot lock {path}: {error.strerror}. Choose another folder.") from None
        return True


def _commit(out: Path, results: Sequence[str]) -> None:
    """From here on the staged results are those of `out`."""
    staging = out / _STAGING
    before = {path.relative_to(out).as_posix() for pattern in results for path in out.glob(pattern)}
    with replacing(staging / _STALE) as stream:
        stream.write(json.dumps(sorted(before - set(files_in(staging)))).encode())
    put_in_place(staging, out / _COMMITTED)


def _move(out: Path) -> None:
    """Remove the results that committed ones take the place of, and move these there, run.json last.

    Every step may have been done before. Raises ResultError.
    """
    committed = out / _COMMITTED
    try:
        stale = _stale(committed)
        for name in stale:
            _below(out, name).unlink(missing_ok=True)
        for name in sorted(files_in(committed), key=lambda name: (name == "run.json", name)):
            target = _below(out, name)
            target.parent.mkdir(parents=True, exist_ok=True)
            _below(committed, name).replace(target)
        shutil.rmtree(committed)
        folders = {parent for name in stale for parent in (out / name).parents if out in parent.parents}
        for folder in sorted(folders, reverse=True):
            with suppress(OSError):  # it holds something
                folder.rmdir()
    except OSError as error:
        where = error.filename2 or error.filename
        raise ResultError(
            f"Cannot move the results from {committed} to {out}: {where}: {error.strerror}. They are whole; clear the "
            "way, and give the command again."
        ) from None


def _stale(committed: Path) -> list[str]:
    """Names of results to remove. Raises ResultError where they are no list of names, and OSError."""
    path = committed / _STALE
    if not path.exists():  # all was moved, and the folder on its way out
        return []
    check_file(path)
    try:
        names = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError):
        names = None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ResultError(f"{path} is not a list of names, so vplog did not write it. Move {committed} out of the way.")
    return names


def _below(folder: Path, name: str) -> Path:
    """A file below a folder. Raises ResultError where a name or a link leads out of it: it may come from a stranger."""
    path = folder / name
    inside = ".." not in PurePosixPath(name).parts and path.parent.resolve().is_relative_to(folder.resolve())
    if not inside or (folder.name == _COMMITTED and folder.is_symlink()):
        raise ResultError(f"{path} leads out of {folder}, so vplog did not write it. Move {folder} out of the way.")
    return path
