"""MCAP files (mcap.dev/spec), whole, cut, damaged or without a summary, as a Container."""

from __future__ import annotations

import io
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from vplog.logs.formats.budget import Budget
from vplog.logs.formats.chunk_cache import Chunks, reader_at
from vplog.logs.formats.chunk_layout import Chunk, ChunkLosses
from vplog.logs.formats.compression import BadChunkError, crc32, unpack
from vplog.logs.formats.container import HEADER_BYTES, Channel, Contents, Message, Notes, Place, RawData, part_of
from vplog.logs.formats.loss_account import sampled
from vplog.logs.formats.mcap_layout import RECORD, read_layout
from vplog.storage.remote_path import RemotePath

_IDL = ("ros2idl", "omgidl")
"""Schema languages whose writers may name types as C++ and DDS do."""
_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode and length; channel id, sequence, log time, publish time: a message record up to its data."""
_IS_MESSAGE, _IS_SCHEMA, _DEFINES = int(Opcode.MESSAGE), int(Opcode.SCHEMA), (int(Opcode.SCHEMA), int(Opcode.CHANNEL))
_OUTSIDE = frozenset({0, *map(int, Opcode)}.difference(_DEFINES, [_IS_MESSAGE]))
"""Opcodes that no record in a chunk has; those not known yet are stepped over, as the specification requires."""
_WINDOW = 4096
"""Bytes that are read of a chunk at once where most of its bytes are those of images, which are stepped over."""


class McapFile:
    """A Container over one MCAP file."""

    def __init__(self, path: Path, notes: Notes, name: str = "", budget: Budget | None = None) -> None:
        """`name` is what the file is called in remarks. `budget` limits its content, by default by its size."""
        self._name, self._notes, length = name or path.name, notes, path.stat().st_size
        self._budget = budget or Budget(str(path), length)
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
        # parts of what is not packed can be read again by themselves, unless each costs a request
        cached = [not self._local or not _is_plain(chunk) for chunk in self._layout.chunks]
        load, damaged = self._unpack, self._add_damaged_chunk
        self._data = Chunks(load, damaged, sizes.__getitem__, cached.__getitem__, self._local)

    def contents(self) -> Contents:
        """Counted by the indexes behind the chunks; a chunk without is unpacked, as all are where the file's statistics
        differ or a channel is not defined: its definition may lie in any chunk before."""
        layout = self._layout
        by_id, times = self._counted(unpack_all=False)
        if layout.summary_definitions or by_id.keys() - self._channels.keys():
            self._define_all()
            by_id, times = self._counted(unpack_all=False)
        listed = +by_id
        for chunk in layout.missing:
            listed.update(chunk.counts)
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
                reader = self._reader(number, len(data))
                times += sampled([message.log_ns for message in reader.read(data)])
                damaged = self._account_for_chunk(chunk, reader) or not data
                counts.update(reader.counts | Counter(chunk.counts) if damaged else reader.counts)
                if not damaged:
                    chunk.counts = dict(reader.counts)
        return counts, times

    def messages(self, channels: Collection[Channel], header_only: Collection[Channel] = ()) -> Iterator[Message]:
        wanted, chunks = set(channels), self._layout.chunks
        numbers = (number for number, chunk in enumerate(chunks) if self._losses.may_hold(chunk, wanted))
        in_place = (self._is_read_in_place,) if header_only else ()
        for number, data in self._data.iterate(numbers, *in_place):
            chunk = chunks[number]
            if not self._losses.may_hold(chunk, wanted):  # by a definition that came meanwhile
                continue
            end = chunk.stop - chunk.start if data is None else len(data)
            reader = self._reader(number, end, wanted, header_only)
            if data is None:
                yield from reader.read_in_place(lambda start, length, at=chunk.start: self._at(at + start, length))
            else:
                yield from reader.read(data)
            self._account_for_chunk(chunk, reader)

    def read(self, place: Place) -> RawData:
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
            self._reader(number, len(data)).read(data)
        for opcode, data in self._layout.summary_definitions:
            self._define(opcode, data, doubtful=True)
        self._layout.summary_definitions.clear()

    def _reader(
        self,
        number: int,
        end: int,
        wanted: Collection[Channel] | None = None,
        header_only: Collection[Channel] = (),
        doubtful: bool = False,
    ) -> ChunkReader:
        """Return a reader of chunk `number`. The definitions of a damaged chunk are `doubtful`."""
        define, cut = partial(self._define, doubtful=doubtful), self._layout.chunks[number].cut and not doubtful
        return ChunkReader(number, end, self._channels, define, wanted, header_only, cut, self._budget)

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
        charge = partial(self._budget.charge_bytes, number)
        data = unpack(chunk.compression, data, chunk.size, chunk.cut, charge)
        if chunk.crc and not chunk.cut and not self._sound[number]:
            if crc32(data) != chunk.crc:
                raise BadChunkError("its checksum does not match", data)
            self._sound[number] = 1
        return data

    def _add_damaged_chunk(self, number: int, error: BadChunkError) -> None:
        """Account for a damaged chunk, and take its schemas and channels, which other chunks need."""
        self._reader(number, len(error.data), doubtful=True).read(error.data)
        self._unread[number] = f", left out: {error}"
        self._add_unread(number)

    def _add_unread(self, number: int) -> None:
        chunk = self._layout.chunks[number]
        span = chunk.first_ns, max(chunk.first_ns, chunk.last_ns)
        self._losses.add_chunk(chunk, {}, [span], self._unread[number])

    def _is_read_in_place(self, number: int) -> bool:
        """Whether a chunk's messages can be found where they lie, without reading all of it."""
        chunk = self._layout.chunks[number]
        if not self._local or not _is_plain(chunk) or chunk.cut:
            return False
        sound = not chunk.crc or bool(self._sound[number])
        return chunk.compression is None or (sound and chunk.stop - chunk.start == chunk.size)


def _is_plain(chunk: Chunk) -> bool:
    return chunk.compression in (None, "", "none")


class ChunkReader:
    """Messages found so far in chunk `number`, from its first byte to `position`."""

    def __init__(
        self,
        number: int,
        end: int,
        channels: dict[int, Channel],
        define: Callable[[int, bytes], None],
        wanted: Collection[Channel] | None,
        header_only: Collection[Channel] = (),
        cut: bool = False,
        budget: Budget | None = None,
    ) -> None:
        """`end` is its length, `cut` whether the file ends in it. Messages on `wanted` channels are given (None: on
        all); those on `header_only` ones need not be whole. `define` takes a schema or channel record and may add to
        `channels`. `budget` is that of the file; by default, that of a file of this length."""
        self.position = 0
        self.last_ns: int | None = None
        """Log time of the last message, on whatever channel."""
        self.number, self.end, self._channels, self._define = number, end, channels, define
        self._wanted, self._header_only, self._cut = wanted, header_only, cut
        self._budget = budget or Budget(f"Chunk {number}", end)
        self._used: dict[int, Channel | None] = {}
        """Channels of the messages found so far, None for those that are not wanted."""
        self._ids: list[int] = []
        self._messages: list[Message] = []

    @property
    def counts(self) -> Counter[int]:
        """Messages by channel id."""
        return Counter(self._ids)

    def read(self, data: bytes) -> list[Message]:
        """The messages of the chunk, of which `data` are all bytes."""
        self._parse(data)
        return self._without_damaged()

    def read_in_place(self, read: Callable[[int, int], bytes]) -> list[Message]:
        """The messages of a chunk that is not packed, from what `read(start, length)` gives of its bytes."""
        while (left := self.end - self.position) >= RECORD.size:
            before = self.position
            data = read(before, min(_WINDOW, left))
            self._parse(data)
            if self.position == before:
                length = RECORD.size + RECORD.unpack_from(data)[1] if len(data) >= RECORD.size else left + 1
                if not len(data) < length <= left:
                    break
                self._parse(read(before, length))
                if self.position == before:
                    break
        return self._without_damaged()

    def _without_damaged(self) -> list[Message]:
        """The messages found, without the one before damage: its length may be what is damaged."""
        self._budget.charge_messages(self.number, len(self._ids))
        if self.position < self.end and not self._cut and self._ids and self._channel(self._ids.pop()):
            self._messages.pop()
        return self._messages

    def _channel(self, number: int) -> Channel | None:
        """Return the channel of this number, or None if it is not wanted or not defined."""
        if number not in self._used:
            channel = self._channels.get(number)
            self._used[number] = channel if self._wanted is None or channel in self._wanted else None
        return self._used[number]

    def _parse(self, data: bytes) -> None:
        """On through `data`, which lie at `position` in the chunk, up to the first record that more is needed of."""
        base, at, size, left = self.position, 0, len(data), self.end - self.position
        max_messages = self._budget.max_messages
        while at + _MESSAGE.size <= size:
            opcode, length, channel_id, _, log_ns, _ = _MESSAGE.unpack_from(data, at)
            start, stop = at + _MESSAGE.size, at + RECORD.size + length
            if stop < start if opcode == _IS_MESSAGE else opcode in _OUTSIDE:
                break
            if stop > size and (
                opcode != _IS_MESSAGE or stop > left or self._is_needed(channel_id, size - start, length)
            ):
                break
            if opcode == _IS_MESSAGE:
                self._ids.append(channel_id)
                if len(self._ids) > max_messages:
                    raise self._budget.error()
                self.last_ns = log_ns
                if (channel := self._channel(channel_id)) is not None:
                    place = self.number, base + start, base + stop
                    self._messages.append(Message(channel, log_ns, part_of(data, start, stop), place))
            elif opcode in _DEFINES:
                self._take_definition(opcode, data[at + RECORD.size : stop])
            at = stop
        while at + RECORD.size <= size:  # too short for a message
            opcode, length = RECORD.unpack_from(data, at)
            stop = at + RECORD.size + length
            if stop > size or opcode == _IS_MESSAGE or opcode in _OUTSIDE:
                break
            if opcode in _DEFINES:
                self._take_definition(opcode, data[at + RECORD.size : stop])
            at = stop
        self.position = base + at

    def _take_definition(self, opcode: int, data: bytes) -> None:
        self._define(opcode, data)
        if opcode != _IS_SCHEMA:
            self._used.pop(int.from_bytes(data[:2], "little"), None)  # the number of the channel, which may be new

    def _is_needed(self, channel_id: int, there: int, length: int) -> bool:
        """Whether more of a message is needed than the bytes that are there."""
        channel = self._channel(channel_id)
        return channel is not None and (channel not in self._header_only or there < HEADER_BYTES or length < _WINDOW)
