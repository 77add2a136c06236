"""Chunks of an MCAP file (mcap.dev/spec): from its summary if that is sound, else record by record and over damage.

A record has its length twice: before its fields, and by the lengths among them. If the two agree, the record is valid.
If they differ, the length with a valid record after it holds. Otherwise the walk resumes at the next valid record.
"""

from __future__ import annotations

import io
import re
import struct
from collections import Counter
from collections.abc import Callable
from typing import BinaryIO

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader

from vplog.errors import LogError
from vplog.logs.formats.compression import KINDS, crc32
from vplog.logs.formats.salvage import MAX_GAPS, Chunk, Layout, ResyncSearch

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
"""Opcode and length before every record."""
_MESSAGE_INDEX = int(Opcode.MESSAGE_INDEX)
_INDEX_HEAD = struct.Struct("<BQHI")
"""Opcode, length, channel id, bytes of entries: a message index up to its entries."""
_CHUNK_HEAD = struct.Struct("<QQQII")
"""Start, end, unpacked size, CRC, length of the compression's name: the head of a chunk record."""
_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel id, sequence, log time, publish time: the head of a message record."""
_FOOTER = struct.Struct("<BQQQI")
"""Opcode 2, length 20, starts of the summary and of its offsets, CRC; the magic follows it, and the file ends."""
_ENTRY = 16
"""Bytes of an entry of a message index: time and offset, 8 each."""
_MAX_DEFINITION = 16 * 2**20
"""Bytes of a schema or channel record that are read; the largest real schemas are some 100 kB."""
_MAX_SUMMARY = 64 * 2**20
"""Bytes of a summary that is read at once; one of 100,000 chunks has some 10 MB."""
_RUN = 2**20
"""Bytes up to which neighbouring messages outside chunks form one run."""
_FARTHEST_NS = 10 * 365 * 86_400 * 10**9
"""ns between two messages of a log above which bytes that look like a message are none: ten years."""
_PRIVATE = 0x80
"""Opcodes from here on belong to applications and are skipped, as the specification requires."""
_BEGIN = re.compile(re.escape(MAGIC) + rb"\x01")
"""Magic bytes of a recording: another one may be appended to the first."""
_FILLED = re.compile(rb"[^\0]")
"""Anything but the zeros that a disk may leave after the end."""
_U32, _U64 = -4, -8
"""Bytes that follow a length of 4 or 8 bytes, in _SHAPES."""
_SHAPES: dict[int, tuple[int, ...]] = {
    Opcode.HEADER: (_U32, _U32),
    Opcode.FOOTER: (20,),
    Opcode.SCHEMA: (2, _U32, _U32, _U32),
    Opcode.CHANNEL: (4, _U32, _U32, _U32),
    Opcode.CHUNK: (28, _U32, _U64),
    Opcode.MESSAGE_INDEX: (2, _U32),
    Opcode.CHUNK_INDEX: (32, _U32, 8, _U32, 16),
    Opcode.ATTACHMENT: (16, _U32, _U32, _U64, 4),
    Opcode.ATTACHMENT_INDEX: (40, _U32, _U32),
    Opcode.STATISTICS: (42, _U32),
    Opcode.METADATA: (_U32, _U32),
    Opcode.METADATA_INDEX: (16, _U32),
    Opcode.SUMMARY_OFFSET: (17,),
    Opcode.DATA_END: (4,),
}
"""Fields of each kind of record but messages: bytes of numbers, or _U32, _U64."""
_OUTSIDE_CHUNKS = re.compile(rb"[\x06-\x0f].{5}\x00{3}", re.DOTALL)
"""The opcode of a record that lies in no chunk, and a length below 2^40 bytes."""
_CHUNKS = re.compile(rb"[\x06\x07].{5}\x00{3}", re.DOTALL)
"""The opcode of a chunk or a message index, and a length below 2^40 bytes."""
_MESSAGES = re.compile(rb"\x05.{3}\x00{5}", re.DOTALL)
"""The opcode of a message, and a length below 2^24 bytes."""
_UNCHUNKED = re.compile(rb"[\x03-\x05\x09\x0c\x0f].{3}\x00{5}", re.DOTALL)
"""The opcode of a record in the data of a file without chunks, and a length below 2^24 bytes."""
_BAD_RECORD = (McapError, struct.error, UnicodeDecodeError, OverflowError)
"""Errors of the mcap library for records that it cannot read."""
_PARSED: dict[int, type[records.Schema | records.Channel | records.Statistics | records.ChunkIndex]] = {
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.STATISTICS: records.Statistics,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
}

Definition = records.Schema | records.Channel


def read_layout(file: BinaryIO, length: int, define: Callable[[Definition | None, bool], None], name: str) -> Layout:
    """Return the chunks of a file. `define` gets every schema and channel record outside the chunks (None for one that
    is damaged), and whether it may be wrong. Raises LogError if the file is not an MCAP."""
    walk = _Walk(file, length, define)
    if walk.at(0, len(MAGIC)) != MAGIC:
        raise LogError(f"{name} is not an MCAP file: it does not start with MCAP's magic bytes.")
    walk.read_summary()
    if not walk.is_indexed():
        walk.records(len(MAGIC))
        walk.finish()
    return walk.layout


def parse(opcode: int, data: bytes) -> Definition | records.Statistics | records.ChunkIndex | None:
    """Return a record as the mcap library reads it, or None if it is damaged or of another kind."""
    try:
        return _PARSED[opcode].read(ReadDataStream(io.BytesIO(data)))
    except (*_BAD_RECORD, KeyError):
        return None


class _Walk:
    def __init__(self, file: BinaryIO, length: int, define: Callable[[Definition | None, bool], None]) -> None:
        self._length, self._define = length, define
        self.layout = Layout()
        self._listed: dict[int, Chunk] = {}
        """By offset of its record: chunks as the summary lists them."""
        self._unfit: list[tuple[int, int]] = []
        """Offset and opcode of records of other lengths than their fields, which may have been messages."""
        self._chunked = False
        self._indexing: Chunk | None = None
        """The chunk whose message indexes are being read."""
        self._search = ResyncSearch(file, length)
        self.at = self._search.at
        self._summary_start = length
        self._summary_sound: bool | None = None
        """Whether the checksum of the summary is right; None if there is no checksum or no summary."""

    def read_summary(self) -> None:
        """Read the summary at the end of the file unless its checksum is wrong."""
        size = _FOOTER.size + len(MAGIC)
        tail = self.at(self._length - size, size)
        if len(tail) < size or not tail.endswith(MAGIC):
            return
        opcode, length, start, _, crc = _FOOTER.unpack_from(tail)
        if (opcode, length) != (Opcode.FOOTER, 20) or not 0 < start < self._length <= start + _MAX_SUMMARY:
            return
        self._summary_start, data = start, self.at(start, self._length - start)
        if crc:
            self._summary_sound = crc32(data[: -len(MAGIC) - 4]) == crc
        if self._summary_sound is False:
            return
        summary = io.BytesIO(data)
        try:
            for record in StreamReader(summary, skip_magic=True, emit_chunks=True).records:
                self._take(record)
        except _BAD_RECORD:
            self._summary_sound = False
        if summary.tell() < len(data):  # another recording follows
            self._summary_sound = False

    def is_indexed(self) -> bool:
        """Return whether the summary counts every message and each of its chunks begins where it says."""
        layout, counts = self.layout, Counter[int]()
        for chunk in self._listed.values():
            counts.update(chunk.counts)
        if self._summary_sound is False or not counts or dict(counts) != layout.recorded:
            return False
        chunks, end = sorted(self._listed.values(), key=lambda chunk: chunk.start), len(MAGIC)
        for chunk in chunks:
            head = self.at(chunk.record, RECORD.size + _CHUNK_HEAD.size).ljust(RECORD.size + _CHUNK_HEAD.size, b"\0")
            opcode, length = RECORD.unpack_from(head)
            *fields, chunk.crc, name_length = _CHUNK_HEAD.unpack_from(head, RECORD.size)
            if (
                (opcode, chunk.record + RECORD.size + length) != (Opcode.CHUNK, chunk.stop)
                or fields != [chunk.first_ns, chunk.last_ns, chunk.size]
                or name_length != len(chunk.compression or "")
                or not end <= chunk.record < chunk.start <= chunk.stop <= self._summary_start
            ):
                return False
            end = chunk.stop
        layout.chunks = chunks
        return True

    def records(self, position: int) -> None:
        """Read every record from here on, to the footer or the end."""
        before, data_ended = position, False
        while True:
            opcode, stop = self._bounds(position)
            if not opcode:
                if data_ended and not self._has_messages(position):
                    self.layout.index_cut_at = min(position, self._length)
                    self.layout.appended_at = self._search.first(_BEGIN, position)
                    return
                resumed = self._resume(before, position) if len(self.layout.gaps) < MAX_GAPS else None
                if resumed is None:
                    self.layout.cut_at = min(position, self._length)
                    return
                before = position = resumed
                continue
            self._record(opcode, position, min(stop, self._length), cut=stop > self._length)
            if opcode == Opcode.FOOTER or (opcode == Opcode.DATA_END and self._summary_sound):  # read before
                if opcode == Opcode.FOOTER and self._search.first(_FILLED, stop + len(MAGIC)) is not None:
                    self.layout.appended_at = stop + len(MAGIC)
                return
            if stop > self._length:
                self.layout.cut_at = self._length
                return
            data_ended = data_ended or opcode in (Opcode.DATA_END, Opcode.STATISTICS, Opcode.CHUNK_INDEX)
            start = position + RECORD.size
            if opcode != Opcode.MESSAGE and not self._chunked and self._length_by_fields(opcode, start) != stop - start:
                self._unfit.append((position, opcode))
            before, position = position, stop

    def finish(self) -> None:
        """Add the chunks that the summary lists in damaged bytes, and a message that damage made another record."""
        layout, found = self.layout, {chunk.record for chunk in self.layout.chunks}
        if not self._chunked:
            timed = any(chunk.last_ns > _FARTHEST_NS for chunk in layout.chunks)  # else any field may be a time
            unfit = ((at, opcode) for at, opcode in self._unfit if timed or opcode not in _SHAPES)
            at = next((at for at, opcode in unfit if self._is_message_head(at, opcode)), None)
            layout.gaps += [] if at is None else [(at, at)]
        absent = [self._listed[at] for at in self._listed.keys() - found]
        if found and all(layout.is_in_gap(chunk.record) for chunk in absent):
            orphans = [chunk for chunk in layout.missing if not layout.is_in_gap(chunk.record)]
            layout.missing = absent + orphans if self._listed else layout.missing
            layout.gaps = [] if self._listed else layout.gaps
        layout.chunks.sort(key=lambda chunk: chunk.start)
        layout.sound &= not (layout.gaps or layout.missing or absent)

    def _bounds(self, position: int, nested: bool = False) -> tuple[int, int]:
        """Return the opcode of the record at `position` and its end, with either repaired if it is damaged. The opcode
        is 0, which is invalid, if there is no record. A chunk may end after the file."""
        head = self.at(position, RECORD.size)
        if len(head) < RECORD.size:
            return 0, 0
        opcode, length = RECORD.unpack(head)
        start = position + RECORD.size
        stop = start + length
        if opcode == Opcode.MESSAGE and length >= _MESSAGE_HEAD.size and stop <= self._length and not self._chunked:
            return opcode, stop
        for kind in dict.fromkeys((opcode, Opcode.CHUNK, Opcode.MESSAGE_INDEX)):  # damage may have changed the opcode
            if kind == Opcode.CHUNK:
                agrees = self._is_chunk(position, length)
            else:
                agrees = self._length_by_fields(kind, start) == length and stop <= self._length
            if agrees:
                return kind, stop
        by_fields = start + (self._length_by_fields(opcode, start) or 0)
        for end in sorted({stop, by_fields}):
            if end > start and self._is_record(end, after=opcode, longer=end == stop):
                return opcode, end
            if end > start and opcode in _SHAPES and not nested and self._bounds(end, nested=True)[0] in _SHAPES:
                return opcode, end  # the next record is damaged too
        return (opcode, stop) if opcode >= _PRIVATE and stop <= self._length else (0, 0)

    def _length_by_fields(self, opcode: int, start: int) -> int | None:
        """Bytes of a record whose fields begin at `start`, by the lengths among them."""
        if opcode not in _SHAPES:
            return None
        at = start
        for step in _SHAPES[opcode]:
            at += step if step > 0 else int.from_bytes(self.at(at, -step), "little") - step
        return at - start

    def _is_record(self, position: int, after: int = 0, longer: bool = False) -> bool:
        """Return whether a record lies here whose two lengths agree, or the end of the file. A record that is `longer`
        than its fields is of a later version. After a chunk, records that lie in chunks do not count."""
        head = self.at(position, RECORD.size)
        if len(head) < RECORD.size:
            return position == self._length or (head == MAGIC and position + len(head) == self._length)
        opcode, length = RECORD.unpack(head)
        inside = opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
        if position + RECORD.size + length > self._length or (after == Opcode.CHUNK and inside):
            return False
        if opcode == Opcode.MESSAGE:
            return length >= _MESSAGE_HEAD.size
        by_fields = self._length_by_fields(opcode, position + RECORD.size)
        return by_fields == length or (longer and by_fields is not None and by_fields < length)

    def _record(self, opcode: int, position: int, stop: int, cut: bool) -> None:
        start = position + RECORD.size
        if opcode == _MESSAGE_INDEX:
            self._add_message_index(start, stop - start)
        elif opcode == Opcode.CHUNK:
            self._add_chunk(start, stop, cut)
        elif opcode == Opcode.MESSAGE:
            self._add_message(start, stop)
        elif opcode in _PARSED:
            record = parse(opcode, self.at(start, min(stop - start, _MAX_DEFINITION)))
            self._take(record, opcode in (Opcode.SCHEMA, Opcode.CHANNEL), position >= self._summary_start)

    def _take(self, record: object, is_definition: bool = False, doubtful: bool = False) -> None:
        """Take a record of the summary; a definition, which may be damaged (None), outside it as well."""
        if is_definition or isinstance(record, Definition):
            self._define(record, doubtful)  # pyrefly: ignore[bad-argument-type]
        elif isinstance(record, records.Statistics):
            counts = {i: count for i, count in record.channel_message_counts.items() if count}
            plausible = sum(counts.values()) == record.message_count <= self._length
            self.layout.recorded = counts if plausible else {}
        elif isinstance(record, records.ChunkIndex):
            at, stop = record.chunk_start_offset, record.chunk_start_offset + record.chunk_length
            first_ns, last_ns = record.message_start_time, record.message_end_time
            chunk = Chunk(stop - record.compressed_size, stop, record.compression, record.uncompressed_size, 0,
                          first_ns, last_ns, record=at)  # fmt: skip
            starts = sorted((offset, i) for i, offset in record.message_index_offsets.items())
            ends = [*(offset for offset, _ in starts[1:]), stop + record.message_index_length]
            for (start, i), end in zip(starts, ends, strict=False):
                chunk.counts[i] = max(end - start - _INDEX_HEAD.size, 0) // _ENTRY
            self._listed[at] = chunk

    def _add_message_index(self, start: int, length: int) -> None:
        if self._indexing is None or length < _INDEX_HEAD.size - RECORD.size:
            return
        chunk, channel_id = self._indexing, int.from_bytes(self.at(start, 2), "little")
        entries, rest = divmod(length - (_INDEX_HEAD.size - RECORD.size), _ENTRY)
        chunk.doubtful |= channel_id in chunk.counts or rest > 0
        if entries:
            chunk.counts[channel_id] = entries

    def _add_chunk(self, start: int, stop: int, cut: bool) -> None:
        head = self.at(start, _CHUNK_HEAD.size)
        if len(head) < _CHUNK_HEAD.size:
            return
        first_ns, last_ns, size, crc, name_length = _CHUNK_HEAD.unpack(head)
        named = self.at(start + _CHUNK_HEAD.size, 4 + 8)
        kind = named[: min(name_length, 4)].decode("latin-1")
        if name_length > 4 or kind not in KINDS:  # the length of the data tells where its own length is
            rest = stop - start - _CHUNK_HEAD.size - 8
            lengths = {
                k: int.from_bytes(named[len(k) : len(k) + 8], "little") for k in KINDS if named.startswith(k.encode())
            }
            kind = next((k for k, length in lengths.items() if length == rest - len(k)), kind)
        data = min(start + _CHUNK_HEAD.size + len(kind) + 8, stop)
        self._indexing = Chunk(data, stop, kind, size, crc, first_ns, last_ns, cut=cut, record=start - RECORD.size)
        self._chunked = True
        self.layout.chunks.append(self._indexing)

    def _add_message(self, start: int, stop: int) -> None:
        chunks = self.layout.chunks
        last = chunks[-1] if chunks else None
        head = self.at(start, _MESSAGE_HEAD.size)
        log_ns = _MESSAGE_HEAD.unpack(head)[2] if len(head) == _MESSAGE_HEAD.size else 0
        if last and last.compression is None and last.stop == start - RECORD.size and stop - last.start < _RUN:
            last.stop, last.first_ns, last.last_ns = stop, min(last.first_ns, log_ns), max(last.last_ns, log_ns)
        else:
            chunks.append(Chunk(start - RECORD.size, stop, None, first_ns=log_ns, last_ns=log_ns))

    def _resume(self, before: int, position: int) -> int | None:
        """Return where the walk continues if there is no record at `position`. In a file without chunks the length of
        the message before, at `before`, may be what is damaged, so this message is dropped."""
        layout, chunks = self.layout, self.layout.chunks
        layout.sound = False
        if not chunks:  # damage before the first message
            self._chunked |= (
                bool(self._listed) or self._search.first(_CHUNKS, position + 1, self._is_record) is not None
            )
        if not self._chunked and chunks and chunks[-1].stop > before and not self._is_message_head(position):
            chunks[-1].stop, position = before, before
            if chunks[-1].start == before:
                chunks.pop()
        pattern, accept = (_OUTSIDE_CHUNKS, self._is_record) if self._chunked else (_UNCHUNKED, self._is_likely)
        found = self._search.first(pattern, position + 1, accept)
        layout.appended_at = self._search.first(_BEGIN, before, stop=found)
        if found is None or layout.appended_at is not None:
            return None
        if chunks and chunks[-1].record >= 0:
            chunks[-1].doubtful = True
        self._indexing = None
        if self.at(found, 1) == bytes([_MESSAGE_INDEX]):
            first_ns = int.from_bytes(self.at(found + _INDEX_HEAD.size, 8), "little")
            if chunks and chunks[-1].record >= 0 and chunks[-1].first_ns <= first_ns <= chunks[-1].last_ns:
                self._indexing = chunks[-1]
            else:
                is_one = self._is_chunk(position, found - position - RECORD.size)
                self._indexing = Chunk(position, found, record=position, doubtful=not is_one)
                layout.missing.append(self._indexing)
                return found
        least = _CHUNK_HEAD.size + 8 if self._chunked else _MESSAGE_HEAD.size
        if found - position >= RECORD.size + least:  # else no message has room in it
            layout.gaps.append((position, found))
        return found

    def _has_messages(self, position: int) -> bool:
        """Return whether a chunk or, in a file without chunks, a message follows from `position` on."""
        pattern, accept = (_CHUNKS, self._is_record) if self._chunked else (_MESSAGES, self._is_likely)
        return self._search.first(pattern, position, accept) is not None

    def _is_chunk(self, position: int, length: int) -> bool:
        """Return whether the lengths in the head of a chunk agree with that of the record and with each other."""
        start = position + RECORD.size
        size, name = struct.unpack("<I4s", self.at(start + _CHUNK_HEAD.size - 4, 8).ljust(8, b"\xff"))
        known = size <= len(name) and name[:size].decode("latin-1") in KINDS
        return known and self._length_by_fields(Opcode.CHUNK, start) == length

    def _is_message_head(self, position: int, opcode: int = Opcode.MESSAGE) -> bool:
        """Return whether a message of a time near those found begins here, whatever its length."""
        head = self.at(position, RECORD.size + _MESSAGE_HEAD.size)
        if len(head) < RECORD.size + _MESSAGE_HEAD.size or head[0] != opcode:
            return False
        chunks, log_ns = self.layout.chunks, _MESSAGE_HEAD.unpack_from(head, RECORD.size)[2]
        return not chunks or abs(log_ns - chunks[-1].last_ns) <= _FARTHEST_NS

    def _is_likely(self, position: int) -> bool:
        """Return whether a record of a file without chunks lies here, with another one or the end after it."""
        opcode, length = RECORD.unpack(self.at(position, RECORD.size))
        if opcode == Opcode.MESSAGE and not self._is_message_head(position):
            return False
        return self._is_record(position) and self._is_record(position + RECORD.size + length)
