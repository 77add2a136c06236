"""Where the chunks of a ROS 1 bag lie (wiki.ros.org/Bags/Format/2.0): found by walking it, over damage too.

Where a record cannot be one, the walk goes on at the next chunk: the one that the bag's own index names, or the next
bytes that can be the head of one.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from vplog.errors import LogError
from vplog.logs.compression import KINDS
from vplog.logs.search import MOST_GAPS, Search

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import BinaryIO

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
"""Values of the field `op`."""
_MAX_HEADER = 2**20
"""Bytes of a record header that are believed; real ones are some 100 bytes."""
_MAX_CONNECTION = 16 * 2**20
"""Bytes of a connection record that are read: its message definition, 100 kB at most in practice."""
_CHUNK_START = re.compile(rb".\x00\x00\x00[\x05-\x1b]\x00\x00\x00(?=(?:compression=|op=\x05|size=))", re.DOTALL)
"""Length of a header below 256 bytes, and of its first field, one of the three that a chunk has."""


@dataclass(slots=True)
class Chunk:
    start: int
    """Offset of its data in the file."""
    stop: int
    compression: str
    size: int
    cut: bool
    counts: dict[int, int] = field(default_factory=dict)
    """Messages per connection, from the index records behind it; empty where there are none."""
    first_ns: int = 0
    """From the indexes; 0 where there are none."""
    last_ns: int = 0


@dataclass
class Layout:
    """What the walk found."""

    chunks: list[Chunk] = field(default_factory=list)
    missing: list[Chunk] = field(default_factory=list)
    """Chunks that the bag's index lists and that are not where it says."""
    gaps: list[tuple[int, int]] = field(default_factory=list)
    """Bytes without a record, from and to."""
    cut_at: int | None = None
    """Byte behind which nothing can be read, where messages may have been."""
    index_cut_at: int | None = None
    """The same where all chunks that the bag had were found before."""


def read_layout(file: BinaryIO, length: int, connect: Callable[[dict[bytes, bytes], bytes], None], name: str) -> Layout:
    """Walk the bag; `connect` gets header and data of every connection record outside the chunks. Raises LogError."""
    walk = _Walk(file, length, connect)
    if walk.at(0, len(MAGIC)) != MAGIC:
        raise LogError(f"{name} does not start as a ROS 1 bag of format 2.0 does.")
    walk.records(len(MAGIC))
    walk.finish()
    return walk.layout


class _Walk:
    def __init__(self, file: BinaryIO, length: int, connect: Callable[[dict[bytes, bytes], bytes], None]) -> None:
        self._file, self._length, self._connect = file, length, connect
        self.layout = Layout()
        self._offsets: dict[int, Chunk] = {}
        """By offset of their record: chunks that were found."""
        self._infos: dict[int, Chunk] = {}
        """The same, as the bag's index lists them."""
        self._index_at = 0
        self._recorded_chunks = 0
        self._search = Search(file, length)

    def records(self, position: int) -> None:
        before = position
        while position < self._length:
            header, start, stop = self._head(position)
            op = number(header, b"op") if header is not None else -1
            if header is None or start > self._length or (stop > self._length and op != _CHUNK):
                resumed = self._resume(before, position) if len(self.layout.gaps) < MOST_GAPS else None
                if resumed is None:
                    self.layout.cut_at = min(position, self._length)
                    return
                self.layout.gaps.append((position, resumed))
                before = position = resumed
                continue
            self._record(op, header, position, start, stop)
            before, position = position, stop
        if position > self._length:
            self.layout.cut_at = self._length

    def finish(self) -> None:
        """Hold what was found against the bag's index."""
        layout = self.layout
        for offset, info in sorted(self._infos.items()):
            if (chunk := self._offsets.get(offset)) is None:
                layout.missing.append(info)
            else:
                chunk.first_ns, chunk.last_ns = info.first_ns, info.last_ns
                chunk.counts = chunk.counts or info.counts
        if layout.cut_at is not None and self._index_at and layout.cut_at >= self._index_at and not layout.gaps:
            layout.cut_at, layout.index_cut_at = None, layout.cut_at

    def at(self, position: int, length: int) -> bytes:
        if not 0 <= position < self._length:  # offsets come from the file
            return b""
        self._file.seek(position)
        return self._file.read(length)

    def _head(self, position: int) -> tuple[dict[bytes, bytes] | None, int, int]:
        """Header of the record at `position`, and where its data start and stop."""
        head = self.at(position, 4)
        size = int.from_bytes(head, "little")
        if len(head) < 4 or size > _MAX_HEADER:
            return None, 0, 0
        data = self.at(position + 4, size + 4)
        start = position + 8 + size
        if len(data) < size + 4:
            return None, 0, 0
        return fields(data[:size]), start, start + int.from_bytes(data[size:], "little")

    def _record(self, op: int, header: dict[bytes, bytes], position: int, start: int, stop: int) -> None:
        if op == _CHUNK:
            kind = header.get(b"compression", b"").decode("ascii", "replace")
            cut = stop > self._length
            chunk = Chunk(start, min(stop, self._length), kind, number(header, b"size"), cut)
            self.layout.chunks.append(chunk)
            self._offsets[position] = chunk
        elif op == _INDEX and self.layout.chunks:
            count = number(header, b"count")
            if 0 < 12 * count <= stop - start:  # each entry: seconds, nanoseconds, offset, of 4 bytes each
                chunk = self.layout.chunks[-1]
                chunk.counts[number(header, b"conn")] = count
                for at in (start, start + 12 * (count - 1)):
                    seconds, nanoseconds = struct.unpack("<II", self.at(at, 8))
                    log_ns = seconds * 1_000_000_000 + nanoseconds
                    chunk.first_ns = min(chunk.first_ns or log_ns, log_ns)
                    chunk.last_ns = max(chunk.last_ns, log_ns)
        elif op == _CHUNK_INFO:
            self._add_info(header, self.at(start, min(stop - start, _MAX_CONNECTION)))
        elif op == CONNECTION:
            self._connect(header, self.at(start, min(stop - start, _MAX_CONNECTION)))
        elif op == _BAG:
            self._index_at = max(number(header, b"index_pos"), 0)

    def _add_info(self, header: dict[bytes, bytes], data: bytes) -> None:
        info = Chunk(0, 0, "", 0, False, {}, time_ns(header, b"start_time"), time_ns(header, b"end_time"))
        for connection, count in struct.iter_unpack("<II", data[: len(data) // 8 * 8]):
            if 0 < count <= self._length:
                info.counts[connection] = count
        self._infos[number(header, b"chunk_pos")] = info

    def _resume(self, before: int, position: int) -> int | None:
        """The next record to go on with, where there is none at `position`; the one before, at `before`, may be the
        one whose length is damaged."""
        if not self._infos and len(MAGIC) < self._index_at < self._length:
            index = self._index_at
            while index < self._length:
                header, start, stop = self._head(index)
                if header is None or stop > self._length or number(header, b"op") not in (CONNECTION, _CHUNK_INFO):
                    break
                self._record(number(header, b"op"), header, index, start, stop)
                index = stop
        if self._infos:
            behind = (offset for offset in sorted(self._infos) if offset > before and self._is_chunk(offset))
            found = next(behind, self._index_at if self._index_at > before else None)
        else:
            found = self._search.first(_CHUNK_START, before + 1, self._is_chunk)
        if found is not None and found < position and self.layout.chunks and self.layout.chunks[-1].stop > found:
            dropped = self.layout.chunks.pop()
            self._offsets = {offset: chunk for offset, chunk in self._offsets.items() if chunk is not dropped}
        return found

    def _is_chunk(self, position: int) -> bool:
        header, start, stop = self._head(position)
        if header is None or number(header, b"op") != _CHUNK or start > self._length or stop <= start:
            return False
        kind, size = header.get(b"compression", b"").decode("latin-1"), number(header, b"size")
        return kind in KINDS and (stop - start == size if kind == "none" else size > 0) and stop <= self._length


def fields(data: bytes) -> dict[bytes, bytes] | None:
    """The `name=value` fields of a header; None where it is damaged."""
    found: dict[bytes, bytes] = {}
    position = 0
    while position < len(data):
        stop = position + 4 + int.from_bytes(data[position : position + 4], "little")
        name, equals, value = data[position + 4 : stop].partition(b"=")
        if stop > len(data) or not equals:
            return None
        found[name] = value
        position = stop
    return found


def number(header: dict[bytes, bytes], name: bytes) -> int:
    """A little-endian field of 1 to 8 bytes; -1 where it is missing."""
    return int.from_bytes(header[name][:8], "little") if name in header else -1


def time_ns(header: dict[bytes, bytes], name: bytes) -> int:
    """Nanoseconds of a ROS time field: u32 seconds, u32 nanoseconds."""
    value = header.get(name, b"")
    if len(value) != 8:
        return 0
    seconds, nanoseconds = struct.unpack("<II", value)
    return seconds * 1_000_000_000 + nanoseconds
