"""Where the length, offset and count fields of small logs lie, by the formats' specifications alone.

MCAP: mcap.dev/spec. ROS 1 bag 2.0: wiki.ros.org/Bags/Format/2.0. SQLite: sqlite.org/fileformat2.html.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


class Field(NamedTuple):
    """An integer of `width` bytes at `offset` of a file."""

    name: str
    offset: int
    width: int
    big: bool = False
    """Big-endian, as SQLite's are."""

    def read(self, data: bytes) -> int:
        return int.from_bytes(data[self.offset : self.offset + self.width], "big" if self.big else "little")

    def set(self, data: bytes, value: int) -> bytes:
        value %= 1 << 8 * self.width
        inserted = value.to_bytes(self.width, "big" if self.big else "little")
        return data[: self.offset] + inserted + data[self.offset + self.width :]


_MCAP_RECORDS: dict[int, tuple[str, str]] = {
    # Per opcode: its name, and its fields in order: digits are widths of plain values that are stepped over, l4 and l8
    # lengths of bytes that follow, o offsets, sizes and counts of 8 bytes (n of 4), m a map of strings, i a map from
    # channel ids to offsets or counts, x an array of message index entries.
    1: ("header", "l4 l4"),
    2: ("footer", "o o 4"),
    3: ("schema", "2 l4 l4 l4"),
    4: ("channel", "2 2 l4 l4 m"),
    5: ("message", ""),
    6: ("chunk", "8 8 o 4 l4 l8"),
    7: ("message_index", "2 x"),
    8: ("chunk_index", "8 8 o o i o l4 o o"),
    9: ("attachment", "8 8 l4 l4 l8 4"),
    10: ("attachment_index", "o o 8 8 o l4 l4"),
    11: ("statistics", "o 2 4 4 4 4 8 8 i"),
    12: ("metadata", "l4 m"),
    13: ("metadata_index", "o o l4"),
    14: ("summary_offset", "1 o o"),
    15: ("data_end", "4"),
}


def mcap_fields(data: bytes) -> Iterator[Field]:
    """Every length and offset of an MCAP file, those in chunks that are not compressed included."""
    yield from _mcap_records(data, 8, len(data) - 8)


def _mcap_records(data: bytes, position: int, stop: int) -> Iterator[Field]:
    while position < stop:
        opcode, length = data[position], int.from_bytes(data[position + 1 : position + 9], "little")
        name, layout = _MCAP_RECORDS[opcode]
        yield Field(f"{name}.record_length", position + 1, 8)
        at = position + 9
        for number, kind in enumerate(layout.split()):
            at = yield from _mcap_field(data, f"{name}.{number}", kind, at)
        if opcode == 6 and data[position + 9 + 28 : position + 9 + 32] == bytes(4):  # the compression has no name
            yield from _mcap_records(data, position + 9 + 40, at)
        position += 9 + length


def _mcap_field(data: bytes, name: str, kind: str, at: int) -> Iterator[Field]:
    """Gives the position behind it."""
    if kind.isdigit():
        return at + int(kind)
    if kind in "on":
        width = 8 if kind == "o" else 4
        yield Field(f"{name}.value", at, width)
        return at + width
    width = 8 if kind == "l8" else 4
    length = int.from_bytes(data[at : at + width], "little")
    yield Field(f"{name}.length", at, width)
    start, stop = at + width, at + width + length
    if kind == "m":
        while start < stop:
            start = yield from _mcap_field(data, f"{name}.text", "l4", start)
    elif kind == "i":
        yield from (Field(f"{name}.entry", entry + 2, 8) for entry in range(start, stop, 10))
    elif kind == "x":
        yield from (Field(f"{name}.offset", entry + 8, 8) for entry in range(start, stop, 16))
    return stop


def bag_fields(data: bytes) -> Iterator[Field]:
    """Every length, offset and count of a ROS 1 bag, those in chunks that are not compressed included."""
    yield from _bag_records(data, 13, len(data))


def _bag_records(data: bytes, position: int, stop: int) -> Iterator[Field]:
    while position < stop:
        size = int.from_bytes(data[position : position + 4], "little")
        start = position + 8 + size
        header = dict(_bag_header(data, position + 4, start - 4))
        op = data[header[b"op"][0]]
        yield Field(f"op{op}.header_length", position, 4)
        for name, (at, width) in header.items():
            yield Field(f"op{op}.{name.decode()}.length", at - len(name) - 5, 4)
            if name in (b"index_pos", b"conn_count", b"chunk_count", b"size", b"chunk_pos", b"count"):
                yield Field(f"op{op}.{name.decode()}", at, width)
        length = int.from_bytes(data[start - 4 : start], "little")
        yield Field(f"op{op}.data_length", start - 4, 4)
        if op == 5 and data[header[b"compression"][0] :].startswith(b"none"):
            yield from _bag_records(data, start, start + length)
        elif op == 7:
            for name, (at, _) in _bag_header(data, start, start + length):
                yield Field(f"op7.data.{name.decode()}.length", at - len(name) - 5, 4)
        elif op == 4:
            yield from (Field("op4.offset", entry + 8, 4) for entry in range(start, start + length, 12))
        elif op == 6:
            yield from (Field("op6.entry", entry + 4, 4) for entry in range(start, start + length, 8))
        position = start + length


def _bag_header(data: bytes, position: int, stop: int) -> Iterator[tuple[bytes, tuple[int, int]]]:
    """Name, and position and length of the value."""
    while position < stop:
        length = int.from_bytes(data[position : position + 4], "little")
        name, _, value = data[position + 4 : position + 4 + length].partition(b"=")
        yield name, (position + 5 + len(name), len(value))
        position += 4 + length


def sqlite_fields(data: bytes) -> Iterator[Field]:
    """Every size, offset and count of an SQLite file: of its head, and of all pages of B-trees."""
    page = int.from_bytes(data[16:18], "big")
    heads = {"page_size": (16, 2), "pages": (28, 4), "freelist": (32, 4), "free_pages": (36, 4), "reserved": (20, 1)}
    yield from (Field(f"file.{name}", *where, big=True) for name, where in heads.items())
    for start in range(0, len(data), page):
        head = start + 100 if start == 0 else start
        if data[head] in (2, 5, 10, 13):
            yield from _sqlite_page(data, start, head)


def _sqlite_page(data: bytes, start: int, head: int) -> Iterator[Field]:
    kind = data[head]
    yield from (Field(f"page{kind}.{name}", head + at, 2, big=True)
                for name, at in {"freeblock": 1, "cells": 3, "content": 5}.items())  # fmt: skip
    if kind in (2, 5):
        yield Field(f"page{kind}.rightmost", head + 8, 4, big=True)
    first = head + (12 if kind in (2, 5) else 8)
    for number in range(int.from_bytes(data[head + 3 : head + 5], "big")):
        pointer = Field(f"page{kind}.cell_pointer", first + 2 * number, 2, big=True)
        yield pointer
        cell = start + pointer.read(data)
        if kind in (2, 5):
            yield Field(f"page{kind}.left_child", cell, 4, big=True)
        if kind in (10, 13):
            yield from _sqlite_cell(data, cell, kind)


def _sqlite_cell(data: bytes, at: int, kind: int) -> Iterator[Field]:
    """Varints change by their last byte alone, so that what lies behind stays where it is."""
    at, _ = _varint(data, at)
    yield Field(f"cell{kind}.payload", at - 1, 1)
    if kind == 13:
        at, _ = _varint(data, at)
        yield Field(f"cell{kind}.rowid", at - 1, 1)
    start = at
    at, length = _varint(data, at)
    yield Field(f"cell{kind}.header", at - 1, 1)
    while at < start + length:
        at, _ = _varint(data, at)
        yield Field(f"cell{kind}.serial_type", at - 1, 1)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """The position behind, and the value."""
    value = 0
    while True:
        value = value << 7 | data[at] & 0x7F
        at += 1
        if not data[at - 1] & 0x80:
            return at, value


FIELDS: dict[str, Callable[[bytes], Iterator[Field]]] = {
    ".mcap": mcap_fields, ".bag": bag_fields, ".db3": sqlite_fields
}  # fmt: skip
