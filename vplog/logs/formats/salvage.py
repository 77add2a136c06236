"""Chunks and damage of a recording, a bounded search for the next record after damage, and the messages that are lost.

A layout is `sound` if its index counts every message and every chunk was found at its place. Messages are then counted
by the index, and a chunk that turns out to be damaged loses what its own index lists. In any other layout each chunk is
read once to count its messages.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Set
from dataclasses import dataclass, field
from itertools import accumulate
from typing import BinaryIO, NamedTuple

from vplog.errors import plural
from vplog.logs.formats.container import Channel, Contents, Notes, by_topic, topics_of
from vplog.logs.formats.loss_account import Span, confirmed_span, sampled

MAX_GAPS = 1000
"""Maximum number of damaged places in one file. A file with more is read up to the last of them."""
_BLOCK = 2**20
"""Bytes that are searched at once."""
_WINDOW = 4096
"""Bytes that are read at once: the head of a record and the small records after it."""
_MAX_CANDIDATES = 500_000
"""Candidate records that are tested in one file, about one second of work. A hostile file may consist of them."""


@dataclass(slots=True)
class Chunk:
    """A chunk of messages, or a run of MCAP message records outside any chunk (compression None)."""

    start: int
    """Offset of its data in the file."""
    stop: int
    compression: str | None = ""
    size: int = 0
    """Bytes after unpacking."""
    crc: int = 0
    first_ns: int = 0
    last_ns: int = 0
    """Log times of its messages; 0 if unknown."""
    cut: bool = False
    """True if the file ends inside it."""
    record: int = -1
    """Offset of its record."""
    counts: dict[int, int] = field(default_factory=dict)
    """Messages per channel id by its index; empty if unknown."""
    doubtful: bool = False
    """True if its index may be incomplete."""
    counted: bool = False
    """True if it was read to its end, so that `counts` are right."""


@dataclass
class Layout:
    """Chunks and damage of a file."""

    chunks: list[Chunk] = field(default_factory=list)
    missing: list[Chunk] = field(default_factory=list)
    """Chunks that an index lists and that could not be found."""
    recorded: dict[int, int] = field(default_factory=dict)
    """Messages per channel id by the index of the whole file; empty if it has none that is valid."""
    gaps: list[tuple[int, int]] = field(default_factory=list)
    """First byte that may be damaged, and the byte where reading resumes."""
    sound: bool = True
    """True if no damage was met, so that the counts of the chunks are right."""
    cut_at: int | None = None
    """Byte after which nothing can be read and messages may have been."""
    appended_at: int | None = None
    """Byte where another recording follows the end of this one."""
    index_cut_at: int | None = None
    """Byte after which nothing can be read, after the last message."""

    def is_in_gap(self, position: int) -> bool:
        """Return whether a byte lies in one of the gaps, which are in order."""
        number = bisect_right(self.gaps, position, key=lambda gap: gap[0]) - 1
        return number >= 0 and position < self.gaps[number][1]

    def is_counted(self, number: int) -> bool:
        """Return whether the index of a chunk counts its messages. A cut file may lack a part of the last index."""
        chunk = self.chunks[number]
        whole = self.cut_at is None or number + 1 < len(self.chunks)
        return self.sound and bool(chunk.counts) and whole and not chunk.doubtful


class ResyncSearch:
    """The bytes of one file, and a search for patterns whose total cost is bounded."""

    def __init__(self, file: BinaryIO, length: int) -> None:
        self._file, self._length, self._left = file, length, _MAX_CANDIDATES
        self._window, self._start = b"", 0

    def at(self, position: int, length: int) -> bytes:
        """Return bytes from `position` on; fewer at the end of the file, none outside it."""
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
        """Return the first offset from `start` on and below `stop` at which the pattern (at most 64 bytes) matches and
        `accept(offset)` is true, or None."""
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


class ChunkRead(NamedTuple):
    """The outcome of reading one chunk."""

    number: int
    counts: Counter[int]
    """Messages per channel id, on whatever channel."""
    log_ns: list[int]
    """Log times of the messages that were asked for."""
    last_ns: int | None
    """Log time of the last message; None if there is none."""
    problem: str
    """End of the sentence about damage that was met; else empty."""
    verified: bool = False
    """True if the checksum of the chunk is right."""


@dataclass
class FileLosses:
    """Adds the losses of one file to the account of its log."""

    name: str
    length: int
    layout: Layout
    channels: dict[int, Channel]
    notes: Notes

    def may_hold(self, chunk: Chunk, wanted: set[Channel]) -> bool:
        """Return False if the index of a chunk names only channels that are defined and not wanted."""
        known = self.channels
        listed = chunk.counts if chunk.counted or (self.layout.sound and not chunk.doubtful) else ()
        return (not listed and not chunk.counted) or any(known.get(i) in wanted or i not in known for i in listed)

    def contents(self, read: Callable[[int], ChunkRead], define: Callable[[Set[int]], None]) -> Contents:
        """Return the number of messages, and account for all that are lost. Chunks without an index, and all chunks of
        a damaged file, are `read` to count their messages. `define` reads chunks until some channel ids are defined."""
        by_id, times, damaged = self._count(read)
        define(by_id.keys())
        if self.layout.sound and by_id.keys() - self.channels.keys():  # the indexes may be what is damaged
            self.layout.sound = False
            by_id, times, damaged = self._count(read)
        for chunk_read in damaged:
            self._add_chunk(chunk_read)
        # Bytes that follow a damaged chunk without an index are a part of the same loss.
        open_ends = {chunk.stop for chunk in (self.layout.chunks[read.number] for read in damaged) if chunk.doubtful}
        self.layout.gaps = [gap for gap in self.layout.gaps if gap[0] not in open_ends]
        counts = dict.fromkeys(self.channels.values(), 0)
        for number in by_id.keys() & self.channels.keys():
            counts[self.channels[number]] += by_id[number]
        span = confirmed_span(times)
        if unknown := by_id.total() - sum(counts.values()):
            self.notes.account.add("unknown_channel", {"": unknown}, (self.name, 0), [span])
        self._add_damage(sum(counts.values()), span)
        found, recorded = by_topic(counts), topics_of(self.layout.recorded, self.channels)
        account, whole = self.notes.account, not (self.layout.gaps or self.layout.missing or self.layout.cut_at)
        account.set_recorded(self.name, recorded or (found if whole else {}), *span)
        unexplained = account.reconcile({self.name}, recorded, found)
        if unexplained and sum(recorded.values()) > by_id.total():  # else the index names other topics
            detail = f"The index of {self.name} counts more messages than it holds."
            account.add("damaged_bytes", unexplained, (self.name, 0), [span], detail)
        return Contents(dict(sorted(counts.items())), *confirmed_span(times))

    def _count(self, read: Callable[[int], ChunkRead]) -> tuple[Counter[int], list[int], list[ChunkRead]]:
        """Return the messages by channel id, log times of each chunk, the first and last among them, and the damaged
        chunks among those that were read."""
        counts, times, damaged = Counter[int](), list[int](), list[ChunkRead]()
        for number, chunk in enumerate(self.layout.chunks):
            if self.layout.is_counted(number):
                counts.update(chunk.counts)
                times += chunk.first_ns, chunk.last_ns
                continue
            chunk_read = read(number)
            counts.update(chunk_read.counts)
            times += sampled(chunk_read.log_ns)
            if self._is_damaged(chunk_read):
                damaged.append(chunk_read._replace(log_ns=[]))
            elif not chunk.cut:
                if chunk.counts and not chunk.doubtful and chunk.counts != chunk_read.counts:
                    self.layout.recorded = {}  # the index is what is damaged
                chunk.counts, chunk.doubtful, chunk.counted = dict(chunk_read.counts), False, True
        return counts, times, damaged

    def check(self, chunk_read: ChunkRead) -> None:
        """Account for a chunk that turns out to be damaged after its messages were counted by its index."""
        if self.layout.is_counted(chunk_read.number) and self._is_damaged(chunk_read):
            self._add_chunk(chunk_read)

    def _is_damaged(self, chunk_read: ChunkRead) -> bool:
        """Return whether a chunk could not be read to its end, or lacks messages that a sound index lists."""
        chunk = self.layout.chunks[chunk_read.number]
        listed = chunk.counts if self.layout.sound and not chunk_read.verified else {}
        return not chunk.cut and (bool(chunk_read.problem) or not Counter(listed) <= chunk_read.counts)

    def _add_chunk(self, chunk_read: ChunkRead) -> None:
        """Add what a damaged chunk lacks: the messages of its index less those that were read, per channel id."""
        chunk, lost = self.layout.chunks[chunk_read.number], None
        if chunk.counts and not chunk.doubtful:
            short = Counter(chunk.counts)
            short.subtract(chunk_read.counts)
            if self.layout.sound:  # then messages of undefined channels are accounted for by `contents`
                short = Counter({i: count for i, count in short.items() if i in self.channels})
            changed = min(short.values(), default=0) < 0  # damage gave messages the number of another channel
            lost = {"": max(short.total(), 0)} if changed else topics_of(short, self.channels)
        first_ns = chunk.first_ns if chunk_read.last_ns is None else chunk_read.last_ns
        spans = [(min(first_ns, chunk.last_ns or first_ns), max(first_ns, chunk.last_ns))] if first_ns else []
        problem = chunk_read.problem or "; it holds fewer messages than its index lists"
        detail = f"{self.name} has a damaged chunk at byte {chunk.start}{problem}."
        self.notes.account.add("damaged_chunk", lost, (self.name, chunk.start), spans, detail)

    def _add_damage(self, messages: int, span: Span) -> None:
        """Add what lay in damaged bytes and after the end, of which the index of the file may know the number."""
        layout, account, name = self.layout, self.notes.account, self.name
        times = _TimesBetween(layout.chunks, span)
        for chunk in layout.missing:
            counts = None if chunk.doubtful else topics_of(chunk.counts, self.channels) or None
            when = (chunk.first_ns, chunk.last_ns) if chunk.last_ns else times.at(chunk.start)
            detail = f"{name} is damaged near byte {chunk.start}."
            account.add("damaged_bytes", counts, (name, chunk.start), [when], detail)
        for start, stop in layout.gaps:
            detail = f"{name} is damaged near byte {start}; reading resumes at byte {stop}."
            account.add("damaged_bytes", None, (name, -start), [times.at(start)], detail)
        if layout.cut_at is not None:
            before = f"the {plural(messages, 'message')} before it are read"
            detail = f"{name} is cut or damaged at byte {layout.cut_at} of {self.length}; {before}."
            account.add("cut", None, (name, layout.cut_at), [(span[1], span[1])], detail)
        if layout.appended_at is not None:
            account.add_appended(name, layout.appended_at, self.length)
        if layout.index_cut_at is not None:
            self.notes.add(f"{name} is cut or damaged at byte {layout.index_cut_at}, after its last message.")


class _TimesBetween:
    """Log times of the chunks around damaged places."""

    def __init__(self, chunks: list[Chunk], span: Span) -> None:
        """`chunks` are in the order of the file, and `span` is that of the file."""
        chunks = [chunk for chunk in chunks if chunk.last_ns]
        self._starts, self._stops = [chunk.start for chunk in chunks], [chunk.stop for chunk in chunks]
        self._last_ns = [span[0], *accumulate((chunk.last_ns for chunk in chunks), max)]
        self._first_ns = [*accumulate((chunk.first_ns for chunk in reversed(chunks)), min)][::-1]
        self._first_ns.append(span[1])

    def at(self, position: int) -> Span:
        """Return the last time in the chunks before a byte, and the first time in the chunks after it."""
        before, after = bisect_right(self._stops, position), bisect_right(self._starts, position)
        return self._last_ns[before], self._first_ns[after]
