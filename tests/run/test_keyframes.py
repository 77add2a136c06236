"""Keyframes are spaced by motion, and only where odometry is known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vplog.data import Keyframes, Odometry
from vplog.errors import LogError, SettingsError
from vplog.geometry import se3
from vplog.logs import TopicChoice
from vplog.run.keyframes import KeyframeSettings, select_keyframes, ways_without_images

START = 1_700_000_000 * 10**9
MS = 10**6


def _drive(
    speed: float, turn: float = 0.0, seconds: float = 60.0, rate: float = 20.0, seed: int | None = None
) -> Odometry:
    """Straight on at `speed` m/s while turning by `turn` rad/s, or a random walk about that."""
    count = int(seconds * rate) + 1
    twist = np.tile([0, 0, turn / rate, speed / rate, 0, 0], (count - 1, 1))
    if seed is not None:
        twist *= np.random.default_rng(seed).uniform(0, 2, (count - 1, 1))
    poses = [np.eye(4)]
    for step in se3.exp(twist):
        poses.append(poses[-1] @ step)
    stamps = START + (np.arange(count) * (1e9 / rate)).astype(np.int64)
    return Odometry(stamps, np.array(poses), None)


def _frames(seconds: float = 60.0, rate: float = 10.0, start_s: float = 0.0) -> np.ndarray:
    return START + int(start_s * 1e9) + (np.arange(int(seconds * rate) + 1) * (1e9 / rate)).astype(np.int64)


def _select(stamps: np.ndarray, odometry: Odometry, **settings: Any) -> tuple[Keyframes, list[str]]:
    return select_keyframes("drive", stamps, odometry, KeyframeSettings(**settings))


def _keeps_the_rule(
    keyframes: Keyframes, stamps: np.ndarray, odometry: Odometry, metres: float, degrees: float
) -> None:
    """Each keyframe is the first frame that is far enough from the one before it."""
    kept = set(keyframes.stamp_ns.tolist())
    last = None
    for stamp in stamps.tolist():
        pose = se3.interpolate_at(odometry.stamp_ns, odometry.odom_from_body, np.array([stamp]))[0]
        if last is not None:
            step = np.linalg.inv(last) @ pose
            turned = np.degrees(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1, 1)))
            far = np.linalg.norm(step[:3, 3]) >= metres or turned >= degrees
            assert (stamp in kept) == far
        if stamp in kept:
            last = pose


@pytest.mark.parametrize("seed", range(4))
def test_keyframes_are_spaced_by_distance_or_turn(seed: int) -> None:
    odometry, stamps = _drive(1.3, 0.07, seed=seed), _frames(start_s=0.013, seconds=59.0)
    keyframes, warnings = _select(stamps, odometry, distance_m=0.77, rotation_deg=7.3)
    assert warnings == []
    assert keyframes.drive == "drive"
    assert keyframes.stamp_ns[0] == stamps[0]
    assert 20 < len(keyframes.stamp_ns) < len(stamps)
    _keeps_the_rule(keyframes, stamps, odometry, 0.77, 7.3)
    expected = se3.interpolate_at(odometry.stamp_ns, odometry.odom_from_body, keyframes.stamp_ns)
    np.testing.assert_array_equal(keyframes.odom_from_body, expected)


def test_turning_on_the_spot_makes_keyframes() -> None:
    keyframes, _ = _select(_frames(), _drive(0.0, np.deg2rad(3.0)))
    assert len(keyframes.stamp_ns) in (18, 19)  # 180 degrees, one every 10


def test_standing_still_makes_one() -> None:
    keyframes, _ = _select(_frames(), _drive(0.0))
    assert len(keyframes.stamp_ns) == 1


@pytest.mark.parametrize(
    ("speed", "seconds", "spacing"),
    [
        (50.0, 60.0, 1.0),  # 3 km: the paper's 1 m
        (5.0, 60.0, 0.3),  # 300 m: a thousandth
        (0.21, 60.0, 0.05),  # 13 m: 5 cm
    ],
)
def test_the_usual_spacing_follows_the_path(speed: float, seconds: float, spacing: float) -> None:
    stamps = _frames(seconds, rate=20.0)
    odometry = _drive(speed, seconds=seconds)
    usual, _ = _select(stamps, odometry)
    below, _ = _select(stamps, odometry, distance_m=spacing * 0.999)
    np.testing.assert_array_equal(usual.stamp_ns, below.stamp_ns)
    step = speed / 20.0
    expected = np.ceil(spacing * 0.999 / step) * step
    np.testing.assert_allclose(np.linalg.norm(np.diff(usual.odom_from_body[:, :3, 3], axis=0), axis=1), expected)


def test_noise_of_a_robot_that_stands_makes_no_path() -> None:
    odometry, rng = _drive(1.0, seconds=60.0), np.random.default_rng(1)
    poses = np.concatenate([odometry.odom_from_body, np.tile(odometry.odom_from_body[-1], (12_000, 1, 1))])
    poses[:, :3, 3] += rng.normal(0.0, 0.01, (len(poses), 3))
    stamps = START + np.arange(len(poses)) * 50 * MS
    keyframes, _ = _select(stamps, Odometry(stamps, poses, None))
    assert len(keyframes.stamp_ns) > 500  # of 60 m, with the least spacing


def test_a_short_piece_has_a_keyframe() -> None:
    odometry = _drive(1.0, seconds=10.0)
    pieces = Odometry(odometry.stamp_ns, odometry.odom_from_body, None, breaks=np.array([103, 109]))
    keyframes, _ = _select(odometry.stamp_ns, pieces, distance_m=1.0)
    assert np.isin(odometry.stamp_ns[[103, 109]], keyframes.stamp_ns).all()
    unknown = Odometry(odometry.stamp_ns, odometry.odom_from_body, None, breaks=np.arange(1, 201))
    assert len(_select(odometry.stamp_ns, unknown, distance_m=1.0)[0].stamp_ns) == 10


def test_frames_before_and_after_the_odometry_are_left_out() -> None:
    odometry = _drive(2.0, seconds=10.0)
    stamps = _frames(seconds=20.0, start_s=-5.0)
    keyframes, warnings = _select(stamps, odometry)
    outside = int(((stamps < odometry.stamp_ns[0]) | (stamps > odometry.stamp_ns[-1])).sum())
    assert outside == 100
    assert warnings == [f"{outside} of {len(stamps)} frames without odometry at its stamp left out."]
    assert keyframes.stamp_ns[0] == START  # the first sample's own stamp has odometry
    assert keyframes.stamp_ns[-1] <= odometry.stamp_ns[-1]
    inside = stamps[(stamps >= odometry.stamp_ns[0]) & (stamps <= odometry.stamp_ns[-1])]
    again, none = _select(inside, odometry)
    assert none == []
    np.testing.assert_array_equal(again.stamp_ns, keyframes.stamp_ns)


def _without(odometry: Odometry, from_s: float, to_s: float) -> Odometry:
    seconds = (odometry.stamp_ns - START) / 1e9
    kept = (seconds <= from_s) | (seconds >= to_s)
    return Odometry(odometry.stamp_ns[kept], odometry.odom_from_body[kept], None)


def test_frames_in_a_gap_of_the_odometry_are_left_out() -> None:
    odometry = _without(_drive(2.0), 20.0, 25.0)
    keyframes, warnings = _select(_frames(), odometry)
    seconds = (keyframes.stamp_ns - START) / 1e9
    assert not ((seconds > 20.0) & (seconds < 25.0)).any()
    assert (seconds >= 25.0).any()
    assert warnings == ["49 of 601 frames without odometry at its stamp left out."]
    _, none = _select(_frames(), odometry, max_odometry_gap_s=5.0)
    assert none == []


def test_short_gaps_and_slow_odometry_are_bridged() -> None:
    assert _select(_frames(), _without(_drive(2.0), 20.0, 21.0))[1] == []
    slow = _drive(2.0, rate=0.5)  # a sample every 2 s is no gap: that is its rate
    assert _select(_frames(), slow)[1] == []
    assert _select(_frames(), _without(slow, 20.0, 26.0))[1] == []  # two lost in a row
    assert len(_select(_frames(), _without(slow, 20.0, 28.0))[1]) == 1


@dataclass
class Camera:
    """A log with images at some stamps."""

    stamp_ns: np.ndarray
    others: tuple[str, ...] = ()
    name = "/front"

    def stamps(self) -> np.ndarray:
        return self.stamp_ns

    def camera(self) -> Camera:
        return self

    def further_cameras(self) -> list[str]:
        return list(self.others)


def test_a_camera_that_stops_or_starts_late_is_told() -> None:
    moves, stops = _drive(2.0, seconds=120.0), _drive(2.0, seconds=120.0)
    stops.odom_from_body[800:] = stops.odom_from_body[800]  # parked from 40 s on
    early, late, every = _frames(40.0), _frames(60.0, start_s=60.0), _frames(120.0)
    both = np.concatenate([_frames(20.0), _frames(85.0, start_s=35.0)])
    cut = TopicChoice(stop_s=40.0)
    for stamp_ns, odometry, topics, words in (
        (early, moves, TopicChoice(), "no images for 80 s, from 40 s of the odometry on, while"),
        (late, moves, TopicChoice(), "no images for 60 s, from 0 s of the odometry on, while"),
        (both, moves, TopicChoice(), "no images for 15 s, from 20 s of the odometry on, while"),
        (np.delete(both, np.s_[400:600]), moves, TopicChoice(), "20 s, from 55 s of the odometry on, and 1 time more"),
        (_frames(120.0, rate=1 / 15), moves, TopicChoice(), ""),
        (every[::4], moves, TopicChoice(), ""),
        (_frames(112.0), moves, TopicChoice(), ""),
        (early, stops, TopicChoice(), ""),
        (early, moves, cut, ""),
    ):
        keyframes, _ = _select(stamp_ns, odometry)
        found = " ".join(ways_without_images(Camera(stamp_ns), topics, keyframes, odometry))  # type: ignore[arg-type]
        assert words in found
        assert bool(words) == bool(found)
    keyframes, _ = _select(early, moves)
    (line,) = ways_without_images(Camera(early, ("/rear",)), TopicChoice(), keyframes, moves)  # type: ignore[arg-type]
    assert "the body moves on by 160 m: no place is recognised there. Further cameras count at its images alone" in line


def test_samples_beside_a_gap_still_count() -> None:
    odometry = _without(_drive(2.0), 20.0, 25.0)
    keyframes, _ = _select(odometry.stamp_ns, odometry, distance_m=0.0)
    np.testing.assert_array_equal(keyframes.stamp_ns, odometry.stamp_ns)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 9_999), min_size=2, max_size=60))
def test_no_two_keyframes_have_the_same_stamp(offsets_ms: list[int]) -> None:
    stamps = START + np.sort(np.array([*offsets_ms, offsets_ms[0], (offsets_ms[0] + 1) % 10_000])) * MS
    keyframes, _ = _select(stamps, _drive(1.0, seconds=10.0), distance_m=0.0)
    np.testing.assert_array_equal(keyframes.stamp_ns, np.unique(stamps))
    assert (np.diff(keyframes.stamp_ns) > 0).all()


@pytest.mark.parametrize("offset_s", [-100.0, 100.0, 1e9 / 2])
def test_clocks_that_do_not_meet(offset_s: float) -> None:
    with pytest.raises(LogError, match="drive: no two frames have odometry") as error:
        _select(_frames(start_s=offset_s, seconds=20.0), _drive(1.0, seconds=10.0))
    assert "\n" not in str(error.value)


def test_too_little_odometry_or_frames() -> None:
    full = _drive(1.0)
    one = Odometry(full.stamp_ns[:1], full.odom_from_body[:1], None)
    few = "and a graph needs two"
    for stamps, odometry, said in (
        (_frames(), one, "no two frames have"), (_frames()[:1], full, f"1 frame, {few}"),
        (_frames()[:0], full, f"0 frames, {few}"),
    ):  # fmt: skip
        with pytest.raises(LogError, match=said):
            _select(stamps, odometry)


@pytest.mark.parametrize("change", [{"distance_m": -1.0}, {"rotation_deg": -1.0}, {"max_odometry_gap_s": 1e300}])
def test_settings_that_cannot_work(change: dict[str, float]) -> None:
    with pytest.raises(SettingsError):
        KeyframeSettings.read(change, "test")
