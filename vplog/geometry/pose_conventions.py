"""Conventions in which poses may be written, other than world_from_body with quaternions x y z w."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vplog.data import Floats
from vplog.geometry import se3

AS_GIVEN = "as given"


def _conjugated(poses: Floats) -> Floats:
    return se3.pose(np.swapaxes(poses[..., :3, :3], -1, -2), poses[..., :3, 3])


def _w_first(poses: Floats) -> Floats:
    return se3.pose(se3.rotation(np.roll(se3.quaternion(poses[..., :3, :3]), -1, axis=-1)), poses[..., :3, 3])


def _mirrored(poses: Floats) -> Floats:
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    return mirror @ poses @ mirror


POSE_CONVENTIONS: dict[str, Callable[[Floats], Floats]] = {
    AS_GIVEN: lambda poses: poses,
    "body_from_world (inverted)": se3.inverse,
    "with conjugated quaternions": _conjugated,
    "with quaternions in the order w x y z": _w_first,
    "in left-handed axes (mirrored)": _mirrored,
}
"""The function that converts poses (..., 4, 4) to world_from_body, for each convention by its name in warnings.

Axes such as NED or FRD need no entry. They are rotations of the world or of the sensor's mount.
"""
