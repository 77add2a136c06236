"""Interface of every kind of file: raw messages by topic in file order, and any one of them again by its place."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, NamedTuple, Protocol

from vplog.logs.formats.loss_account import LossAccount

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from vplog.data import Gps, Trajectory

Octets = bytes | memoryview
"""Bytes of a message: its own where they are few, else a view of the chunk that holds them."""
Place = tuple[int, ...]
"""Place of a message in its container; only the container that gave it out can read it."""


class Channel(NamedTuple):
    """A topic with one type in one encoding."""

    topic: str
    type: str
    """As the file names it: `sensor_msgs/msg/Image`, `sensor_msgs/Image`, `foxglove.RawImage`."""
    encoding: str
    """`cdr`, `ros1`, `protobuf`, `json`, or another that vplog lists but does not decode."""


class Message(NamedTuple):
    """One message as the file holds it."""

    channel: Channel
    log_ns: int
    data: Octets
    place: Place


class Block(NamedTuple):
    """Messages that lie in the same bytes, in file order: a chunk's, or one alone. All lists are as long."""

    data: Octets
    channels: list[Channel]
    log_ns: list[int]
    starts: list[int]
    stops: list[int]
    places: list[Place]

    def messages(self) -> Iterator[Message]:
        return map(self.message, range(len(self.channels)))

    def message(self, row: int) -> Message:
        start, stop = self.starts[row], self.stops[row]
        data = self.data if stop - start < _COPIED else memoryview(self.data)
        return Message(self.channels[row], self.log_ns[row], data[start:stop], self.places[row])


Row = tuple[Channel, int, int, int, Place]
"""Channel, log time, start, stop and place of a message of a block."""


def block_of(data: Octets, rows: list[Row]) -> Block:
    return Block(data, *map(list, zip(*rows, strict=True))) if rows else Block(data, [], [], [], [], [])


_COPIED = 4096
"""Bytes of a message below which it is given as a copy: as cheap as a view, and quicker to read numbers from."""
_TOGETHER = 256
"""Small messages of one block, at most; they take about as long to go through as one call does to set up."""


def in_blocks(messages: Iterable[Message]) -> Iterator[Block]:
    """Blocks of messages that lie in no chunk: small ones together, up to the next large one, which is one alone; few
    at first, for who takes only the first of a topic."""
    waiting: list[Message] = []
    together = 1
    for message in messages:
        large = len(message.data) >= _COPIED
        if waiting and (large or len(waiting) >= together):
            yield _joined(waiting)
            waiting.clear()
            together = min(2 * together, _TOGETHER)
        if large:
            yield _joined([message])
        else:
            waiting.append(message)
    if waiting:
        yield _joined(waiting)


def _joined(messages: list[Message]) -> Block:
    data = messages[0].data if len(messages) == 1 else b"".join(message.data for message in messages)
    bounds = pairwise(accumulate((len(message.data) for message in messages), initial=0))
    return block_of(data, [(m.channel, m.log_ns, *ends, m.place) for m, ends in zip(messages, bounds, strict=True)])


@dataclass(frozen=True)
class Contents:
    """Channels of a container with their message counts, in order of names, and its log times."""

    counts: dict[Channel, int]
    start_ns: int
    """First log time; 0 where there is no message."""
    end_ns: int
    truth: Trajectory | Gps | None = None
    """Ground truth that is published with it: poses of the body, or its places."""
    body: str = ""
    """Frame that the truth is of."""
    names: dict[int, str] = field(default_factory=dict)
    """Image file by stamp, of images that are known by their names."""
    files: dict[str, dict[int, str]] = field(default_factory=dict)
    """By topic, the path of each image by its stamp, of those that are files."""

    @property
    def messages(self) -> int:
        return sum(self.counts.values())


@dataclass
class Notes:
    """Remarks on a log, each once, in the order they were found, and the account of what is lost."""

    account: LossAccount = field(default_factory=LossAccount)
    _remarks: list[str] = field(default_factory=list)

    def add(self, line: str) -> None:
        if line not in self._remarks:
            self._remarks.append(line)

    def extend(self, other: Notes) -> None:
        self.account.extend(other.account)
        for line in other._remarks:
            self.add(line)

    @property
    def lines(self) -> list[str]:
        """The losses first."""
        return [*self.account.sentences, *self._remarks]


class Container(Protocol):
    """A file or folder of raw messages. Damage is skipped and noted; what cannot be opened at all raises LogError."""

    def contents(self) -> Contents: ...

    def blocks(self, channels: Collection[Channel], brief: Collection[Channel] = ()) -> Iterator[Block]:
        """The messages of these channels in file order, by the bytes they lie in, one block in memory at a time. Of
        large messages of `brief` channels, in the encodings of ROS, only the header's stamp is there: what follows it,
        up to their stop and beyond the end of the block, are bytes of others. `read` gives them whole."""
        ...

    def read(self, place: Place) -> Octets:
        """The bytes of one message, from any place that `blocks` gave."""
        ...


def messages_in(container: Container, channels: Collection[Channel]) -> Iterator[Message]:
    """The messages of these channels in file order."""
    for block in container.blocks(channels):
        yield from block.messages()


def by_topic(counts: Mapping[Channel, int]) -> dict[str, int]:
    """Counts of topics, whatever the types under one name."""
    result: Counter[str] = Counter()
    for channel, count in counts.items():
        result[channel.topic] += count
    return dict(result)


def topics_of(counts: Mapping[int, int], channels: Mapping[int, Channel]) -> dict[str, int]:
    """Counts by topic of counts by channel number, zero and less left out; those that nothing defines of no topic."""
    result: Counter[str] = Counter()
    for number, count in counts.items():
        if count > 0:
            result[channels[number].topic if number in channels else ""] += count
    return dict(result)
