"""Bytes of a file for a parser that jumps from record to record, and a bounded search behind damage for the next."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import re
    from collections.abc import Callable
    from typing import BinaryIO

_BLOCK = 2**20
"""Bytes that are searched at once."""
_WINDOW = 4096
"""Bytes that are read at once: the head of a record, and those of the small ones behind it."""
MOST_GAPS = 1000
"""Damaged places in one file behind which reading goes on; a file with more is read up to there."""
_MOST_TRIED = 500_000
"""Places that are looked at in one file, about a second's work; a stranger's file may be made of false ones."""


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
        """The first offset from `start` on, below `stop`, where the pattern matches and `accept(offset)` holds.

        The pattern matches at most 64 bytes, so that none is missed between two blocks.
        """
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
