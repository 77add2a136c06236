"""Recorded drives and other projects' logs; skipped where the data are not there."""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from rosbags import rosbag1

from vplog import logs
from vplog.errors import LogError
from vplog.logs.formats.container import Channel, Notes
from vplog.logs.formats.mcap_file import McapFile
from vplog.logs.formats.ros1_bag import Ros1Bag
from vplog.logs.recorded_log import RecordedLog

DATA = Path(os.environ.get("VPLOG_DATA", Path(__file__).resolve().parents[2] / ".." / "shared" / "data"))


def data(name: str) -> Path:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"needs {name} of the folder that VPLOG_DATA names")
    return path


@pytest.mark.parametrize("name", ["drives/kitti00", "drives/kitti00/kitti00.mcap"])
def test_kitti(name: str) -> None:
    log = logs.open(data(name))
    odometry, gps, camera = log.odometry(), log.gps(), log.camera()
    assert odometry is not None
    assert gps is not None
    assert camera.matrix is not None
    assert (log.name, len(log.stamps()), len(odometry.stamp_ns), len(gps.stamp_ns)) == ("kitti00", 850, 1699, 170)
    assert odometry.covariance is not None
    assert np.isfinite(odometry.covariance).all()
    assert (camera.matrix[0, 0], camera.width, camera.height) == (718.856, 1241, 376)
    np.testing.assert_allclose(camera.body_from_camera[:3, 2], [1, 0, 0], atol=1e-9)  # looks ahead
    assert next(iter(log.frames(log.stamps()[:1]))).decode().image.shape == (376, 1241)
    assert log.info().warnings == []


def test_seven_scenes() -> None:
    log = logs.open(data("drives/seven_scenes.bag"))
    odometry = log.odometry()
    assert odometry is not None
    assert len(log.stamps()) == len(odometry.stamp_ns) == 250
    assert odometry.covariance is None
    assert "no usable covariance" in log.warnings[0]
    frames = list(log.frames(log.stamps()[::50]))
    for frame in frames:
        depth = frame.decode().depth
        assert depth is not None
        assert depth.shape == (480, 640)
        assert 0.3 < np.nanmedian(depth) < 5  # m, an office
    assert len(frames) == 5


@pytest.mark.parametrize(
    ("name", "shape"), [("day_left", (540, 960)), ("day_right", (540, 960)), ("night_right", (360, 640))]
)
def test_gardens(name: str, shape: tuple[int, int]) -> None:
    log = logs.open(data(f"drives/gardens_{name}.mcap"))
    odometry = log.odometry()
    assert odometry is not None
    assert len(log.stamps()) == len(odometry.stamp_ns) == 200
    assert log.camera().matrix is None
    assert next(iter(log.frames(log.stamps()[:1]))).decode().image.shape == shape


def test_every_log_informs_or_says_why_not() -> None:
    folder = data("logs")
    files = sorted(path for path in folder.rglob("*") if path.suffix in (".mcap", ".bag", ".db3"))
    told: Counter[str] = Counter()
    for path in files + sorted(path.parent for path in folder.rglob("metadata.yaml")):
        try:
            log = logs.open(path)
            info = log.info()
            assert info.messages == sum(topic.count for topic in info.topics)
            log.odometry()
            log.gps()
            told["informs"] += 1
            for frame in log.frames(log.stamps()):
                frame.decode()
        except LogError as error:
            assert "\n" not in str(error)
            told["refused"] += "No camera images" not in str(error) and " decodes" not in str(error)
    assert told["informs"] >= 198  # of 204; the rest are empty, no log, or folders without their file
    assert told["refused"] <= 6


def test_conformance_files_give_exactly_their_records() -> None:
    """Each file of the format's own set has the records that a reader must find beside it."""
    files = sorted(data("logs/mcap/foxglove+mcap").rglob("*.mcap"))
    for path in files:
        records = json.loads(path.with_suffix(".json").read_text())["records"]
        fields = [(record["type"], dict(record["fields"])) for record in records]
        schemas = {"0": "", **{one["id"]: one["name"] for kind, one in fields if kind == "Schema"}}
        channels = {
            one["id"]: Channel(one["topic"], schemas[one["schema_id"]], one["message_encoding"])
            for kind, one in fields if kind == "Channel"
        }  # fmt: skip
        expected = [
            (channels[one["channel_id"]], int(one["log_time"]), bytes(map(int, one["data"])))
            for kind, one in fields if kind == "Message"
        ]  # fmt: skip
        file = McapFile(path, notes := Notes())
        contents = file.contents()
        found = list(file.messages(contents.counts))
        assert [(m.channel, m.log_ns, m.data) for m in found] == expected, path.name
        assert [file.read(m.place) for m in found] == [message for _, _, message in expected]
        assert contents.counts.keys() == set(channels.values()), path.name
        assert contents.messages == len(expected)
        assert (contents.start_ns, contents.end_ns) == (
            min((at for _, at, _ in expected), default=0), max((at for _, at, _ in expected), default=0),
        )  # fmt: skip
        assert notes.lines == []
    assert len(files) > 100


@pytest.mark.parametrize("bytes_flipped", [0, 1000])
def test_damage_to_a_real_drive_is_counted_exactly(bytes_flipped: int, tmp_path: Path) -> None:
    """The first chunk that is flipped is the last of the 70 % that are left."""
    source = data("drives/kitti00")
    shutil.copy(source / "metadata.yaml", tmp_path)
    whole = (source / "kitti00.mcap").read_bytes()
    with (source / "kitti00.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    recorded = {summary.channels[i].topic: n for i, n in summary.statistics.channel_message_counts.items()}
    left = bytearray(whole[: len(whole) * 7 // 10])
    start = summary.chunk_indexes[20].chunk_start_offset
    left[start : start + 9] = bytes(9 * bool(bytes_flipped)) or left[start : start + 9]
    (tmp_path / "kitti00.mcap").write_bytes(left)
    log = logs.open(tmp_path)
    assert isinstance(log, RecordedLog)
    info = log.info()
    found = {topic.name: topic.count for topic in info.topics}
    lost: Counter[str] = Counter()
    for loss in log.losses:
        lost[loss.topic] += loss.messages or 0
    assert Counter(found) + lost == Counter(recorded)
    assert {loss.of for loss in log.losses} == {recorded[loss.topic] for loss in log.losses}
    odometry = log.odometry()
    assert odometry is not None
    assert len(odometry.stamp_ns) == found["/wheel/odometry"]
    assert len(log.stamps()) == found["/cam0/image_raw/compressed"]
    assert max(span[1] for loss in log.losses for span in loss.spans_ns) == summary.statistics.message_end_time


def test_mcap_messages_are_those_of_the_reference_reader() -> None:
    files = sorted(data("logs").rglob("*.mcap"))
    compared = 0
    for path in files:
        file = McapFile(path, Notes())
        ours = [(m.channel.topic, m.log_ns, m.data) for m in file.messages(file.contents().counts)]
        with path.open("rb") as stream:
            try:
                theirs = [
                    (c.topic, m.log_time, m.data)
                    for _, c, m in NonSeekingReader(stream).iter_messages(log_time_order=False)
                ]
            except McapError:
                continue
        assert ours == theirs, path.name
        assert file.contents().messages == len(theirs)
        compared += 1
    assert compared >= 0.95 * len(files)


def test_ros1_messages_are_those_of_the_reference_reader() -> None:
    compared = 0
    for path in sorted(data("logs").rglob("*.bag")):
        try:
            with rosbag1.Reader(path) as reader:
                theirs = sorted((c.topic, stamp, bytes(raw)) for c, stamp, raw in reader.messages())
        except (rosbag1.ReaderError, AssertionError):
            continue
        bag = Ros1Bag(path, Notes())
        messages = list(bag.messages(bag.contents().counts))
        assert sorted((m.channel.topic, m.log_ns, m.data) for m in messages) == theirs, path.name
        assert bag.contents().messages == len(theirs)
        assert all(bag.read(m.place) == m.data for m in messages[:50])
        compared += 1
    assert compared >= 15


@pytest.mark.parametrize("name", ["msgs_20x2m_same.mcap", "bz2_many.bag", "gencol_rand.db3"])
def test_files_that_took_minutes_are_refused(name: str) -> None:
    with pytest.raises(LogError, match=r"claims more content|generated columns") as error:
        logs.open(data(f"damaged/{name}"))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["overflow_traceback.mcap", "ovf.mcap"])
def test_forged_log_times_leave_the_header_stamps(name: str) -> None:
    log = logs.open(data(f"damaged/{name}"))
    odometry = log.odometry()
    assert odometry is not None
    assert any("log times jump" in warning for warning in log.warnings)
