"""The account of what is lost: for every topic, what is read and what is lost add up to what was recorded."""

from __future__ import annotations

import gc
import random
import shutil
import tempfile
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags import rosbag1

from tests.logs.drives import (
    FRAMES,
    LATENCY_NS,
    START_NS,
    Drive,
    foxglove_messages,
    ros_messages,
    store,
    write_foxglove,
    write_ros1,
    write_ros2,
)
from vplog import logs
from vplog.errors import LogError
from vplog.logs.formats.loss_account import LossAccount, LossRuns, merged, runs_of
from vplog.logs.recorded_log import RecordedLog
from vplog.storage import scratch

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.logs.formats.loss_account import TopicLoss

DRIVE = Drive()
RECORDED = Counter(m.topic for m in ros_messages(DRIVE, 2))
"""Messages by topic in every ROS drive of these tests."""


def opened(path: Path) -> tuple[dict[str, int], list[TopicLoss], str]:
    """Messages by topic that the log says it has, what it says is lost, and its warnings, after all was read."""
    log = logs.open(path)
    assert isinstance(log, RecordedLog)
    found = {topic.name: topic.count for topic in log.info().topics}
    if len(log.stamps()):
        list(log.frames(log.stamps()))
    before = log.losses
    log.info()
    assert log.losses == before  # what is found again is not counted again
    return found, log.losses, " ".join(log.warnings)


def lost_by_topic(losses: list[TopicLoss], *reasons: str) -> Counter[str]:
    return Counter({loss.topic: loss.messages or 0 for loss in losses if loss.reason in reasons and loss.messages})


def spread(messages: list, times: int) -> list:
    """The same messages again and again, as a longer log."""
    return messages * times


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("share", [0.35, 0.5, 0.7, 0.9, 0.97])
def test_a_cut_bag_is_counted_by_its_metadata(storage: str, share: float, tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", ros_messages(DRIVE, 2), storage)
    file = next(path for path in folder.iterdir() if path.suffix in (".mcap", ".db3"))
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    try:
        found, losses, _ = opened(folder)
    except LogError as error:
        assert any(why in str(error) for why in ("nothing in it can be read", "decodes: "))
        return
    outside = lost_by_topic(losses, "cut", "damaged_bytes", "unknown_channel")
    assert Counter(found) + outside == RECORDED
    assert all(loss.of == RECORDED[loss.topic] for loss in losses if loss.messages)
    if outside and storage == "mcap":
        (span,) = next(loss.spans_ns for loss in losses if loss.reason == "cut")
        assert span[1] == DRIVE.stamp_ns[-1] + LATENCY_NS  # the metadata say when the recording ended


def test_a_cut_file_without_metadata_says_where_it_ends(tmp_path: Path) -> None:
    file = write_ros2(tmp_path / "drive", ros_messages(DRIVE, 2)) / "drive.mcap"
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) * 7 // 10])
    found, losses, said = opened(file)
    (loss,) = [loss for loss in losses if loss.reason == "cut"]
    assert (loss.topic, loss.messages, loss.of) == ("", None, None)
    assert loss.spans_ns[0][1] <= DRIVE.stamp_ns[-1] + LATENCY_NS
    assert "an unknown number of messages" in said
    assert f"{sum(found.values())} messages before it are read" in said


def chunked(path: Path, **options: object) -> Path:
    """A drive of many small chunks with checksums."""
    return write_foxglove(path, foxglove_messages(DRIVE), "protobuf", chunk_size=4096, **options)


def read(log: RecordedLog) -> Counter[str]:
    """Messages by topic that can really be read."""
    return Counter(m.channel.topic for m in log._container.messages(log._contents.counts))


def in_chunk(path: Path, number: int) -> tuple[int, Counter[str], tuple[int, int]]:
    """Where a chunk's record lies, what is in it by the reference reader, and when."""
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        chunk = summary.chunk_indexes[number]
        start_ns, end_ns = chunk.message_start_time, chunk.message_end_time
        there: Counter[str] = Counter()
        for _, channel, message in reader.iter_messages(starting_at=start_ns, ending_at=end_ns):
            offsets = chunk.message_index_offsets
            there[channel.topic] += channel.id in offsets and start_ns <= message.log_time <= end_ns
    return chunk.chunk_start_offset, there, (start_ns, end_ns)


def test_a_chunk_with_a_wrong_checksum_is_counted_by_its_index(tmp_path: Path) -> None:
    path = chunked(tmp_path / "a.mcap", compression=0)
    whole, _, _ = opened(path)
    start, _, span = in_chunk(path, 2)
    data = bytearray(path.read_bytes())
    data[start + 200] ^= 0xFF
    path.write_bytes(data)
    log = logs.open(path)
    assert isinstance(log, RecordedLog)
    log.info()
    losses = [loss for loss in log.losses if loss.reason == "damaged_chunk"]
    assert losses
    assert read(log) + lost_by_topic(losses, "damaged_chunk") == Counter(whole)
    assert all(loss.spans_ns == (span,) for loss in losses)
    assert all(loss.of == whole[loss.topic] for loss in losses)
    assert "its checksum does not match" in " ".join(log.warnings)


@pytest.mark.parametrize("summary", [True, False])
@pytest.mark.parametrize("at", [0, 3, 8])  # opcode; a low and the highest byte of the length
@pytest.mark.parametrize("compression", [0, 1, 2])
def test_a_damaged_record_head_costs_no_more_than_its_chunk(
    compression: int, at: int, summary: bool, tmp_path: Path
) -> None:
    path = chunked(tmp_path / "a.mcap", compression=compression)
    whole, _, _ = opened(path)
    start, there, span = in_chunk(path, 2)
    if not summary:
        chunked(path, compression=compression, use_statistics=False, repeat_channels=False, repeat_schemas=False)
    data = bytearray(path.read_bytes())
    data[start + at] ^= 0x51
    path.write_bytes(data)
    log = logs.open(path)
    assert isinstance(log, RecordedLog)
    log.info()
    missed = Counter(whole) - read(log)
    assert missed <= there
    assert lost_by_topic(log.losses, "damaged_bytes") == missed
    assert all(loss.spans_ns[0] == span for loss in log.losses if loss.messages)


@pytest.mark.parametrize("at", [0, 4, 9])
@pytest.mark.parametrize("compression", ["", "lz4", "bz2"])
def test_a_damaged_ros1_chunk_head_costs_no_more_than_its_chunk(compression: str, at: int, tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "drive.bag", ros_messages(DRIVE, 1), compression)
    with rosbag1.Reader(path) as reader:
        infos = sorted(reader.chunk_infos, key=lambda info: info.pos)
        topics = {connection.id: connection.topic for connection in reader.connections}
        info = infos[len(infos) // 2]
        there = Counter({topics[number]: count for number, count in info.connection_counts.items()})
    whole, _, _ = opened(path)
    data = bytearray(path.read_bytes())
    data[info.pos + at] ^= 0x51
    path.write_bytes(data)
    log = logs.open(path)
    assert isinstance(log, RecordedLog)
    log.info()
    missed = Counter(whole) - read(log)
    assert missed == lost_by_topic(log.losses, "damaged_bytes", "damaged_chunk")
    assert not missed or missed == there
    assert all(loss.spans_ns == ((info.start_time, info.end_time - 1),) for loss in log.losses if loss.messages)


def test_a_damaged_ros1_chunk_is_counted_by_its_index(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "drive.bag", ros_messages(DRIVE, 1), "bz2")
    with rosbag1.Reader(path) as reader:
        infos = sorted(reader.chunk_infos, key=lambda info: info.pos)
        topics = {connection.id: connection.topic for connection in reader.connections}
    data = bytearray(path.read_bytes())
    middle = (infos[1].pos + infos[2].pos) // 2
    data[middle : middle + 40] = bytes(40)
    path.write_bytes(data)
    _, losses, _ = opened(path)
    there = Counter({topics[number]: count for number, count in infos[1].connection_counts.items()})
    assert lost_by_topic(losses, "damaged_chunk") == there
    assert losses[0].spans_ns == ((infos[1].start_time, infos[1].end_time - 1),)  # rosbags' end is one behind the last


@pytest.mark.parametrize("page", [0.2, 0.5, 0.8])
def test_a_damaged_page_of_a_db3_costs_its_rows(page: float, tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", spread(ros_messages(DRIVE, 2), 4), "sqlite3")
    file = folder / "drive.db3"
    data = bytearray(file.read_bytes())
    start = int(page * len(data)) // 4096 * 4096
    data[start : start + 4096] = random.Random(1).randbytes(4096)
    file.write_bytes(data)
    found, losses, _ = opened(folder)
    recorded = Counter({topic: 4 * count for topic, count in RECORDED.items()})
    outside = lost_by_topic(losses, "cut", "damaged_bytes")
    assert Counter(found) + outside == recorded
    assert sum(outside.values()) <= 12  # rows in one page of 4 kB
    log = logs.open(folder)
    assert isinstance(log, RecordedLog)
    before = log.losses
    log._container.contents()
    assert log.losses == before


def test_images_without_data_are_counted_and_placed(tmp_path: Path) -> None:
    messages = ros_messages(DRIVE, 2)
    images = [m for m in messages if m.topic == "/cam/image/compressed"]
    for row in (1, 3):
        images[row].message.data = np.zeros(0, np.uint8)
    _, losses, said = opened(write_ros2(tmp_path / "drive", messages))
    (loss,) = [loss for loss in losses if loss.reason == "empty_image"]
    assert (loss.topic, loss.messages, loss.of) == ("/cam/image/compressed", 2, FRAMES)
    assert loss.spans_ns == tuple((int(DRIVE.stamp_ns[row]) + LATENCY_NS,) * 2 for row in (1, 3))
    assert "Lost: 2 messages without image data, from t=0.100 to 0.300 s in 2 places" in said


def test_images_that_do_not_decode_are_counted_when_they_are_decoded(tmp_path: Path) -> None:
    messages = foxglove_messages(DRIVE)
    next(m for m in messages if m.topic == "/cam/image" and m.stamp_ns > START_NS).message.data = b"\xff\xd8\xffnothing"
    log = logs.open(write_foxglove(tmp_path / "a.mcap", messages, "protobuf"))
    assert isinstance(log, RecordedLog)
    for frame in log.frames(log.stamps()):
        try:
            frame.decode()
        except LogError:
            assert frame.stamp_ns == DRIVE.stamp_ns[1]
    (loss,) = log.losses
    assert (loss.reason, loss.topic, loss.messages, loss.of) == ("undecodable_image", "/cam/image", 1, FRAMES)


def test_messages_that_do_not_unpack_are_counted(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", ros_messages(DRIVE, 2), "sqlite3", compression="message")
    file = folder / "drive.db3"
    data = file.read_bytes()
    assert data.count(b"\x28\xb5\x2f\xfd") == sum(RECORDED.values())  # each message begins as a zstd frame does
    at = data.rindex(b"\x28\xb5\x2f\xfd")
    file.write_bytes(data[:at] + b"#" + data[at + 1 :])
    _, losses, _ = opened(folder)
    assert sum(loss.messages or 0 for loss in losses if loss.reason == "packed") == 1


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_file_packed_as_a_whole_is_the_same_log(storage: str, tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", ros_messages(DRIVE, 2), storage)
    file = next(path for path in folder.iterdir() if path.suffix in (".mcap", ".db3"))
    packed = file.with_name(f"{file.name}.zstd")
    packer, data = zstandard.ZstdCompressor().compressobj(), file.read_bytes()
    pieces = [packer.compress(data[at : at + 4096]) + packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
              for at in range(0, len(data), 4096)]  # fmt: skip
    packed.write_bytes(b"".join(pieces) + packer.flush())
    whole = logs.open(file)
    whole.info()
    for path in (packed, folder):
        if path == folder:
            file.unlink()
            text = (folder / "metadata.yaml").read_text()
            text = text.replace(file.name, packed.name).replace("compression_mode: ''", "compression_mode: FILE")
            (folder / "metadata.yaml").write_text(text)
        log = logs.open(path)
        assert log.name == "drive"
        assert log.info().messages == sum(RECORDED.values())
        np.testing.assert_array_equal(log.stamps(), DRIVE.stamp_ns)
    assert whole.warnings == log.warnings
    data = packed.read_bytes()
    packed.write_bytes(data[: len(data) * 3 // 4])
    found, losses, _ = opened(folder)
    assert Counter(found) + lost_by_topic(losses, "cut", "damaged_bytes", "unknown_channel") == RECORDED


def test_a_file_packed_as_a_whole_is_unpacked_for_as_long_as_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    folder = write_ros2(tmp_path / "drive", ros_messages(DRIVE, 2), "mcap")
    file = next(folder.glob("*.mcap"))
    packed = tmp_path / "drive.mcap.zst"
    packed.write_bytes(zstandard.compress(file.read_bytes()))
    log = logs.open(packed)
    frames = log.frames(log.stamps()[:3])
    del log
    gc.collect()
    assert list(scratch.own_folder().glob("log-*"))
    assert [frame.decode().image.shape for frame in frames] == 3 * [DRIVE.images[0].shape[:2]]
    del frames
    gc.collect()
    assert not list(scratch.own_folder().glob("log-*"))


def test_missing_storage_files_are_counted(tmp_path: Path) -> None:
    messages = ros_messages(DRIVE, 2)
    for number, part in enumerate((messages[:16], messages[16:])):
        write_ros2(tmp_path / f"drive_{number}", part)
    folder = tmp_path / "drive_0"
    shutil.copy(tmp_path / "drive_1" / "drive_1.mcap", folder)
    whole = write_ros2(tmp_path / "whole", messages) / "metadata.yaml"
    text = whole.read_text().replace("  - whole.mcap", "  - drive_0.mcap\n  - drive_1.mcap", 1)
    assert "drive_1.mcap" in text
    (folder / "metadata.yaml").write_text(text)
    assert opened(folder)[1] == []
    for damage in (lambda file: file.unlink(), lambda file: file.write_bytes(b"no log")):
        damage(folder / "drive_1.mcap") if (folder / "drive_1.mcap").exists() else (folder / "drive_1.mcap").touch()
        found, losses, _ = opened(folder)
        assert Counter(found) + lost_by_topic(losses, "missing_file") == RECORDED


def test_nothing_readable_is_an_error_of_one_line(tmp_path: Path) -> None:
    path = chunked(tmp_path / "a.mcap")
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(LogError, match="nothing in it can be read") as error:
        logs.open(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["sensor_msgs::msg::CompressedImage", "sensor_msgs::msg::dds_::CompressedImage_"])
def test_types_named_as_idl_does_are_known(name: str, tmp_path: Path) -> None:
    """As in ROS 2 logs whose schemas are IDL, and as DDS recorders name types."""
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/cam", "cdr", writer.register_schema(name, "ros2idl", b"module sensor_msgs"))
        for m in ros_messages(DRIVE, 2):
            if m.topic == "/cam/image/compressed":
                writer.add_message(channel, m.stamp_ns, store(2).serialize_cdr(m.message, m.type), m.stamp_ns)
        writer.finish()
    log = logs.open(tmp_path / "a.mcap")
    np.testing.assert_array_equal(log.stamps(), DRIVE.stamp_ns)
    np.testing.assert_array_equal([frame.decode().image for frame in log.frames(log.stamps())], DRIVE.images)


@given(st.lists(st.booleans(), max_size=40))
def test_runs_are_those_of_the_lost_messages(lost: list[bool]) -> None:
    runs = LossRuns()
    for time_ns, one in enumerate(lost):
        runs.add_lost(time_ns) if one else runs.add_sound()
    assert runs.messages == sum(lost)
    covered = {t for start, stop in runs.spans for t in range(start, stop + 1)}
    assert covered == {t for t, one in enumerate(lost) if one}
    assert runs_of(np.array(lost, bool), np.arange(len(lost))) == runs.spans


@given(st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 50)), max_size=200))
def test_merged_spans_cover_all_and_are_few(found: list[tuple[int, int]]) -> None:
    spans = [(start, start + length) for start, length in found]
    joined = merged(spans)
    assert len(joined) <= 64
    assert all(any(a <= start and stop <= b for a, b in joined) for start, stop in spans)
    assert joined == sorted(joined)


@given(st.permutations(range(6)), st.integers(0, 5))
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_the_account_does_not_depend_on_the_order(order: list[int], again: int) -> None:
    def account(places: list[int]) -> LossAccount:
        made = LossAccount()
        for place in places:
            made.add("damaged_chunk", {"/a": place + 1, "/b": 1}, ("file", place), [(place * 10**9, place * 10**9 + 1)])
        return made

    assert account([*order, again]).losses == account(list(range(6))).losses
    assert account(order).sentences == [
        "Lost: 27 messages in damaged chunks or pages, from t=0.000 to 5.000 s in 6 places: /a 21, /b 6."
    ]
