"""Chunks by other threads and from the cache, and messages found where they lie, are those of plain reading."""

from __future__ import annotations

import struct
import time
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.logs.drives import Drive, foxglove_messages, ros_messages, write_foxglove, write_ros2
from vplog.logs.formats import chunk_cache as chunks_module
from vplog.logs.formats.chunk_cache import Chunks
from vplog.logs.formats.compression import BadChunkError
from vplog.logs.formats.container import HEADER_BYTES, Channel, Notes
from vplog.logs.formats.mcap_file import ChunkReader, McapFile

if TYPE_CHECKING:
    from pathlib import Path

CHANNELS = {i: Channel(f"/{i}", "sensor_msgs/msg/Image", "cdr") for i in range(3)}


@pytest.mark.parametrize("threads", [False, True])
def test_chunks_come_in_turn_and_damaged_ones_are_told(threads: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks_module, "_ALONE_S", 0.0)
    size, lost, loaded = 2**20, [], []

    def load(number: int) -> bytes:
        loaded.append(number)
        if number % 3 == 0:
            raise BadChunkError("broken")
        return bytes([number]) * size

    chunks = Chunks(
        load, lambda number, _: lost.append(number), lambda _: size, lambda number: number % 2 == 0, threads
    )
    for _ in range(2):
        expected = [(n, None if n == 5 else b"" if n % 3 == 0 else bytes([n]) * size) for n in range(9)]
        assert list(chunks.iterate(range(9), lambda number: number == 5)) == expected
    assert sorted(loaded) == sorted([*range(5), *range(6, 9), 1, 3, 7])  # even ones were kept
    assert lost == [0, 3, 6, 3]
    some = chunks.iterate(range(100, 200))
    next(some)
    some.close()
    assert loaded[-1] == 100  # who looks for one does not load those behind it


def test_no_more_is_unpacked_ahead_than_may_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """And whoever stops in the middle leaves nothing behind."""
    monkeypatch.setattr(chunks_module, "_ALONE_S", 0.0)
    monkeypatch.setattr(chunks_module, "_AHEAD_BYTES", 2 * 2**20)
    size, loaded = 2**20, []

    def load(number: int) -> bytes:
        loaded.append(number)
        return bytes([number]) * size

    chunks = Chunks(load, lambda *_: None, lambda _: size, lambda _: False, True)
    for number, data in chunks.iterate(range(12)):
        time.sleep(0.01)
        assert data == bytes([number]) * size
        assert max(loaded) <= number + 1
    loaded.clear()
    some = chunks.iterate(range(100, 200), lambda number: number == 102)
    assert [next(some)[0], next(some)[0]] == [100, 101]
    some.close()
    assert max(loaded) <= 103


def test_what_is_kept_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunks_module, "MOST_BYTES", 1000)
    kept = chunks_module._RecentChunks()
    for number in range(50):
        kept.put((number % 2, number), bytes(90))
    assert kept._bytes == 90 * len(kept._chunks) <= 1000
    assert kept.get((1, 49)) == bytes(90)
    assert kept.get((0, 0)) is None
    kept.forget(1)
    assert kept._bytes == 90 * len(kept._chunks)
    kept.put((0, 1), bytes(5000))  # larger than all that may be kept, and still there for who goes on with it
    assert kept.get((0, 1)) == bytes(5000)


records = st.lists(
    st.tuples(st.sampled_from([1, 4, 5, 5, 5, 15]), st.integers(0, 3), st.sampled_from([0, 9, 500, 5000]))
)


@given(records, st.integers(0, 60), st.sets(st.integers(0, 2)))
def test_messages_are_found_in_place_as_in_the_whole(
    found: list[tuple[int, int, int]], cut: int, used: set[int]
) -> None:
    """Messages, some on channels that are not known, between other records; `cut` bytes are missing at the end."""
    data = b""
    for i, (opcode, channel, size) in enumerate(found):
        body = struct.pack("<HIQQ", channel, i, 10 * i, i) if opcode == 5 else b""
        body += bytes([i % 251]) * size
        data += struct.pack("<BQ", opcode, len(body)) + body
    data = data[: max(len(data) - cut, 0)]
    wanted = {CHANNELS[i] for i in used}
    for header_only in ((), wanted):
        defined: list[list] = [[], []]
        walks = [
            ChunkReader(3, len(data), dict(CHANNELS), lambda *one, to=to: to.append(one), wanted, header_only)  # pyrefly: ignore[missing-attribute]
            for to in defined
        ]
        whole = walks[0].read(data)
        there = walks[1].read_in_place(lambda start, length: data[start : start + length])
        assert defined[0] == defined[1]
        assert walks[0].__dict__.keys() == walks[1].__dict__.keys()
        for name in ("position", "last_ns", "counts"):
            assert getattr(walks[0], name) == getattr(walks[1], name)
        assert [(m.channel, m.log_ns, m.place) for m in whole] == [(m.channel, m.log_ns, m.place) for m in there]
        for a, b in zip(whole, there, strict=True):
            least = HEADER_BYTES if header_only and len(a.data) >= 4096 - 22 else len(a.data)
            assert bytes(a.data[:least]) == bytes(b.data[:least])
            assert bytes(a.data) == data[a.place[1] : a.place[2]]


@pytest.mark.parametrize("ros", [False, True])
def test_messages_read_again_are_those_read_first(ros: bool, tmp_path: Path) -> None:
    """From chunks that are packed, and from plain ones in the file."""
    if ros:
        path = write_ros2(tmp_path / "drive", ros_messages(Drive(), 2)) / "drive.mcap"
    else:
        path = write_foxglove(tmp_path / "drive.mcap", foxglove_messages(Drive()), "protobuf", chunk_size=4096)
    file = McapFile(path, Notes())
    counts = file.contents().counts
    found = [(message, bytes(message.data)) for message in file.messages(counts)]
    assert len(found) == sum(counts.values())
    assert all(file.read(message.place) == data for message, data in found)
    stamped = list(file.messages(counts, list(counts)))
    assert [(m.channel, m.log_ns, m.place) for m in stamped] == [(m.channel, m.log_ns, m.place) for m, _ in found]
