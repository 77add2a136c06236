"""Truth is a smooth closed loop; odometry drifts by as much as it says; fixes scatter around the truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limit
from hypothesis import strategies as st
from pydantic import ValidationError

from vplog.geometry.se3 import between, log, transform, umeyama
from vplog.verbs.demo import SMALL, DemoSettings, route

blocks = st.builds(
    DemoSettings,
    block_length_m=st.floats(20, 100),
    block_width_m=st.floats(20, 100),
    corner_radius_m=st.floats(3, 9),
    laps=st.floats(0.5, 3),
)


@limit(max_examples=100, deadline=None)
@given(blocks, st.floats(0, 1))
def test_a_lap_later_the_axis_is_at_the_same_point(block: DemoSettings, share: float) -> None:
    lap = route.lap_length(block)
    points, headings = route.axis_point(block, np.array([share, share + 1.0]) * lap)
    np.testing.assert_allclose(points[0], points[1], atol=1e-6)
    assert headings[1] - headings[0] == pytest.approx(2 * np.pi, abs=1e-6)


@limit(max_examples=30, deadline=None)
@given(blocks)
def test_the_axis_is_run_at_unit_speed_without_a_kink(block: DemoSettings) -> None:
    distance = np.linspace(0, 2 * route.lap_length(block), 4001)
    points, headings = route.axis_point(block, distance)
    step = distance[1]
    assert np.linalg.norm(np.diff(points, axis=0), axis=1) == pytest.approx(step, rel=0.01)
    assert np.abs(np.diff(headings)).max() <= step / block.corner_radius_m * 1.001 + 1e-9


@pytest.mark.parametrize("settings", [DemoSettings(), SMALL])
def test_the_second_lap_repeats_the_first_beside_its_track(settings: DemoSettings) -> None:
    lap_ns = round(route.lap_length(settings) / settings.speed_m_s * 1e9)
    second = route.odometry_stamps(settings)
    second = second[second - route.START_NS > lap_ns]
    assert len(second) >= 0.39 * lap_ns * 1e-9 * settings.odometry_rate_hz
    first_pose, second_pose = (route.world_from_body(settings, t) for t in (second - lap_ns, second))
    beside = between(first_pose, second_pose)
    assert np.abs(beside[:, 1, 3]).min() > 0.2
    assert np.linalg.norm(beside[:, :3, 3], axis=1).max() <= 1.0
    assert np.degrees(np.linalg.norm(log(beside)[:, :3], axis=1)).max() < 12


def test_odometry_drifts_by_metres_over_the_default_drive() -> None:
    settings = DemoSettings()
    for seed in range(5):
        odometry = route.odometry(settings, np.random.default_rng(seed))
        truth = route.world_from_body(settings, route.odometry_stamps(settings))
        aligned, _ = umeyama(odometry[:, :3, 3], truth[:, :3, 3])
        error = np.linalg.norm(transform(aligned, odometry[:, :3, 3]) - truth[:, :3, 3], axis=1)
        assert 2 < np.sqrt((error**2).mean()) < 8


def test_odometry_without_errors_is_the_truth() -> None:
    settings = DemoSettings(
        odometry_scale_error=0, odometry_yaw_bias_rad_s=0, odometry_step_noise_m=0, odometry_turn_noise_rad=0
    )
    truth = route.world_from_body(settings, route.odometry_stamps(settings))
    odometry = route.odometry(settings, np.random.default_rng(0))
    np.testing.assert_allclose(odometry, between(truth[:1], truth), atol=1e-8)


def test_every_frame_lies_between_odometry_samples() -> None:
    for settings in (DemoSettings(), SMALL):
        frames, samples = route.frame_stamps(settings), route.odometry_stamps(settings)
        assert samples[0] < frames[0] < frames[-1] <= samples[-1]
        assert not np.isin(frames, samples).all()
    assert 150 <= len(route.frame_stamps(DemoSettings())) <= 240
    assert 35 <= len(route.frame_stamps(SMALL)) <= 50


def test_fixes_scatter_around_the_truth_in_metres() -> None:
    settings = DemoSettings(laps=10, gps_rate_hz=10)
    stamp_ns = route.stamps(settings, settings.gps_rate_hz)
    fixes = np.radians(route.gps(settings, stamp_ns, np.random.default_rng(0)))
    # WGS84 to earth-centred and back to east-north-up by their definitions, as an independent way.
    a, e2 = 6378137.0, 0.00669437999014

    def earth_centred(latitude: np.ndarray, longitude: np.ndarray, altitude: np.ndarray) -> np.ndarray:
        n = a / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
        x, y = np.cos(longitude), np.sin(longitude)
        level = (n + altitude) * np.cos(latitude)
        return np.stack([level * x, level * y, (n * (1 - e2) + altitude) * np.sin(latitude)], axis=-1)

    lat, lon = np.radians(route.ORIGIN_DEG)
    origin = earth_centred(lat, lon, np.array(route.ORIGIN_ALTITUDE_M))
    east = np.array([-np.sin(lon), np.cos(lon), 0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    offset = earth_centred(fixes[:, 0], fixes[:, 1], np.degrees(fixes[:, 2])) - origin
    error = np.stack([offset @ east, offset @ north], axis=-1) - route.world_from_body(settings, stamp_ns)[:, :2, 3]
    np.testing.assert_allclose(error.std(axis=0), settings.gps_sigma_m, rtol=0.1)
    np.testing.assert_allclose(error.mean(axis=0), 0, atol=0.12)


def test_turns_wider_than_the_block_are_refused() -> None:
    with pytest.raises(ValidationError, match="corner_radius_m"):
        DemoSettings(block_width_m=16, corner_radius_m=8)
