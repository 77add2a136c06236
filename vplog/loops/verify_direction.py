"""Turn and direction between two keyframes where nothing gives metres: epipolar geometry of a calibrated camera."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from pydantic import Field

from vplog import geometry
from vplog.loops import chance, undistort
from vplog.loops.verify_metric import Pose
from vplog.settings import Settings

if TYPE_CHECKING:
    from vplog.data import Camera, Floats, Verdict

_SAMPLE = 5
"""Matches that fix an essential matrix: Nister 2004."""
_MODELS = 10
"""Essential matrices that five matches allow: Nister 2004, section 3."""
_GATE = 2.576
"""Sigmas of an epipolar error that 1 % of right matches exceed."""
_HUBER = 1.5
"""Sigmas beyond which an error counts linearly, as for metric poses."""
_STEPS = 10
"""Gauss-Newton steps; RANSAC starts within the linear range and three or four converge."""
_CONVERGED = 1e-4
"""Squared length of a step in sigmas: a hundredth of a sigma moves nothing that is then decided."""
_SINGULAR = 1e12
"""Condition of the Hessian beyond which its inverse has no digit left that a sensor could have measured."""


class DirectionSettings(Settings):
    """What is kept of two views that agree, where landmarks are too few or too far for metres."""

    keep: bool = False
    """Whether such a row gets turn and direction, for the solve to take where they fit (`direction_only`): its `scale`
    is `none`, its pose is that of a camera translation of length one, and its information says nothing of that
    length."""
    min_inliers: int = Field(default=30, ge=8)
    """Matches that must agree; a line is a weak test, so more than for a pose."""
    log10_false_alarms: float = Field(default=-6.0, le=0)
    """Most wrong geometries expected by chance, as log10 (Moisan & Stival 2004)."""
    ransac_px: float = Field(default=2.0, gt=0)
    """Distance in px to the epipolar line that RANSAC calls an agreement."""
    rounds: int = Field(default=1000, ge=1, le=1_000_000)
    """Most samples of RANSAC: a geometry is found with 99 % where 34 % of the matches are right."""
    min_spread: float = Field(default=0.1, ge=0, le=1)
    """Share of the image that the inliers' bounding box must cover."""
    parallax_sigmas: float = Field(default=3.0, gt=0)
    """Least median parallax in sigmas of a match; below it a turn on the spot explains the views, without direction."""


def solve(
    verdict: Verdict,
    query: Floats,
    match: Floats,
    image_share: Floats,
    camera: Camera,
    pixel_sigma: float,
    systematic_px: float,
    settings: DirectionSettings,
) -> Pose:
    """Turn and direction of the query's camera in the match's, from matched rays (K, 2); the verdict stays as given.

    `image_share` (K, 2) are the query's pixels as shares of its size. The pose has a translation of length one, its
    information (6, 6), in the query's frame, has no weight along it. No pose where the views do not agree, or agree
    without parallax.
    """
    focal_px = undistort.focal_px(camera)
    sigma = pixel_sigma / focal_px
    nothing = Pose(verdict, 0, 0.0)
    if len(query) < settings.min_inliers:
        return nothing
    essential, mask = cv2.findEssentialMat(
        query, match, np.eye(3), cv2.USAC_MAGSAC, 0.99, settings.ransac_px / focal_px, settings.rounds
    )
    if essential is None or mask is None or np.shape(essential) != (3, 3) or not np.isfinite(essential).all():
        return nothing
    # a line crosses the image over its diagonal at most: Moisan & Stival 2004, eq. 9
    share = 2.0 * settings.ransac_px * np.hypot(camera.width, camera.height) / (camera.width * camera.height)
    count = int(mask.sum())
    alarms = chance.log10_false_alarms(len(query), count, _SAMPLE, _MODELS, share)
    if count < settings.min_inliers or alarms > settings.log10_false_alarms:
        return nothing
    _, turn, shift, front = cv2.recoverPose(essential, query, match, np.eye(3), mask=mask.copy())
    match_from_query = geometry.pose(np.asarray(turn, np.float64), np.asarray(shift, np.float64)[:, 0])
    inlier = front.ravel() > 0
    if inlier.sum() < settings.min_inliers:  # points behind the cameras: two lines through every point, no scene
        return nothing
    x = np.column_stack([query, np.ones(len(query))])
    y = np.column_stack([match, np.ones(len(match))])
    match_from_query, hessian, basis, excess = _refine(match_from_query, x[inlier], y[inlier], sigma)
    residual, _ = _sampson(match_from_query, x, y)
    inlier &= np.abs(residual) < _GATE * sigma
    count = int(inlier.sum())
    if count < settings.min_inliers or np.linalg.cond(hessian) > _SINGULAR:
        return nothing
    spread = float(np.prod(np.ptp(image_share[inlier], axis=0)))
    apart, depth = _parallax(match_from_query, x[inlier], y[inlier])
    if spread < settings.min_spread or apart < settings.parallax_sigmas * np.sqrt(2.0) * sigma:
        return Pose(verdict, count, spread)
    covariance = np.linalg.inv(hessian) * max(1.0, excess)
    shared = systematic_px / focal_px
    covariance += shared**2 * np.diag([1.0, 1.0, 1.0, depth**2, depth**2])
    information = basis @ np.linalg.inv(covariance) @ basis.T
    return Pose(verdict, count, spread, match_from_query, information=(information + information.T) / 2.0)


def _refine(match_from_query: Floats, x: Floats, y: Floats, sigma: float) -> tuple[Floats, Floats, Floats, float]:
    """Gauss-Newton over turn and direction: the pose, its Hessian (5, 5), the basis (6, 5) of its steps, the excess."""
    hessian, basis, excess = np.eye(5), np.zeros((6, 5)), 1.0
    for _ in range(_STEPS):
        residual, by_pose = _sampson(match_from_query, x, y)
        ahead = match_from_query[:3, :3].T @ match_from_query[:3, 3]
        basis = np.zeros((6, 5))
        basis[:3, :3] = np.eye(3)
        basis[3:, 3:] = np.linalg.svd(ahead[None])[2][1:].T  # two directions across the translation
        rows = by_pose @ basis / sigma
        error = residual / sigma
        robust = 1.0 / np.maximum(1.0, np.abs(error) / _HUBER)
        weighted = rows * robust[:, None]
        hessian = weighted.T @ rows
        excess = float((robust * error**2).sum() / max(len(error) - 5.0, 1.0))
        step = -np.linalg.lstsq(hessian, weighted.T @ error, rcond=1e-12)[0]
        match_from_query = match_from_query @ geometry.exp(basis @ step)
        match_from_query[:3, 3] /= np.linalg.norm(match_from_query[:3, 3])
        if step @ hessian @ step < _CONVERGED:
            break
    return match_from_query, hessian, basis, excess


def _sampson(match_from_query: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Distances (K,) of matches to the epipolar geometry and derivatives (K, 6): Hartley & Zisserman 2004, eq. 11.9.

    The pose moves as match_from_query exp(d); how the denominator changes is left out, as it does not at the optimum.
    """
    rotation = match_from_query[:3, :3]
    essential = geometry.skew(match_from_query[:3, 3]) @ rotation
    line, back = x @ essential.T, y @ essential
    length = np.sqrt((line[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
    length = np.maximum(length, 1e-12)[:, None]
    by_pose = np.concatenate([np.cross(x, back), np.cross(x, y @ rotation)], axis=1)
    return (line * y).sum(axis=1) / length[:, 0], by_pose / length


def _parallax(match_from_query: Floats, x: Floats, y: Floats) -> tuple[float, float]:
    """Medians of the angle in rad by which translation moves points, and of their depth in translations."""
    turned = x @ match_from_query[:3, :3].T
    translation = match_from_query[:3, 3]
    # y (a_z + rho t_z) = a_xy + rho t_xy, with rho the inverse depth
    slope = y[:, :2] * translation[2] - translation[:2]
    offset = turned[:, :2] - y[:, :2] * turned[:, 2:]
    rho = (slope * offset).sum(axis=1) / np.maximum((slope**2).sum(axis=1), 1e-12)
    angle = np.linalg.norm(turned[:, :2] / turned[:, 2:] - y[:, :2], axis=1)
    return float(np.median(angle)), float(1.0 / max(np.median(rho), 1e-6))
