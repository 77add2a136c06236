"""A file appears whole or not at all."""

from __future__ import annotations

import os
from contextlib import contextmanager
from typing import TYPE_CHECKING, BinaryIO

from vplog.errors import ResultError
from vplog.scratch import put_in_place

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A binary stream that becomes `path` when the block ends well; what was there before stays until then.

    The bytes go to a hidden file beside it (a rename is atomic only within one file system), are synced, then
    renamed. A link stays one: what it points to is replaced. A device or a pipe is written into, as renaming would put
    a file in its place. Raises ResultError where the folder cannot be written or the disk is full; nothing is left
    behind.
    """
    if not path.name:
        raise ResultError("The name of a file to write is empty. Give one with -o.")
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            with path.open("wb") as stream:
                yield stream
            return
        path = path.resolve() if path.is_symlink() else path
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            with part.open("wb") as stream:
                yield stream
            put_in_place(part, path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or str(error).splitlines()[0]
        raise ResultError(f"Cannot write {path}: {reason}. Free space or choose another folder with -o.") from None
