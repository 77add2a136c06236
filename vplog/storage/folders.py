"""Maps, run folders and libraries may come from anyone: they hold regular files, and nothing that leads elsewhere.

A link inside would make vplog copy, send or overwrite a file of its user; a pipe or a device would be waited for. The
folder itself may be a link of its user's own.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from vplog.errors import ResultError

_KINDS = {
    stat.S_IFLNK: "link", stat.S_IFIFO: "pipe", stat.S_IFSOCK: "socket", stat.S_IFCHR: "device", stat.S_IFBLK: "device",
}  # fmt: skip
_LOGS = (b"\x89MCAP0\r\n", b"#ROSBAG V", b"SQLite format 3\0", b"\x28\xb5\x2f\xfd")
"""Magic numbers of recorded drives, zstd's too."""
_PNG = b"\x89PNG\r\n\x1a\n"
_PICTURES = (b"\xff\xd8\xff", b"II*\0", b"MM\0*", b"GIF8", b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51", b"\x1a\x45\xdf\xa3")
"""JPEG, TIFF, GIF, JPEG 2000 and Matroska."""
_BLOCK_BYTES = 512
"""Unit of `st_blocks` (POSIX sys/stat.h leaves it to the system: 512 on Linux and macOS)."""
_BOXES, _RIFF = (b"ftyp", b"moov", b"mdat"), (b"AVI ", b"WEBP")
"""Second four bytes of an ISO base media file (MP4, QuickTime, AVIF, HEIC); third four of a RIFF file."""


def regular_files(folder: Path) -> Iterator[str]:
    """Names of the files in a folder and below it, hidden ones too, in order, relative to it; none where there is no
    such folder. Links are not followed. Raises ResultError at the first link, pipe, socket or device, and at a name
    that no record can hold."""
    try:
        with os.scandir(folder) as found:
            entries = sorted(found, key=lambda entry: entry.name)
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise ResultError(f"Cannot read {folder}: {error.strerror}. Check its permissions.") from None
    for entry in entries:
        if not is_unicode(entry.name):
            raise ResultError(f"{folder / entry.name} has a name that is not UTF-8, which records are. Rename it.")
        if entry.is_dir(follow_symlinks=False):
            yield from (f"{entry.name}/{name}" for name in regular_files(folder / entry.name))
        elif entry.is_file(follow_symlinks=False):
            yield entry.name
        else:
            with suppress(FileNotFoundError):  # deleted meanwhile
                kind = _KINDS.get(stat.S_IFMT(entry.stat(follow_symlinks=False).st_mode), "special file")
                raise ResultError(
                    f"{folder / entry.name} is a {kind}, and maps, runs and libraries hold only files of their own. "
                    "Replace it with a copy of the file."
                )


def disk_bytes(folder: Path) -> int:
    """Return the disk space that a folder and everything below it occupies, as `du` reports it: whole blocks, and each
    file once however many names it has. Links are not followed. Files that are removed meanwhile are left out."""
    blocks = dict[tuple[int, int], int]()
    for path in [folder, *folder.rglob("*")]:
        with suppress(FileNotFoundError):
            found = path.lstat()
            blocks[found.st_dev, found.st_ino] = found.st_blocks
    return _BLOCK_BYTES * sum(blocks.values())


def names_in(folder: Path) -> list[str]:
    """Names in a folder, in order; none where there is no such folder."""
    with suppress(FileNotFoundError, NotADirectoryError):
        return sorted(path.name for path in folder.iterdir())
    return []


def is_unicode(name: str) -> bool:
    """Whether the name of a file is UTF-8: Python has half a character for each byte of any other."""
    return not any("\ud800" <= character <= "\udfff" for character in name)


def numbered(name: str, base: str, taken: Iterable[str]) -> str:
    """The name, or where it is taken `base` with the first free number. Names that differ in case alone are one, as
    on disks of macOS and Windows and on memory cards."""
    number, free, folded = 2, name, {one.casefold() for one in taken}
    while free.casefold() in folded:
        free, number = f"{base}-{number}", number + 1
    return free


def is_below(name: object) -> bool:
    """Whether a name that a record has is that of something below its folder."""
    return isinstance(name, str) and not {"", ".", ".."} & {*name.split("/")} and not {"\\", "\0"} & {*name}


def check_replaceable(path: Path) -> None:
    """Raises ResultError where a file to write is a recorded log, which nothing brings back."""
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(max(map(len, _LOGS)))
        if head.startswith(_LOGS):
            raise ResultError(f"{path} is a recorded log, which is not replaced. Name another file.")


def check_no_picture(path: Path) -> None:
    """Raises ResultError where a file to write is a photograph or a video, which may be a frame of a drive: PNG, which
    vplog writes itself, by its other ending."""
    with path.open("rb") as file:
        head = file.read(12)
    starts = head.startswith(_PICTURES) or head[4:8] in _BOXES or (head[:4] == b"RIFF" and head[8:] in _RIFF)
    if starts or (head.startswith(_PNG) and path.suffix.lower() != ".png"):
        raise ResultError(f"{path} is a picture or a video, which is not replaced. Name another file.")


def check_regular(folder: Path, record: str = "") -> None:
    """Raises ResultError where something in a folder or below it is neither a regular file nor a folder; with the name
    of a record only where that is there: what is no map may be a home folder."""
    if os.path.lexists(folder / record):
        for _ in regular_files(folder):
            pass
