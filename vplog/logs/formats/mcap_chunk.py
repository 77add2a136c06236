"""The messages of one chunk of an MCAP file (mcap.dev/spec), read record by record."""

from __future__ import annotations

import struct
from collections import Counter
from typing import TYPE_CHECKING

from mcap.opcode import Opcode

from vplog.logs.formats.container import BRIEF, Message, part_of
from vplog.logs.formats.mcap_layout import RECORD

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from vplog.logs.formats.container import Channel

_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode and length; channel id, sequence, log time, publish time: a message record up to its data."""
_IS_MESSAGE, _IS_SCHEMA, _DEFINES = int(Opcode.MESSAGE), int(Opcode.SCHEMA), (int(Opcode.SCHEMA), int(Opcode.CHANNEL))
_OUTSIDE = frozenset({0, *map(int, Opcode)}.difference(_DEFINES, [_IS_MESSAGE]))
"""Opcodes that no record in a chunk has; those not known yet are stepped over, as the specification requires."""
_WINDOW = 4096
"""Bytes that are read of a chunk at once where most of its bytes are those of images, which are stepped over."""


class ChunkReader:
    """Messages found so far in chunk `number`, from its first byte to `position`."""

    def __init__(
        self,
        number: int,
        end: int,
        channels: dict[int, Channel],
        define: Callable[[int, bytes], None],
        wanted: Collection[Channel] | None,
        brief: Collection[Channel] = (),
        cut: bool = False,
    ) -> None:
        """`end` is its length, `cut` whether the file ends in it. Messages on `wanted` channels are given (None: on
        all); those on `brief` ones need not be whole. `define` takes a schema or channel record and may add to
        `channels`."""
        self.position = 0
        self.last_ns: int | None = None
        """Log time of the last message, on whatever channel."""
        self.number, self.end, self._channels, self._define = number, end, channels, define
        self._wanted, self._brief, self._cut = wanted, brief, cut
        self._used = {i: channel for i, channel in channels.items() if wanted is None or channel in wanted}
        self._ids: list[int] = []
        self._messages: list[Message] = []

    @property
    def counts(self) -> Counter[int]:
        """Messages by channel id."""
        return Counter(self._ids)

    def whole(self, data: bytes) -> list[Message]:
        """The messages of the chunk, of which `data` are all bytes."""
        self._go(data)
        return self._sound()

    def in_place(self, read: Callable[[int, int], bytes]) -> list[Message]:
        """The messages of a chunk that is not packed, from what `read(start, length)` gives of its bytes."""
        while (left := self.end - self.position) >= RECORD.size:
            before = self.position
            data = read(before, min(_WINDOW, left))
            self._go(data)
            if self.position == before:
                length = RECORD.size + RECORD.unpack_from(data)[1] if len(data) >= RECORD.size else left + 1
                if not len(data) < length <= left:
                    break
                self._go(read(before, length))
                if self.position == before:
                    break
        return self._sound()

    def _sound(self) -> list[Message]:
        """The messages found, without the one before damage: its length may be what is damaged."""
        if self.position < self.end and not self._cut and self._ids and self._ids.pop() in self._used:
            self._messages.pop()
        return self._messages

    def _go(self, data: bytes) -> None:
        """On through `data`, which lie at `position` in the chunk, up to the first record that more is needed of."""
        base, at, size, left = self.position, 0, len(data), self.end - self.position
        used = self._used
        while at + _MESSAGE.size <= size:
            opcode, length, channel_id, _, log_ns, _ = _MESSAGE.unpack_from(data, at)
            start, stop = at + _MESSAGE.size, at + RECORD.size + length
            if stop < start if opcode == _IS_MESSAGE else opcode in _OUTSIDE:
                break
            if stop > size and (
                opcode != _IS_MESSAGE or stop > left or self._is_needed(used.get(channel_id), size - start, length)
            ):
                break
            if opcode == _IS_MESSAGE:
                self._ids.append(channel_id)
                self.last_ns = log_ns
                if channel_id in used:
                    place = self.number, base + start, base + stop
                    self._messages.append(Message(used[channel_id], log_ns, part_of(data, start, stop), place))
            elif opcode in _DEFINES:
                self._learn(opcode, data[at + RECORD.size : stop])
            at = stop
        while at + RECORD.size <= size:  # too short for a message
            opcode, length = RECORD.unpack_from(data, at)
            stop = at + RECORD.size + length
            if stop > size or opcode == _IS_MESSAGE or opcode in _OUTSIDE:
                break
            if opcode in _DEFINES:
                self._learn(opcode, data[at + RECORD.size : stop])
            at = stop
        self.position = base + at

    def _learn(self, opcode: int, data: bytes) -> None:
        """Take a definition; it may be of a wanted channel, and a log may have ten thousands of them."""
        self._define(opcode, data)
        number = int.from_bytes(data[:2], "little")  # of a schema or channel record, its first field
        channel = self._channels.get(number)
        if opcode != _IS_SCHEMA and channel is not None:
            if self._wanted is None or channel in self._wanted:
                self._used[number] = channel
            else:
                self._used.pop(number, None)

    def _is_needed(self, channel: Channel | None, there: int, length: int) -> bool:
        """Whether more of a message is needed than the bytes that are there."""
        return channel is not None and (channel not in self._brief or there < BRIEF or length < _WINDOW)
