"""MCAP files (mcap.dev/spec), whole, cut, damaged or without a summary, as a Container.

What the message indexes behind the chunks say spares the unpacking of chunks without a topic of interest.
"""

from __future__ import annotations

import io
import struct
from collections import Counter
from typing import TYPE_CHECKING

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from vplog.logs.formats.checksum import crc32
from vplog.logs.formats.chunk_cache import Chunks, reader_at
from vplog.logs.formats.compression import BadChunkError, unpack
from vplog.logs.formats.container import Channel, Contents, Notes, by_topic, ordered, plural, topics_of
from vplog.logs.formats.mcap_layout import MAGIC, RECORD, read_layout
from vplog.logs.formats.mcap_walk import ChunkReader
from vplog.storage.remote_path import RemotePath

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator
    from pathlib import Path

    from vplog.logs.formats.container import Block, Message, Octets, Place
    from vplog.logs.formats.mcap_layout import Chunk

__all__ = ["MAGIC", "McapFile"]

_IDL = ("ros2idl", "omgidl")
"""Schema languages whose writers may name types as C++ and DDS do."""


class McapFile:
    """A Container over one MCAP file."""

    def __init__(self, path: Path, notes: Notes, name: str = "") -> None:
        """`name` is what the file is called in remarks."""
        self._name, self._notes = name or path.name, notes
        self._file = path.open("rb")
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, str] = {0: ""}
        self._doubtful: set[tuple[int, int]] = set()
        """Opcodes and ids of schemas and channels from damaged chunks, until a sound one says the same."""
        self._length = path.stat().st_size
        self._layout = read_layout(self._file, self._length, self._define, self._name)
        self._local = not isinstance(path, RemotePath)
        self._at = reader_at(self._file, self._local)
        self._sound = bytearray(len(self._layout.chunks))
        """1 for chunks whose checksum was found right."""
        sizes = [chunk.stop - chunk.start if self._is_plain(chunk) else chunk.size for chunk in self._layout.chunks]
        self._data = Chunks(self._unpack, self._add_damaged_chunk, sizes.__getitem__, self._is_cached, self._local)

    def contents(self) -> Contents:
        """Counted by the indexes behind the chunks; a chunk without is unpacked, as all are where the file's statistics
        say something else."""
        layout = self._layout
        if layout.spare:
            self._define_doubtful()
        by_id, times = self._counted(unpack_all=False)
        missing = [chunk.counts for chunk in layout.missing]
        if layout.recorded and layout.recorded != _total([by_id, *missing]) and layout.chunks:
            by_id, times = self._counted(unpack_all=True)
        counts: dict[Channel, int] = dict.fromkeys(self._channels.values(), 0)
        for channel_id, count in by_id.items():
            if channel_id in self._channels:
                counts[self._channels[channel_id]] += count
        start_ns, end_ns = times or (0, 0)
        self._account_for(by_topic(counts), start_ns, end_ns)
        return Contents(ordered(counts), start_ns, end_ns)

    def _counted(self, unpack_all: bool) -> tuple[dict[int, int], list[int]]:
        """Messages by channel id, and the first and last log time."""
        counts: list[dict[int, int]] = []
        times: list[int] = []
        for number, chunk in enumerate(self._layout.chunks):
            if chunk.counts and chunk.counts.keys() <= self._channels.keys() and not unpack_all:
                counts.append(chunk.counts)
                times += (chunk.first_ns, chunk.last_ns)
            else:
                data = self._data(number)
                reader = ChunkReader(number, len(data), self._channels, self._define, None, cut=chunk.cut)
                times += reader.whole(data).log_ns
                damaged = self._account_for_chunk(chunk, reader) or not data
                counts.append(reader.counts | Counter(chunk.counts) if damaged else reader.counts)
            times = [min(times), max(times)] if times else []
        return _total(counts), times

    def messages(self, channels: Collection[Channel]) -> Iterator[Message]:
        for block in self.blocks(channels):
            yield from block.messages()

    def blocks(self, channels: Collection[Channel], brief: Collection[Channel] = ()) -> Iterator[Block]:
        wanted = set(channels)
        chunks = self._layout.chunks
        numbers = (number for number, chunk in enumerate(chunks) if self._may_hold(chunk, wanted))
        for number, data in self._data.in_turn(numbers, self._stays if brief else None):
            chunk = chunks[number]
            if not self._may_hold(chunk, wanted):  # by a definition that came meanwhile
                continue
            end = chunk.stop - chunk.start if data is None else len(data)
            reader = ChunkReader(number, end, self._channels, self._define, wanted, brief, chunk.cut)
            if data is None:
                yield reader.in_place(lambda start, length, at=chunk.start: self._at(at + start, length))
            else:
                yield reader.whole(data)
            self._account_for_chunk(chunk, reader)

    def read(self, place: Place) -> Octets:
        number, start, stop = place
        chunk = self._layout.chunks[number]
        if self._local and self._is_plain(chunk):  # as when it was gone through
            return self._at(chunk.start + start, stop - start)
        return self._data.part(number, start, stop)

    def _account_for(self, found: dict[str, int], start_ns: int, end_ns: int) -> None:
        """What was not found, and how much of what was recorded that is."""
        layout, account, name = self._layout, self._notes.account, self._name
        recorded = topics_of(layout.recorded, self._channels)
        lost = dict(found)
        for chunk in layout.missing:
            counts = topics_of(chunk.counts, self._channels)
            spans = [(chunk.first_ns, chunk.last_ns)]
            spans = spans if chunk.last_ns else self._between(chunk.start, start_ns, end_ns)
            account.add("damaged_bytes", counts or None, (name, chunk.start), spans)
            for topic, count in counts.items():
                lost[topic] = lost.get(topic, 0) + count
        for start, stop in layout.gaps:
            detail = f"{name} is damaged near byte {start}; reading resumes at byte {stop}."
            account.add("damaged_bytes", None, (name, -start), self._between(start, start_ns, end_ns), detail)
        if layout.unknown_at is not None and (not recorded or sum(lost.values()) < sum(recorded.values())):
            detail = f"{name} has a record of an unknown kind at byte {layout.unknown_at}."
            account.add("damaged_bytes", None, (name, layout.unknown_at), [(start_ns, end_ns)], detail)
        if layout.cut_at is not None:
            total = sum(found.values())
            detail = (
                f"{name} is cut or damaged at byte {layout.cut_at} of {self._length}; "
                f"the {plural(total, 'message')} before it are read."
            )
            account.add("cut", None, (name, layout.cut_at), [(end_ns, end_ns)], detail)
        if layout.appended_at is not None:
            account.add_appended(name, layout.appended_at, self._length)
        if layout.index_cut_at is not None:
            self._notes.add(f"{name} is cut or damaged at byte {layout.index_cut_at}, after its last message.")
        whole = layout.cut_at is None and not layout.gaps
        account.know(name, recorded or (lost if whole or layout.missing else {}), start_ns)
        unexplained = account.settle({name}, recorded, found)
        if unexplained and sum(recorded.values()) > sum(lost.values()):  # else it names other topics
            detail = f"The statistics of {name} count more messages than it holds."
            account.add("damaged_bytes", unexplained, (name, 0), [(start_ns, end_ns)], detail)

    def _between(self, position: int, start_ns: int, end_ns: int) -> list[tuple[int, int]]:
        """The time between the chunk before a damaged place and the one behind it."""
        found = self._layout.chunks
        before = max((chunk.last_ns for chunk in found if chunk.stop <= position), default=start_ns)
        behind = min((chunk.first_ns for chunk in found if chunk.start > position), default=end_ns)
        return [(min(before, behind), max(before, behind))]

    def _define(self, opcode: int, data: bytes, doubtful: bool = False) -> None:
        stream = ReadDataStream(io.BytesIO(data))
        try:
            if opcode == Opcode.SCHEMA:
                schema = records.Schema.read(stream)
                if self._is_news(opcode, schema.id, schema.id in self._schemas, doubtful):
                    self._schemas[schema.id] = _ros_name(schema.name) if schema.encoding in _IDL else schema.name
            else:
                channel = records.Channel.read(stream)
                # A summary may repeat channels without their schemas: such a channel waits for the one in the data.
                known = channel.id in self._channels
                if channel.schema_id in self._schemas and self._is_news(opcode, channel.id, known, doubtful):
                    name = self._schemas[channel.schema_id]
                    self._channels[channel.id] = Channel(channel.topic, name, channel.message_encoding)
        except (struct.error, UnicodeDecodeError, McapError):
            self._notes.add(f"{self._name} holds a damaged schema or channel; its messages are left out.")

    def _define_doubtful(self) -> None:
        """Take schemas and channels of a damaged summary where no chunk has them."""
        for number in range(len(self._layout.chunks)):
            data = self._data(number)
            ChunkReader(number, len(data), self._channels, self._define, None).whole(data)
        for opcode, data in self._layout.spare:
            self._define(opcode, data, doubtful=True)
        self._layout.spare.clear()

    def _is_news(self, opcode: int, number: int, known: bool, doubtful: bool) -> bool:
        """The first sound definition of a number holds; one from a damaged chunk until there is a sound one."""
        news = not known or ((opcode, number) in self._doubtful and not doubtful)
        if news and doubtful:
            self._doubtful.add((opcode, number))
        elif news:
            self._doubtful.discard((opcode, number))
        return news

    def _account_for_chunk(self, chunk: Chunk, reader: ChunkReader) -> bool:
        """Account for what a chunk lacks; whether it is damaged."""
        key, account, counts = (self._name, chunk.start), self._notes.account, reader.counts
        known = {i: n for i, n in chunk.counts.items() if i in self._channels}
        fewer = not self._sound[reader.number] and counts.total() < sum(chunk.counts.values())
        damaged = reader.end > 0 and not chunk.cut and (reader.position < reader.end or fewer)
        if damaged:
            short = topics_of({i: n - counts[i] for i, n in known.items()}, self._channels)
            detail = f"{self._name} has a damaged chunk at byte {chunk.start}; the rest of it is left out."
            last_ns = chunk.first_ns if reader.last_ns is None else reader.last_ns
            span = (min(last_ns, chunk.last_ns), chunk.last_ns)
            account.add("damaged_chunk", short if chunk.counts else None, key, [span], detail)
        elif reader.unknown:
            account.add("unknown_channel", {"": reader.unknown}, key, [(chunk.first_ns, chunk.last_ns)])
        return damaged

    def _may_hold(self, chunk: Chunk, wanted: set[Channel]) -> bool:
        """Not where its indexes name only channels that are known and not wanted."""
        return not chunk.counts or any(self._channels.get(i) in wanted or i not in self._channels for i in chunk.counts)

    def _unpack(self, number: int) -> bytes:
        """The records of one chunk. Raises BadChunkError where it is damaged."""
        chunk = self._layout.chunks[number]
        data = self._at(chunk.start, chunk.stop - chunk.start)
        if chunk.compression is None:
            return data
        data = unpack(chunk.compression, data, chunk.size, partial=chunk.cut)
        if chunk.crc and not chunk.cut and not self._sound[number]:
            if crc32(data) != chunk.crc:
                raise BadChunkError("its checksum does not match", data)
            self._sound[number] = 1
        return data

    def _add_damaged_chunk(self, number: int, error: BadChunkError) -> None:
        """Account for a damaged chunk."""
        self._define_all(error.data)
        chunk = self._layout.chunks[number]
        detail = f"{self._name} has a damaged chunk at byte {chunk.start}, left out: {error}."
        span = (chunk.first_ns, max(chunk.first_ns, chunk.last_ns))
        counts = topics_of(chunk.counts, self._channels) if chunk.counts else None
        self._notes.account.add("damaged_chunk", counts, (self._name, chunk.start), [span], detail)

    def _is_cached(self, number: int) -> bool:
        """Parts of what is not packed can be read again by themselves, unless each costs a request."""
        return not self._local or not self._is_plain(self._layout.chunks[number])

    def _stays(self, number: int) -> bool:
        """Whether a chunk's messages can be found where they lie, without reading all of it."""
        chunk = self._layout.chunks[number]
        if not self._local or not self._is_plain(chunk) or chunk.cut:
            return False
        sound = not chunk.crc or bool(self._sound[number])
        return chunk.compression is None or (sound and chunk.stop - chunk.start == chunk.size)

    @staticmethod
    def _is_plain(chunk: Chunk) -> bool:
        return chunk.compression in (None, "", "none")

    def _define_all(self, data: bytes) -> None:
        """Schemas and channels of a chunk whose checksum is wrong: other chunks need them, and a wrong one fails to
        decode, which a wrong message may not."""
        position = 0
        while position + RECORD.size <= len(data):
            opcode, length = RECORD.unpack_from(data, position)
            position += RECORD.size
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and position + length <= len(data):
                self._define(opcode, data[position : position + length], doubtful=True)
            position += length


def _total(counts: Iterable[dict[int, int]]) -> dict[int, int]:
    """The sums of counts, zeros left out."""
    total: dict[int, int] = {}
    for each in counts:
        for channel_id, count in each.items():
            total[channel_id] = total.get(channel_id, 0) + count
    return {channel_id: count for channel_id, count in total.items() if count}


def _ros_name(name: str) -> str:
    """`sensor_msgs/msg/Image` of `sensor_msgs::msg::Image` and of DDS's `sensor_msgs::msg::dds_::Image_`."""
    return name.replace("::", "/").replace("/dds_/", "/").rstrip("_")
