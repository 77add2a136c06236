"""Systematic errors of a drive's closures: the calibration and the time stamps of its camera."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from vplog.data import Floats, Ints, Keyframes
from vplog.geometry import se3
from vplog.settings import Settings


class CalibrationSettings(Settings):
    """Comparison of the camera's rotations with the odometry's.

    A relative error of the focal length makes every rotation between two views wrong by the same factor and leaves
    small residuals, so only another sensor detects it. It is not corrected: it widens the closures' covariance.
    """

    pairs: int = Field(default=32, ge=0, le=10_000)
    """Pairs of keyframes that are compared; their mean is six times surer than one."""
    angle: float = Field(default=0.15, gt=0, lt=3.2)
    """Rotation of a pair in rad, by odometry: enough to stand out of its noise, little enough to share a view."""
    reach: int = Field(default=8, ge=1, le=1000)
    """Keyframes that a pair may be apart."""
    least_share: float = Field(default=0.01, ge=0, le=1)
    """Share of the rotation that is never claimed to be known better: a careful calibration's focal length."""
    most_share: float = Field(default=0.2, gt=0, le=1)
    """A larger disagreement is the odometry's, not a lens's: it is taken as this much."""
    stamp_sigma_s: float = Field(default=0.002, ge=0, le=1)
    """Standard deviation in s of a frame's stamp against the odometry's: half an exposure by day, and what a driver
    takes to write the stamp. It moves a closure along the drive by speed times this."""


def compared_pairs(keyframes: Keyframes, settings: CalibrationSettings) -> Ints:
    """(P, 2) int64 rows (earlier, later) of keyframes between which motions of camera and odometry are compared.

    They are the `turning_pairs`, and the neighbours between which the body's rates of turning and its velocities change
    most, which shows a time offset.
    """
    change = np.diff(body_twists(keyframes), axis=0)
    rates = np.linalg.norm(change[:, :3], axis=1), np.linalg.norm(change[:, 3:], axis=1)
    earlier = np.concatenate([np.argsort(-rate, kind="stable")[: settings.pairs // 2] for rate in rates])
    changing = np.column_stack([earlier, earlier + 1])
    return np.unique(np.concatenate([turning_pairs(keyframes, settings), changing]), axis=0).astype(np.int64)


def turning_pairs(keyframes: Keyframes, settings: CalibrationSettings) -> Ints:
    """(P, 2) int64 rows (earlier, later) of keyframes that turn by about `angle` within `reach`, spread evenly."""
    count = len(keyframes.stamp_ns)
    later = np.full(count, -1)
    for separation in range(settings.reach, 0, -1):  # from far to near, so that the nearest is kept
        if separation < count:
            turn = se3.angle(se3.between(keyframes.odom_from_body[:-separation], keyframes.odom_from_body[separation:]))
            fits = np.flatnonzero((turn > settings.angle) & (turn < 2.0 * settings.angle))
            later[fits] = fits + separation
    earlier = np.flatnonzero(later >= 0)
    if len(earlier) > settings.pairs:
        earlier = earlier[np.linspace(0, len(earlier) - 1, settings.pairs).astype(np.int64)]
    return np.column_stack([earlier, later[earlier]]).astype(np.int64)


def motion_covariance(match_from_query: Floats, share: float) -> Floats:
    """(6, 6) what a calibration that is wrong by `share` adds to a closure, in the query's frame.

    It stretches rotation and translation, and what it does across them hangs on the scene: an error as long as the
    share of their length, in any direction.
    """
    turned, moved = se3.so3_log(match_from_query[:3, :3]), match_from_query[:3, 3]
    result = np.zeros((6, 6))
    result[:3, :3] = (turned @ turned) * np.eye(3)
    result[3:, 3:] = (moved @ moved) * np.eye(3)
    return share**2 / 3.0 * result  # three axes share the length


def body_twists(keyframes: Keyframes) -> Floats:
    """(N, 6) speed of the body at each keyframe, rad/s and m/s in its own frame, by odometry from its neighbours."""
    count = len(keyframes.stamp_ns)
    before, after = np.maximum(np.arange(count) - 1, 0), np.minimum(np.arange(count) + 1, count - 1)
    seconds = np.maximum((keyframes.stamp_ns[after] - keyframes.stamp_ns[before]) * 1e-9, 1e-9)
    motion = se3.log(se3.between(keyframes.odom_from_body[before], keyframes.odom_from_body[after]))
    return np.asarray(motion / seconds[:, None], np.float64)


def stamp_covariance(match_from_query: Floats, match_twist: Floats, query_twist: Floats, sigma_s: float) -> Floats:
    """(6, 6) what wrong stamps of both frames add to a closure, in the query's frame.

    exp(x m) T exp(y q) = T exp(Ad(T^-1) m x + q y) to first order, for stamps wrong by x and y.
    """
    moved = np.column_stack([se3.adjoint(se3.inverse(match_from_query)) @ match_twist, query_twist])
    return sigma_s**2 * moved @ moved.T
