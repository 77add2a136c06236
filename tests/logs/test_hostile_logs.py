"""Logs that were made to hurt: each is read or refused in one line, at once and in little memory."""

from __future__ import annotations

import json
import os
import random
import re
import sqlite3
import struct
import sys
import tracemalloc
from contextlib import closing, suppress
from io import BytesIO
from typing import TYPE_CHECKING, Any

import lz4.frame
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from tests.logs.drives import START_NS, Drive, ros_messages, store, write_raw, write_ros2
from vplog import logs
from vplog.errors import LogError
from vplog.logs import topic_selection
from vplog.logs.formats.budget import Budget
from vplog.logs.formats.container import Channel, Message, Notes
from vplog.logs.formats.mcap_file import ChunkReader, McapFile
from vplog.logs.formats.ros2_folder import ZstdMessages
from vplog.logs.formats.salvage import ResyncSearch
from vplog.logs.formats.sqlite_bag import SqliteBag

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from types import FrameType

EMPTY_MESSAGE = struct.pack("<BQHIQQ", 5, 22, 1, 0, 0, 0)
"""An MCAP message record of channel 1 without data."""


def write(path: Path, topics: int) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema("foxglove.LocationFix", "jsonschema", b"{}")
        for number in range(topics):
            channel = writer.register_channel(f"/fix/{number}", "json", schema)
            writer.add_message(channel, number, json.dumps({"number": number}).encode(), number)
        writer.finish()
    return path


def test_channels_are_taken_as_they_come_in_a_chunk(tmp_path: Path) -> None:
    """One by one: a log of 20,000 topics took minutes when each made the table of all anew."""
    file = McapFile(write(tmp_path / "a.mcap", 300), Notes())
    found = [(m.channel.topic, json.loads(bytes(m.data))["number"]) for m in file.messages(file.contents().counts)]
    assert found == [(f"/fix/{number}", number) for number in range(300)]
    wanted = {Channel(f"/fix/{number}", "foxglove.LocationFix", "json") for number in (7, 299)}
    assert [m.log_ns for m in file.messages(wanted)] == [7, 299]


@pytest.mark.parametrize("deep", ["[" * 50_000, "- " * 50_000, "{a: " * 20_000, "a: " + "[" * 50_000 + "]" * 50_000])
def test_metadata_that_nests_without_end_is_left_out(tmp_path: Path, deep: str) -> None:
    """libyaml's loader went down with the process."""
    write(tmp_path / "a.mcap", 3)
    (tmp_path / "metadata.yaml").write_text(deep)
    log = logs.open(tmp_path)
    assert any("metadata" in warning for warning in log.info().warnings)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mcap")
    with pytest.raises(LogError, match="neither a file nor a folder"):
        logs.open(tmp_path / "a.mcap")


def mcap_chunk(data: bytes, compression: bytes = b"zstd", time_ns: int = 0) -> bytes:
    packed = zstandard.compress(data) if compression else data
    body = struct.pack("<QQQII", time_ns, time_ns, len(data), 0, len(compression)) + compression
    body += struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


def mcap(*records: bytes) -> bytes:
    header = struct.pack("<BQII", 1, 8, 0, 0)
    return b"\x89MCAP0\r\n" + header + b"".join(records)


def ros1_record(data: bytes, **fields: bytes) -> bytes:
    header = b"".join(
        struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value for name, value in fields.items()
    )
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def ros1_bag(*chunks: bytes) -> bytes:
    counts = {"index_pos": bytes(8), "conn_count": bytes(4), "chunk_count": bytes(4)}
    records = [
        ros1_record(lz4.frame.compress(one), op=b"\x05", compression=b"lz4", size=struct.pack("<I", len(one)))
        for one in chunks
    ]
    return b"#ROSBAG V2.0\n" + ros1_record(b" " * 4027, op=b"\x03", **counts) + b"".join(records)


MANY = {
    "messages in one chunk": lambda: mcap(mcap_chunk(300_000 * EMPTY_MESSAGE)),
    "messages in several chunks": lambda: mcap(*3 * [mcap_chunk(100_000 * EMPTY_MESSAGE)]),
    "bytes in several chunks": lambda: mcap(*2 * [mcap_chunk(bytes(40 * 2**20))]),
    "bytes in chunks of ROS 1": lambda: ros1_bag(*2 * [bytes(40 * 2**20)]),
    "messages in chunks of ROS 1": lambda: ros1_bag(
        *2 * [150_000 * ros1_record(b"", op=b"\x02", conn=bytes(4), time=bytes(8))]
    ),
    "messages in a packed file": lambda: zstandard.compress(mcap(mcap_chunk(300_000 * EMPTY_MESSAGE, b""))),
}


def test_a_chunk_in_the_summary_is_not_unpacked(tmp_path: Path) -> None:
    data = mcap(mcap_chunk(EMPTY_MESSAGE))
    bomb = mcap_chunk(bytes(2**26))
    huge = struct.pack("<BQQQQIIQ", 6, 40, 0, 0, 0, 0, 0, 2**63)
    for record in (bomb, huge):
        footer = struct.pack("<BQQQI", 2, 20, len(data), 0, 0) + b"\x89MCAP0\r\n"
        (tmp_path / "a.mcap").write_bytes(data + record + footer)
        tracemalloc.start()
        try:
            with suppress(LogError):
                McapFile(tmp_path / "a.mcap", Notes())
            assert tracemalloc.get_traced_memory()[1] < 2**24
        finally:
            tracemalloc.stop()


@pytest.mark.parametrize("kind", MANY)
def test_a_small_file_of_more_than_any_log_has_is_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_bytes(MANY[kind]())
    with pytest.raises(LogError, match=r"a\.log claims more content than a log of \d+ bytes can have") as error:
        logs.open(path)
    assert "\n" not in str(error.value)


def test_a_chunk_counts_once_however_often_it_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(mcap(mcap_chunk(100_000 * EMPTY_MESSAGE)))
    file = McapFile(tmp_path / "a.mcap", Notes())
    for _ in range(3):
        file.contents()


def test_messages_that_unpack_to_more_than_any_log_has_are_refused() -> None:
    frame, channel = zstandard.compress(bytes(40 * 2**20)), Channel("/a", "b", "cdr")

    class Packed:
        def messages(self, *_: Any) -> Iterator[Message]:
            for number in range(1000):
                yield Message(channel, number, frame, (number,))

    found = ZstdMessages(Packed(), Notes()).messages([channel])  # pyrefly: ignore[bad-argument-type]
    assert len(next(found).data) == 40 * 2**20
    with pytest.raises(LogError, match="unpack to more than"):
        next(found)


def test_a_chunk_is_read_without_a_look_at_every_channel() -> None:
    """8,000 channels in 2,000 chunks took 19 CPU seconds when each chunk made a table of the wanted channels."""

    class Channels(dict[int, Channel]):
        def __iter__(self) -> Iterator[int]:
            raise AssertionError("all channels are gone through")

        items = values = keys = __iter__  # pyrefly: ignore[bad-override]

    channel = Channel("/a", "b", "cdr")
    for wanted in (None, {channel}):
        reader = ChunkReader(0, len(EMPTY_MESSAGE), Channels({1: channel}), lambda *_: None, wanted)
        assert [message.channel for message in reader.read(EMPTY_MESSAGE)] == [channel]


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("seed", range(8))
def test_forged_times_are_read_or_refused(seed: int, tmp_path: Path) -> None:
    """numpy's integers overflow with an error or, as a warning, without one."""
    rng, storage = random.Random(seed), "mcap" if seed % 2 else "sqlite3"
    extremes = (0, 1, 2**32, 2**62, 2**63 - 1) + ((2**63, 2**64 - 1) if storage == "mcap" else (-1, -(2**63)))
    messages = 6 * ros_messages(Drive(), 2)
    folder = write_ros2(tmp_path / "a", messages, storage)
    if storage == "sqlite3":
        path = next(folder.glob("*.db3"))
        with closing(sqlite3.connect(path)) as db:
            for row in range(1, len(messages), rng.choice([2, 9])):
                db.execute("UPDATE messages SET timestamp = ? WHERE id = ?", (rng.choice(extremes), row))
            db.commit()
    else:
        path = write_raw(tmp_path / "b.mcap", [
            (one.topic, one.type, "cdr", rng.choice(extremes) if rng.random() < 0.3 else one.stamp_ns + row, data)
            for row, one in enumerate(messages)
            for data in [bytes(store(2).serialize_cdr(one.message, one.type))]
        ])  # fmt: skip
    log = logs.open(path)
    log.odometry()
    log.gps()
    stamps = log.stamps()
    assert (stamps[:-1] < stamps[1:]).all()
    assert stamps[0] >= 0


def steps_of(action: Callable[[], object]) -> int:
    """Return the number of Python's instructions that an action takes."""
    steps = 0

    def count(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal steps
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        steps += event == "opcode"
        return count

    traced = sys.gettrace()
    sys.settrace(count)
    try:
        with suppress(LogError):
            action()
    finally:
        sys.settrace(traced)
    return steps


def chunk_index(offset: int) -> bytes:
    return struct.pack("<BQQQQQIQIQQ", 8, 64, 0, 0, offset, 80, 0, 0, 0, 0, 0)


def damaged_chunks(count: int) -> bytes:
    return mcap(*[mcap_chunk(bytes(100), time_ns=START_NS + number) for number in range(count)])


def listed_in_damage(count: int) -> bytes:
    """Chunks that the index lists in damaged bytes, behind as many sound ones."""
    sound = mcap(*[mcap_chunk(EMPTY_MESSAGE, time_ns=START_NS + number) for number in range(count)])
    start = len(sound) + 100 * count
    index = b"".join(chunk_index(len(sound) + 100 * number) for number in range(count))
    return sound + 100 * count * b"\xff" + index + struct.pack("<BQQQI", 2, 20, start, 0, 0) + b"\x89MCAP0\r\n"


def topics_of_images(count: int) -> bytes:
    with BytesIO() as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/CompressedImage", "ros2msg", b"")
        for number in range(count):
            channel = writer.register_channel(f"/left/{number}", "cdr", schema)
            writer.add_message(channel, number, bytes(20), number)
        writer.finish()
        return stream.getvalue()


@pytest.mark.parametrize("write", [damaged_chunks, listed_in_damage, topics_of_images])
def test_the_work_is_in_proportion_to_the_file(
    write: Callable[[int], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """8,000 damaged chunks took 29 CPU seconds, and as many that an index lists in damaged bytes some minutes."""
    monkeypatch.setattr(topic_selection, "MOST_TOPICS", 20)
    steps = []
    for count in (10, 150, 300):  # once to import modules
        path = tmp_path / f"{count}.mcap"
        path.write_bytes(write(count))
        steps.append(steps_of(lambda path=path: logs.open(path).info()))
    assert steps[2] < 2.2 * steps[1]


def test_a_search_that_succeeds_nearby_reads_no_more() -> None:
    class Counted(BytesIO):
        total = 0

        def read(self, size: int | None = -1, /) -> bytes:
            data = super().read(size)
            self.total += len(data)
            return data

    file = Counted(1000 * (99 * b" " + b"x"))
    search = ResyncSearch(file, 100_000)
    assert [search.first(re.compile(b"x"), 100 * number) for number in range(900)] == [*range(99, 90_000, 100)]
    assert file.total < 900 * 10_000
    assert search.first(re.compile(b"y"), 0) is None


def write_bag(path: Path, messages: str, values: int) -> Path:
    """A ROS 2 bag whose table of messages is made by a statement of SQL."""
    with closing(sqlite3.connect(path)) as db:
        db.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        db.execute("INSERT INTO topics VALUES (1, '/odom', 'nav_msgs/msg/Odometry', 'cdr')")
        db.execute(messages)
        if values:
            rows = [(number, 1, number) for number in range(values)]
            db.executemany("INSERT INTO messages(id, topic_id, timestamp) VALUES (?, ?, ?)", rows)
        db.commit()
    return path


COMPUTED = {
    "generated column": "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data AS (zeroblob(9)))",
    "stored column": "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data AS (x'00') STORED)",
    "view": "CREATE VIEW messages AS SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, x'00' AS data",
    "endless view": "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
    "SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n",
}


@pytest.mark.parametrize("forged", [False, True])
@pytest.mark.parametrize("kind", COMPUTED)
def test_rows_that_sqlite_would_compute_are_refused(kind: str, forged: bool, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "a.db3", COMPUTED[kind], 0 if "view" in kind else 3)
    if forged:  # the list of tables names a view as one
        with closing(sqlite3.connect(path)) as db:
            db.execute("PRAGMA writable_schema = ON")
            db.execute("UPDATE sqlite_master SET type = 'table' WHERE name = 'messages'")
            db.commit()
    with pytest.raises(LogError, match="they are views or have generated columns"):
        logs.open(path)


def test_queries_that_take_too_many_steps_are_stopped(tmp_path: Path) -> None:
    table = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB)"
    path, budget = write_bag(tmp_path / "a.db3", table, 20_000), Budget("a.db3", 0)
    assert SqliteBag(path, Notes(), budget=budget).contents().messages == 20_000
    budget.max_bytes = 2**16
    with pytest.raises(LogError, match=r"a\.db3 claims more content"):
        SqliteBag(path, Notes(), budget=budget).contents()
