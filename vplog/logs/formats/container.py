"""Interface of every kind of file: raw messages by topic in file order, and any one of them again by its place."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

from vplog.data import Gps, Trajectory
from vplog.logs.formats.loss_account import LossAccount

RawData = bytes | memoryview
"""Bytes of a message: its own where they are few, else a view of the chunk that holds them."""
Place = tuple[int, ...]
"""Place of a message in its container; only the container that gave it out can read it."""
HEADER_BYTES = 512
"""Bytes of a large message that suffice where its header alone is wanted: more than a message without content has."""
_COPIED = 4096
"""Bytes of a message below which it is given as a copy: as cheap as a view, and quicker to read numbers from."""


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
    data: Any
    """RawData; of a published data set the record that they would be decoded to."""
    place: Place


def part_of(data: bytes, start: int, stop: int) -> RawData:
    """The bytes of a message in a chunk, as far as they are there."""
    return data[start:stop] if stop - start < _COPIED else memoryview(data)[start:stop]


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
    assumed_times: bool = False
    """Where the names of the images hold no times: they are taken to be 0.1 s apart, and need not follow each other."""

    @property
    def messages(self) -> int:
        return sum(self.counts.values())

    def with_image_offset(self, offset_ns: int) -> Contents:
        """The contents with image files by their stamps plus `offset_ns`."""
        files = {topic: _later(names, offset_ns) for topic, names in self.files.items()}
        return replace(self, names=_later(self.names, offset_ns), files=files) if offset_ns else self


def _later(names: Mapping[int, str], offset_ns: int) -> dict[int, str]:
    return {stamp_ns + offset_ns: name for stamp_ns, name in names.items()}


@dataclass
class Notes:
    """Remarks on a log, each once, in the order they were found, and the account of what is lost."""

    account: LossAccount = field(default_factory=LossAccount)
    _remarks: dict[str, None] = field(default_factory=dict)

    def add(self, line: str) -> None:
        self._remarks.setdefault(line)

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

    def messages(self, channels: Collection[Channel], header_only: Collection[Channel] = ()) -> Iterator[Message]:
        """The messages of these channels in file order. Of large ones of `header_only` channels, in the encodings of
        ROS, the first HEADER_BYTES suffice; `read` gives them whole."""
        ...

    def read(self, place: Place) -> Any:
        """The data of one message, from any place that `messages` gave."""
        ...


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
