"""The benchmark of reading runs, on next to nothing, and measures what it says."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tests.benchmarks.reading import growth, repeat_drive, speed, write_drive
from tests.logs.test_real_logs import data
from vplog import logs

if TYPE_CHECKING:
    from pathlib import Path


def test_the_synthetic_drive_is_one(tmp_path: Path) -> None:
    write_drive(tmp_path / "drive.mcap", 0.01)
    log = logs.open(tmp_path / "drive.mcap")
    odometry = log.odometry()
    assert odometry is not None
    assert len(log.stamps()) == 5  # of 2 MB each
    np.testing.assert_array_equal(odometry.stamp_ns[::5], log.stamps())
    np.testing.assert_allclose(np.diff(odometry.odom_from_body[:, 0, 3]), 0.02)
    assert log.warnings == []


def test_a_drive_that_is_repeated_has_the_same_frames(tmp_path: Path) -> None:
    once = logs.open(data("drives/gardens_day_left.mcap"))
    repeat_drive(data("drives/gardens_day_left.mcap"), tmp_path / "drive.mcap", 2)
    twice = logs.open(tmp_path / "drive.mcap")
    stamps, count = twice.stamps(), len(once.stamps())
    odometry = twice.odometry()
    assert odometry is not None
    assert len(stamps) == len(odometry.stamp_ns) == 2 * count
    assert (np.diff(stamps) > 0).all()
    for a, b in zip(once.frames(once.stamps()[::50]), twice.frames(stamps[count::50]), strict=True):
        np.testing.assert_array_equal(a.decode().image, b.decode().image)


def test_memory_is_measured(tmp_path: Path) -> None:
    figure = growth(tmp_path, (0.01, 0.02), 1.1, rounds=1)
    assert all(50 < peak < 1000 for peak in figure.facts.values())  # MB: Python with OpenCV, and little more


def test_speed_is_measured_on_the_same_images() -> None:
    figure = speed(data("drives/gardens_day_left.mcap"), "/front/image", 1, 1, 0.9)
    assert figure.facts["keyframes"] == 200
    assert figure.ratio > 0
