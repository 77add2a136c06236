"""Where the chunks of an MCAP file lie (mcap.dev/spec): found by walking it record by record, over damage too.

Chunks are stepped over, so the walk reads a few kB per MB. Where a record cannot be one, the walk goes on at the next
chunk: the one that the file's own index names, or the next bytes that can be the head of one.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from mcap.opcode import Opcode

from vplog.errors import LogError
from vplog.logs.compression import KINDS
from vplog.logs.search import MOST_GAPS, Search

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import BinaryIO

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
"""Opcode and length before every record."""
_CHUNK_HEAD = struct.Struct("<QQQII")
"""Start, end, unpacked size, CRC, length of the compression's name: the head of a chunk record."""
_MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel id, sequence, log time, publish time: the head of a message record."""
_FOOTER = struct.Struct("<BQQQI")
"""Opcode 2, length 20, starts of the summary and of its offsets, CRC; the magic follows it, and the file ends."""
_MAX_DEFINITION = 16 * 2**20
"""Bytes of a schema or channel record that are read; the largest real schemas are some 100 kB."""
_RUN = 2**20
"""Bytes up to which neighbouring messages outside chunks are kept as one run."""
_FARTHEST_NS = 10 * 365 * 86_400 * 10**9
"""ns between two messages of a log above which bytes that look like a message are none: ten years."""
_OPCODES = frozenset(int(opcode) for opcode in Opcode)
"""Known kinds of records; others are stepped over, as the specification asks."""
_CHUNK_START = re.compile(rb"\x06.{5}\x00{3}", re.DOTALL)
"""The opcode of a chunk, and a length below 2^40 bytes."""
_MESSAGE_START = re.compile(rb"\x05.{3}\x00{5}", re.DOTALL)
"""The opcode of a message, and a length below 2^24 bytes."""


@dataclass(slots=True)
class Chunk:
    """A chunk of messages; or, with compression None, message records outside any chunk."""

    start: int
    """Offset of its records in the file."""
    stop: int
    compression: str | None
    size: int
    crc: int
    first_ns: int
    last_ns: int
    counts: dict[int, int] = field(default_factory=dict)
    """Messages per channel id, from the message indexes behind it; empty where the writer left none."""
    cut: bool = False


@dataclass
class Layout:
    """What the walk found."""

    chunks: list[Chunk] = field(default_factory=list)
    missing: list[Chunk] = field(default_factory=list)
    """Chunks that the file's index lists and that are not where it says."""
    recorded: dict[int, int] = field(default_factory=dict)
    """Messages per channel id by the file's statistics; empty where it has none."""
    gaps: list[tuple[int, int, int]] = field(default_factory=list)
    """Where damage may begin, where the walk goes on, and the number of chunks before."""
    cut_at: int | None = None
    """Byte behind which nothing can be read, where messages may have been."""
    index_cut_at: int | None = None
    """Byte behind which nothing can be read, where the messages had ended."""


def read_layout(file: BinaryIO, length: int, define: Callable[[int, bytes], None], name: str) -> Layout:
    """Walk the file; `define` gets every schema and channel record outside the chunks. Raises LogError."""
    walk = _Walk(file, length, define)
    if walk.at(0, len(MAGIC)) != MAGIC:
        raise LogError(f"{name} does not start as an MCAP file does.")
    walk.records(len(MAGIC))
    walk.find_missing()
    return walk.layout


class _Walk:
    def __init__(self, file: BinaryIO, length: int, define: Callable[[int, bytes], None]) -> None:
        self._file, self._length, self._define = file, length, define
        self.layout = Layout()
        self._indexed: dict[int, tuple[Chunk, dict[int, int]]] = {}
        """By offset: chunks as the summary's index lists them, and where the message index of each channel lies."""
        self._seen: set[int] = set()
        self._search = Search(file, length)
        self._summary_start: int | None = None

    def records(self, position: int) -> None:
        """Every record from here on, to the footer or the end."""
        before, data_ended = position, False
        while True:
            head = self.at(position, RECORD.size) if position < self._length else b""
            opcode, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
            stop = position + RECORD.size + length
            if opcode not in _OPCODES and opcode and self._is_chunk(position, length):
                opcode = Opcode.CHUNK  # damage to that one byte costs nothing
            # Opcode 0 is invalid by the specification.
            if not opcode or (stop > self._length and not self._cut_chunk(opcode, position, stop)):
                if data_ended:
                    self.layout.index_cut_at = min(position, self._length)
                    return
                resumed = self._resume(before, position) if len(self.layout.gaps) < MOST_GAPS else None
                if resumed is None:
                    self.layout.cut_at = min(position, self._length)
                    return
                self.layout.gaps.append((before, resumed, len(self.layout.chunks)))
                before = position = resumed
                continue
            self._record(opcode, position, min(stop, self._length), cut=stop > self._length)
            if opcode == Opcode.FOOTER:
                return
            if stop > self._length:
                self.layout.cut_at = self._length
                return
            data_ended = data_ended or opcode in (Opcode.DATA_END, Opcode.STATISTICS, Opcode.CHUNK_INDEX)
            before, position = position, stop

    def find_missing(self) -> None:
        """Count what lies in the chunks that the index lists and the walk did not come by."""
        for offset, (chunk, indexes) in sorted(self._indexed.items()):
            damaged = any(start <= offset < stop for start, stop, _ in self.layout.gaps)
            if offset in self._seen or not damaged:  # an index that is damaged itself names places without a chunk
                continue
            for channel_id, at in indexes.items():
                head = self.at(at, RECORD.size + 6)
                if len(head) == RECORD.size + 6 and head[0] == Opcode.MESSAGE_INDEX:
                    found, size = struct.unpack_from("<HI", head, RECORD.size)
                    if found == channel_id and size <= self._length:
                        chunk.counts[channel_id] = size // 16
            self.layout.missing.append(chunk)

    def at(self, position: int, length: int) -> bytes:
        if not 0 <= position < self._length:  # offsets come from the file
            return b""
        self._file.seek(position)
        return self._file.read(length)

    def _cut_chunk(self, opcode: int, position: int, stop: int) -> bool:
        """A chunk that goes on behind the end of the file is read as far as it goes, if it is one."""
        return opcode == Opcode.CHUNK and self._is_chunk(position, stop - position - RECORD.size)

    def _record(self, opcode: int, position: int, stop: int, cut: bool) -> None:
        start = position + RECORD.size
        length = stop - start
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(opcode, self.at(start, min(length, _MAX_DEFINITION)))
        elif opcode == Opcode.CHUNK:
            self._add_chunk(start, stop, cut)
        elif opcode == Opcode.MESSAGE:
            self._add_message(start, stop)
        elif opcode == Opcode.MESSAGE_INDEX and self.layout.chunks and length >= 6:  # channel id, size of its entries
            channel_id, size = struct.unpack("<HI", self.at(start, 6))
            if 0 < size <= length - 6:
                self.layout.chunks[-1].counts[channel_id] = size // 16  # each entry: time and offset, 8 bytes each
        elif opcode == Opcode.STATISTICS and 46 <= length <= _MAX_DEFINITION:  # 42 bytes of totals, then id and count
            data = self.at(start, length)
            (size,) = struct.unpack_from("<I", data, 42)
            entries = struct.iter_unpack("<HQ", data[46 : 46 + min(size, length - 46) // 10 * 10])
            self.layout.recorded = {channel_id: count for channel_id, count in entries if count <= self._length}
        elif opcode == Opcode.CHUNK_INDEX and 64 <= length <= _MAX_DEFINITION:
            self._add_index(self.at(start, length))

    def _add_chunk(self, start: int, stop: int, cut: bool) -> None:
        self._seen.add(start - RECORD.size)
        head = self.at(start, _CHUNK_HEAD.size)
        if len(head) < _CHUNK_HEAD.size:
            return
        first_ns, last_ns, size, crc, name_length = _CHUNK_HEAD.unpack(head)
        name = self.at(start + _CHUNK_HEAD.size, min(name_length, 20))  # known names have 0 to 4 bytes
        data = start + _CHUNK_HEAD.size + name_length + 8
        if data <= stop and size:
            (length,) = struct.unpack("<Q", self.at(data - 8, 8))
            stop = min(stop, data + length)
            kind = name.decode("utf-8", "replace")
            self.layout.chunks.append(Chunk(data, stop, kind, size, crc, first_ns, last_ns, cut=cut))

    def _add_message(self, start: int, stop: int) -> None:
        chunks = self.layout.chunks
        last = chunks[-1] if chunks else None
        head = self.at(start, _MESSAGE_HEAD.size)
        log_ns = _MESSAGE_HEAD.unpack(head)[2] if len(head) == _MESSAGE_HEAD.size else 0
        if last and last.compression is None and last.stop == start - RECORD.size and stop - last.start < _RUN:
            last.stop, last.first_ns, last.last_ns = stop, min(last.first_ns, log_ns), max(last.last_ns, log_ns)
        else:
            chunks.append(Chunk(start - RECORD.size, stop, None, 0, 0, log_ns, log_ns))

    def _add_index(self, data: bytes) -> None:
        first_ns, last_ns, offset, _, size = struct.unpack_from("<QQQQI", data)
        entries = data[36 : 36 + min(size, len(data) - 36) // 10 * 10]  # channel id and offset of its message index
        chunk = Chunk(offset, offset, "", 0, 0, first_ns, last_ns)
        self._indexed[offset] = chunk, dict(struct.iter_unpack("<HQ", entries))

    def _resume(self, before: int, position: int) -> int | None:
        """The next record to go on with, where there is none at `position`; the one before, at `before`, may be the
        one whose length is damaged."""
        self._read_summary()
        if self._indexed:
            behind = (offset for offset in sorted(self._indexed) if offset > before)
            return next((offset for offset in behind if self.at(offset, 1) == b"\x06"), self._summary_start)
        start = position if self._whole_chunk(before) else before + 1
        if any(chunk.compression is None for chunk in self.layout.chunks):
            found = self._search.first(_MESSAGE_START, start, self._is_message)
        else:
            found = self._search.first(_CHUNK_START, start, self._whole_chunk)
        found = self._summary_start if found is None else found
        if found is not None and found < position and self.layout.chunks and self.layout.chunks[-1].stop > found:
            self.layout.chunks.pop()
        return found

    def _read_summary(self) -> None:
        """The index and statistics at the end of the file, where it has its end."""
        size = _FOOTER.size + len(MAGIC)
        tail = self.at(max(self._length - size, 0), size)
        if self._summary_start is not None or len(tail) < size or not tail.endswith(MAGIC):
            return
        opcode, length, start, _, _ = _FOOTER.unpack_from(tail)
        if (opcode, length) != (Opcode.FOOTER, 20) or not 0 < start < self._length:
            return
        position = self._summary_start = start
        while position + RECORD.size <= self._length - size:
            opcode, length = RECORD.unpack(self.at(position, RECORD.size))
            stop = position + RECORD.size + length
            if stop > self._length or opcode in (0, Opcode.CHUNK, Opcode.MESSAGE, Opcode.FOOTER):
                return
            self._record(opcode, position, stop, cut=False)
            position = stop

    def _whole_chunk(self, position: int) -> bool:
        head = self.at(position, RECORD.size)
        if len(head) < RECORD.size or head[0] != Opcode.CHUNK:
            return False
        length = RECORD.unpack(head)[1]
        return position + RECORD.size + length <= self._length and self._is_chunk(position, length)

    def _is_chunk(self, position: int, length: int) -> bool:
        """Whether the lengths that the head of a chunk holds agree: with that of the record, and with each other."""
        head = self.at(position + RECORD.size, _CHUNK_HEAD.size + 4 + 8)
        if len(head) < _CHUNK_HEAD.size:
            return False
        name_length = _CHUNK_HEAD.unpack_from(head)[4]
        start = _CHUNK_HEAD.size + name_length
        if name_length > 4 or len(head) < start + 8 or head[_CHUNK_HEAD.size : start].decode("latin-1") not in KINDS:
            return False
        return struct.unpack_from("<Q", head, start)[0] + start + 8 == length

    def _is_message(self, position: int) -> bool:
        """Whether a message can lie here: of a time near those found, and with another record or the end behind it."""
        head = self.at(position, RECORD.size + _MESSAGE_HEAD.size)
        if len(head) < RECORD.size + _MESSAGE_HEAD.size:
            return False
        length = RECORD.unpack_from(head)[1]
        log_ns = _MESSAGE_HEAD.unpack_from(head, RECORD.size)[2]
        stop = position + RECORD.size + length
        behind = self.at(stop, RECORD.size) if length >= _MESSAGE_HEAD.size and stop <= self._length else b""
        if len(behind) < RECORD.size or abs(log_ns - self.layout.chunks[-1].last_ns) > _FARTHEST_NS:
            return False
        opcode, length = RECORD.unpack(behind)
        return Opcode.HEADER <= opcode <= Opcode.DATA_END and stop + RECORD.size + length <= self._length
