"""ROS 1 bags, format 2.0 (wiki.ros.org/Bags/Format/2.0), whole, cut or never indexed."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from vplog.errors import LogError
from vplog.logs.chunks import ChunkCache
from vplog.logs.compression import BadChunkError, unpack
from vplog.logs.containers import Channel, Contents, Message, Notes, count_messages, ordered, plural

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from vplog.logs.containers import Place

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
"""Values of the field `op`."""
_MAX_HEADER = 2**20
"""Bytes of a record header that are believed; real ones are some 100 bytes."""
_MAX_CONNECTION = 16 * 2**20
"""Bytes of a connection record that are read: its message definition, 100 kB at most in practice."""


@dataclass
class _Chunk:
    start: int
    stop: int
    compression: str
    size: int
    cut: bool
    counts: dict[int, int] = field(default_factory=dict)
    """Messages per connection, from the index records behind it; empty where there are none."""


class Ros1Bag:
    """A Container over one bag file."""

    def __init__(self, path: Path, notes: Notes) -> None:
        self._path, self._notes = path, notes
        self._file = path.open("rb")
        self._length = path.stat().st_size
        self._channels: dict[int, Channel] = {}
        self._chunks: list[_Chunk] = []
        self._cut_at: int | None = None
        self._times: list[tuple[int, int]] = []
        self._data = ChunkCache(self._unpack)
        self._walk()

    def contents(self) -> Contents:
        found = self._indexed() or count_messages(self._scan(None), self._channels.values())
        if self._cut_at is not None:
            left = f"the {plural(found.messages, 'message')} before it are read"
            self._notes.add(f"{self._path.name} is cut or damaged at byte {self._cut_at}; {left}.")
        return found

    def messages(self, channels: Collection[Channel]) -> Iterator[Message]:
        return self._scan(set(channels))

    def read(self, place: Place) -> bytes:
        chunk, start, stop = place
        return self._data(chunk)[start:stop]

    def _indexed(self) -> Contents | None:
        """The contents by the indexes behind the chunks; None where they do not cover the file."""
        unknown = any(not c.counts or not c.counts.keys() <= self._channels.keys() for c in self._chunks)
        if unknown or len(self._times) != len(self._chunks):
            return None
        counts = dict.fromkeys(self._channels.values(), 0)
        for chunk in self._chunks:
            for connection, count in chunk.counts.items():
                counts[self._channels[connection]] += count
        start_ns = min((start for start, _ in self._times), default=0)
        return Contents(ordered(counts), start_ns, max((end for _, end in self._times), default=0))

    def _walk(self) -> None:
        if self._at(0, len(MAGIC)) != MAGIC:
            raise LogError(f"{self._path} does not start as a ROS 1 bag of format 2.0 does.")
        position = len(MAGIC)
        while position < self._length:
            head = self._at(position, 4)
            size = int.from_bytes(head, "little")
            header = _fields(self._at(position + 4, size)) if len(head) == 4 and size <= _MAX_HEADER else None
            start = position + 8 + size
            if header is None or start > self._length:
                break
            stop = start + int.from_bytes(self._at(start - 4, 4), "little")
            op = _number(header, b"op")
            if stop > self._length and op != _CHUNK:
                break
            if op == _CHUNK:
                kind = header.get(b"compression", b"").decode("ascii", "replace")
                cut = stop > self._length
                self._chunks.append(_Chunk(start, min(stop, self._length), kind, _number(header, b"size"), cut))
            elif op == _INDEX and self._chunks:
                self._chunks[-1].counts[_number(header, b"conn")] = _number(header, b"count")
            elif op == _CHUNK_INFO:
                self._times.append((_time(header, b"start_time"), _time(header, b"end_time")))
            elif op == _CONNECTION:
                self._connect(header, self._at(start, min(stop - start, _MAX_CONNECTION)))
            position = stop
        if position != self._length:
            self._cut_at = min(position, self._length)

    def _connect(self, header: dict[bytes, bytes], data: bytes) -> None:
        topic = header.get(b"topic", b"").decode("utf-8", "replace")
        kind = (_fields(data) or {}).get(b"type", b"").decode("utf-8", "replace")
        self._channels[_number(header, b"conn")] = Channel(topic, kind, "ros1")

    def _scan(self, wanted: set[Channel] | None) -> Iterator[Message]:
        unknown = 0
        for number, chunk in enumerate(self._chunks):
            if wanted is not None and not self._may_hold(chunk, wanted):
                continue
            data = self._data(number)
            position = 0
            while position < len(data):
                size = int.from_bytes(data[position : position + 4], "little")
                start = position + 8 + size
                header = _fields(data[position + 4 : start - 4]) if start <= len(data) else None
                stop = start + int.from_bytes(data[start - 4 : start], "little")
                if header is None or stop > len(data):
                    at = self._chunks[number].start
                    self._notes.add(f"{self._path.name} has a damaged chunk at byte {at}; the rest of it is left out.")
                    break
                op = _number(header, b"op")
                if op == _CONNECTION:
                    self._connect(header, data[start:stop])
                elif op == _MESSAGE:
                    channel = self._channels.get(_number(header, b"conn"))
                    unknown += channel is None
                    if channel is not None and (wanted is None or channel in wanted):
                        yield Message(channel, _time(header, b"time"), data[start:stop], (number, start, stop))
                position = stop
        if unknown:
            self._notes.add(f"{self._path.name}: {plural(unknown, 'message')} of unknown connections left out.")

    def _may_hold(self, chunk: _Chunk, wanted: set[Channel]) -> bool:
        """Not where its indexes name only connections that are known and not wanted."""
        return not chunk.counts or any(self._channels.get(i) in wanted or i not in self._channels for i in chunk.counts)

    def _unpack(self, number: int) -> bytes:
        """The records of one chunk; empty, with a note, where it is damaged."""
        chunk = self._chunks[number]
        try:
            return unpack(chunk.compression, self._at(chunk.start, chunk.stop - chunk.start), chunk.size, chunk.cut)
        except BadChunkError as error:
            self._notes.add(f"{self._path.name} has a damaged chunk at byte {chunk.start}, left out: {error}.")
            return b""

    def _at(self, position: int, length: int) -> bytes:
        self._file.seek(position)
        return self._file.read(length)


def _fields(data: bytes) -> dict[bytes, bytes] | None:
    """The `name=value` fields of a header; None where it is damaged."""
    fields: dict[bytes, bytes] = {}
    position = 0
    while position < len(data):
        stop = position + 4 + int.from_bytes(data[position : position + 4], "little")
        name, equals, value = data[position + 4 : stop].partition(b"=")
        if stop > len(data) or not equals:
            return None
        fields[name] = value
        position = stop
    return fields


def _number(header: dict[bytes, bytes], name: bytes) -> int:
    """A little-endian field of 1 to 8 bytes; -1 where it is missing."""
    return int.from_bytes(header[name][:8], "little") if name in header else -1


def _time(header: dict[bytes, bytes], name: bytes) -> int:
    """Nanoseconds of a ROS time field: u32 seconds, u32 nanoseconds."""
    value = header.get(name, b"")
    if len(value) != 8:
        return 0
    seconds, nanoseconds = struct.unpack("<II", value)
    return seconds * 1_000_000_000 + nanoseconds
