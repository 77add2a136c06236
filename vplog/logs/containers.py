"""What every kind of file offers: raw messages by topic in file order, and any one of them again by its place."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol

from vplog.logs.losses import Account

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

Place = tuple[int, ...]
"""Where a message lies in its container; only the container that gave it out can read it."""


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
    data: bytes
    place: Place


@dataclass(frozen=True)
class Contents:
    """What is in a container: its channels with their counts, in order of their names."""

    counts: dict[Channel, int]
    start_ns: int
    """First log time; 0 where there is no message."""
    end_ns: int

    @property
    def messages(self) -> int:
        return sum(self.counts.values())


@dataclass
class Notes:
    """What is said of a log: remarks, each once, in the order they were found, and the account of what is lost."""

    account: Account = field(default_factory=Account)
    _said: list[str] = field(default_factory=list)

    def add(self, line: str) -> None:
        if line not in self._said:
            self._said.append(line)

    @property
    def lines(self) -> list[str]:
        """The losses first."""
        return [*self.account.sentences, *self._said]


class Container(Protocol):
    """A file or folder of raw messages. Damage is skipped and noted; what cannot be opened at all raises LogError."""

    def contents(self) -> Contents: ...

    def messages(self, channels: Collection[Channel]) -> Iterator[Message]:
        """The messages of these channels in file order, one in memory at a time."""
        ...

    def read(self, place: Place) -> bytes:
        """The bytes of one message, from any place that `messages` gave."""
        ...


def ordered(counts: dict[Channel, int]) -> dict[Channel, int]:
    """The same counts in an order that does not depend on the file."""
    return dict(sorted(counts.items()))


def plural(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def by_topic(counts: Mapping[Channel, int]) -> dict[str, int]:
    """Counts of topics, whatever the types under one name."""
    result: dict[str, int] = {}
    for channel, count in counts.items():
        result[channel.topic] = result.get(channel.topic, 0) + count
    return result


def count_messages(messages: Iterable[Message], channels: Iterable[Channel]) -> Contents:
    """Contents by reading every message; `channels` may turn out to be empty."""
    counts: dict[Channel, int] = {}
    start_ns, end_ns = 2**64, 0
    for message in messages:
        counts[message.channel] = counts.get(message.channel, 0) + 1
        start_ns, end_ns = min(start_ns, message.log_ns), max(end_ns, message.log_ns)
    counts = dict.fromkeys(channels, 0) | counts
    return Contents(ordered(counts), min(start_ns, end_ns), end_ns)
