"""What is no log, and what is left of a damaged one."""

from __future__ import annotations

import random
import shutil
import sqlite3
from typing import TYPE_CHECKING

import numpy as np
import pytest
import zstandard

from tests.logs.drives import Drive, foxglove_messages, ros_messages, write_foxglove, write_raw, write_ros1, write_ros2
from vplog import logs
from vplog.errors import LogError
from vplog.logs.formats.compression import BadChunkError, unpack

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

DRIVE = Drive()
WRITERS: dict[str, Callable[[Path], Path]] = {
    "mcap": lambda p: write_ros2(p / "drive", ros_messages(DRIVE, 2)) / "drive.mcap",
    "db3": lambda p: write_ros2(p / "drive", ros_messages(DRIVE, 2), "sqlite3") / "drive.db3",
    "ros1": lambda p: write_ros1(p / "drive.bag", ros_messages(DRIVE, 1)),
    "ros1-lz4": lambda p: write_ros1(p / "drive.bag", ros_messages(DRIVE, 1), "lz4"),
    "protobuf": lambda p: write_foxglove(p / "drive.mcap", foxglove_messages(DRIVE), "protobuf", chunk_size=4096),
    "json": lambda p: write_foxglove(p / "drive.mcap", foxglove_messages(DRIVE), "json", use_chunking=False),
}


def refusal(path: Path) -> str:
    with pytest.raises(LogError) as error:
        logs.open(path)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_what_is_no_log(tmp_path: Path) -> None:
    assert "no such file or folder" in refusal(tmp_path / "missing.mcap")
    empty = tmp_path / "empty.bag"
    empty.touch()
    assert "empty (0 bytes)" in refusal(empty)
    text = tmp_path / "text.mcap"
    text.write_text("not a log")
    assert "starts with b'not a lo', which no log does" in refusal(text)
    (tmp_path / "folder").mkdir()
    assert "holds nothing. A log is" in refusal(tmp_path / "folder")
    shutil.copy(text, tmp_path / "folder")
    assert "1 file, but no log and no images" in refusal(tmp_path / "folder")
    for name, what in (("map.json", "a map"), ("library.json", "a library")):
        (tmp_path / what).mkdir()
        (tmp_path / what / name).write_text("{}")
        assert f"{what} that vplog wrote, not a log" in refusal(tmp_path / what)
    with sqlite3.connect(tmp_path / "other.db3") as db:
        db.execute("CREATE TABLE other (x)")
    assert "not a ROS 2 bag" in refusal(tmp_path / "other.db3")


@pytest.mark.parametrize("name", ["drive.mcap", "drive.bag", "images/0001.png"])
def test_a_git_lfs_pointer_is_named(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.parent.mkdir(exist_ok=True)
    file.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:" + 64 * "0" + "\nsize 12345678\n")
    for path in {file, file.parent} - {tmp_path}:
        assert "Git LFS pointer" in refusal(path)
        assert refusal(path).endswith("git lfs pull.")


def test_a_list_of_topics_with_holes_is_read(tmp_path: Path) -> None:
    """Damage may leave nothing where a name was."""
    path = write_ros2(tmp_path / "drive", ros_messages(DRIVE, 2), "sqlite3") / "drive.db3"
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE other AS SELECT * FROM topics")
        db.execute("DROP TABLE topics")
        db.execute("ALTER TABLE other RENAME TO topics")
        db.execute("INSERT INTO topics (id) SELECT id FROM topics")
        db.execute("INSERT INTO topics (name) SELECT name FROM topics")
    db.close()
    np.testing.assert_array_equal(logs.open(path).stamps(), DRIVE.stamp_ns)
    (tmp_path / "packed.mcap").write_bytes(zstandard.compress(b"anything"))
    assert "does not hold a log" in refusal(tmp_path / "packed.mcap")


def test_kind_is_told_by_content(tmp_path: Path) -> None:
    path = WRITERS["ros1"](tmp_path)
    assert logs.open(path.rename(tmp_path / "drive.mcap")).info().kind == "ros1"


def test_bag_folder_with_damaged_metadata(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "drive", ros_messages(DRIVE, 2))
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    log = logs.open(folder)
    assert len(log.stamps()) == 5
    assert "is not the metadata of a ROS 2 bag" in log.warnings[0]
    shutil.copy(folder / "drive.mcap", folder / "another.mcap")
    assert "holds 2 logs" in refusal(folder)
    for file in folder.glob("*.mcap"):
        file.unlink()
    assert "Copy the whole bag folder" in refusal(folder)


def test_metadata_lead_to_no_other_folder(tmp_path: Path) -> None:
    write_ros2(tmp_path / "secret", ros_messages(DRIVE, 2))
    folder = write_ros2(tmp_path / "drive", ros_messages(DRIVE, 2)[:1])
    text = (folder / "metadata.yaml").read_text().replace("drive.mcap", "../secret/secret.mcap")
    (folder / "metadata.yaml").write_text(text)
    assert logs.open(folder).info().messages == 1


def test_log_without_images_informs_but_gives_no_frames(tmp_path: Path) -> None:
    messages = [m for m in ros_messages(DRIVE, 2) if m.topic in ("/odom", "/fix")]
    log = logs.open(write_ros2(tmp_path / "drive", messages))
    assert log.info().messages == 10
    assert log.odometry() is not None
    for ask in (log.stamps, log.camera, lambda: list(log.frames(np.zeros(0, np.int64)))):
        with pytest.raises(LogError, match=r"No camera images in drive\. Topics: /fix, /odom"):
            ask()


@pytest.mark.parametrize("kind", ["mcap", "ros1", "ros1-lz4", "protobuf", "json"])
@pytest.mark.parametrize("share", [0.5, 0.8, 0.97])
def test_cut_log_gives_what_is_left(kind: str, share: float, tmp_path: Path) -> None:
    path = WRITERS[kind](tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    log = logs.open(path)
    assert any("cut or damaged at byte" in line for line in log.info().warnings)
    left = len(log.stamps())
    assert 5 * share - 2 <= left <= 5
    np.testing.assert_array_equal(log.stamps(), DRIVE.stamp_ns[:left])
    images = [frame.decode().image for frame in log.frames(log.stamps())]
    np.testing.assert_array_equal(images, DRIVE.images[:left])


def test_chunk_with_a_wrong_checksum_is_left_out_and_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    messages = foxglove_messages(DRIVE)
    write_foxglove(path, messages, "json", chunk_size=1, compression=0)  # type: ignore[arg-type]
    data = bytearray(path.read_bytes())
    data[data.index(b'"position"')] = ord("#")
    path.write_bytes(data)
    log = logs.open(path)
    odometry = log.odometry()
    assert odometry is not None
    assert len(odometry.stamp_ns) == 4
    assert any("checksum does not match" in line for line in log.warnings)


@pytest.mark.parametrize("kind", WRITERS)
def test_flipped_bytes_raise_nothing_else_than_a_known_error(kind: str, tmp_path: Path) -> None:
    path = WRITERS[kind](tmp_path)
    whole = path.read_bytes()
    rng = random.Random(5)
    heads = [m for m in (b"odom", b"camera", b"CREATE", b"topic") if m in whole]
    for _ in range(12):
        data = bytearray(whole)
        for _ in range(rng.choice([1, 3, 50])):
            near = whole.find(rng.choice(heads), rng.randrange(len(data))) if rng.random() < 0.5 else -1
            data[near + rng.randrange(-20, 40) if near > 20 else rng.randrange(len(data))] = rng.randrange(256)
        path.write_bytes(data[: rng.randrange(len(data))] if rng.random() < 0.3 else data)
        try:
            log = logs.open(path)
            log.info()
            log.odometry()
            log.gps()
            for frame in log.frames(log.stamps()):
                frame.decode()
        except LogError as error:
            assert "\n" not in str(error)


def test_claims_beyond_what_the_bytes_justify_are_refused() -> None:
    packed = zstandard.compress(bytes(2**26))
    assert len(unpack("zstd", packed, 2**26)) == 2**26
    for kind in ("zstd", "lz4", "bz2"):
        with pytest.raises(BadChunkError, match="claim"):
            unpack(kind, packed, 2**40)
        with pytest.raises(BadChunkError):
            unpack(kind, b"nothing of the kind", 100)
    with pytest.raises(BadChunkError, match="1000 bytes instead of 2000"):
        unpack("zstd", zstandard.compress(bytes(1000)), 2000)
    with pytest.raises(BadChunkError, match="unknown compression 'snappy'"):
        unpack("snappy", b"", 0)


def test_types_and_encodings_that_vplog_does_not_know_are_listed(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.mcap", [
        ("/scan", "sensor_msgs/msg/LaserScan", "cdr", 5, b"1234"),
        ("/image", "foxglove.CompressedImage", "cbor", 6, b"1234"),
        ("/odom", "nav_msgs/msg/Odometry", "cdr", 7, b"1"),
    ])  # fmt: skip
    log = logs.open(path)
    info = log.info()
    assert [(t.name, t.role) for t in info.topics] == [("/image", ""), ("/odom", "odometry"), ("/scan", "")]
    assert (info.start_ns, info.end_ns) == (5, 7)
    assert log.odometry() is None
    assert "Lost: 1 message that cannot be decoded, at t=0.000 s: /odom 1 of 1." in info.warnings
