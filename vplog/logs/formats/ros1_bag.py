"""ROS 1 bags, format 2.0 (wiki.ros.org/Bags/Format/2.0), whole, cut, damaged or never indexed, as a Container."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Set
from functools import partial
from pathlib import Path

from vplog.logs.formats.budget import Budget
from vplog.logs.formats.chunk_cache import Chunks, reader_at
from vplog.logs.formats.compression import BadChunkError, unpack
from vplog.logs.formats.container import Channel, Contents, Message, Notes, Place, RawData, part_of
from vplog.logs.formats.ros1_layout import CONNECTION, MESSAGE, fields, number, read_layout, time_ns
from vplog.logs.formats.salvage import ChunkRead, FileLosses
from vplog.storage.remote_path import RemotePath

_FIELDS = {MESSAGE: {b"conn", b"time"}, CONNECTION: {b"conn", b"topic"}}
"""Header fields of each kind of record in the chunks."""


class Ros1Bag:
    """A Container over one bag file."""

    def __init__(self, path: Path, notes: Notes, name: str = "", budget: Budget | None = None) -> None:
        """`name` is what the file is called in remarks. `budget` limits its content, by default by its size."""
        self._name, length = name or path.name, path.stat().st_size
        self._budget = budget or Budget(str(path), length)
        self._file = path.open("rb")
        self._channels: dict[int, Channel] = {}
        self._doubtful: dict[int, Channel] = {}
        """Connections whose type is damaged. They are used for ids that no other record defines."""
        self._unread: dict[int, str] = {}
        """By number of a chunk that could not be unpacked: the end of the sentence about it."""
        self._contents: Contents | None = None
        self._layout = read_layout(self._file, length, self._connect, self._name)
        self._losses = FileLosses(self._name, length, self._layout, self._channels, notes)
        local = not isinstance(path, RemotePath)
        self._at = reader_at(self._file, local)
        sizes = [chunk.size for chunk in self._layout.chunks]
        self._data = Chunks(self._unpack, self._add_damaged_chunk, sizes.__getitem__, lambda _: True, local)

    def contents(self) -> Contents:
        """Return the counts by the indexes of the chunks, which are read only if the file is damaged or has none."""
        self._contents = self._contents or self._losses.contents(self._read_chunk, self._define_all)
        return self._contents

    def _read_chunk(self, row: int) -> ChunkRead:
        found, outcome = self._found(row, self._data(row))
        return outcome._replace(log_ns=[log_ns for _, log_ns, _, _ in found])

    def _define_all(self, ids: Set[int]) -> None:
        """Read chunks, which define their connections too, until these are defined; then take damaged definitions."""
        for row in range(len(self._layout.chunks)):
            if (ids | self._doubtful.keys()) <= self._channels.keys():
                return
            self._found(row, self._data(row))
        for connection, channel in self._doubtful.items():
            self._channels.setdefault(connection, channel)

    def messages(self, channels: Collection[Channel], header_only: Collection[Channel] = ()) -> Iterator[Message]:
        wanted, chunks = set(channels), self._layout.chunks
        rows = (row for row, chunk in enumerate(chunks) if self._losses.may_hold(chunk, wanted))
        for row, data in self._data.iterate(rows):
            found, outcome = self._found(row, data or b"")
            for connection, log_ns, start, stop in found:
                if (channel := self._channels.get(connection)) in wanted and channel:
                    yield Message(channel, log_ns, part_of(data or b"", start, stop), (row, start, stop))
            self._losses.check(outcome)

    def read(self, place: Place) -> RawData:
        return self._data.part(*place)

    def _connect(self, header: dict[bytes, bytes], data: bytes) -> None:
        """Take the first sound definition of each connection, and keep damaged ones."""
        about = fields(data) or {}
        topic, kind = (each.decode("utf-8", "replace") for each in (header.get(b"topic", b""), about.get(b"type", b"")))
        known = self._channels if b"type" in about else self._doubtful
        known.setdefault(number(header, b"conn"), Channel(topic, kind, "ros1"))

    def _found(self, row: int, data: bytes) -> tuple[list[tuple[int, int, int, int]], ChunkRead]:
        """Return the connection, log time, start and stop of every message in a chunk, and the outcome of reading."""
        found: list[tuple[int, int, int, int]] = []
        position = 0
        while position < len(data):
            size = int.from_bytes(data[position : position + 4], "little")
            start = position + 8 + size
            header = fields(data[position + 4 : start - 4]) if start <= len(data) else None
            stop = start + int.from_bytes(data[start - 4 : start], "little")
            if header is None or stop > len(data) or not header.keys() >= _FIELDS.get(number(header, b"op"), {b""}):
                break
            if number(header, b"op") == CONNECTION:
                self._connect(header, data[start:stop])
            else:
                found.append((number(header, b"conn"), time_ns(header[b"time"]), start, stop))
                if len(found) > self._budget.max_messages:
                    raise self._budget.error()
            position = stop
        self._budget.charge_messages(row, len(found))
        damaged = position < len(data) and not self._layout.chunks[row].cut
        if damaged and found:
            found.pop()  # its length may be what is damaged
        problem = self._unread.get(row, "; the rest of it is left out" if damaged else "")
        counts, last_ns = Counter(connection for connection, *_ in found), found[-1][1] if found else None
        return found, ChunkRead(row, counts, [], last_ns, problem)

    def _unpack(self, row: int) -> bytes:
        """Return the records of one chunk. Raises BadChunkError if it is damaged."""
        chunk = self._layout.chunks[row]
        data = self._at(chunk.start, chunk.stop - chunk.start)
        charge = partial(self._budget.charge_bytes, row)
        return unpack(chunk.compression or "", data, chunk.size, chunk.cut, charge)

    def _add_damaged_chunk(self, row: int, error: BadChunkError) -> None:
        self._unread[row] = f", left out: {error}"
