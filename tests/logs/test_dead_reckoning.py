"""Velocities added up, where they are slow, where they pause, and beside a gyroscope that pauses or disagrees."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from vplog.data import Gps, Odometry
from vplog.geometry.geodesy import geodetic
from vplog.graph.noise import NoiseSettings, edge_covariance
from vplog.logs.continuity import without_jumps
from vplog.logs.dead_reckoning import dead_reckoned, gyro_agrees, odometry_of_fixes, turned_by_gyro
from vplog.logs.formats.container import Notes

if TYPE_CHECKING:
    from pathlib import Path

START_NS = 1_600_000_000_000_000_000
UNKNOWN = np.nan


def stamps(seconds: np.ndarray) -> np.ndarray:
    return START_NS + np.rint(seconds * 1e9).astype(np.int64)


def ahead(count: int, speed: float, turn: float | np.ndarray = 0.0) -> np.ndarray:
    """(T, 6)."""
    found = np.zeros((count, 6))
    found[:, 0], found[:, 5] = speed, turn
    return found


def way_m(odometry: Odometry) -> float:
    return float(np.linalg.norm(np.diff(odometry.odom_from_body[:, :3, 3], axis=0), axis=1).sum())


@pytest.mark.parametrize("period_s", [0.02, 1.0, 1.5, 5.0])
def test_slow_velocities_lose_no_path(period_s: float) -> None:
    """As the speed of an OBD or CAN logger, whose stamps jitter."""
    at_s = np.arange(0, 300, period_s)
    at_s += np.random.default_rng(1).uniform(-0.005, 0.005, len(at_s)) * min(period_s, 1.0)
    found = dead_reckoned(stamps(at_s), ahead(len(at_s), 10.0), np.full((len(at_s), 6), UNKNOWN))
    assert way_m(found) == pytest.approx(10.0 * (at_s[-1] - at_s[0]))
    assert not len(found.breaks)


@pytest.mark.parametrize("variance", [UNKNOWN, 0.01])
def test_what_happened_in_a_pause_is_not_known(variance: float) -> None:
    at_s = np.concatenate([np.arange(0, 30, 0.1), np.arange(90, 120, 0.1)])
    found = dead_reckoned(stamps(at_s), ahead(len(at_s), 10.0), np.full((len(at_s), 6), variance))
    assert found.breaks.tolist() == [300]
    keys = stamps(np.array([0.0, 15.0, 29.0, 91.0, 110.0]))
    edges, _, _ = edge_covariance(found, keys, NoiseSettings())
    sigma_m = np.sqrt(edges[:, 3, 3])
    assert sigma_m[2] > 500
    assert sigma_m[[0, 1, 3]].max() < 10


def pausing(wheels_s: np.ndarray, gyro_s: np.ndarray) -> Odometry:
    """The odometry of a circle by wheels that turn too far, and by a gyroscope that does not."""
    gyro = np.zeros((len(gyro_s), 3))
    gyro[:, 2] = 0.1
    found = turned_by_gyro(stamps(wheels_s), ahead(len(wheels_s), 10.0, 0.12), stamps(gyro_s), gyro)
    return dead_reckoned(found[0], found[1], np.full_like(found[1], UNKNOWN))


def test_a_gyroscope_that_pauses_or_starts_late_leaves_the_wheels() -> None:
    wheels_s, gyro_s = np.arange(0, 120, 0.05), np.arange(0, 120, 0.01)
    paused = pausing(wheels_s, gyro_s[(gyro_s < 50) | (gyro_s > 60)])
    late = pausing(wheels_s, gyro_s[gyro_s > 20])
    for found, turn in ((paused, 110 * 0.1 + 10 * 0.12), (late, 100 * 0.1 + 20 * 0.12)):
        assert way_m(found) == pytest.approx(1199.5, rel=0.001)
        assert not len(found.breaks)
        heading = np.unwrap(np.arctan2(found.odom_from_body[:, 1, 0], found.odom_from_body[:, 0, 0]))
        assert heading[-1] - heading[0] == pytest.approx(turn, abs=0.03)


def test_nothing_is_made_up_where_the_wheels_pause() -> None:
    wheels_s, gyro_s = np.arange(0, 120, 0.05), np.arange(0, 120, 0.01)
    found = pausing(wheels_s[(wheels_s < 30) | (wheels_s > 90)], gyro_s)
    assert way_m(found) == pytest.approx(600, abs=2)
    assert len(found.breaks) == 1


@pytest.mark.parametrize("seed", range(4))
def test_a_gyroscope_agrees_with_the_turns_it_measures(seed: int) -> None:
    """Not in the axes of a camera, in degrees, by another clock, or of something else; wheels may slip."""
    rng = np.random.default_rng(seed)
    gyro_s, wheels_s = np.arange(0, 60, 0.01), np.arange(0, 60, 0.05)
    phase = rng.uniform(0, 6, 4)

    def rate(at_s: np.ndarray) -> np.ndarray:
        return 0.2 * np.sin(np.outer(0.3 + 0.2 * np.arange(4), at_s) + phase[:, None]).sum(0)

    gyro = rng.normal([0, 0, 0.02], 0.1, (len(gyro_s), 3))
    gyro[:, 2] += rate(gyro_s)
    turning = ahead(len(wheels_s), 1.0, rate(wheels_s) + rng.normal(0, 0.02, len(wheels_s)))
    both = stamps(wheels_s), turning, stamps(gyro_s)
    assert gyro_agrees(*both, gyro)
    assert gyro_agrees(*both[:1], 2 * turning, both[2], gyro)
    assert gyro_agrees(*both[:1], 0 * turning, both[2], gyro)
    assert not gyro_agrees(*both, gyro[:, [1, 2, 0]])
    assert not gyro_agrees(*both, np.degrees(gyro))
    assert not gyro_agrees(*both, -gyro)
    assert not gyro_agrees(*both, np.roll(gyro, 1000, axis=0))


@pytest.mark.parametrize("axes", [[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [57.3, 57.3, 57.3], [0.0, 0.0, 0.0]])
@pytest.mark.parametrize("turns", [True, False])
def test_a_steady_turn_and_a_speed_alone_tell_a_gyroscope_that_cannot_be(turns: bool, axes: list[float]) -> None:
    """Upside down, in degrees or silent."""
    gyro_s, wheels_s = np.arange(0, 60, 0.01), np.arange(0, 60, 0.05)
    gyro = np.random.default_rng(7).normal([0.01, 0, 0.21], 0.05, (len(gyro_s), 3)) * axes
    moving = ahead(len(wheels_s), 10.0, 0.2 * turns)
    impossible = axes[0] > 1 or (turns and axes[2] <= 0)
    assert gyro_agrees(stamps(wheels_s), moving, stamps(gyro_s), gyro) is not impossible


def test_turns_on_the_spot_are_no_bias_where_wheels_tell_a_speed_alone() -> None:
    gyro_s, wheels_s = np.arange(0, 60, 0.01), np.arange(0, 60, 0.05)
    gyro = np.where(gyro_s < 10, 0.5, 0.1)[:, None] * [0.0, 0.0, 1.0]
    moving = ahead(len(wheels_s), 1.0)
    moving[wheels_s < 10, 0] = 0.0
    found = turned_by_gyro(stamps(wheels_s), moving, stamps(gyro_s), gyro)
    assert found[2] is None
    np.testing.assert_allclose(found[1][[100, -100], 5], [0.5, 0.1])
    biased = turned_by_gyro(stamps(wheels_s), moving, stamps(gyro_s), np.full((len(gyro_s), 3), 0.07))
    assert biased[2] == pytest.approx(0.07 * 3**0.5)  # a cheap gyroscope's, all the way
    moving[wheels_s > 20, 5] = 0.1  # that wheels tell turns makes it one
    assert turned_by_gyro(stamps(wheels_s), moving, stamps(gyro_s), gyro)[2] == pytest.approx(0.5)


@pytest.mark.parametrize("turns", [True, False])
@pytest.mark.parametrize(("accel", "upside_down"), [(9.8, False), (-9.8, True), (-9.8, False)])
def test_an_imu_that_hangs_turns_the_other_way(accel: float, upside_down: bool, turns: bool, tmp_path: Path) -> None:
    """Or is forward-right-down: without a transform gravity tells, but for the turns of wheels."""
    from tests.logs.test_odometry_kinds import header, opened, topic, velocities

    at_s, gyro_s = np.arange(0, 60, 0.05), np.arange(0, 60, 0.02)
    rate = 0.2 * np.sin(gyro_s / 5)
    wheels = [{"header": header(int(one), "base_link"), "twist": velocities(2.0, turns * 0.2 * np.sin(second / 5))}
              for one, second in zip(stamps(at_s), at_s.tolist(), strict=True)]  # fmt: skip
    rate = -rate if upside_down else rate
    imu = [{"header": header(int(one), "imu"), "angular_velocity": {"z": turn}, "linear_acceleration": {"z": accel}}
           for one, turn in zip(stamps(gyro_s), rate.tolist(), strict=True)]  # fmt: skip
    log = opened(
        tmp_path, topic("/twist", "geometry_msgs/msg/TwistStamped", wheels, stamps(at_s)),
        topic("/imu", "sensor_msgs/msg/Imu", imu, stamps(gyro_s)),
    )  # fmt: skip
    odometry, hangs = log.odometry(), upside_down or (accel < 0 and not turns)
    assert odometry is not None
    yaw = np.unwrap(np.arctan2(odometry.odom_from_body[:, 1, 0], odometry.odom_from_body[:, 0, 0]))
    assert np.ptp(yaw) == pytest.approx(2.0, abs=0.02)
    assert (yaw.max() > 1.9) == (hangs == upside_down)
    assert "turns by the gyroscope" in " ".join(log.warnings)
    assert ("it is taken to have z down" in " ".join(log.warnings)) is hangs


@pytest.mark.parametrize("first_m", [0.0, 30.0])
@pytest.mark.parametrize("gap_s", [3.0, 5.0, 20.0])
def test_an_estimator_that_starts_again_is_a_break(gap_s: float, first_m: float) -> None:
    """However long the gap is, in which any jump might be a motion; from the first pose, or from zero."""
    at_s = np.concatenate([np.arange(0, 60, 0.05), np.arange(60 + gap_s, 120, 0.05)])
    poses = np.tile(np.eye(4), (len(at_s), 1, 1))
    poses[:1200, 0, 3], poses[1200:, 0, 3] = first_m + at_s[:1200], at_s[1200:] - at_s[1200]
    found = without_jumps(Odometry(stamps(at_s), poses, None), "/odom", notes := Notes())
    assert found.breaks.tolist() == [1200]
    assert "starts again" in notes.lines[0]
    assert found.odom_from_body[1200, 0, 3] == pytest.approx(found.odom_from_body[1199, 0, 3])
    assert way_m(found) == pytest.approx(60 + 60 - gap_s, abs=0.2)


@pytest.mark.parametrize("moving_s", [60.0, 3.0])
@pytest.mark.parametrize("gap_s", [3.0, 10.0, 40.0])
def test_a_drive_that_goes_on_through_a_gap_does_not_start_again(gap_s: float, moving_s: float) -> None:
    """At 1 m/s, 60 s of it or but 3 s around the gap; at rest the poses shake by a millimetre."""
    at_s = np.concatenate([np.arange(0, 60, 0.05), np.arange(60 + gap_s, 160, 0.05)])
    poses = np.tile(np.eye(4), (len(at_s), 1, 1))
    poses[:, :3, 3] = np.random.default_rng(9).normal(0, 1e-3, (len(at_s), 3))
    poses[:, 0, 3] += at_s.clip(60 - moving_s / 2, 60 + gap_s + moving_s / 2)
    found = without_jumps(Odometry(stamps(at_s), poses, None), "/odom", notes := Notes())
    assert not len(found.breaks)
    assert notes.lines == []


def test_a_drive_that_is_faster_within_a_gap_does_not_start_again() -> None:
    """From one yard to another, while the recorder was paused."""
    at_s = np.concatenate([np.arange(0, 60, 0.05), np.arange(160, 220, 0.05)])
    poses = np.tile(np.eye(4), (len(at_s), 1, 1))
    poses[:, 0, 3] = np.where(at_s < 100, 2.0 * at_s, 920.0 + 2.0 * (at_s - 160))
    assert not len(without_jumps(Odometry(stamps(at_s), poses, None), "/odom", Notes()).breaks)
    poses[1200:, 0, 3] -= 920.0  # as of an estimator that was restarted
    assert len(without_jumps(Odometry(stamps(at_s), poses, None), "/odom", Notes()).breaks) == 1


def test_a_robot_that_comes_back_to_its_dock_does_not_start_again() -> None:
    at_s = np.concatenate([np.arange(0, 60, 0.05), np.arange(70, 120, 0.05)])
    poses = np.tile(np.eye(4), (len(at_s), 1, 1))
    poses[:1200, 0, 3] = 20 * np.sin(np.linspace(0, np.pi, 1200))
    found = without_jumps(Odometry(stamps(at_s), poses, None), "/odom", notes := Notes())
    assert not len(found.breaks)
    assert notes.lines == []


def test_axes_that_are_not_measured_take_the_drift_model() -> None:
    """As diff_drive_controller marks z, roll and pitch: such marks are no noise, whatever the period is."""
    at_s = np.arange(0, 30, 0.02)
    variances = np.tile([1e-3, 1e-3, 1e6, 1e6, 1e6, 0.03], (len(at_s), 1))
    found = dead_reckoned(stamps(at_s), ahead(len(at_s), 1.0), variances)
    edges, warnings, _ = edge_covariance(found, stamps(np.arange(0.0, 29.0)), NoiseSettings())
    model, _, _ = edge_covariance(found, stamps(np.arange(0.0, 29.0)), NoiseSettings(source="model"))
    np.testing.assert_allclose(edges[:, [0, 1, 5], [0, 1, 5]], model[:, [0, 1, 5], [0, 1, 5]])
    assert "leaves roll, pitch, z unknown" in warnings[0]


def test_slow_velocities_beside_a_gyroscope_that_starts_late_are_no_gaps(tmp_path: Path) -> None:
    from tests.logs.test_odometry_kinds import header, message, opened, topic, velocities

    at_s = np.arange(0, 60, 1.0) + np.random.default_rng(2).uniform(-0.005, 0.005, 60)
    gyro_s = np.arange(30, 60, 0.01)
    wheels = [{"header": header(int(one), "base_link"), "twist": velocities(2.0, 0.1)} for one in stamps(at_s)]
    rates = [{"header": header(int(one), "base_link"), "angular_velocity": {"z": 0.1}} for one in stamps(gyro_s)]
    assert message("geometry_msgs/msg/Twist", **velocities(2.0, 0.1)).linear.x == 2.0
    log = opened(
        tmp_path, topic("/twist", "geometry_msgs/msg/TwistStamped", wheels, stamps(at_s)),
        topic("/imu", "sensor_msgs/msg/Imu", rates, stamps(gyro_s)),
    )  # fmt: skip
    odometry = log.odometry()
    assert odometry is not None and not len(odometry.breaks)
    assert way_m(odometry) == pytest.approx(118, abs=0.5)


NAN, TWIST = np.nan, (2.0, 0.0, 0.0, 0.0, 0.0, 0.1)
"""m/s ahead, rad/s about z."""


@pytest.mark.parametrize(
    ("row", "values", "dropped"),
    [
        (0, (NAN, 0.0, 0.0, 0.0, 0.0, 0.1), "1 message"),
        (slice(None), (2.0, 0.0, NAN, NAN, NAN, 0.1), ""),
        (300, (2.0, 0.0, 0.0, 0.0, 0.0, 1e6), "1 message"),
        (slice(300, 302), (1e8, 0.0, 0.0, 0.0, 0.0, 0.1), "2 messages"),
    ],
)
def test_velocities_that_are_none_leave_the_others(row: Any, values: tuple, dropped: str, tmp_path: Path) -> None:
    """A damaged message, and axes that a driver does not measure."""
    from tests.logs.test_odometry_kinds import header, opened, topic

    at_s, moving = np.arange(0, 30, 0.05), np.tile(TWIST, (600, 1))
    moving[row] = values
    fields = [
        {"header": header(int(stamp), "base_link"),
         "twist": {"linear": dict(zip("xyz", one[:3], strict=True)), "angular": dict(zip("xyz", one[3:], strict=True))}}
        for stamp, one in zip(stamps(at_s), moving.tolist(), strict=True)
    ]  # fmt: skip
    log = opened(tmp_path, topic("/vel", "geometry_msgs/msg/TwistStamped", fields, stamps(at_s)))
    odometry = log.odometry()
    assert odometry is not None
    turn = 0.1 * (at_s[-1] - at_s[0])
    end = 20 * np.array([np.sin(turn), 1 - np.cos(turn), 0])
    within = 0.3 if values[0] != values[0] else 0.02  # the first pose is the second message's
    np.testing.assert_allclose(odometry.odom_from_body[-1, :3, 3], end, atol=within)
    assert [line for line in log.warnings if "dropped" in line] == (
        [f"/vel: {dropped} with a velocity that is not finite, or beyond 1000 m/s or 100 rad/s, dropped."]
        if dropped
        else []
    )


@pytest.mark.parametrize("pairs", [1, 298])
@pytest.mark.parametrize("apart_s", [1e-3, 1e-5, 1e-6, 2e-7])
def test_fixes_close_in_time_are_odometry(apart_s: float, pairs: int) -> None:
    """A fix that a driver repeats at once, or the second of two receivers."""
    at_s = np.arange(300.0)
    enu = np.stack([10 * at_s, 50 * np.sin(at_s / 20), 0 * at_s], 1) + np.random.default_rng(3).normal(0, 1, (300, 3))
    again = np.linspace(0, 299, pairs + 2)[1:-1].astype(int)
    stamp_ns = stamps(np.concatenate([at_s, at_s[again]])) + np.repeat([0, int(apart_s * 1e9)], [300, pairs])
    order = np.argsort(stamp_ns, kind="stable")

    def fixes(stamp_ns: np.ndarray, enu: np.ndarray) -> Gps:
        latitude, longitude, altitude = geodetic(enu, (48.0, 11.0, 500.0)).T
        return Gps(stamp_ns, latitude, longitude, altitude, np.tile(np.eye(3), (len(enu), 1, 1)))

    alone = odometry_of_fixes(fixes(stamps(at_s), enu))
    found = odometry_of_fixes(fixes(stamp_ns[order], np.concatenate([enu, enu[again]])[order]))
    assert alone is not None and found is not None
    assert way_m(found) == pytest.approx(way_m(alone), rel=0.02)
