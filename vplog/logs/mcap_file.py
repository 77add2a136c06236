"""MCAP files (mcap.dev/spec), whole, cut or without a summary.

The file is walked record by record once; chunks are stepped over, so that walk reads a few kB per MB. What the
message indexes behind the chunks say then spares the unpacking of chunks without a topic of interest.
"""

from __future__ import annotations

import io
import struct
import zlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from vplog.errors import LogError
from vplog.logs.chunks import ChunkCache
from vplog.logs.compression import BadChunkError, unpack
from vplog.logs.containers import Channel, Contents, Message, Notes, count_messages, ordered, plural

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from pathlib import Path

    from vplog.logs.containers import Place

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
"""Opcode and length before every record."""
_MESSAGE = struct.Struct("<HIQQ")
"""Channel id, sequence, log time, publish time: the head of a message record."""
_CHUNK_HEAD = struct.Struct("<QQQII")
"""Start, end, unpacked size, CRC, length of the compression's name: the head of a chunk record."""
_MAX_DEFINITION = 16 * 2**20
"""Bytes of a schema or channel record that are read; the largest real schemas are some 100 kB."""


@dataclass
class _Chunk:
    """A chunk of messages; or, with compression None, one message record outside any chunk."""

    start: int
    """Offset of the record's content in the file."""
    stop: int
    compression: str | None
    size: int
    crc: int
    first_ns: int
    last_ns: int
    counts: dict[int, int] = field(default_factory=dict)
    """Messages per channel id, from the message indexes behind it; empty where the writer left none."""
    cut: bool = False


class McapFile:
    """A Container over one MCAP file."""

    def __init__(self, path: Path, notes: Notes) -> None:
        self._path, self._notes = path, notes
        self._file = path.open("rb")
        self._length = path.stat().st_size
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, str] = {0: ""}
        self._chunks: list[_Chunk] = []
        self._cut_at: int | None = None
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
        if any(not c.counts or not c.counts.keys() <= self._channels.keys() for c in self._chunks):
            return None
        counts = dict.fromkeys(self._channels.values(), 0)
        for chunk in self._chunks:
            for channel_id, count in chunk.counts.items():
                counts[self._channels[channel_id]] += count
        start_ns = min((chunk.first_ns for chunk in self._chunks), default=0)
        return Contents(ordered(counts), start_ns, max((chunk.last_ns for chunk in self._chunks), default=0))

    def _walk(self) -> None:
        """Find every chunk and definition of the data and summary sections."""
        if self._file.read(len(MAGIC)) != MAGIC:
            raise LogError(f"{self._path} does not start as an MCAP file does.")
        position, ended = len(MAGIC), False
        while not ended:
            head = self._at(position, _RECORD.size) if position < self._length else b""
            if len(head) < _RECORD.size:
                break
            opcode, length = _RECORD.unpack(head)
            start = position + _RECORD.size
            stop = start + length
            if opcode == 0 or (stop > self._length and opcode != Opcode.CHUNK):
                break  # opcode 0 is invalid by the specification
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(opcode, self._at(start, min(length, _MAX_DEFINITION)))
            elif opcode == Opcode.CHUNK:
                self._add_chunk(start, min(stop, self._length), cut=stop > self._length)
            elif opcode == Opcode.MESSAGE:
                self._add_lone_message(start, stop)
            elif opcode == Opcode.MESSAGE_INDEX and self._chunks and length >= 6:  # channel id, size of its entries
                channel_id, size = struct.unpack("<HI", self._at(start, 6))
                if size:
                    self._chunks[-1].counts[channel_id] = size // 16  # each entry: time and offset, 8 bytes each
            ended = opcode == Opcode.FOOTER
            position = stop
        if not ended:
            self._cut_at = min(position, self._length)

    def _add_chunk(self, start: int, stop: int, cut: bool) -> None:
        head = self._at(start, _CHUNK_HEAD.size)
        if len(head) < _CHUNK_HEAD.size:
            return
        first_ns, last_ns, size, crc, name_length = _CHUNK_HEAD.unpack(head)
        name = self._at(start + _CHUNK_HEAD.size, min(name_length, 20))  # known names have 0 to 4 bytes
        data = start + _CHUNK_HEAD.size + name_length + 8
        if data <= stop and size:
            (length,) = struct.unpack("<Q", self._at(data - 8, 8))
            stop = min(stop, data + length)
            kind = name.decode("utf-8", "replace")
            self._chunks.append(_Chunk(data, stop, kind, size, crc, first_ns, last_ns, cut=cut))

    def _add_lone_message(self, start: int, stop: int) -> None:
        """Neighbouring messages outside chunks are kept as one run."""
        last = self._chunks[-1] if self._chunks else None
        if last and last.compression is None and last.stop == start - _RECORD.size and stop - last.start < 2**20:
            last.stop = stop
        else:
            self._chunks.append(_Chunk(start - _RECORD.size, stop, None, 0, 0, 0, 0))

    def _define(self, opcode: int, data: bytes) -> None:
        stream = ReadDataStream(io.BytesIO(data))
        try:
            if opcode == Opcode.SCHEMA:
                schema = records.Schema.read(stream)
                self._schemas[schema.id] = schema.name
            else:
                channel = records.Channel.read(stream)
                # A summary may repeat channels without their schemas: such a channel waits for the one in the data.
                if channel.schema_id in self._schemas and channel.id not in self._channels:
                    name = self._schemas[channel.schema_id]
                    self._channels[channel.id] = Channel(channel.topic, name, channel.message_encoding)
        except (struct.error, UnicodeDecodeError, McapError):
            self._notes.add(f"{self._path.name} holds a damaged schema or channel; its messages are left out.")

    def _scan(self, wanted: set[Channel] | None) -> Iterator[Message]:
        unknown = 0
        for number, chunk in enumerate(self._chunks):
            if wanted is not None and not self._may_hold(chunk, wanted):
                continue
            data = self._data(number)
            position = 0
            while position + _RECORD.size <= len(data):
                opcode, length = _RECORD.unpack_from(data, position)
                start, stop = position + _RECORD.size, position + _RECORD.size + length
                if stop > len(data):
                    self._notes.add(
                        f"{self._path.name} has a damaged chunk at byte {chunk.start}; the rest of it is left out."
                    )
                    break
                if opcode == Opcode.MESSAGE and length >= _MESSAGE.size:
                    channel_id, _, log_ns, _ = _MESSAGE.unpack_from(data, start)
                    channel = self._channels.get(channel_id)
                    unknown += channel is None
                    if channel is not None and (wanted is None or channel in wanted):
                        body = start + _MESSAGE.size
                        yield Message(channel, log_ns, data[body:stop], (number, body, stop))
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._define(opcode, data[start:stop])
                position = stop
        if unknown:
            self._notes.add(f"{self._path.name}: {plural(unknown, 'message')} of unknown channels left out.")

    def _may_hold(self, chunk: _Chunk, wanted: set[Channel]) -> bool:
        """Not where its indexes name only channels that are known and not wanted."""
        return not chunk.counts or any(self._channels.get(i) in wanted or i not in self._channels for i in chunk.counts)

    def _unpack(self, number: int) -> bytes:
        """The records of one chunk; empty, with a note, where it is damaged."""
        chunk = self._chunks[number]
        data = self._at(chunk.start, chunk.stop - chunk.start)
        if chunk.compression is not None:
            try:
                data = unpack(chunk.compression, data, chunk.size, partial=chunk.cut)
                if chunk.crc and not chunk.cut and zlib.crc32(data) != chunk.crc:
                    raise BadChunkError("its checksum does not match")
            except BadChunkError as error:
                self._notes.add(f"{self._path.name} has a damaged chunk at byte {chunk.start}, left out: {error}.")
                data = b""
        return data

    def _at(self, position: int, length: int) -> bytes:
        self._file.seek(position)
        return self._file.read(length)
