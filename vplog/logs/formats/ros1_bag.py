"""ROS 1 bags, format 2.0 (wiki.ros.org/Bags/Format/2.0), whole, cut, damaged or never indexed, as a Container."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from vplog.logs.formats.chunk_cache import Chunks, reader_at
from vplog.logs.formats.compression import BadChunkError, unpack
from vplog.logs.formats.container import Block, Channel, Contents, Notes, by_topic, ordered, plural, topics_of
from vplog.logs.formats.ros1_layout import CONNECTION, MAGIC, MESSAGE, fields, number, read_layout, time_ns
from vplog.storage.remote_path import RemotePath

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from vplog.logs.formats.container import Message, Octets, Place
    from vplog.logs.formats.ros1_layout import Chunk

_FIELDS = {MESSAGE: {b"conn", b"time"}, CONNECTION: {b"conn", b"topic"}}
"""What the header of each kind of record in the chunks has."""
__all__ = ["MAGIC", "Ros1Bag"]


class Ros1Bag:
    """A Container over one bag file."""

    def __init__(self, path: Path, notes: Notes, name: str = "") -> None:
        """`name` is what the file is called in remarks."""
        self._name, self._notes = name or path.name, notes
        self._file = path.open("rb")
        self._length = path.stat().st_size
        self._channels: dict[int, Channel] = {}
        self._doubtful: dict[int, Channel] = {}
        """Connections whose type is damaged, for those that no other record defines."""
        self._layout = read_layout(self._file, self._length, self._connect, self._name)
        local = not isinstance(path, RemotePath)
        self._at = reader_at(self._file, local)
        sizes = [chunk.size for chunk in self._layout.chunks]
        self._data = Chunks(self._unpack, self._add_damaged_chunk, sizes.__getitem__, lambda _: True, local)

    def contents(self) -> Contents:
        """Counted by the indexes; a chunk without is unpacked."""
        if self._doubtful.keys() - self._channels.keys():
            for count in range(len(self._layout.chunks)):  # which define their connections too
                self._messages(count, self._data(count))
            self._channels = self._doubtful | self._channels
        counts: dict[Channel, int] = {}
        start_ns, end_ns = 2**64, 0
        for count, chunk in enumerate(self._layout.chunks):
            if chunk.counts and chunk.counts.keys() <= self._channels.keys() and chunk.last_ns:
                found = chunk.counts
                start_ns, end_ns = min(start_ns, chunk.first_ns), max(end_ns, chunk.last_ns)
            else:
                found = {}
                for connection, log_ns, _, _ in self._messages(count, self._data(count)):
                    found[connection] = found.get(connection, 0) + 1
                    start_ns, end_ns = min(start_ns, log_ns), max(end_ns, log_ns)
                    chunk.first_ns, chunk.last_ns = min(chunk.first_ns or log_ns, log_ns), max(chunk.last_ns, log_ns)
            if chunk.damaged:
                found = Counter(found) | Counter(chunk.counts)
            if chunk.listed and not chunk.damaged and found != chunk.listed:
                self._layout.recorded = {}  # the bag's index is what is damaged
            for connection, messages in found.items():
                if connection in self._channels:
                    channel = self._channels[connection]
                    counts[channel] = counts.get(channel, 0) + messages
        start_ns = min(start_ns, end_ns)
        counts = ordered(dict.fromkeys(self._channels.values(), 0) | counts)
        self._account_for(by_topic(counts), start_ns, end_ns)
        return Contents(counts, start_ns, end_ns)

    def messages(self, channels: Collection[Channel]) -> Iterator[Message]:
        for block in self.blocks(channels):
            yield from block.messages()

    def blocks(self, channels: Collection[Channel], brief: Collection[Channel] = ()) -> Iterator[Block]:
        wanted = set(channels)
        chunks = self._layout.chunks
        numbers = (count for count, chunk in enumerate(chunks) if self._may_hold(chunk, wanted))
        for count, data in self._data.in_turn(numbers):
            if data is None or not self._may_hold(chunks[count], wanted):  # by a connection that came meanwhile
                continue
            block = Block(data, [], [], [], [], [])
            for connection, log_ns, start, stop in self._messages(count, data):
                channel = self._channels.get(connection)
                if channel in wanted and channel is not None:
                    block.channels.append(channel)
                    block.log_ns.append(log_ns)
                    block.starts.append(start)
                    block.stops.append(stop)
                    block.places.append((count, start, stop))
            yield block

    def read(self, place: Place) -> Octets:
        return self._data.part(*place)

    def _account_for(self, found: dict[str, int], start_ns: int, end_ns: int) -> None:
        layout, account, name = self._layout, self._notes.account, self._name
        recorded = dict(found)
        for chunk in layout.missing:
            counts = topics_of(chunk.counts, self._channels)
            before = max((c.last_ns for c in layout.chunks if c.stop <= chunk.record), default=start_ns)
            behind = min((c.first_ns for c in layout.chunks if c.start > chunk.record and c.first_ns), default=end_ns)
            first_ns, last_ns = (chunk.first_ns, chunk.last_ns) if chunk.last_ns else (before, behind)
            detail = f"{name} is damaged near byte {chunk.record}."
            account.add("damaged_bytes", counts or None, (name, chunk.record), [(first_ns, last_ns)], detail)
            for topic, messages in counts.items():
                recorded[topic] = recorded.get(topic, 0) + messages
        if layout.cut_at is not None:
            detail = (
                f"{name} is cut or damaged at byte {layout.cut_at} of {self._length}; "
                f"the {plural(sum(found.values()), 'message')} before it are read."
            )
            account.add("cut", None, (name, layout.cut_at), [(end_ns, end_ns)] if end_ns else [], detail)
        if layout.appended_at is not None:
            account.add_appended(name, layout.appended_at, self._length)
        if layout.index_cut_at is not None:
            self._notes.add(f"{name} is cut or damaged at byte {layout.index_cut_at}, after its last message.")
        whole = layout.cut_at is None and all(chunk.counts for chunk in layout.missing)
        listed = topics_of(layout.recorded, self._channels)
        account.know(name, listed or (recorded if whole else {}), start_ns)
        account.settle({name}, listed, found)

    def _connect(self, header: dict[bytes, bytes], data: bytes) -> None:
        """The first sound definition of a connection holds, and a damaged one where there is no sound one."""
        connection, about = number(header, b"conn"), fields(data)
        channel = Channel(
            header.get(b"topic", b"").decode("utf-8", "replace"),
            (about or {}).get(b"type", b"").decode("utf-8", "replace"),
            "ros1",
        )
        if about is None or b"type" not in about:
            self._doubtful.setdefault(connection, channel)
        else:
            self._channels.setdefault(connection, channel)

    def _messages(self, count: int, data: bytes) -> list[tuple[int, int, int, int]]:
        """Connection, log time, start and stop of every message in a chunk; what it was short of is accounted for."""
        chunk = self._layout.chunks[count]
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
                found.append((number(header, b"conn"), time_ns(header, b"time"), start, stop))
            position = stop
        damaged = position < len(data) and not chunk.cut
        if damaged and found:
            found.pop()  # its length may be what is damaged
        key, account = (self._name, chunk.start), self._notes.account
        counts = Counter(connection for connection, _, _, _ in found)
        last_ns = found[-1][1] if found else chunk.first_ns
        span = [(min(last_ns, chunk.last_ns or last_ns), max(last_ns, chunk.last_ns))] if last_ns else []
        unknown = sum(messages for connection, messages in counts.items() if connection not in self._channels)
        if damaged:
            chunk.damaged = True
            short = topics_of({i: messages - counts[i] for i, messages in chunk.counts.items()}, self._channels)
            detail = f"{self._name} has a damaged chunk at byte {chunk.start}; the rest of it is left out."
            account.add("damaged_chunk", short if chunk.counts else None, key, span, detail)
        if unknown:
            account.add("unknown_channel", {"": unknown}, key, span)
        return found

    def _may_hold(self, chunk: Chunk, wanted: set[Channel]) -> bool:
        """Not where its indexes name only connections that are known and not wanted."""
        return not chunk.counts or any(self._channels.get(i) in wanted or i not in self._channels for i in chunk.counts)

    def _unpack(self, count: int) -> bytes:
        """The records of one chunk. Raises BadChunkError where it is damaged."""
        chunk = self._layout.chunks[count]
        return unpack(chunk.compression, self._at(chunk.start, chunk.stop - chunk.start), chunk.size, chunk.cut)

    def _add_damaged_chunk(self, count: int, error: BadChunkError) -> None:
        """Account for a damaged chunk."""
        chunk = self._layout.chunks[count]
        chunk.damaged = True
        detail = f"{self._name} has a damaged chunk at byte {chunk.start}, left out: {error}."
        span = [(chunk.first_ns, chunk.last_ns)] if chunk.last_ns else []
        counts = topics_of(chunk.counts, self._channels) if chunk.counts else None
        self._notes.account.add("damaged_chunk", counts, (self._name, chunk.start), span, detail)
