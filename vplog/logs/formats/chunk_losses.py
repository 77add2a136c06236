"""What is lost of a file of chunks, MCAP or ROS 1, by its layout and by what its chunks hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vplog.logs.formats.container import plural, topics_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vplog.logs.formats.container import Channel, Notes
    from vplog.logs.formats.layout import Chunk, Layout
    from vplog.logs.formats.loss_account import Span


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

    def add_chunk(self, chunk: Chunk, counts: Mapping[int, int], spans: list[Span], what: str) -> None:
        """Messages by channel id that are lost of a damaged chunk; `what` ends the sentence about it."""
        lost = topics_of(counts, self.channels) if chunk.counts else None
        detail = f"{self.name} has a damaged chunk at byte {chunk.start}{what}."
        self.notes.account.add("damaged_chunk", lost, (self.name, chunk.start), spans, detail)

    def add_unknown(self, chunk: Chunk, count: int, spans: list[Span]) -> None:
        """Messages of channels that nothing defines."""
        if count:
            self.notes.account.add("unknown_channel", {"": count}, (self.name, chunk.start), spans)

    def add_missing(self, found: Mapping[str, int], span: Span, detail: str) -> dict[str, int]:
        """The chunks in damaged bytes, of a file whose messages cover `span`. Messages by topic, found or lost."""
        total = dict(found)
        for chunk in self.layout.missing:
            counts = topics_of(chunk.counts, self.channels)
            when = (chunk.first_ns, chunk.last_ns) if chunk.last_ns else self.between(chunk.start, span)
            about = detail and f"{self.name} {detail} {chunk.start}."
            self.notes.account.add("damaged_bytes", counts or None, (self.name, chunk.start), [when], about)
            for topic, count in counts.items():
                total[topic] = total.get(topic, 0) + count
        return total

    def between(self, position: int, span: Span) -> Span:
        """The time between the chunk before a damaged place and the one behind it; `span` is that of the file."""
        chunks = [chunk for chunk in self.layout.chunks if chunk.last_ns]
        before = max((chunk.last_ns for chunk in chunks if chunk.stop <= position), default=span[0])
        behind = min((chunk.first_ns for chunk in chunks if chunk.start > position), default=span[1])
        return before, behind

    def add_end(self, messages: int, spans: list[Span]) -> None:
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
