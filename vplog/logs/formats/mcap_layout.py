"""Layout of the chunks of an MCAP file (mcap.dev/spec): read record by record, over damage too.

A record has its length twice, before its fields and by them: where the two differ, the one with a record behind it
holds. Where neither has, reading goes on at the next chunk of the file's index, or the next bytes that can be a record.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from typing import BinaryIO

from mcap.opcode import Opcode

from vplog.errors import LogError
from vplog.logs.formats.chunk_layout import MOST_GAPS, Chunk, Layout, ResyncSearch
from vplog.logs.formats.compression import KINDS, crc32

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
"""Opcode and length before every record."""
_INDEX_HEAD = struct.Struct("<BQHI")
"""Opcode, length, channel id, bytes of entries: a message index up to its entries."""
_MESSAGE_INDEX = int(Opcode.MESSAGE_INDEX)
_CHUNK_HEAD = struct.Struct("<QQQII")
"""Start, end, unpacked size, CRC, length of the compression's name: the head of a chunk record."""
_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel id, sequence, log time, publish time: the head of a message record."""
_FOOTER = struct.Struct("<BQQQI")
"""Opcode 2, length 20, starts of the summary and of its offsets, CRC; the magic follows it, and the file ends."""
_ENTRY = 16
"""Bytes of an entry of a message index: time and offset, 8 each."""
_LEAST_CHUNK = RECORD.size + _CHUNK_HEAD.size + 8
"""Bytes of a chunk record without data."""
_MAX_DEFINITION = 16 * 2**20
"""Bytes of a schema or channel record that are read; the largest real schemas are some 100 kB."""
_MAX_SUMMARY = 64 * 2**20
"""Bytes of a summary whose checksum is tried; one of 100,000 chunks has some 10 MB."""
_RUN = 2**20
"""Bytes up to which neighbouring messages outside chunks form one run."""
_FARTHEST_NS = 10 * 365 * 86_400 * 10**9
"""ns between two messages of a log above which bytes that look like a message are none: ten years."""
_PRIVATE = 0x80
"""Opcodes from here on are an application's own and stepped over, as the specification requires."""
_BEGIN = re.compile(re.escape(MAGIC) + rb"\x01")
"""Magic bytes of a recording: another one may be appended to the first."""
_FILLED = re.compile(rb"[^\0]")
"""Anything but the zeros that a disk may leave behind the end."""
_U32, _U64 = -4, -8
"""Bytes behind a length of 4 or 8 bytes, in _SHAPES."""
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
_OUTSIDE = _SHAPES.keys() - {Opcode.SCHEMA, Opcode.CHANNEL}
_OUTSIDE_CHUNKS = re.compile(rb"[\x06-\x0f].{5}\x00{3}", re.DOTALL)
"""The opcode of a record that lies in no chunk, and a length below 2^40 bytes."""
_CHUNKS = re.compile(rb"[\x06\x07].{5}\x00{3}", re.DOTALL)
"""The opcode of a chunk or a message index, and a length below 2^40 bytes."""
_UNCHUNKED = re.compile(rb"[\x03-\x05\x09\x0c\x0f].{3}\x00{5}", re.DOTALL)
"""The opcode of a record in the data of a file without chunks, and a length below 2^24 bytes."""


def read_layout(file: BinaryIO, length: int, define: Callable[[int, bytes], None], name: str) -> Layout:
    """Read the records of a file; `define` gets every schema and channel record outside the chunks. Raises LogError."""
    reader = _LayoutReader(file, length, define)
    if reader.at(0, len(MAGIC)) != MAGIC:
        raise LogError(f"{name} is not an MCAP file: it does not start with MCAP's magic bytes.")
    reader.check_summary()
    reader.records(len(MAGIC))
    reader.finish()
    return reader.layout


class _LayoutReader:
    def __init__(self, file: BinaryIO, length: int, define: Callable[[int, bytes], None]) -> None:
        self._length, self._define = length, define
        self.layout = Layout()
        self._indexed: dict[int, tuple[Chunk, dict[int, int]]] = {}
        """By offset: chunks as the summary's index lists them, and where the message index of each channel lies."""
        self._ahead: list[int] | None = None
        """Offsets of the index that may be chunks to go on with behind damage, the next one last."""
        self._unfit: list[tuple[int, int]] = []
        """Offset and opcode of records of other lengths than their fields, which may have been messages."""
        self._chunked = self._looked_for_chunks = False
        self._indexing: Chunk | None = None
        """The chunk whose message indexes come by."""
        self._search = ResyncSearch(file, length)
        self.at = self._search.at
        self._summary_start: int | None = None
        self._summary_sound: bool | None = None
        """By its checksum; None where it has none."""

    def records(self, position: int) -> None:
        """Every record from here on, to the footer or the end."""
        before, data_ended = position, False
        while True:
            opcode, stop = self._bounds(position)
            if not opcode:
                if data_ended and self._search.first(_CHUNKS, position, self._is_record) is None:
                    self.layout.index_cut_at = min(position, self._length)
                    self.layout.appended_at = self._search.first(_BEGIN, position)
                    return
                resumed = self._resume(before, position) if len(self.layout.gaps) < MOST_GAPS else None
                if resumed is None:
                    if self._indexing is not None and position < self._length:
                        self._indexing.doubtful = True
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
        """Hold the chunks that were found against those that the index at the end lists."""
        if not self._chunked:
            timed = any(chunk.last_ns > _FARTHEST_NS for chunk in self.layout.chunks)  # else any field may be a time
            unfit = (one for one in self._unfit if timed or one[1] not in _SHAPES)
            self.layout.unknown_at = next((at for at, opcode in unfit if self._is_message_head(at, opcode)), None)
        found = {chunk.record: chunk for chunk in self.layout.chunks if chunk.compression is not None}
        placed = bool(found and self._indexed)
        for offset, (listed, indexes) in sorted(self._indexed.items()):
            if (chunk := found.get(offset)) is not None:
                if chunk.counts and chunk.counts.keys() != indexes.keys():
                    chunk.doubtful |= chunk.counts != {i: n for i, n in self._counts(indexes).items() if n}
            elif (there := self._bounds(offset))[0] == Opcode.CHUNK and there[1] <= self._length:  # jumped over
                self._add_chunk(offset + RECORD.size, there[1], cut=False)
                self.layout.chunks[-1].counts = self._counts(indexes)
            elif self.layout.is_in_gap(offset):
                listed.counts = self._counts(indexes)
                self.layout.missing.append(listed)
            else:  # bytes are gone or new before it, or the index is damaged
                placed = False
        self.layout.in_order()
        if placed:  # the index tells of every chunk in the gaps
            self.layout.gaps = []

    def _counts(self, indexes: dict[int, int]) -> dict[int, int]:
        """Messages per channel id by message indexes at these offsets; empty where one is not there."""
        counts: dict[int, int] = {}
        for channel_id, position in indexes.items():
            opcode, stop = self._bounds(position)
            if opcode != Opcode.MESSAGE_INDEX or self.at(position + RECORD.size, 2) != channel_id.to_bytes(2, "little"):
                return {}
            counts[channel_id] = (stop - position - RECORD.size - 6) // _ENTRY
        return counts

    def _bounds(self, position: int, damaged: int = 2) -> tuple[int, int]:
        """Opcode of the record at `position` and where it stops, either as what it must have been where one of them is
        damaged; opcode 0, which the specification has as invalid, where there is none. A chunk may go on behind the end
        of the file. So many records behind it may be `damaged` too."""
        head = self.at(position, _INDEX_HEAD.size)
        if len(head) < RECORD.size:
            return 0, 0
        opcode, length = RECORD.unpack_from(head)
        start = position + RECORD.size
        stop = start + length
        if opcode == _MESSAGE_INDEX and length == int.from_bytes(head[-4:], "little") + 6 and stop <= self._length:
            return opcode, stop  # most records are of this kind
        if opcode == Opcode.MESSAGE and length >= _MESSAGE_HEAD.size and stop <= self._length and not self._chunked:
            return opcode, stop
        for kind in (opcode, Opcode.CHUNK, Opcode.MESSAGE_INDEX):  # of which damage may have changed the opcode
            if kind == Opcode.CHUNK:
                agrees = self._is_chunk(position, length)
            else:
                agrees = self._length_by_fields(kind, start) == length and stop <= self._length
            if agrees:
                return kind, stop
        by_fields = start + (self._length_by_fields(opcode, start) or 0)
        ends = sorted({stop, by_fields})
        for end in ends:
            if ((opcode in _SHAPES and end > start) or end == stop) and self._is_record(end, behind=opcode):
                return opcode, end
        for end in ends if damaged and opcode in _SHAPES else ():
            if end > start and self._bounds(end, damaged - 1)[0] in (_OUTSIDE if self._chunked else _SHAPES):
                return opcode, end
        if (0 < by_fields < stop or opcode >= _PRIVATE) and self._is_record(stop, behind=opcode, longer=True):
            return opcode, stop  # with fields of a later version, which are ignored
        return (opcode, stop) if opcode >= _PRIVATE and stop <= self._length else (0, 0)

    def _length_by_fields(self, opcode: int, start: int) -> int | None:
        """Bytes of a record whose fields begin at `start`, by the lengths among them."""
        if opcode not in _SHAPES:
            return None
        at = start
        for step in _SHAPES[opcode]:
            at += step if step > 0 else int.from_bytes(self.at(at, -step), "little") - step
        return at - start

    def _is_record(self, position: int, behind: int = 0, longer: bool = False) -> bool:
        """Whether a record lies here whose two lengths agree, or that is `longer` than its fields, or the end of the
        file. Behind a chunk it is none of those that lie in chunks."""
        head = self.at(position, RECORD.size)
        if len(head) < RECORD.size:
            return position == self._length or (head == MAGIC and position + len(head) == self._length)
        opcode, length = RECORD.unpack(head)
        inside = opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
        if position + RECORD.size + length > self._length or (behind == Opcode.CHUNK and inside):
            return False
        if opcode == Opcode.MESSAGE:
            return length >= _MESSAGE_HEAD.size
        by_fields = self._length_by_fields(opcode, position + RECORD.size)
        return by_fields == length or (longer and by_fields is not None and by_fields < length)

    def _record(self, opcode: int, position: int, stop: int, cut: bool) -> None:
        start = position + RECORD.size
        length = stop - start
        if opcode == _MESSAGE_INDEX:
            self._add_message_index(start, length)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            data = self.at(start, min(length, _MAX_DEFINITION))
            if self._summary_sound is False and position >= (self._summary_start or 0):
                self.layout.summary_definitions.append((opcode, data))
            else:
                self._define(opcode, data)
        elif opcode == Opcode.CHUNK:
            self._add_chunk(start, stop, cut)
        elif opcode == Opcode.MESSAGE:
            self._add_message(start, stop)
        elif opcode == Opcode.STATISTICS and 46 <= length <= _MAX_DEFINITION:  # 42 bytes of totals, then id and count
            data = self.at(start, length)
            total, size = struct.unpack_from("<Q34xI", data)
            entries = struct.iter_unpack("<HQ", data[46 : 46 + min(size, length - 46) // 10 * 10])
            counts = {channel_id: count for channel_id, count in entries if count}
            self.layout.recorded = counts if sum(counts.values()) == total <= self._length else {}
        elif opcode == Opcode.CHUNK_INDEX and 64 <= length <= _MAX_DEFINITION:
            data = self.at(start, length)
            first_ns, last_ns, offset, _, size = struct.unpack_from("<QQQQI", data)
            entries = data[36 : 36 + min(size, len(data) - 36) // 10 * 10]  # channel id and offset of its message index
            listed = Chunk(offset, offset, first_ns=first_ns, last_ns=last_ns)
            self._indexed[offset] = listed, dict(struct.iter_unpack("<HQ", entries))

    def _add_message_index(self, start: int, length: int) -> None:
        if self._indexing is None or length < 6:
            return
        chunk, channel_id = self._indexing, int.from_bytes(self.at(start, 2), "little")
        chunk.doubtful |= channel_id in chunk.counts or (length - 6) % _ENTRY > 0
        if length > 6:
            chunk.counts[channel_id] = (length - 6) // _ENTRY

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
        """The next record to go on with, where there is none at `position`. In a file without chunks the message
        before, at `before`, may be the one whose length is damaged, and is dropped."""
        if self._summary_start is not None and not self._indexed:
            self._read_summary(self._summary_start)
        chunks, found = self.layout.chunks, None
        self._look_for_chunks(position)
        if not self._chunked and chunks and chunks[-1].stop > before and not self._is_message_head(position):
            chunks[-1].stop, position = before, before
            if chunks[-1].start == before:
                chunks.pop()
        if self._indexed:
            found = self._next_listed_chunk(position)
        elif self._chunked:
            found = self._search.first(_OUTSIDE_CHUNKS, position + 1, self._is_record)
        else:
            found = self._search.first(_UNCHUNKED, position + 1, self._is_likely)
        found = self._summary_start if found is None else found
        self.layout.appended_at = self._search.first(_BEGIN, before, stop=found)
        if found is None or found <= position or self.layout.appended_at is not None:
            return None
        self._indexing = None
        if chunks and chunks[-1].record >= 0:
            chunks[-1].doubtful = True
        if not self._indexed and self.at(found, 1) == bytes([Opcode.MESSAGE_INDEX]):
            first_ns = int.from_bytes(self.at(found + _INDEX_HEAD.size, 8), "little")
            if chunks and chunks[-1].record >= 0 and chunks[-1].first_ns <= first_ns <= chunks[-1].last_ns:
                self._indexing = chunks[-1]
            else:
                is_whole = self._is_chunk(position, found - position - RECORD.size)
                self._indexing = Chunk(position, found, doubtful=not is_whole)
                self.layout.missing.append(self._indexing)
        if found - position >= (_LEAST_CHUNK if self._chunked else RECORD.size + _MESSAGE_HEAD.size):
            self.layout.gaps.append((position, found))  # else no message has room in it
        return found

    def _look_for_chunks(self, position: int) -> None:
        """Find out whether chunks follow damage before the first message; a second search would find the same."""
        if not self.layout.chunks and not self._looked_for_chunks:
            self._looked_for_chunks = True
            self._chunked |= self._search.first(_CHUNKS, position + 1, self._is_record) is not None

    def _next_listed_chunk(self, position: int) -> int | None:
        """Return the next chunk of the index behind `position`, which increases from call to call; None without one."""
        if self._ahead is None:
            self._ahead = sorted(self._indexed, reverse=True)
        while self._ahead and (self._ahead[-1] <= position or self._bounds(self._ahead[-1])[0] != Opcode.CHUNK):
            self._ahead.pop()
        return self._ahead[-1] if self._ahead else None

    def check_summary(self) -> None:
        """Find the summary at the end of the file, and read it where its checksum is right."""
        size = _FOOTER.size + len(MAGIC)
        tail = self.at(max(self._length - size, 0), size)
        if len(tail) < size or not tail.endswith(MAGIC):
            return
        opcode, length, start, _, crc = _FOOTER.unpack_from(tail)
        if (opcode, length) != (Opcode.FOOTER, 20) or not 0 < start < self._length:
            return
        self._summary_start = start
        length = self._length - len(MAGIC) - 4 - start
        if crc and length <= _MAX_SUMMARY:
            self._summary_sound = crc32(self.at(start, length)) == crc
        if self._summary_sound:
            self._read_summary(start)

    def _read_summary(self, position: int) -> None:
        while position + RECORD.size <= self._length - _FOOTER.size - len(MAGIC):
            opcode, stop = self._bounds(position)
            if stop > self._length or opcode in (0, Opcode.CHUNK, Opcode.MESSAGE, Opcode.FOOTER):
                return
            self._record(opcode, position, stop, cut=False)
            position = stop

    def _is_chunk(self, position: int, length: int) -> bool:
        """Whether the lengths that the head of a chunk holds agree: with that of the record, and with each other."""
        start = position + RECORD.size
        size, name = struct.unpack("<I4s", self.at(start + _CHUNK_HEAD.size - 4, 8).ljust(8, b"\xff"))
        known = size <= len(name) and name[:size].decode("latin-1") in KINDS
        return known and self._length_by_fields(Opcode.CHUNK, start) == length

    def _is_message_head(self, position: int, opcode: int = Opcode.MESSAGE) -> bool:
        """Whether a message of a time near those found begins here, whatever its length."""
        head = self.at(position, RECORD.size + _MESSAGE_HEAD.size)
        if len(head) < RECORD.size + _MESSAGE_HEAD.size or head[0] != opcode:
            return False
        chunks, log_ns = self.layout.chunks, _MESSAGE_HEAD.unpack_from(head, RECORD.size)[2]
        return not chunks or abs(log_ns - chunks[-1].last_ns) <= _FARTHEST_NS

    def _is_likely(self, position: int) -> bool:
        """Whether a record of a file without chunks can lie here, with another or the end behind it."""
        opcode, length = RECORD.unpack(self.at(position, RECORD.size))
        if opcode == Opcode.MESSAGE and not self._is_message_head(position):
            return False
        return self._is_record(position) and self._is_record(position + RECORD.size + length)
