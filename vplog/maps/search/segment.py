"""A part of a map's index in one file: the inverted lists of some drives, read in place by any number of processes.

    8 bytes      magic
    8 bytes      length of the header, little endian
    header       JSON: format, library, block, references, windows, entries, and the drives with their places
    arrays       those of `CodeLists`, little endian, each from a multiple of 64 bytes on; zeros between
    4 bytes      CRC-32 of all before, little endian: it is summed up at 2.6 GB/s, sha256 at an eighth of that

The header has the size of every array, and a file of another length than follows from it is refused. It is named by the
hash of its header: drives of the same content make the same file under the same name.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from vplog.data import Bytes, Ints
from vplog.errors import ResultError
from vplog.places.code_search import MOST_ROWS, CodeLists, check_lists
from vplog.storage.json_records import canonical_json
from vplog.storage.parquet_limits import check_file
from vplog.storage.scratch import replacing

SUFFIX = ".lists"
_MAGIC = b"vplists\n"
_CRC_BYTES = 4
_ALIGNED = 64
"""Bytes; a line of the cache, and more than any number needs."""
_MOST_PLACES = 2**31 - 1
"""A row has 31 bits."""


@dataclass(frozen=True, order=True)
class Content:
    """A drive of a segment, as it was when its places were read."""

    drive: str
    key: str
    """Key in drive.json: hash of all that the drive was made from."""
    mark: str
    """sha256 of its descriptors.parquet by drive.json or the manifest, which differs between tables even where the key
    is the same."""


@dataclass(frozen=True, eq=False)
class Segment:
    """Places of some drives, in the order of `contents`."""

    library: str
    contents: tuple[Content, ...]
    first: Ints
    """(D + 1,) row of each drive's first place, and the number of all."""
    lists: CodeLists

    def __len__(self) -> int:
        return len(self.lists)

    @property
    def header(self) -> bytes:
        places = np.diff(self.first).tolist()
        record = {
            "format": 2,
            "library": self.library,
            "block": self.lists.block,
            "references": self.lists.start.shape[0],
            "windows": self.lists.boxes.shape[1],
            "entries": len(self.lists.offset),
            "drives": [{**asdict(one), "places": count} for one, count in zip(self.contents, places, strict=True)],
        }
        return canonical_json(record).encode()

    @property
    def name(self) -> str:
        return hashlib.sha256(self.header).hexdigest()[:32] + SUFFIX


def write_segment(folder: Path, segment: Segment) -> Path:
    """Write a segment under its name, whole or not at all. Raises ResultError where the folder cannot be written."""
    path = folder / segment.name
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise ResultError(f"Cannot write {path}: it is a link, a folder or a pipe, and a file is written there.")
    with replacing(path, parents=True) as stream:
        total = 0
        for block in _blocks(segment):
            total = zlib.crc32(block, total)
            stream.write(block)
        stream.write(total.to_bytes(_CRC_BYTES, "little"))
    return path


def _blocks(segment: Segment) -> Iterator[bytes | memoryview]:
    """The bytes of its file, but for the checksum."""
    header = segment.header
    yield (start := _MAGIC + len(header).to_bytes(8, "little") + header)
    at = len(start)
    for part in segment.lists.parts:
        yield bytes(-at % _ALIGNED)
        at += -at % _ALIGNED
        if part.size:  # an array of none has no bytes to look at
            yield (data := np.ascontiguousarray(part, part.dtype.newbyteorder("<")).data.cast("B"))
            at += len(data)


class _Drive(BaseModel, strict=True):
    drive: str
    key: str
    mark: str
    places: Annotated[int, Field(ge=0, le=_MOST_PLACES)]


class _Header(BaseModel, strict=True):
    format: Literal[2]
    library: str
    block: Annotated[int, Field(gt=0, le=MOST_ROWS)]
    references: Annotated[int, Field(ge=0, le=65_535)]
    """A reference's number has 16 bits, and the last one is none."""
    windows: Annotated[int, Field(ge=0, le=256)]
    """16 windows along each side, as the settings have it."""
    entries: Annotated[int, Field(ge=0, le=2**48)]
    drives: list[_Drive]


def open_segment(path: Path) -> Segment:
    """A segment whose arrays stay in the file, which is read through once for its checksum.

    The file may be anyone's: sizes are held to that of the file, and indices to their ranges. Raises ResultError where
    it is no segment, a damaged one or of another version, and FileNotFoundError where it is gone.
    """
    try:
        check_file(path)
        with path.open("rb") as stream:
            if not stream.read(1):
                raise ResultError("It is not a part of an index.")
            return _parsed(np.asarray(np.memmap(stream, np.uint8, "r")))
    except FileNotFoundError:
        raise
    except OSError as error:
        raise ResultError(f"{path} cannot be read: {error.strerror or error}.") from None
    except ResultError as error:
        what = f"{path} is damaged, or of another version of vplog. {error}"
        raise ResultError(f"{what} Remove it: the next query builds it again.") from None


def _parsed(whole: Bytes) -> Segment:
    """The segment in the bytes of a file. Raises ResultError where they are damaged."""
    start = whole[:16].tobytes()
    length = int.from_bytes(start[8:], "little")
    if len(start) < 16 or not start.startswith(_MAGIC) or length > len(whole) - 16:
        raise ResultError("It is not a part of an index.")
    header = _header(whole[16 : 16 + length].tobytes())
    places = [one.places for one in header.drives]
    slices, at = [], 16 + length
    for kind, shape in _shapes(header, sum(places)):
        at += -at % _ALIGNED
        stop = at + np.dtype(kind).itemsize * int(np.prod([int(n) for n in shape], dtype=object))
        slices.append((kind, shape, at, stop))
        at = stop
    if at + _CRC_BYTES != len(whole):
        raise ResultError(f"It has {len(whole)} bytes, and its header claims {at + _CRC_BYTES}.")
    if zlib.crc32(whole[:at].data).to_bytes(_CRC_BYTES, "little") != whole[at:].tobytes():
        raise ResultError("Its checksum does not match.")
    parts = [whole[start:stop].view(kind).reshape(shape) for kind, shape, start, stop in slices]
    lists = CodeLists(*parts, block=header.block)
    check_lists(lists)
    contents = tuple(Content(one.drive, one.key, one.mark) for one in header.drives)
    return Segment(header.library, contents, np.cumsum([0, *places]), lists)


def _header(text: bytes) -> _Header:
    """The header, every value within its limits. Raises ResultError."""
    try:
        return _Header.model_validate_json(text)
    except ValidationError:
        raise ResultError("Its header is not JSON, lacks a value, or has an impossible one.") from None


def _shapes(header: _Header, places: int) -> Sequence[tuple[str, tuple[int, ...]]]:
    """Type and shape of each array, in the order of `CodeLists.parts`."""
    if places > _MOST_PLACES:
        raise ResultError(f"It would hold {places} places, and a row has 31 bits.")
    entries, blocks = header.entries, -(-places // header.block)
    return [
        ("<i8", (header.references, blocks + 1)),
        ("<u2", (entries,)),
        ("u1", (entries,)),
        ("u1", (entries,)),
        ("u1", (entries, header.windows)),
        ("<u4", (places,)),
    ]
