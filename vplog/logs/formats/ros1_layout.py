"""Chunks of a ROS 1 bag (wiki.ros.org/Bags/Format/2.0), found record by record and over damage.

A record is valid if another one follows it, or if its fields confirm its length. Otherwise the walk resumes at the next
bytes that can be the head of a chunk or of a record of an index.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import BinaryIO

from vplog.errors import LogError
from vplog.logs.formats.salvage import MAX_GAPS, Chunk, Layout, ResyncSearch

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
"""Values of the field `op`."""
_MAX_HEADER = 2**20
"""Largest header of a record in bytes; real ones have some 100."""
_MAX_CONNECTION = 16 * 2**20
"""Bytes of a connection record that are read: its message definition, 100 kB at most in practice."""
_FIELDS = {
    _BAG: {b"index_pos", b"conn_count", b"chunk_count"},
    _INDEX: {b"ver", b"conn", b"count"},
    _CHUNK: {b"compression", b"size"},
    _CHUNK_INFO: {b"ver", b"chunk_pos", b"start_time", b"end_time", b"count"},
    CONNECTION: {b"conn", b"topic"},
}
"""Header fields of each kind of record outside the chunks."""
_ENTRY = {_INDEX: 12, _CHUNK_INFO: 8}
"""Bytes of each of the `count` entries of a record: time and offset of a message; a connection and its count."""
_RECORD_START = re.compile(
    rb".\x00\x00\x00[\x04-\x1b]\x00\x00\x00(?=(?:op|compression|size|ver|conn|count|chunk_pos|start_time|end_time)=)",
    re.DOTALL,
)
"""Length of a header below 256 bytes, and its first field, one of a chunk's or an index's."""
_BEGIN = re.compile(re.escape(MAGIC))
"""Magic bytes of a recording: another one may be appended to the first."""
_Head = tuple[dict[bytes, bytes] | None, int, int]
"""Header of a record (None if it is damaged), and the start and stop of its data."""


def read_layout(file: BinaryIO, length: int, connect: Callable[[dict[bytes, bytes], bytes], None], name: str) -> Layout:
    """Read the records of a bag; `connect` gets the connections outside the chunks. Raises LogError."""
    reader = _LayoutReader(file, length, connect)
    if reader.at(0, len(MAGIC)) != MAGIC:
        raise LogError(f"{name} is not a ROS 1 bag of format 2.0: it does not start with its magic bytes.")
    reader.records(len(MAGIC))
    reader.finish()
    return reader.layout


class _LayoutReader:
    def __init__(self, file: BinaryIO, length: int, connect: Callable[[dict[bytes, bytes], bytes], None]) -> None:
        self._length, self._connect = length, connect
        self.layout = Layout()
        self._infos: dict[int, Chunk] = {}
        """By offset of its record: chunks as the bag's index lists them."""
        self._index_sound = True
        """True unless the index lists a chunk twice, or has another number of counts for a chunk than it announces."""
        self._indexing: Chunk | None = None
        """The chunk whose index records come by."""
        self._index_at = self._chunk_count = 0
        self._search = ResyncSearch(file, length)
        self.at = self._search.at
        self._last: tuple[int, _Head] = -1, (None, 0, 0)

    def records(self, position: int) -> None:
        """Read every record from here on, to the end."""
        while position < self._length or position == len(MAGIC):
            header, start, stop = self._head(position)
            op = number(header, b"op") if header is not None and self._is_sound(header) else -1
            end = self._end(position, op)
            if end is None:
                if self._indexing is not None:
                    self._indexing.doubtful = True
                end = self._repaired_end(position, op)
            if end is None:
                return
            if header is not None and op >= 0:
                self._record(op, header, position, start, end)
                if op == _CHUNK and end != stop and self._indexing is not None:
                    self._indexing.doubtful = True  # the first records of its index may be in what was skipped
            position = end
        if position > self._length or (self._index_at > self._length and not self._infos):
            self.layout.cut_at = self._length

    def _repaired_end(self, position: int, op: int) -> int | None:
        """Return the end of a record without a valid one after it: where the next valid record begins, unless it is the
        bag's own, which is filled up with blanks, or a chunk whose size confirms its length. None if nothing follows
        that can be read."""
        found = self._next_record(position) if len(self.layout.gaps) < MAX_GAPS else None
        header, start, stop = self._head(position)
        if position == self.layout.appended_at:
            return None
        if header is None or op not in (_BAG, _CHUNK) or (found is not None and found < start):
            if found is None:
                self.layout.cut_at = position
            else:
                self._skip(position, found)
            return found
        if found is None:
            return stop
        if op == _BAG:
            rest = self.at(start, min(found - start, _MAX_HEADER))
            return start + len(rest) - len(rest.lstrip(b" "))
        by_size = start + number(header, b"size")
        if header[b"compression"] == b"none" and by_size == stop <= found:
            return stop
        if found != stop:
            self._skip(position, found, is_chunk=found <= min(stop, by_size))
        return found

    def _end(self, position: int, op: int) -> int | None:
        """Return the end of a record by its length or its fields: if both agree, or a valid record lies there."""
        header, start, stop = self._head(position)
        if header is None or op < 0:
            return None
        if op in _ENTRY:
            by_fields = start + _ENTRY[op] * number(header, b"count")
            is_whole = by_fields == stop <= self._length
            return stop if is_whole else next(filter(self._is_record, (stop, by_fields)), None)
        if op == _CHUNK and stop - start > number(header, b"size") and self._next_record(position) != stop:
            return None  # it ends after the record that follows it
        return stop if self._is_record(stop, after_chunk=op == _CHUNK) else None

    def _skip(self, position: int, stop: int, is_chunk: bool = False) -> None:
        """Skip bytes without a valid record, in which chunks may lie unless they are one chunk that is read."""
        self.layout.gaps.append((position, stop))
        behind = (self.layout.chunks[-1].record if self.layout.chunks else 0) < self._index_at <= position
        is_header = position == len(MAGIC) and self.at(stop - 1, 1) == b" "  # the bag's own, filled up with blanks
        if not (is_chunk or behind or is_header):
            self._indexing = Chunk(position, stop, record=position, doubtful=True)
            self.layout.missing.append(self._indexing)

    def finish(self) -> None:
        """Compare the chunks that were found with those in the bag's index."""
        layout = self.layout
        complete = self._index_sound and len(self._infos) == self._chunk_count
        layout.sound &= not layout.gaps
        found, absent = {chunk.record: chunk for chunk in layout.chunks}, list[Chunk]()
        others = found.keys() - self._infos.keys()  # by bytes inserted or lost, or a damaged index
        for offset, info in sorted(self._infos.items()):
            chunk = found.get(offset)
            if chunk is None and self._is_chunk(offset):  # the search for the next record missed it
                header, start, stop = self._head(offset)
                self._record(_CHUNK, header or {}, offset, start, stop)
                layout.chunks[-1].counts = info.counts
            elif chunk is None:
                info.doubtful |= bool(others)  # then it may be one of these
                absent.append(info)
            elif not _is_another(chunk, info):
                chunk.first_ns, chunk.last_ns = info.first_ns, info.last_ns
                if chunk.doubtful or not chunk.counts:
                    chunk.counts, chunk.doubtful = info.counts, info.doubtful
                elif chunk.counts != info.counts:  # one of the two indexes is damaged
                    complete, layout.sound, chunk.doubtful = False, False, True
        if complete:
            for info in self._infos.values():
                for connection, count in info.counts.items():
                    layout.recorded[connection] = layout.recorded.get(connection, 0) + count
        in_gaps = [info for info in absent if layout.is_in_gap(info.record)]
        whole = 0 < len(self._infos) == self._chunk_count and len(in_gaps) == len(absent)
        layout.missing = in_gaps if whole else layout.missing + in_gaps
        layout.gaps = []  # each has its chunk among the missing ones
        layout.sound &= not (absent or layout.missing)
        layout.chunks.sort(key=lambda chunk: chunk.start)
        ended = self._infos or 0 < self._index_at <= (layout.cut_at or 0)
        if layout.cut_at is not None and ended and not layout.missing:
            layout.cut_at, layout.index_cut_at = None, layout.cut_at

    def _head(self, position: int) -> _Head:
        """Return the header of the record at `position`, and the start and stop of its data."""
        if position == self._last[0]:  # just looked at from the record before
            return self._last[1]
        self._last = position, self._parsed(position)
        return self._last[1]

    def _parsed(self, position: int) -> _Head:
        head = self.at(position, 4)
        size = int.from_bytes(head, "little")
        if len(head) < 4 or size > _MAX_HEADER:
            return None, 0, 0
        data = self.at(position + 4, size + 4)
        start = position + 8 + size
        if len(data) < size + 4:
            return None, 0, 0
        return fields(data[:size]), start, start + int.from_bytes(data[size:], "little")

    def _is_sound(self, header: dict[bytes, bytes]) -> bool:
        return header.keys() >= _FIELDS.get(number(header, b"op"), {b""})

    def _is_record(self, position: int, after_chunk: bool = True) -> bool:
        """Return whether a record or the end of the file is here. Connections lie in chunks too; after a chunk, they
        count only in the index of the bag."""
        header, _, _ = self._head(position)
        if header is None or not self._is_sound(header):
            return position == self._length
        return not after_chunk or number(header, b"op") != CONNECTION or 0 < self._index_at <= position

    def _is_chunk(self, position: int) -> bool:
        header, _, stop = self._head(position)
        return (
            header is not None and number(header, b"op") == _CHUNK and self._is_sound(header) and self._is_record(stop)
        )

    def _next_record(self, position: int) -> int | None:
        """Return the offset of the next chunk or record of an index after `position`, or None. Connections do not
        count, because they lie in chunks as well."""
        found = self._search.first(_RECORD_START, position + 1, self._is_record)
        appended_at = self._search.first(_BEGIN, position, stop=found)
        if appended_at is None:
            return found
        self.layout.appended_at = self._length = appended_at
        return None

    def _record(self, op: int, header: dict[bytes, bytes], position: int, start: int, stop: int) -> None:
        if op == _CHUNK:
            kind = header[b"compression"].decode("ascii", "replace")
            cut, stop = stop > self._length, max(start, min(stop, self._length))
            size = stop - start if kind == "none" and not cut else number(header, b"size")
            self._indexing = Chunk(start, stop, kind, size, cut=cut, record=position)
            self.layout.chunks.append(self._indexing)
        elif op == _INDEX and self._indexing is not None:
            chunk, connection, count = self._indexing, number(header, b"conn"), (stop - start) // 12
            chunk.doubtful |= connection in chunk.counts or (stop - start) % 12 > 0 or stop > self._length
            if count and stop <= self._length:
                chunk.counts[connection] = count
                for at in (start, start + 12 * (count - 1)):
                    log_ns = time_ns(self.at(at, 8))
                    chunk.first_ns = min(chunk.first_ns or log_ns, log_ns)
                    chunk.last_ns = max(chunk.last_ns, log_ns)
        elif op == _CHUNK_INFO:
            self._add_info(header, self.at(start, min(stop - start, _MAX_CONNECTION)))
        elif op == CONNECTION:
            self._connect(header, self.at(start, min(stop - start, _MAX_CONNECTION)))
        elif op == _BAG:
            self._index_at = max(number(header, b"index_pos"), 0)
            self._chunk_count = number(header, b"chunk_count")

    def _add_info(self, header: dict[bytes, bytes], data: bytes) -> None:
        position = number(header, b"chunk_pos")
        first_ns, last_ns = time_ns(header[b"start_time"]), time_ns(header[b"end_time"])
        info = Chunk(position, position, first_ns=first_ns, last_ns=last_ns, record=position)
        for connection, count in struct.iter_unpack("<II", data[: len(data) // 8 * 8]):
            if 0 < count <= self._length // _ENTRY[_INDEX]:
                info.counts[connection] = count
        info.doubtful = len(info.counts) != number(header, b"count")
        self._index_sound &= not info.doubtful and position not in self._infos
        self._infos[position] = info


def fields(data: bytes) -> dict[bytes, bytes] | None:
    """Return the `name=value` fields of a header, or None if it is damaged."""
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
    """Return a little-endian field of 1 to 8 bytes, or -1 if it is missing."""
    return int.from_bytes(header[name][:8], "little") if name in header else -1


def time_ns(value: bytes) -> int:
    """Return the ns of a ROS time (u32 seconds, u32 nanoseconds), or 0 if it does not have 8 bytes."""
    seconds, nanoseconds = struct.unpack("<II", value) if len(value) == 8 else (0, 0)
    return seconds * 1_000_000_000 + nanoseconds


def _is_another(chunk: Chunk, info: Chunk) -> bool:
    """Return whether a chunk has other times than the one that the bag's index lists at its place."""
    return bool(chunk.counts) and (chunk.last_ns < info.first_ns <= info.last_ns or chunk.first_ns > info.last_ns > 0)
