"""ROS 1 bags, format 2.0 (wiki.ros.org/Bags/Format/2.0), whole, cut, damaged or never indexed, as a Container."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from functools import partial
from pathlib import Path

from vplog.logs.formats.budget import Budget
from vplog.logs.formats.chunk_cache import Chunks, reader_at
from vplog.logs.formats.chunk_layout import ChunkLosses
from vplog.logs.formats.compression import BadChunkError, unpack
from vplog.logs.formats.container import Channel, Contents, Message, Notes, Place, RawData, part_of
from vplog.logs.formats.loss_account import sampled
from vplog.logs.formats.ros1_layout import CONNECTION, MESSAGE, fields, number, read_layout, time_ns
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
        """Connections whose type is damaged, for those that no other record defines."""
        self._layout = read_layout(self._file, length, self._connect, self._name)
        self._losses = ChunkLosses(self._name, length, self._layout, self._channels, notes)
        local = not isinstance(path, RemotePath)
        self._at = reader_at(self._file, local)
        sizes = [chunk.size for chunk in self._layout.chunks]
        self._data = Chunks(self._unpack, self._add_damaged_chunk, sizes.__getitem__, lambda _: True, local)

    def contents(self) -> Contents:
        """Counted by the indexes; a chunk without is unpacked, as all are where a connection is not defined."""
        by_id, times = self._counted()
        if (by_id.keys() | self._doubtful.keys()) - self._channels.keys():
            for row in range(len(self._layout.chunks)):  # which define their connections too
                self._found(row, self._data(row))
            for connection, channel in self._doubtful.items():
                self._channels.setdefault(connection, channel)
            by_id, times = self._counted()
        return self._losses.contents(by_id, times, "index")

    def _counted(self) -> tuple[Counter[int], list[int]]:
        """Messages by connection, and log times of each chunk, the first and last among them."""
        counts: Counter[int] = Counter()
        times: list[int] = []
        for row, chunk in enumerate(self._layout.chunks):
            if self._losses.is_counted(row) and chunk.counts.keys() <= self._channels.keys() and chunk.last_ns:
                found = chunk.counts
                times += chunk.first_ns, chunk.last_ns
            else:
                messages = self._found(row, self._data(row))
                found = Counter(connection for connection, *_ in messages)
                own = [log_ns for _, log_ns, _, _ in messages]
                chunk.first_ns = min([*own, chunk.first_ns] if chunk.first_ns else own, default=0)
                chunk.last_ns = max([*own, chunk.last_ns])
                times += sampled(own)
                if not chunk.damaged:
                    chunk.counts = dict(found)
            if chunk.damaged:
                found = Counter(found) | Counter(chunk.counts)
            if chunk.listed and (chunk.disputed or not chunk.damaged) and found != chunk.listed:
                self._layout.recorded = {}  # the bag's index is what is damaged
            counts.update(found)
        return counts, times

    def messages(self, channels: Collection[Channel], header_only: Collection[Channel] = ()) -> Iterator[Message]:
        wanted, chunks = set(channels), self._layout.chunks
        rows = (row for row, chunk in enumerate(chunks) if self._losses.may_hold(chunk, wanted))
        for row, data in self._data.iterate(rows):
            if data is None or not self._losses.may_hold(chunks[row], wanted):  # by a connection that came meanwhile
                continue
            for connection, log_ns, start, stop in self._found(row, data):
                if (channel := self._channels.get(connection)) in wanted and channel:
                    yield Message(channel, log_ns, part_of(data, start, stop), (row, start, stop))

    def read(self, place: Place) -> RawData:
        return self._data.part(*place)

    def _connect(self, header: dict[bytes, bytes], data: bytes) -> None:
        """The first sound definition of a connection holds, and a damaged one where there is no sound one."""
        about = fields(data) or {}
        topic, kind = (each.decode("utf-8", "replace") for each in (header.get(b"topic", b""), about.get(b"type", b"")))
        known = self._channels if b"type" in about else self._doubtful
        known.setdefault(number(header, b"conn"), Channel(topic, kind, "ros1"))

    def _found(self, row: int, data: bytes) -> list[tuple[int, int, int, int]]:
        """Connection, log time, start and stop of every message in a chunk; what it was short of is accounted for."""
        chunk = self._layout.chunks[row]
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
        damaged = position < len(data) and not chunk.cut
        if damaged and found:
            found.pop()  # its length may be what is damaged
        counts = Counter(connection for connection, *_ in found)
        last_ns = found[-1][1] if found else chunk.first_ns
        span = [(min(last_ns, chunk.last_ns or last_ns), max(last_ns, chunk.last_ns))] if last_ns else []
        if damaged:
            chunk.damaged = True
            self._losses.add_chunk(chunk, counts, span, "; the rest of it is left out")
        self._losses.add_unknown(chunk, counts, damaged, span)
        return found

    def _unpack(self, row: int) -> bytes:
        """The records of one chunk. Raises BadChunkError where it is damaged."""
        chunk = self._layout.chunks[row]
        data = self._at(chunk.start, chunk.stop - chunk.start)
        charge = partial(self._budget.charge_bytes, row)
        return unpack(chunk.compression or "", data, chunk.size, chunk.cut, charge)

    def _add_damaged_chunk(self, row: int, error: BadChunkError) -> None:
        chunk = self._layout.chunks[row]
        chunk.damaged = True
        span = [(chunk.first_ns, chunk.last_ns)] if chunk.last_ns else []
        self._losses.add_chunk(chunk, {}, span, f", left out: {error}")
