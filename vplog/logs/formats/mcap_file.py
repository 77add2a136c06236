"""MCAP files (mcap.dev/spec), whole, cut, damaged or without a summary, as a Container."""

from __future__ import annotations

import io
import struct
from collections import Counter
from functools import partial
from typing import TYPE_CHECKING

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from vplog.logs.formats.chunk_cache import Chunks, reader_at
from vplog.logs.formats.compression import BadChunkError, crc32, unpack
from vplog.logs.formats.container import Channel, Contents, Notes
from vplog.logs.formats.layout import ChunkLosses
from vplog.logs.formats.loss_account import sampled
from vplog.logs.formats.mcap_chunk import ChunkReader
from vplog.logs.formats.mcap_layout import MAGIC, read_layout
from vplog.storage.remote_path import RemotePath

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from vplog.logs.formats.container import Message, Octets, Place
    from vplog.logs.formats.layout import Chunk

__all__ = ["MAGIC", "McapFile"]

_IDL = ("ros2idl", "omgidl")
"""Schema languages whose writers may name types as C++ and DDS do."""


class McapFile:
    """A Container over one MCAP file."""

    def __init__(self, path: Path, notes: Notes, name: str = "") -> None:
        """`name` is what the file is called in remarks."""
        self._name, self._notes, length = name or path.name, notes, path.stat().st_size
        self._file = path.open("rb")
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, str] = {0: ""}
        self._doubtful: set[tuple[int, int]] = set()
        """Opcodes and ids of schemas and channels from damaged chunks, until a sound one repeats it."""
        self._unread: dict[int, str] = {}
        """End of the sentence about each chunk that could not be unpacked, by its number."""
        self._layout = read_layout(self._file, length, self._define, self._name)
        self._losses = ChunkLosses(self._name, length, self._layout, self._channels, notes)
        self._local = not isinstance(path, RemotePath)
        self._at = reader_at(self._file, self._local)
        self._sound = bytearray(len(self._layout.chunks))
        """1 for chunks whose checksum was found right."""
        sizes = [chunk.stop - chunk.start if _is_plain(chunk) else chunk.size for chunk in self._layout.chunks]
        self._data = Chunks(self._unpack, self._add_damaged_chunk, sizes.__getitem__, self._is_cached, self._local)

    def contents(self) -> Contents:
        """Counted by the indexes behind the chunks; a chunk without is unpacked, as all are where the file's statistics
        differ or a channel is not defined: its definition may lie in any chunk before."""
        layout = self._layout
        by_id, times = self._counted(unpack_all=False)
        if layout.summary_definitions or by_id.keys() - self._channels.keys():
            self._define_all()
            by_id, times = self._counted(unpack_all=False)
        listed = sum((Counter(chunk.counts) for chunk in layout.missing), +by_id)
        if layout.recorded and layout.recorded != dict(listed) and layout.chunks:
            by_id, times = self._counted(unpack_all=True)
        for number in self._unread:  # more channels may be defined by now
            self._add_unread(number)
        return self._losses.contents(by_id, times, "statistics record")

    def _counted(self, unpack_all: bool) -> tuple[Counter[int], list[int]]:
        """Messages by channel id, and log times of each chunk, the first and last among them."""
        counts: Counter[int] = Counter()
        times: list[int] = []
        for number, chunk in enumerate(self._layout.chunks):
            sure = self._losses.is_counted(number) and not unpack_all
            if sure and chunk.counts.keys() <= self._channels.keys():
                counts.update(chunk.counts)
                times += (chunk.first_ns, chunk.last_ns)
            else:
                data = self._data(number)
                reader = ChunkReader(number, len(data), self._channels, self._define, None, cut=chunk.cut)
                times += sampled([message.log_ns for message in reader.whole(data)])
                damaged = self._account_for_chunk(chunk, reader) or not data
                counts.update(reader.counts | Counter(chunk.counts) if damaged else reader.counts)
                if not damaged:
                    chunk.counts = dict(reader.counts)
        return counts, times

    def messages(self, channels: Collection[Channel], brief: Collection[Channel] = ()) -> Iterator[Message]:
        wanted, chunks = set(channels), self._layout.chunks
        numbers = (number for number, chunk in enumerate(chunks) if self._losses.may_hold(chunk, wanted))
        for number, data in self._data.iterate(numbers, self._is_read_in_place if brief else None):
            chunk = chunks[number]
            if not self._losses.may_hold(chunk, wanted):  # by a definition that came meanwhile
                continue
            end = chunk.stop - chunk.start if data is None else len(data)
            reader = ChunkReader(number, end, self._channels, self._define, wanted, brief, chunk.cut)
            if data is None:
                yield from reader.in_place(lambda start, length, at=chunk.start: self._at(at + start, length))
            else:
                yield from reader.whole(data)
            self._account_for_chunk(chunk, reader)

    def read(self, place: Place) -> Octets:
        number, start, stop = place
        chunk = self._layout.chunks[number]
        if self._local and _is_plain(chunk):  # as when its messages were found
            return self._at(chunk.start + start, stop - start)
        return self._data.part(number, start, stop)

    def _define(self, opcode: int, data: bytes, doubtful: bool = False) -> None:
        """Take a schema or a channel: the first sound definition of a number, or a doubtful one until there is a sound
        one."""
        stream = ReadDataStream(io.BytesIO(data))
        try:
            record = records.Schema.read(stream) if opcode == Opcode.SCHEMA else records.Channel.read(stream)
        except (struct.error, UnicodeDecodeError, McapError):
            self._notes.add(f"{self._name} holds a damaged schema or channel; its messages are left out.")
            return
        known = self._schemas if isinstance(record, records.Schema) else self._channels
        if isinstance(record, records.Channel) and record.schema_id not in self._schemas:
            return  # a summary may repeat channels without their schemas: this one waits for that in the data
        key = opcode, record.id
        if record.id in known and (doubtful or key not in self._doubtful):
            return
        self._doubtful.add(key) if doubtful else self._doubtful.discard(key)
        if isinstance(record, records.Schema):
            name = record.name
            if record.encoding in _IDL:  # sensor_msgs::msg::Image, and DDS's sensor_msgs::msg::dds_::Image_
                name = name.replace("::", "/").replace("/dds_/", "/").rstrip("_")
            self._schemas[record.id] = name
        else:
            self._channels[record.id] = Channel(record.topic, self._schemas[record.schema_id], record.message_encoding)

    def _define_all(self) -> None:
        """Take the schemas and channels of all chunks, and those of a damaged summary where no chunk has them."""
        for number in range(len(self._layout.chunks)):
            data = self._data(number)
            ChunkReader(number, len(data), self._channels, self._define, None).whole(data)
        for opcode, data in self._layout.summary_definitions:
            self._define(opcode, data, doubtful=True)
        self._layout.summary_definitions.clear()

    def _account_for_chunk(self, chunk: Chunk, reader: ChunkReader) -> bool:
        """Account for what a chunk lacks; whether it is damaged."""
        counts = reader.counts
        fewer = not self._sound[reader.number] and counts.total() < sum(chunk.counts.values())
        damaged = reader.end > 0 and not chunk.cut and (reader.position < reader.end or fewer)
        if damaged:
            last_ns = chunk.first_ns if reader.last_ns is None else reader.last_ns
            span = min(last_ns, chunk.last_ns), chunk.last_ns
            self._losses.add_chunk(chunk, counts, [span], "; the rest of it is left out")
        self._losses.add_unknown(chunk, counts, damaged, [(chunk.first_ns, chunk.last_ns)])
        return damaged

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
        """Account for a damaged chunk, and take its schemas and channels, which other chunks need."""
        define = partial(self._define, doubtful=True)
        ChunkReader(number, len(error.data), self._channels, define, None).whole(error.data)
        self._unread[number] = f", left out: {error}"
        self._add_unread(number)

    def _add_unread(self, number: int) -> None:
        chunk = self._layout.chunks[number]
        span = chunk.first_ns, max(chunk.first_ns, chunk.last_ns)
        self._losses.add_chunk(chunk, {}, [span], self._unread[number])

    def _is_cached(self, number: int) -> bool:
        """Parts of what is not packed can be read again by themselves, unless each costs a request."""
        return not self._local or not _is_plain(self._layout.chunks[number])

    def _is_read_in_place(self, number: int) -> bool:
        """Whether a chunk's messages can be found where they lie, without reading all of it."""
        chunk = self._layout.chunks[number]
        if not self._local or not _is_plain(chunk) or chunk.cut:
            return False
        sound = not chunk.crc or bool(self._sound[number])
        return chunk.compression is None or (sound and chunk.stop - chunk.start == chunk.size)


def _is_plain(chunk: Chunk) -> bool:
    return chunk.compression in (None, "", "none")
