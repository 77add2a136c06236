"""Clocks that are set back on the way, told from messages that come out of order, against the true times."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.logs.drives import (
    LATENCY_NS,
    START_NS,
    Drive,
    foxglove_messages,
    ros_messages,
    write_foxglove,
    write_ros1,
    write_ros2,
)
from vplog import logs
from vplog.logs.formats.container import Notes
from vplog.logs.messages.records import PoseMessage
from vplog.logs.recorder_clock import correct_clock_steps
from vplog.logs.stamps import Stamps, set_common_clock
from vplog.logs.tracks import PoseTrack

if TYPE_CHECKING:
    from pathlib import Path

SECOND = 10**9
seeds = st.integers(0, 2**32 - 1)


def topic(rng: np.random.Generator, seconds: float, hz: float) -> tuple[np.ndarray, np.ndarray]:
    """True times and log times, later by up to a third of a period and at most 20 ms."""
    period = SECOND / hz
    true_ns = START_NS + (np.arange(int(seconds * hz)) * period + rng.uniform(0, period)).astype(np.int64)
    return true_ns, true_ns + rng.integers(0, int(min(period / 3, 2e7)), len(true_ns))


def stamps(header_ns: np.ndarray, log_ns: np.ndarray, received_ns: np.ndarray | None = None) -> Stamps:
    """Those of one topic; when they were received, where there are several, is their order in the file."""
    found = Stamps()
    found.extend(header_ns.tolist(), log_ns.tolist(), None if received_ns is None else received_ns.tolist())
    return found


def ordered(*topics: Stamps) -> tuple[list[np.ndarray], list[np.ndarray], list[str]]:
    """Stamps and rows of each, and what was said."""
    notes = Notes()
    correct_clock_steps(topics, notes)
    set_common_clock(topics)
    found = [one.order(f"/{number}", notes) for number, one in enumerate(topics)]
    return [one[0] for one in found], [one[1] for one in found], notes.lines


def moments(rng: np.random.Generator, seconds: float) -> list[tuple[int, int]]:
    """When a clock is set back, at most twice and not twice at once, and by how much."""
    at = rng.permutation([0.3, 0.7])[: rng.integers(1, 3)] * seconds
    return [(START_NS + int(s * SECOND), int(rng.uniform(0.4, 0.15 * seconds) * SECOND)) for s in sorted(at)]


def after(times_ns: np.ndarray, true_ns: np.ndarray, steps: list[tuple[int, int]]) -> np.ndarray:
    return times_ns - sum(np.where(true_ns >= at, size, 0) for at, size in steps)


@given(seeds, st.sampled_from(["header", "log", "both"]))
def test_a_clock_that_is_set_back_is_mended(seed: int, which: str) -> None:
    """All topics stay together, in the order of receipt, and right but for one constant."""
    rng = np.random.default_rng(seed)
    seconds = rng.uniform(20, 60)
    steps, errors = moments(rng, seconds), []
    drives = [topic(rng, seconds, hz) for hz in (rng.uniform(20, 100), rng.uniform(8, 30))]
    found = [
        stamps(
            after(true, true, steps) if which != "log" else true,
            after(log, true, steps) if which != "header" else log,
            true,
        )
        for true, log in drives
    ]
    times, rows, said = ordered(*found)
    for (true_ns, _), stamp_ns, row in zip(drives, times, rows, strict=True):
        np.testing.assert_array_equal(row, np.arange(len(true_ns)))
        errors.append(stamp_ns - true_ns)
    every = np.concatenate(errors)
    assert every.max() - every.min() <= 8e7 * len(steps)  # two periods of the faster topic and the jitter
    assert any("set back" in line or "set by" in line for line in said)


@given(seeds, st.floats(0.0, 3.0))
def test_messages_out_of_order_are_no_step(seed: int, periods: float) -> None:
    """Each is late by up to some periods of its own, so the file holds them in another order than they were taken."""
    rng = np.random.default_rng(seed)
    true_ns, _ = topic(rng, 40, rng.uniform(5, 100))
    period = int(np.median(np.diff(true_ns)))
    log_ns = true_ns + (rng.uniform(0, periods, len(true_ns)) * period).astype(np.int64)
    order = np.argsort(log_ns, kind="stable")
    times, rows, said = ordered(stamps(true_ns[order], log_ns[order]))
    np.testing.assert_array_equal(times[0], true_ns)
    np.testing.assert_array_equal(order[rows[0]], np.arange(len(true_ns)))
    assert not [line for line in said if "set" in line]


@given(seeds, st.sampled_from(["header", "both"]), st.floats(0.0, 1.5))
def test_a_clock_is_mended_though_messages_come_out_of_order(seed: int, which: str, periods: float) -> None:
    """And a tenth of them is lost. Only at the step itself two of them may change places."""
    rng = np.random.default_rng(seed)
    true_ns, _ = topic(rng, 40, rng.uniform(10, 60))
    true_ns = true_ns[rng.random(len(true_ns)) < 0.9]
    period = int(np.median(np.diff(true_ns)))
    log_ns = true_ns + (rng.uniform(0, periods, len(true_ns)) * period).astype(np.int64)
    order = np.argsort(log_ns, kind="stable")
    true_ns, log_ns = true_ns[order], log_ns[order]
    steps = [(START_NS + 20 * SECOND, int(rng.uniform(0.8, 5) * SECOND))]
    received_ns = true_ns if which == "header" else log_ns
    header_ns, recorder_ns = after(true_ns, received_ns, steps), after(log_ns, log_ns, steps)
    times, rows, _ = ordered(stamps(header_ns, log_ns if which == "header" else recorder_ns))
    error = times[0] - true_ns[rows[0]]
    unknown_ns = np.diff(log_ns)[np.searchsorted(received_ns, START_NS + 20 * SECOND) - 1]  # what may be lost there
    assert error.max() - error.min() <= unknown_ns + 4 * period
    assert len(rows[0]) == len(true_ns)


@given(seeds, st.booleans())
def test_chunks_out_of_order_or_written_twice_are_no_step(seed: int, twice: bool) -> None:
    rng = np.random.default_rng(seed)
    true_ns, log_ns = topic(rng, 40, rng.uniform(5, 50))
    parts = np.array_split(np.arange(len(true_ns)), 6)
    first = int(rng.integers(0, 5))
    parts = [*parts[: first + 1], parts[first], *parts[first + 1 :]] if twice else [*parts[1:], parts[0]]
    rows = np.concatenate(parts)
    times, _, said = ordered(stamps(true_ns[rows], log_ns[rows]))
    np.testing.assert_array_equal(times[0], true_ns)
    assert not [line for line in said if "set" in line]


@given(seeds)
def test_stamps_that_run_backwards_give_way_to_the_log_times(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true_ns, log_ns = topic(rng, 20, rng.uniform(2, 60))
    times, rows, said = ordered(stamps(true_ns[::-1], log_ns))
    np.testing.assert_array_equal(times[0], log_ns)
    np.testing.assert_array_equal(rows[0], np.arange(len(true_ns)))
    assert said == ["/0 has header stamps that run backwards; its log times are used instead."]
    times, _, said = ordered(stamps(true_ns[::-1], log_ns[::-1]))  # a file that is written from its end
    np.testing.assert_array_equal(times[0], true_ns)
    assert "backwards" not in " ".join(said)


@given(seeds, st.floats(0.2, 1.5))
def test_bursts_in_no_order_do_not_run_backwards(seed: int, burst_s: float) -> None:
    """A link sends what has waited, within a few ms and the last as well first."""
    rng = np.random.default_rng(seed)
    true_ns, _ = topic(rng, 20, rng.uniform(10, 40))
    burst_ns = int(burst_s * SECOND)
    order = np.lexsort((-true_ns if seed % 2 else rng.random(len(true_ns)), -(-true_ns // burst_ns)))
    log_ns = -(-true_ns[order] // burst_ns) * burst_ns + np.arange(len(true_ns)) * 1000
    times, _, said = ordered(stamps(true_ns[order], log_ns))
    np.testing.assert_array_equal(times[0], true_ns)
    assert "backwards" not in " ".join(said)


@given(seeds, st.floats(1.7, 60))
def test_whole_seconds_give_way_to_finer_log_times(seed: int, hz: float) -> None:
    rng = np.random.default_rng(seed)
    true_ns, log_ns = topic(rng, 40, hz)
    times, _, said = ordered(stamps(true_ns // SECOND * SECOND, log_ns))
    np.testing.assert_array_equal(times[0], log_ns)
    assert "log times are used instead" in said[0]


def test_a_receiver_that_measures_on_the_second_keeps_its_stamps() -> None:
    true_ns = START_NS + SECOND * np.arange(60)
    log_ns = true_ns + np.random.default_rng(2).integers(10**7, 2 * 10**8, 60)
    times, _, said = ordered(stamps(true_ns, log_ns))
    np.testing.assert_array_equal(times[0], true_ns)
    assert said == []


def recorded(fmt: str, path: Path, count: int) -> tuple[Path, list[Any]]:
    """A drive of `count` frames at 10 Hz on a straight line, and the writer of its messages."""
    drive = Drive()
    repeat = np.arange(count) % len(drive.images)
    drive.images, drive.depth_mm, drive.covariance = (
        drive.images[repeat],
        drive.depth_mm[repeat],
        drive.covariance[repeat],
    )
    drive.stamp_ns = START_NS + SECOND // 10 * np.arange(count)
    drive.position = np.outer(np.arange(count), [0.5, 0.0, 0.0])
    drive.quaternion = Rotation.identity(count).as_quat()
    drive.latitude = 48.0 + 1e-5 * np.arange(count)
    if fmt in ("protobuf", "json"):
        return path, foxglove_messages(drive)
    return path, ros_messages(drive, 1 if fmt == "bag" else 2)


def set_back(messages: list[Any], after_ns: int, header_ns: int, log_ns: int) -> None:
    """Set the clocks of headers and recorder back, of all that is written behind a moment."""
    for message in messages:
        if message.stamp_ns < after_ns or "static" in message.topic:
            continue
        stamp_ns = message.stamp_ns - header_ns
        if hasattr(message.message, "timestamp"):
            message.message.timestamp.seconds, message.message.timestamp.nanos = divmod(stamp_ns, SECOND)
        else:
            stamp = message.message.header.stamp
            stamp.sec, stamp.nanosec = divmod(stamp_ns, SECOND)
        message.stamp_ns -= log_ns


def write(fmt: str, path: Path, messages: list[Any]) -> Path:
    if fmt == "bag":
        return write_ros1(path / "drive.bag", messages)
    if fmt in ("protobuf", "json"):
        return write_foxglove(path / "drive.mcap", messages, fmt, chunk_size=4096)
    return write_ros2(path / "drive", messages, fmt)


@pytest.mark.parametrize("fmt", ["mcap", "sqlite3", "bag", "protobuf", "json"])
@pytest.mark.parametrize(
    ("header_s", "log_s"), [(3.0, 3.0), (0.8, 0.0), (0.8, 0.8), (3.0, 0.0), (0.0, 3.0), (3600.0, 3600.0)]
)
def test_odometry_is_not_interleaved(fmt: str, header_s: float, log_s: float, tmp_path: Path) -> None:
    """In every format, though the times are on a grid, so that those that come again are the very same."""
    count = 100
    path, messages = recorded(fmt, tmp_path, count)
    set_back(messages, START_NS + 6 * SECOND, int(header_s * SECOND), int(log_s * SECOND))
    log = logs.open(write(fmt, path, messages))
    odometry = log.odometry()
    assert odometry is not None
    np.testing.assert_allclose(odometry.odom_from_body[:, 0, 3], 0.5 * np.arange(count), atol=1e-9)
    assert np.abs(np.diff(odometry.stamp_ns) - SECOND // 10).max() <= LATENCY_NS
    np.testing.assert_array_equal(log.stamps(), odometry.stamp_ns)
    said = " ".join(log.warnings)
    assert "set back by" in said or "was set by" in said or "log times jump" in said
    assert "Lost" not in said


@given(seeds, st.floats(2.0, 3600.0))
def test_a_clock_is_set_back_by_more_than_had_passed(seed: int, size_s: float) -> None:
    """The motion leads on where it was; behind a part that is missing, of a recording in another order, it does not."""
    rng = np.random.default_rng(seed)
    true_ns, log_ns = topic(rng, 30, rng.uniform(10, 60))
    steps = [(START_NS + 12 * SECOND, int((30 + size_s) * SECOND))]
    found = stamps(after(true_ns, true_ns, steps), after(log_ns, log_ns, steps))
    found.xyz_m = true_ns[:, None] / SECOND * [1.0, 0.0, 0.0]
    _, rows, said = ordered(found)
    np.testing.assert_array_equal(rows[0], np.arange(len(true_ns)))
    assert any("set back" in line for line in said)
    parts = np.array_split(np.arange(len(true_ns)), 4)
    mixed = np.concatenate([parts[3], parts[0], parts[1]])
    found = stamps(true_ns[mixed], log_ns[mixed])
    found.xyz_m = true_ns[mixed, None] / SECOND * [1.0, 0.0, 0.0]
    times, _, said = ordered(found)
    np.testing.assert_array_equal(times[0], np.sort(true_ns[mixed]))
    assert not [line for line in said if "set" in line]


@given(seeds, st.booleans())
def test_a_clock_is_set_back_by_days_in_a_gap(seed: int, still: bool) -> None:
    """No motion tells: parts of one drive in another order do not lie so far apart."""
    rng = np.random.default_rng(seed)
    true_ns, log_ns = topic(rng, 30, rng.uniform(10, 60))
    kept = (true_ns < START_NS + 12 * SECOND) | (true_ns > START_NS + 15 * SECOND)
    true_ns, log_ns = true_ns[kept], log_ns[kept]
    steps = [(START_NS + 13 * SECOND, int(rng.uniform(2, 2000) * 3600) * SECOND)]
    found = stamps(after(true_ns, true_ns, steps), after(log_ns, log_ns, steps))
    found.xyz_m = true_ns[:, None] / SECOND * [0.0 if still else 1.0, 0.0, 0.0]
    _, rows, said = ordered(found)
    np.testing.assert_array_equal(rows[0], np.arange(len(true_ns)))
    assert any("set back" in line for line in said)


@settings(max_examples=10)
@given(seeds, st.floats(0.3, 0.6))
def test_small_steps_of_the_headers_are_mended(seed: int, size_s: float) -> None:
    """A step of less than a second, and a large one behind it."""
    rng = np.random.default_rng(seed)
    true_ns, log_ns = topic(rng, 60, rng.uniform(30, 60))
    steps = [(START_NS + 30 * SECOND, -int(size_s * SECOND)), (START_NS + 36 * SECOND, -700 * SECOND)]
    track = PoseTrack("/odom")
    for stamp_ns, time_ns, x in zip(
        after(true_ns, true_ns, steps).tolist(), log_ns.tolist(), (true_ns - START_NS) / SECOND, strict=True
    ):
        track.add(PoseMessage(stamp_ns, "odom", "base_link", (x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), None), time_ns)
    odometry = track.finish(Notes())
    assert odometry is not None
    way = np.abs(np.diff(odometry.odom_from_body[:, 0, 3])).sum()
    assert way <= 1.02 * (true_ns[-1] - true_ns[0]) / SECOND


@given(seeds)
def test_bursts_of_two_publishers_are_no_step(seed: int) -> None:
    """A wireless link holds messages back and delivers them together; a second publisher is later than the first."""
    rng = np.random.default_rng(seed)
    true_ns, _ = topic(rng, 40, rng.uniform(5, 20))
    late_ns = np.repeat([0, int(rng.uniform(0.1, 0.5) * SECOND)], len(true_ns))
    header_ns = np.concatenate([true_ns, true_ns + int(rng.uniform(1e6, 5e7))])
    bursts_ns = START_NS + (np.cumsum(rng.uniform(0.1, 0.4, 200)) * SECOND).astype(np.int64)
    at = np.searchsorted(bursts_ns, header_ns + late_ns)
    log_ns = bursts_ns[at] + np.arange(len(at))
    order = np.argsort(log_ns, kind="stable")
    times, _, said = ordered(stamps(header_ns[order], log_ns[order]))
    np.testing.assert_array_equal(times[0], np.unique(header_ns))
    assert not [line for line in said if "set back" in line or "set by" in line]


@given(seeds, st.floats(0.5, 3.0), st.floats(1.0, 4.0))
def test_how_long_a_gap_is_that_a_clock_was_set_back_over_the_motion_tells(
    seed: int, gap_s: float, more_s: float
) -> None:
    """Both clocks went back by more than the gap, so that none tells its length; the way over it does."""
    rng = np.random.default_rng(seed)
    true_ns, log_ns = topic(rng, 30, rng.uniform(10, 40))
    at = START_NS + 15 * SECOND
    kept = (true_ns < at) | (true_ns > at + int(gap_s * SECOND))
    true_ns, log_ns = true_ns[kept], log_ns[kept]
    steps = [(at, int((gap_s + more_s) * SECOND))]
    poses = PoseTrack("/odom")
    for header, log, true in zip(after(true_ns, true_ns, steps), after(log_ns, true_ns, steps), true_ns, strict=True):
        place = (2.0 * float(true - START_NS) / SECOND, 0.0, 0.0)
        poses.add(PoseMessage(int(header), "odom", "base_link", place, (0.0, 0.0, 0.0, 1.0), None), int(log))
    poses.set_xyz()
    times, rows, said = ordered(poses.stamps)
    np.testing.assert_array_equal(rows[0], np.arange(len(true_ns)))
    assert np.ptp(times[0] - true_ns) <= 0.15 * SECOND
    assert any("set back" in line for line in said)
