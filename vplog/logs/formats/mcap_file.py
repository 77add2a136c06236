"""MCAP files (mcap.dev/spec), whole, cut, damaged or without a summary, as a Container."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Set
from functools import partial
from pathlib import Path

from mcap import records
from mcap.opcode import Opcode

from vplog.logs.formats.budget import Budget
from vplog.logs.formats.chunk_cache import Chunks, reader_at
from vplog.logs.formats.compression import BadChunkError, crc32, unpack
from vplog.logs.formats.container import HEADER_BYTES, Channel, Contents, Message, Notes, Place, RawData, part_of
from vplog.logs.formats.mcap_layout import RECORD, Definition, parse, read_layout
from vplog.logs.formats.salvage import Chunk, ChunkRead, FileLosses
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
        self._doubtful: list[Definition] = []
        """Schemas and channels from a damaged summary or chunk, for ids that nothing else defines."""
        self._unread: dict[int, str] = {}
        """By number of a chunk that could not be unpacked: the end of the sentence about it."""
        self._contents: Contents | None = None
        self._layout = read_layout(self._file, length, self._define, self._name)
        self._losses = FileLosses(self._name, length, self._layout, self._channels, notes)
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
        """Return the counts by the indexes of the chunks, which are read only if the file is damaged or has none."""
        self._contents = self._contents or self._losses.contents(self._read_chunk, self._define_all)
        return self._contents

    def _read_chunk(self, number: int) -> ChunkRead:
        data = self._data(number)
        reader = self._reader(number, len(data))
        return self._outcome(reader, [message.log_ns for message in reader.read(data)])

    def _outcome(self, reader: ChunkReader, log_ns: list[int]) -> ChunkRead:
        rest = "; the rest of it is left out" if reader.position < reader.end else ""
        problem = self._unread.get(reader.number, rest)
        return ChunkRead(
            reader.number, reader.counts, log_ns, reader.last_ns, problem, bool(self._sound[reader.number])
        )

    def messages(self, channels: Collection[Channel], header_only: Collection[Channel] = ()) -> Iterator[Message]:
        wanted, chunks = set(channels), self._layout.chunks
        numbers = (number for number, chunk in enumerate(chunks) if self._losses.may_hold(chunk, wanted))
        in_place = (self._is_read_in_place,) if header_only else ()
        for number, data in self._data.iterate(numbers, *in_place):
            chunk = chunks[number]
            end = chunk.stop - chunk.start if data is None else len(data)
            reader = self._reader(number, end, wanted, header_only)
            if data is None:
                yield from reader.read_in_place(lambda start, length, at=chunk.start: self._at(at + start, length))
            else:
                yield from reader.read(data)
            self._losses.check(self._outcome(reader, []))

    def read(self, place: Place) -> RawData:
        number, start, stop = place
        chunk = self._layout.chunks[number]
        if self._local and _is_plain(chunk):  # as when its messages were found
            return self._at(chunk.start + start, stop - start)
        return self._data.part(number, start, stop)

    def _define(self, record: Definition | None, doubtful: bool = False) -> None:
        """Take the first definition of each schema and channel, and keep doubtful ones."""
        if record is None:
            self._notes.add(f"{self._name} holds a damaged schema or channel; its messages are left out.")
        elif doubtful:
            self._doubtful.append(record)
        elif isinstance(record, records.Schema):
            name = record.name
            if record.encoding in _IDL:  # sensor_msgs::msg::Image, and DDS's sensor_msgs::msg::dds_::Image_
                name = name.replace("::", "/").replace("/dds_/", "/").rstrip("_")
            self._schemas.setdefault(record.id, name)
        elif record.schema_id in self._schemas:  # a summary may repeat channels without their schemas, as chunks do not
            channel = Channel(record.topic, self._schemas[record.schema_id], record.message_encoding)
            self._channels.setdefault(record.id, channel)

    def _define_all(self, ids: Set[int]) -> None:
        """Read chunks until these channels are defined, then take doubtful definitions of those that are not."""
        for number in range(len(self._layout.chunks)):
            if ids <= self._channels.keys():
                return
            data = self._data(number)
            self._reader(number, len(data)).read(data)
        for record in self._doubtful:
            self._define(record)

    def _reader(
        self,
        number: int,
        end: int,
        wanted: Collection[Channel] | None = None,
        header_only: Collection[Channel] = (),
        doubtful: bool = False,
    ) -> ChunkReader:
        """Return a reader of chunk `number`. The definitions of a damaged chunk are `doubtful`."""

        def define(opcode: int, data: bytes) -> None:
            self._define(parse(opcode, data), doubtful)  # pyrefly: ignore[bad-argument-type]

        cut = self._layout.chunks[number].cut and not doubtful
        return ChunkReader(number, end, self._channels, define, wanted, header_only, cut, self._budget)

    def _unpack(self, number: int) -> bytes:
        """Return the records of one chunk. Raises BadChunkError if it is damaged."""
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
        """Record why a damaged chunk is left out. Its schemas and channels are kept for other chunks."""
        self._reader(number, len(error.data), doubtful=True).read(error.data)
        self._unread[number] = f", left out: {error}"

    def _is_read_in_place(self, number: int) -> bool:
        """Return whether single messages can be read from the file: the chunk is local, uncompressed and sound."""
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
        """Return the messages of the chunk; `data` are all of its bytes."""
        self._parse(data)
        return self._without_damaged()

    def read_in_place(self, read: Callable[[int, int], bytes]) -> list[Message]:
        """Return the messages of a chunk that is not compressed; `read(start, length)` returns bytes of it."""
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
        """Return the messages found, without the one before damage, because its length may be damaged."""
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
        """Parse `data`, which lie at `position` in the chunk, up to the first record that needs more bytes."""
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
        """Return whether more of a message is needed than the bytes that are there."""
        channel = self._channel(channel_id)
        return channel is not None and (channel not in self._header_only or there < HEADER_BYTES or length < _WINDOW)
