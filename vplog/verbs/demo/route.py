"""Where the car is at any time, and the measurements of its odometry and satellite receiver.

The world is flat, x east, y north, z up, its origin the centre of the block. Distance is metres along the axis of
the street, counter-clockwise from the middle of the southern side; lateral is metres left of that axis.
"""

from __future__ import annotations

from itertools import accumulate

import numpy as np

from vplog.data import Floats, Ints
from vplog.geometry.geodesy import geodetic
from vplog.geometry.se3 import between, exp, log, pose, so3_exp
from vplog.verbs.demo.settings import DemoSettings

START_NS = 1_700_000_000_000_000_000
"""Stamp of the first odometry sample; any date serves."""
FIRST_FRAME_NS = 12_345_678
"""The camera's own clock phase: frames fall between odometry samples, as in a real log."""
ORIGIN_DEG = (48.137, 11.575)
"""Latitude and longitude of the world's origin."""
ORIGIN_ALTITUDE_M = 520.0
_LATERAL_OFFSET_M = 0.8
"""Distance of the later laps' track to the left of the first one's."""
SHIFT_LENGTH_M = 10.0
"""Distance before the end of the first lap over which the car moves to its new track and the light changes."""

IMU_MOUNT = pose(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([-0.4, 0.2, 0.3]))
"""body_from_imu: x to the left."""
GRAVITY = 9.81

TURN_LENGTH_M = 18.0
"""Metres that the car would drive while it turns back on the spot."""


def lap_length(settings: DemoSettings) -> float:
    """Metres of one round along the axis: a rectangle with rounded corners."""
    r = settings.corner_radius_m
    return 2 * (settings.block_length_m + settings.block_width_m) - 8 * r + 2 * np.pi * r


def axis_point(settings: DemoSettings, distance_m: Floats) -> tuple[Floats, Floats]:
    """Point (T, 2) and heading (T,) in rad of the axis of the street at these distances."""
    r = settings.corner_radius_m
    long, short = settings.block_length_m - 2 * r, settings.block_width_m - 2 * r
    # Half a side, then a turn and a side in alternation; the plane as complex numbers.
    lengths = np.insert([long / 2, short, long, short, long / 2], [1, 2, 3, 4], np.pi / 2 * r)
    headings = np.array([0, 0, 1, 1, 2, 2, 3, 3, 4]) * np.pi / 2
    is_turn = np.arange(len(lengths)) % 2 == 1
    moves = np.where(is_turn, r * (1 + 1j), lengths) * np.exp(1j * headings)
    starts = np.cumsum(moves) - moves - 0.5j * settings.block_width_m
    ends = np.cumsum(lengths)

    lap = np.floor(distance_m / ends[-1])
    rest = distance_m - lap * ends[-1]
    piece = np.minimum(np.searchsorted(ends, rest, side="right"), len(ends) - 1)
    rest = rest - (ends - lengths)[piece]
    angle = np.where(is_turn[piece], rest / r, 0.0)
    ahead = np.where(is_turn[piece], -1j * r * (np.exp(1j * angle) - 1), rest)
    point = starts[piece] + np.exp(1j * headings[piece]) * ahead
    return np.stack([point.real, point.imag], axis=-1), headings[piece] + angle + 2 * np.pi * lap


def second_lap_share(settings: DemoSettings, distance_m: Floats) -> Floats:
    """0 in the first lap, 1 after it, smooth over the SHIFT_LENGTH_M before its end."""
    x = np.clip((distance_m - lap_length(settings)) / SHIFT_LENGTH_M + 1, 0, 1)
    return x * x * (3 - 2 * x)


def track_point(settings: DemoSettings, distance_m: Floats) -> Floats:
    """(T, 2) of the car: on the axis in the first lap, then 0.4 to 1 times the offset left of it, meandering."""
    point, heading = axis_point(settings, distance_m)
    left_m = _LATERAL_OFFSET_M * second_lap_share(settings, distance_m)
    left_m = left_m * (0.7 + 0.3 * np.sin(2 * np.pi * distance_m / 31.0))
    return point + left_m[..., None] * np.stack([-np.sin(heading), np.cos(heading)], axis=-1)


def _turned_back(settings: DemoSettings, driven_m: Floats) -> tuple[Floats, Floats]:
    """Distance along the street (T,) in m, and by how much the car looks back (T,), 0 to pi, by metres driven: it turns
    in the time of TURN_LENGTH_M."""
    if not settings.turn_back_m:
        return driven_m, np.zeros_like(driven_m)
    turn = np.clip((driven_m - settings.turn_back_m) / TURN_LENGTH_M, 0, 1)
    ahead_m = np.minimum(driven_m, settings.turn_back_m)
    return ahead_m - np.maximum(driven_m - settings.turn_back_m - TURN_LENGTH_M, 0), np.pi * turn * turn * (
        3 - 2 * turn
    )


def world_from_body(settings: DemoSettings, stamp_ns: Ints) -> Floats:
    """(T, 4, 4) truth: along the street at constant speed, with the small sway of a car on its springs."""
    time_s: Floats = (stamp_ns - START_NS).astype(np.float64) * 1e-9
    distance_m, back_rad = _turned_back(settings, settings.speed_m_s * time_s)
    step_m = 0.05  # short against every curve, long against rounding
    forward = track_point(settings, distance_m + step_m) - track_point(settings, distance_m - step_m)
    yaw = (np.arctan2(forward[:, 1], forward[:, 0]) + back_rad)[:, None] * [0, 0, 1]
    # Sway: 0.4 and 0.3 degrees, 1.5 cm, at periods of the order of a second that share no multiple.
    roll, pitch, height = (
        size * np.sin(time_s * rate + phase)
        for size, rate, phase in ((0.007, 2.9, 0), (0.005, 4.3, 1), (0.015, 5.1, 2))
    )
    rotation = so3_exp(yaw) @ so3_exp(np.stack([roll, pitch, np.zeros_like(roll)], axis=-1))
    return pose(rotation, np.column_stack([track_point(settings, distance_m), height]))


def stamps(settings: DemoSettings, rate_hz: float, first_ns: int = 0) -> Ints:
    """Stamps of a sensor in ns, from first_ns after the start to the end of the drive."""
    if not rate_hz:
        return np.zeros(0, np.int64)
    duration_s = settings.laps * lap_length(settings) / settings.speed_m_s
    count = int((duration_s - first_ns * 1e-9) * rate_hz) + 1
    return START_NS + first_ns + np.round(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)


def frame_stamps(settings: DemoSettings) -> Ints:
    """(F,) ns, all between the first and the last odometry sample."""
    frames = stamps(settings, settings.frame_rate_hz, FIRST_FRAME_NS)
    return frames[frames <= odometry_stamps(settings)[-1]]


def odometry_stamps(settings: DemoSettings) -> Ints:
    """(T,) ns."""
    return stamps(settings, settings.odometry_rate_hz)


def odometry(settings: DemoSettings, rng: np.random.Generator) -> Floats:
    """(T, 4, 4) odom_from_body that drifts: the true steps with a scale error, a yaw bias and white noise."""
    truth = world_from_body(settings, odometry_stamps(settings))
    step = log(between(truth[:-1], truth[1:]))
    step[:, 3:] *= 1 + settings.odometry_scale_error
    step[:, 2] += settings.odometry_yaw_bias_rad_s / settings.odometry_rate_hz
    step[:, :3] += rng.normal(size=(len(step), 3)) * settings.odometry_turn_noise_rad
    step[:, 3:] += rng.normal(size=(len(step), 3)) * settings.odometry_step_noise_m
    return np.stack([*accumulate(exp(step), np.matmul, initial=np.eye(4))])


def imu(settings: DemoSettings, stamp_ns: Ints, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """(K, 3) turn rates in rad/s and (K, 3) accelerations in m/s^2 about the IMU's axes, with the noise and the biases
    of a MEMS that no one calibrated."""
    half_ns = 2_500_000  # over 5 ms, as its own filter
    before, here, behind = (world_from_body(settings, stamp_ns + shift) @ IMU_MOUNT for shift in (-half_ns, 0, half_ns))
    seconds = half_ns * 1e-9
    gyro = log(between(before, behind))[:, :3] / (2 * seconds)
    moved = (behind + before - 2 * here)[:, :3, 3] / seconds**2 + [0, 0, GRAVITY]
    accel = (moved[:, None] @ here[:, :3, :3])[:, 0]
    rate = settings.imu_rate_hz
    return tuple(
        value + rng.normal(size=3) * bias + rng.normal(size=value.shape) * density * rate**0.5
        for value, density, bias in ((gyro, 0.0005, 0.005), (accel, 0.006, 0.1))
    )  # type: ignore[return-value]


def gps(settings: DemoSettings, stamp_ns: Ints, rng: np.random.Generator) -> Floats:
    """(G, 3) latitude and longitude in degrees, altitude in m, of the noisy position at these stamps."""
    sigma = np.array([1.0, 1.0, 2.0]) * settings.gps_sigma_m
    enu_m = world_from_body(settings, stamp_ns)[:, :3, 3] + rng.normal(size=(len(stamp_ns), 3)) * sigma
    return geodetic(enu_m, (*ORIGIN_DEG, ORIGIN_ALTITUDE_M))
