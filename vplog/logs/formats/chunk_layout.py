"""Chunks and damage of a recording, a bounded search behind damage for the next record, and what is lost by it."""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import accumulate
from typing import BinaryIO

from vplog.errors import plural
from vplog.logs.formats.container import Channel, Contents, Notes, by_topic, topics_of
from vplog.logs.formats.loss_account import Span, confirmed_span, main_span

MOST_GAPS = 1000
"""Damaged places in one file behind which reading goes on; a file with more is read up to there."""
_BLOCK = 2**20
"""Bytes that are searched at once."""
_WINDOW = 4096
"""Bytes that are read at once: the head of a record, and those of the small ones behind it."""
_MOST_TRIED = 500_000
"""Places that are looked at in one file, about a second's work; a stranger's file may be made of false ones."""
_NO_CHANNEL = -1


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
    disputed: bool = False
    """Its own indexes and that of the bag count its messages differently."""
    damaged: bool = False
    """Some of it could not be unpacked and read."""


@dataclass
class Layout:
    """Chunks and damage of a file."""

    chunks: list[Chunk] = field(default_factory=list)
    missing: list[Chunk] = field(default_factory=list)
    """Chunks that lie in damaged bytes, as listed by the index at the end or by their own indexes."""
    recorded: dict[int, int] = field(default_factory=dict)
    """Messages per channel id by the file's statistics or its whole index; else empty."""
    gaps: list[tuple[int, int]] = field(default_factory=list)
    """First byte that may be damaged, and the byte at which reading resumes."""
    cut_at: int | None = None
    """Byte behind which nothing can be read, where messages may have been."""
    appended_at: int | None = None
    """Byte behind the end of the recording where another one follows."""
    index_cut_at: int | None = None
    """Byte behind which nothing can be read, where the messages had ended."""
    unknown_at: int | None = None
    """The first record that would be a message if the byte of its kind were damaged."""
    summary_definitions: list[tuple[int, bytes]] = field(default_factory=list)
    """Opcode and data of schemas and channels of a damaged summary, for those that no other place defines."""

    def is_in_gap(self, position: int) -> bool:
        """Return whether a byte lies in a damaged place, of which `gaps` are in order."""
        number = bisect_right(self.gaps, position, key=lambda gap: gap[0]) - 1
        return number >= 0 and position < self.gaps[number][1]

    def in_order(self) -> None:
        """Sort the chunks, and take back the counts of doubtful ones."""
        self.chunks.sort(key=lambda chunk: chunk.start)
        for chunk in (*self.chunks, *self.missing):
            chunk.counts = {} if chunk.doubtful else chunk.counts


class ResyncSearch:
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
        accept: Callable[[int], bool | None] = lambda _: True,
        stop: int | None = None,
    ) -> int | None:
        """The first offset from `start` on, below `stop`, where the pattern, of at most 64 bytes, matches and
        `accept(offset)` holds."""
        position, stop, size = start, self._length if stop is None else stop, _WINDOW
        while position < stop and self._left > 0:
            self._file.seek(position)
            size = min(2 * size, _BLOCK, stop - position)  # a match is often near, and searched for many times
            block = self._file.read(size + 64)
            for match in pattern.finditer(block):
                if match.start() >= size:
                    break
                self._left -= 1
                if self._left <= 0:
                    return None
                if accept(position + match.start()):
                    return position + match.start()
            position += size
        return None


@dataclass
class ChunkLosses:
    """Adds the losses of one file to the account of its log."""

    name: str
    length: int
    layout: Layout
    channels: dict[int, Channel]
    notes: Notes

    def may_hold(self, chunk: Chunk, wanted: set[Channel]) -> bool:
        """Not where the indexes of a chunk name only channels that are known and not wanted."""
        known = self.channels
        return not chunk.counts or any(known.get(i) in wanted or i not in known for i in chunk.counts)

    def is_counted(self, number: int) -> bool:
        """Whether a chunk has indexes, and all of them: a file may be cut between those of its last one."""
        layout = self.layout
        return bool(layout.chunks[number].counts) and (bool(layout.recorded) or number + 1 < len(layout.chunks))

    def add_chunk(self, chunk: Chunk, found: Mapping[int, int], spans: list[Span], what: str) -> None:
        """Messages lost in a damaged chunk: all but those found, by channel id; `what` ends the sentence about it."""
        short = Counter(chunk.counts)
        short.subtract({i: n for i, n in found.items() if i in self.channels or i in short})
        if min(short.values(), default=0) < 0:  # damage gave messages the number of another channel
            short = {_NO_CHANNEL: short.total()}
        lost = topics_of(short, self.channels) if chunk.counts else None
        detail = f"{self.name} has a damaged chunk at byte {chunk.start}{what}."
        self.notes.account.add("damaged_chunk", lost, (self.name, chunk.start), spans, detail)

    def add_unknown(self, chunk: Chunk, counts: Mapping[int, int], damaged: bool, spans: list[Span]) -> None:
        """Messages of channels that nothing defines so far; none where they are defined by now. Those of a damaged
        chunk on a channel that its indexes do not list are among what it lacks."""
        known = self.channels
        count = sum(
            n for i, n in counts.items() if i not in known and (i in chunk.counts or not (damaged and chunk.counts))
        )
        self.notes.account.add("unknown_channel", {"": count} if count else {}, (self.name, chunk.start), spans)

    def contents(self, by_id: Mapping[int, int], times: list[int], what: str) -> Contents:
        """The messages per channel id that were found, at these log times (of each chunk the first and the last), held
        against `what` the file says of itself."""
        counts = dict.fromkeys(self.channels.values(), 0)
        for number in by_id.keys() & self.channels.keys():
            counts[self.channels[number]] += by_id[number]
        self._account_for(by_topic(counts), main_span(times), what)
        return Contents(dict(sorted(counts.items())), *confirmed_span(times))

    def _account_for(self, found: Mapping[str, int], span: Span, what: str) -> None:
        """Account for messages that a file recorded and that were not found; those that were found cover `span`."""
        layout, account, name = self.layout, self.notes.account, self.name
        recorded = topics_of(layout.recorded, self.channels)
        total = Counter(found)
        layout.missing = [chunk for chunk in layout.missing if not self._is_read(chunk)]
        times = _TimesBetween(layout.chunks, span)
        for chunk in layout.missing:
            counts = topics_of(chunk.counts, self.channels)
            when = (chunk.first_ns, chunk.last_ns) if chunk.last_ns else times.at(chunk.start)
            detail = f"{name} is damaged near byte {chunk.start}."
            account.add("damaged_bytes", counts or None, (name, chunk.start), [when], detail)
            total.update(counts)
        for start, stop in layout.gaps:
            detail = f"{name} is damaged near byte {start}; reading resumes at byte {stop}."
            account.add("damaged_bytes", None, (name, -start), [times.at(start)], detail)
        if layout.unknown_at is not None and (not recorded or total.total() < sum(recorded.values())):
            detail = f"{name} has a record of unknown content at byte {layout.unknown_at}."
            account.add("damaged_bytes", None, (name, layout.unknown_at), [span], detail)
        self._add_end(sum(found.values()), [(span[1], span[1])])
        whole = layout.cut_at is None and not layout.gaps and all(chunk.counts for chunk in layout.missing)
        account.set_recorded(name, recorded or (total if whole else {}), *span)
        unexplained = account.reconcile({name}, recorded, found)
        if unexplained and sum(recorded.values()) > total.total():  # else it names other topics
            detail = f"The {what} of {name} counts more messages than it holds."
            account.add("damaged_bytes", unexplained, (name, 0), [span], detail)

    def _is_read(self, missing: Chunk) -> bool:
        """Whether the index behind damaged bytes is that of the chunk before them, by its messages and their times."""
        chunks = self.layout.chunks
        number = bisect_right(chunks, missing.start, key=lambda chunk: chunk.stop)
        before = chunks[number - 1] if number else None
        return (
            before is not None
            and missing.start < missing.stop
            and len(missing.counts) > 0
            and before.first_ns <= missing.first_ns <= missing.last_ns <= before.last_ns
            and Counter(missing.counts) <= Counter(before.counts)
        )

    def _add_end(self, messages: int, spans: list[Span]) -> None:
        """Where the file is cut, or goes on with another recording, behind so many messages."""
        layout, account, name = self.layout, self.notes.account, self.name
        if layout.cut_at is not None:
            before = f"the {plural(messages, 'message')} before it are read"
            detail = f"{name} is cut or damaged at byte {layout.cut_at} of {self.length}; {before}."
            account.add("cut", None, (name, layout.cut_at), spans, detail)
        if layout.appended_at is not None:
            account.add_appended(name, layout.appended_at, self.length)
        if layout.index_cut_at is not None:
            self.notes.add(f"{name} is cut or damaged at byte {layout.index_cut_at}, after its last message.")


class _TimesBetween:
    """Log times of the chunks around damaged places."""

    def __init__(self, chunks: list[Chunk], span: Span) -> None:
        """`chunks` in the order of the file; `span` is that of the file."""
        chunks = [chunk for chunk in chunks if chunk.last_ns]
        self._starts, self._stops = [chunk.start for chunk in chunks], [chunk.stop for chunk in chunks]
        self._last_ns = [span[0], *accumulate((chunk.last_ns for chunk in chunks), max)]
        self._first_ns = [*accumulate((chunk.first_ns for chunk in reversed(chunks)), min)][::-1]
        self._first_ns.append(span[1])

    def at(self, position: int) -> Span:
        """Return the last time in the chunks before a byte, and the first time in those behind it."""
        before, behind = bisect_right(self._stops, position), bisect_right(self._starts, position)
        return self._last_ns[before], self._first_ns[behind]
