"""Chunks and damage of a recording, and a bounded search behind damage for the next record."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import re
    from collections.abc import Callable
    from typing import BinaryIO

MOST_GAPS = 1000
"""Damaged places in one file behind which reading goes on; a file with more is read up to there."""
_BLOCK = 2**20
"""Bytes that are searched at once."""
_WINDOW = 4096
"""Bytes that are read at once: the head of a record, and those of the small ones behind it."""
_MOST_TRIED = 500_000
"""Places that are looked at in one file, about a second's work; a stranger's file may be made of false ones."""


@dataclass(slots=True)
class Chunk:
    """A chunk of messages; or, with compression None, message records of MCAP outside any chunk."""

    start: int
    """Offset of its data in the file."""
    stop: int
    compression: str | None = ""
    size: int = 0
    """Bytes that it unpacks to."""
    crc: int = 0
    first_ns: int = 0
    last_ns: int = 0
    cut: bool = False
    record: int = -1
    """Offset of its record."""
    counts: dict[int, int] = field(default_factory=dict)
    """Messages per channel id, from the indexes behind it; empty where the writer left none."""
    listed: dict[int, int] = field(default_factory=dict)
    """Messages per channel id by the index of a ROS 1 bag."""
    doubtful: bool = False
    """Damage lies between its indexes, so that they may not be all."""
    damaged: bool = False
    """Not all of it could be unpacked and read."""


@dataclass
class Layout:
    """Chunks and damage of a file."""

    chunks: list[Chunk] = field(default_factory=list)
    missing: list[Chunk] = field(default_factory=list)
    """Chunks that lie in damaged bytes, as the index at the end or their own indexes tell of them."""
    recorded: dict[int, int] = field(default_factory=dict)
    """Messages per channel id by the file's statistics or its whole index; else empty."""
    gaps: list[tuple[int, int]] = field(default_factory=list)
    """Where damage may begin, and where reading goes on."""
    cut_at: int | None = None
    """Byte behind which nothing can be read, where messages may have been."""
    appended_at: int | None = None
    """Byte behind the end of the recording where another one follows."""
    index_cut_at: int | None = None
    """Byte behind which nothing can be read, where the messages had ended."""
    unknown_at: int | None = None
    """The first record of an unknown kind that would be a message if that byte were damaged."""
    spare: list[tuple[int, bytes]] = field(default_factory=list)
    """Opcode and data of schemas and channels of a damaged summary, for those that no other place defines."""

    def in_order(self) -> None:
        """Sort the chunks, and take back the counts of doubtful ones."""
        self.chunks.sort(key=lambda chunk: chunk.start)
        for chunk in self.chunks:
            chunk.counts = {} if chunk.doubtful else chunk.counts


class Search:
    """One file: its bytes, and a search for patterns whose cost is bounded over the life of the object."""

    def __init__(self, file: BinaryIO, length: int) -> None:
        self._file, self._length, self._left = file, length, _MOST_TRIED
        self._window, self._start = b"", 0

    def at(self, position: int, length: int) -> bytes:
        """Bytes from `position` on, fewer at the end of the file; offsets that it names itself may lie outside it."""
        if not 0 <= position < self._length:
            return b""
        begin = position - self._start
        if begin >= 0 and begin + length <= len(self._window):
            return self._window[begin : begin + length]
        self._file.seek(position)
        if length > _WINDOW:
            return self._file.read(length)
        self._window, self._start = self._file.read(_WINDOW), position
        return self._window[:length]

    def first(
        self,
        pattern: re.Pattern[bytes],
        start: int,
        accept: Callable[[int], bool] = lambda _: True,
        stop: int | None = None,
    ) -> int | None:
        """The first offset from `start` on, below `stop`, where the pattern, of at most 64 bytes, matches and
        `accept(offset)` holds."""
        position, stop = start, self._length if stop is None else stop
        while position < stop and self._left > 0:
            self._file.seek(position)
            block = self._file.read(_BLOCK + 64)
            for match in pattern.finditer(block):
                if match.start() >= min(_BLOCK, stop - position):
                    break
                self._left -= 1
                if self._left <= 0:
                    return None
                if accept(position + match.start()):
                    return position + match.start()
            position += _BLOCK
        return None
