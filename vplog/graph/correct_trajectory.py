"""Correction of every odometry sample by the solved keyframes."""

from __future__ import annotations

import numpy as np

from vplog.data import Floats, Keyframes, Odometry, Trajectory
from vplog.geometry import se3


def correct_trajectory(odometry: Odometry, keyframes: Keyframes, world_from_body: Floats) -> Trajectory:
    """Every odometry sample, moved with its keyframes to their solved poses (N, 4, 4).

    The poses that the keyframes before and after a sample give it by the odometry are interpolated on the geodesic by
    its share of the time between them; outside the keyframes the nearest one decides, and beside a break that of its
    piece. So the path of a piece is continuous, passes through the keyframes, and uncorrected odometry stays as it was.
    """
    keys, poses = keyframes.stamp_ns, keyframes.odom_from_body
    after = np.searchsorted(keys, odometry.stamp_ns, "right")
    left, right = np.maximum(after - 1, 0), np.minimum(after, len(keys) - 1)
    gap = np.maximum(keys[right] - keys[left], 1)  # left == right outside of the keyframes: any gap will do
    share = np.clip((odometry.stamp_ns - keys[left]) / gap, 0.0, 1.0)
    piece = np.searchsorted(odometry.breaks, np.arange(len(odometry.stamp_ns)), "right")
    of_key = np.searchsorted(odometry.stamp_ns[odometry.breaks], keys, "right")
    with_left, with_right = of_key[left] == piece, of_key[right] == piece
    share = np.where(with_left == with_right, share, with_right)
    by_left, by_right = (
        world_from_body[key] @ se3.between(poses[key], odometry.odom_from_body) for key in (left, right)
    )
    return Trajectory(odometry.stamp_ns, se3.interpolate(by_left, by_right, share))
