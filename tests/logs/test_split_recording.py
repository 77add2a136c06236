"""Several files of one drive as one log."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import zstandard

from tests.logs.drives import (
    START_NS,
    Drive,
    foxglove_messages,
    ros_messages,
    write_foxglove,
    write_raw,
    write_ros1,
    write_ros2,
)
from vplog import logs
from vplog.errors import LogError
from vplog.logs.recorded_log import RecordedLog
from vplog.stages import Log

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

DRIVE = Drive()
KINDS: dict[str, Callable[[Path, int, slice], Path]] = {
    "ros1": lambda p, i, part: write_ros1(p / f"drive_{i}.bag", ros_messages(DRIVE, 1)[part], "lz4"),
    "mcap": lambda p, i, part: write_ros2(p / f"drive_{i}", ros_messages(DRIVE, 2)[part]) / f"drive_{i}.mcap",
    "db3": lambda p, i, part: write_ros2(p / f"drive_{i}", ros_messages(DRIVE, 2)[part], "sqlite3") / f"drive_{i}.db3",
    "protobuf": lambda p, i, part: write_foxglove(
        p / f"{i}.mcap", foxglove_messages(DRIVE)[part], "protobuf", chunk_size=2048
    ),
}
FIRST, SECOND = slice(0, 11), slice(11, None)


@pytest.mark.parametrize("kind", KINDS)
def test_files_in_any_order_are_the_whole_drive(kind: str, tmp_path: Path) -> None:
    a, b = (KINDS[kind](tmp_path, i, part) for i, part in enumerate((FIRST, SECOND)))
    whole = logs.open_drive([KINDS[kind](tmp_path, 2, slice(None))])
    for paths in ([a, b], [b, a]):
        log = logs.open_drive(paths)
        assert isinstance(log, Log)
        assert log.name == a.stem
        np.testing.assert_array_equal(log.stamps(), whole.stamps())
        np.testing.assert_array_equal([f.decode().image for f in log.frames(log.stamps())], DRIVE.images)
        for found, expected in ((log.odometry(), whole.odometry()), (log.gps(), whole.gps())):
            assert found is not None
            assert expected is not None
            np.testing.assert_array_equal(found.stamp_ns, expected.stamp_ns)
        np.testing.assert_array_equal(log.camera().body_from_camera, whole.camera().body_from_camera)
        assert log.info().messages == whole.info().messages
        assert log.warnings == whole.warnings


@pytest.mark.parametrize("ending", ["", ".active"])
def test_a_folder_of_a_split_ros1_bag_is_one_drive(ending: str, tmp_path: Path) -> None:
    """The last part has another name while it is recorded, and keeps it where that ends with the power."""
    folder = tmp_path / "monday"
    folder.mkdir()
    _, last = (KINDS["ros1"](folder, i, part) for i, part in enumerate((FIRST, SECOND)))
    last.rename(f"{last}{ending}")
    log = logs.open(folder)
    assert (log.name, log.info().kind, log.info().path) == ("monday", "ros1", str(folder))
    np.testing.assert_array_equal([f.decode().image for f in log.frames(log.stamps())], DRIVE.images)


def test_a_folder_of_a_packed_ros1_bag_is_the_bag(tmp_path: Path) -> None:
    bag = KINDS["ros1"](tmp_path, 0, slice(None))
    (tmp_path / "drive.bag.zst").write_bytes(zstandard.compress(bag.read_bytes()))
    bag.unlink()
    np.testing.assert_array_equal(logs.open(tmp_path).stamps(), DRIVE.stamp_ns)


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_numbered_files_of_two_days_are_not_one_drive(kind: str, tmp_path: Path) -> None:
    """Without metadata.yaml the names alone say so."""
    day = tmp_path / "day"
    day.mkdir()
    for i, part in enumerate((FIRST, SECOND)):
        file = KINDS[kind](tmp_path, i, part)
        file.rename(day / f"run_{i}{file.suffix}")
    log = logs.open(day)
    assert (log.name, "2 storage files found by content" in log.warnings[0]) == ("day", True)
    np.testing.assert_array_equal(log.stamps(), DRIVE.stamp_ns)
    later = Drive()
    later.stamp_ns = later.stamp_ns + 86_400 * 10**9
    storage = "mcap" if kind == "mcap" else "sqlite3"
    file = write_ros2(tmp_path / "later", ros_messages(later, 2)[1:], storage) / f"later.{kind}"
    file.rename(day / f"run_2.{kind}")
    with pytest.raises(LogError, match=r"24.0 hours lie between .*run_1.*run_2.*two drives"):
        logs.open(day)


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_parts_that_the_metadata_do_not_list_are_read(kind: str, tmp_path: Path) -> None:
    """As after a crash of the recorder, and beside a file that is none of its parts."""
    first, second = (KINDS[kind](tmp_path, i, part) for i, part in enumerate((FIRST, SECOND)))
    second.rename(first.parent / second.name)
    (first.parent / f"other_1.{kind}").write_bytes(first.read_bytes())
    log = logs.open(first.parent)
    assert isinstance(log, RecordedLog)
    np.testing.assert_array_equal([f.decode().image for f in log.frames(log.stamps())], DRIVE.images)
    assert f"does not list {second.name}; they are read" in " ".join(log.warnings)
    assert log.losses == []


def test_one_account_of_losses(tmp_path: Path) -> None:
    a, b = (KINDS["protobuf"](tmp_path, i, part) for i, part in enumerate((FIRST, SECOND)))
    (tmp_path / "none.mcap").touch()
    b.write_bytes(b.read_bytes()[: b.stat().st_size // 2])
    log = logs.open_drive([a, b, tmp_path / "none.mcap"])
    assert isinstance(log, RecordedLog)
    log.info()
    assert [loss.reason for loss in log.losses] == ["cut", "missing_file"]
    assert "none.mcap is empty" in " ".join(log.warnings)


def test_files_of_one_name_are_told_apart(tmp_path: Path) -> None:
    paths = []
    for i, part in enumerate((FIRST, SECOND)):
        (tmp_path / str(i)).mkdir()
        paths.append(KINDS["protobuf"](tmp_path / str(i), 7, part))
        paths[-1].write_bytes(paths[-1].read_bytes()[: paths[-1].stat().st_size // 2])
    log = logs.open_drive(paths)
    assert isinstance(log, RecordedLog)
    assert len(next(loss for loss in log.losses if loss.reason == "cut").spans_ns) == 2
    assert str(paths[0]) in log.warnings[0]


def refusal(*paths: Path) -> str:
    with pytest.raises(LogError) as error:
        logs.open_drive(paths)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_what_is_not_one_drive_is_refused(tmp_path: Path) -> None:
    a, b = (KINDS["mcap"](tmp_path, i, part) for i, part in enumerate((FIRST, SECOND)))
    alien = ("/other", "sensor_msgs/msg/Image", "cdr")
    later = write_raw(tmp_path / "later.mcap", [(*alien, START_NS + 10**10, b"1")])
    assert "no topic in common" in refusal(a, b, later)
    next_day = write_raw(tmp_path / "next_day.mcap", [(*alien, START_NS + 86_400 * 10**9, b"1")])
    assert "24.0 hours lie between" in refusal(a, b, next_day)
    other = KINDS["ros1"](tmp_path, 5, SECOND)
    assert "are not one drive" in refusal(a, other)
    assert "no such file" in refusal(a, tmp_path / "missing.mcap")
    assert "is a folder; give it by itself" in refusal(a, b.parent)
    longer = [
        (t, k, e, at, d) for at in (0, 10**10) for t, k, e, _, d in [("/odom", "nav_msgs/msg/Odometry", "cdr", 0, b"")]
    ]
    x, y = (write_raw(tmp_path / f"{name}.mcap", longer) for name in "xy")
    assert "overlap by 10.0 s" in refusal(x, y)
