"""Structure of a camera without depth: the motion between two views, and the depths of points by the views of a window.

Nister 2004 for the essential matrix by five points. Its translation has no length: the unit is such that the points of
the first two views have a median depth of UNIT_DEPTH.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vplog.data import Bools, Floats
from vplog.geometry import se3
from vplog.odometry.bundle_adjustment import Observations, adjust

if TYPE_CHECKING:
    from vplog.odometry.sensor import Points

UNIT_DEPTH = 10.0
"""Units of the median depth, of two views and of a piece: that of a street in m, so that spacings of keyframes and
bounds of closures, which are set in m, suit any scene."""
_RADIUS_PX = 1.0
"""Distance to the epipolar line that RANSAC calls an agreement; corners are followed to some tenths of a px."""
_CONFIDENCE = 0.9999
_LEAST_SHARE = 0.6
"""Points that must agree with one motion, and lie before both views, of those followed; less is moving or a plane's
mirrored twin."""
_LEAST_PARALLAX = np.radians(1.0)
"""Median angle between the two rays of a point: COLMAP asks for 1.5 degrees of a point, ORB-SLAM for 1 of the 50th
best. By less, as when the camera turns only, the translation is noise."""
CERTAINTY = 3.0
"""Sigmas by which an inverse depth must be above zero for a landmark, as of the landmarks of closures."""


class TwoViews(NamedTuple):
    """The motion between two views, in units of its own, and the points that agree with it."""

    first_from_second: Floats
    """(4, 4)."""
    first: Floats
    """(I, 3) in the first view."""
    rows: np.ndarray
    """(I,)."""


def two_views(first: Points, second: Points, focal_px: float, least: int) -> TwoViews | None:
    """The motion by points (K,) that were followed from one view to the other; None where fewer than `least` agree, or
    their parallax is too small to tell a translation from none."""
    if len(first.px) < least:
        return None
    try:
        found = cv2.findEssentialMat(
            first.rays, second.rays, np.eye(3), cv2.RANSAC, _CONFIDENCE, _RADIUS_PX / focal_px
        )  # fmt: skip
        if found[0] is None or found[0].shape != (3, 3):
            return None
        _, rotation, moved, _ = cv2.recoverPose(found[0], first.rays, second.rays, np.eye(3), mask=found[1].copy())
    except cv2.error:  # points on one line
        return None
    second_from_first = se3.pose(np.asarray(rotation, np.float64), np.asarray(moved, np.float64).ravel())
    first_from_second = se3.inverse(second_from_first)
    depth, angle = _triangulated(first.rays, second.rays, first_from_second)
    at = np.column_stack([first.rays, np.ones(len(depth))]) * depth[:, None]
    front = (depth > 0) & (se3.transform(second_from_first, at)[:, 2] > 0)
    rows = np.flatnonzero(front & (found[1].ravel() > 0))
    if len(rows) < max(least, _LEAST_SHARE * len(first.px)) or np.median(angle[rows]) < _LEAST_PARALLAX:
        return None
    return _refined(first.rows(rows), second.rows(rows), first_from_second, at[rows], rows)


def _refined(first: Points, second: Points, first_from_second: Floats, at: Floats, rows: np.ndarray) -> TwoViews | None:
    """Both views adjusted, in units of UNIT_DEPTH."""
    count = np.arange(len(rows))
    view, landmark = np.repeat([0, 1], len(rows)), np.concatenate([count, count])
    both = first.joined(second)
    xyrho = np.column_stack([both.rays, both.rho])
    observed = Observations(view, landmark, xyrho, both.noise, both.variance)
    found = adjust(np.stack([np.eye(4), first_from_second]), at, observed, metric=False)
    if found is None:
        return None
    depth = found.points[:, 2]
    middle = float(np.median(depth))
    if not middle > 0:
        return None
    unit = UNIT_DEPTH / middle
    pose = se3.inverse(found.world_from_camera[0]) @ found.world_from_camera[1]
    pose[:3, 3] *= unit
    good = depth > 0
    return TwoViews(pose, found.points[good] * unit, rows[good])


def _triangulated(rays: Floats, others: Floats, first_from_second: Floats) -> tuple[Floats, Floats]:
    """Depth (K,) in the first view, negative behind it, and the angle (K,) between the two rays of each point."""
    own = np.column_stack([rays, np.ones(len(rays))])
    theirs = np.column_stack([others, np.ones(len(rays))]) @ first_from_second[:3, :3].T
    across = np.cross(own, theirs)
    moved = np.broadcast_to(first_from_second[:3, 3], own.shape)
    square = np.maximum((across**2).sum(1), 1e-18)
    depth = (np.cross(moved, theirs) * across).sum(1) / square
    angle = np.arctan2(np.sqrt(square), (own * theirs).sum(1))
    return depth, angle


def rho_variance(points: Floats, view_centres: Floats, shown: Bools, ray_variance: float) -> Floats:
    """(K,) variance of the inverse depths of points (K, 3) in a camera, by views at (V, 3) in it that show them (V, K)
    and measure rays of this variance; a million where none adds parallax."""
    ray, rho = points[:, :2] / points[:, 2:], 1.0 / points[:, 2]
    behind = 1.0 - rho * view_centres[:, 2:]
    jacobian = (ray * view_centres[:, None, 2:] - view_centres[:, None, :2]) / np.maximum(behind, 0.1)[..., None] ** 2
    information = (shown * (jacobian**2).sum(axis=2)).sum(axis=0) / ray_variance
    return 1.0 / np.maximum(information, 1e-12)


def rho_of(rays: Floats, observed: Floats, views: Floats, px: float) -> tuple[Floats, Floats]:
    """Inverse depths (K,) of rays (K, 2) of a camera by least squares over views, with their variances (K,) ; NaN where
    a point misses one of its views by more than three times `px`, in normalised coordinates, its sigma.

    `observed` (V, K, 2) are the rays in the views, NaN where they do not show it; `views` (V, 4, 4) view_from_camera.
    u (a_z + rho t_z) = a_xy + rho t_xy is linear in rho.
    """
    shown: Bools = np.asarray(np.isfinite(observed).all(axis=2))
    known = np.where(shown[..., None], observed, 0.0)
    turned = np.column_stack([rays, np.ones(len(rays))]) @ np.swapaxes(views[:, :3, :3], 1, 2)
    moved = views[:, None, :3, 3]
    a = np.where(shown[..., None], moved[..., :2] - known * moved[..., 2:], 0.0)
    b = np.where(shown[..., None], known * turned[..., 2:] - turned[..., :2], 0.0)
    weight = (a**2).sum(axis=(0, 2))
    rho = (a * b).sum(axis=(0, 2)) / np.maximum(weight, 1e-18)
    depth = turned[..., 2:] + rho[:, None] * moved[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        missed = np.linalg.norm((turned[..., :2] + rho[:, None] * moved[..., :2]) / depth - known, axis=2)
    good = (~shown | ((missed < 3.0 * px) & (depth[..., 0] > 0))).all(axis=0) & shown.any(axis=0)
    variance = px**2 / np.maximum(weight, 1e-18)
    return np.where(good, rho, np.nan), variance
