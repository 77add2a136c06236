"""3D landmarks of the features of one keyframe, with their covariance: from measured depth, or from motion.

A landmark is (x, y, rho): its normalised image coordinates in the keyframe's camera and its inverse depth in 1/m
(Civera, Davison & Montiel 2008). Inverse depth is close to Gaussian for near and far points alike, and depth sensors
that measure disparity have one constant error in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
from pydantic import Field

from vplog.data import Camera, Features, Floats, Keyframes
from vplog.features.matching import PairMatches
from vplog.geometry import se3
from vplog.geometry.small_matrices import add_inner, add_moved, invert, product, subtract_moved, subtract_outer
from vplog.loops import undistort
from vplog.settings import Settings

FeaturesOf = Callable[[int], Features]


class LandmarkSettings(Settings):
    """3D positions of the features of a map frame."""

    neighbours: int = Field(default=2, ge=1, le=20)
    """Keyframes before and after the map frame that its features are triangulated with."""
    pixel_sigma: float = Field(default=0.7, gt=0.0)
    """Standard deviation in px of a feature's position along each axis; a SIFT point repeats to 0.5 to 1 px."""
    depth_sigma: float = Field(default=1.425e-3, gt=0)
    """Standard deviation in 1/m of measured inverse depth, so that sigma_z = depth_sigma z^2: Khoshelham & Elberink
    2012, section 3.2, for the Kinect (1.425e-3 m^-1)."""
    depth_share: float = Field(default=0.01, ge=0)
    """Further error of measured depth as a share of it: registration to the colour image and its calibration."""
    depth_range_m: float = Field(default=20.0, gt=0)
    """Measured depths beyond this are taken as unknown: twice the longest range of common depth cameras."""
    odometry_rotation: float = Field(default=0.005, gt=0.0)
    """Standard deviation in rad of the odometry's rotation between neighbouring keyframes, before images refine it."""
    odometry_share: float = Field(default=0.02, gt=0)
    """Standard deviation of the odometry's translation between neighbouring keyframes, as a share of its length."""
    certainty: float = Field(default=3.0, gt=0)
    """A landmark is known where its inverse depth is this many sigmas above zero: its depth is then sure to a third,
    and a point at infinity passes once in a thousand."""
    gate_px: float = Field(default=4.0, gt=0)
    """Reprojection error in px beyond which an observation leaves its track: four to six sigmas."""
    iterations: int = Field(default=5, ge=1)
    """Gauss-Newton steps of the window's bundle adjustment; odometry starts it within its linear range."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """3D positions of M features of one keyframe."""

    rho: Floats
    """(M,) inverse depth in 1/m along the camera's z, NaN where the feature was found in one view only."""
    rays: Floats
    """(M, 2) normalised image coordinates, refined by the other views where there are any."""
    covariance: Floats
    """(M, 3, 3) of (x, y, rho)."""
    known: np.ndarray
    """(M,) bool: the depth is good enough to fix a translation."""
    tracked: int
    """Features that were found in another view or have a depth, known or not."""
    from_depth: bool
    """Whether the scale is the depth sensor's; otherwise it is the odometry's."""


_ENOUGH = 20
"""Landmarks by depth that leave nothing to those by motion: a pose takes as many inliers. Sunlight blinds sensors, and
much is beyond their range."""


def landmarks_of(
    row: int,
    keyframes: Keyframes,
    camera: Camera,
    features: FeaturesOf,
    count: int,
    matches: PairMatches,
    settings: LandmarkSettings,
) -> Landmarks:
    """The landmarks of the `count` strongest features of keyframe `row`: from depth where enough have one or none is
    enough, else from motion, by their matches in the neighbouring keyframes."""
    own = features(row).rows(slice(count))
    rays = undistort.rays(camera, own.points)
    measured = None
    if np.isfinite(own.depth_m).any():
        measured = from_depth(rays, own.depth_m.astype(np.float64), camera, settings)
        if measured.known.sum() >= _ENOUGH:
            return measured
    first, last = max(row - settings.neighbours, 0), min(row + settings.neighbours + 1, len(keyframes.stamp_ns))
    rows = [other for other in range(first, last) if other != row]
    observed = np.full((len(rows), len(rays), 2), np.nan)
    for view, other in enumerate(rows):
        mine, found = matches(row, other)
        observed[view, mine] = undistort.rays(camera, features(other).points[found])
    motion = se3.between(keyframes.odom_from_body[rows], keyframes.odom_from_body[row])
    views = se3.inverse(camera.body_from_camera) @ motion @ camera.body_from_camera
    moved = from_motion(rays, observed, views, camera, settings)
    return moved if measured is None or moved.known.sum() >= _ENOUGH else measured


def from_depth(rays: Floats, depth_m: Floats, camera: Camera, settings: LandmarkSettings) -> Landmarks:
    """Landmarks of rays (M, 2) of the camera with measured depths (M,) in m, NaN unknown."""
    rho, variance = inverse_depth(depth_m, settings)
    rho = np.where(np.isfinite(rays).all(axis=1), rho, np.nan)
    known = rho > settings.certainty * np.sqrt(variance)
    return Landmarks(
        rho, rays, with_rho(rays, variance, camera, settings.pixel_sigma), known, int(np.isfinite(rho).sum()), True
    )  # fmt: skip


def with_rho(rays: Floats, variance: Floats, camera: Camera, pixel_sigma: float) -> Floats:
    """(M, 3, 3) covariance of rays (M, 2) and inverse depths of this variance (M,), independent of each other."""
    covariance = np.zeros((len(rays), 3, 3))
    covariance[:, :2, :2] = undistort.noise_of_rays(camera, rays, pixel_sigma)
    covariance[:, 2, 2] = variance
    return covariance


def for_stereo(settings: LandmarkSettings, focal_px: float, baseline_m: float) -> LandmarkSettings:
    """The settings for depths of a stereo pair: disparity has the noise of two features, and no range ends it."""
    sigma = float(np.sqrt(2.0)) * settings.pixel_sigma / (focal_px * baseline_m)
    return settings.model_copy(update={"depth_sigma": sigma, "depth_range_m": np.inf})


def inverse_depth(depth_m: Floats, settings: LandmarkSettings) -> tuple[Floats, Floats]:
    """Inverse depth (M,) in 1/m and its variance (M,) of measured depths (M,) in m; NaN where not to be used."""
    usable = (depth_m > 0) & (depth_m < settings.depth_range_m)
    rho = np.where(usable, 1.0 / np.where(usable, depth_m, 1.0), np.nan)
    return rho, settings.depth_sigma**2 + (settings.depth_share * rho) ** 2


def from_motion(rays: Floats, observed: Floats, views: Floats, camera: Camera, settings: LandmarkSettings) -> Landmarks:
    """Landmarks of rays (M, 2), found again at `observed` (V, M, 2), NaN where not, by cameras `views` (V, 4, 4).

    `views` are view_from_camera by odometry, which fixes the scale; images refine them, together with the landmarks,
    by a bundle adjustment of the window with the odometry as prior (Triggs et al. 2000, section 6.1: the landmarks are
    eliminated). A landmark's covariance holds the uncertainty of the views.
    """
    gate = settings.gate_px
    moved = np.linalg.norm(views[:, :3, 3], axis=1)
    prior = np.zeros((len(views), 6, 6))
    turn, shift = settings.odometry_rotation, settings.odometry_share * moved
    prior[:, [0, 1, 2], [0, 1, 2]] = turn**-2
    prior[:, [3, 4, 5], [3, 4, 5]] = (np.maximum(shift, 1e-6) ** -2)[:, None]  # 1 um: a camera that stood still
    # what odometry may be wrong by moves points by this much more
    loose = gate + settings.certainty * turn * undistort.focal_px(camera)
    visible = np.isfinite(observed).all(axis=2) & np.isfinite(rays).all(axis=1).reshape(1, -1)
    rho, refined, covariance = np.full(len(rays), np.nan), rays.copy(), np.zeros((len(rays), 3, 3))
    tracked = np.flatnonzero(visible.any(axis=0))
    if len(tracked):
        own, observed, visible = rays[tracked], observed[:, tracked], visible[:, tracked]
        px_from_ray = undistort.px_from_ray(camera, observed.reshape(-1, 2)).reshape(*observed.shape, 2)
        own_px = undistort.px_from_ray(camera, own)
        own_information = np.swapaxes(own_px, 1, 2) @ own_px / settings.pixel_sigma**2
        points = np.column_stack([own, _linear_inverse_depth(own, observed, views, visible)])
        visible &= _errors(points, observed, views, px_from_ray) < loose
        start = views
        spread = np.zeros((len(own), 3, 3))
        for step in range(settings.iterations):
            if step == settings.iterations - 1:  # the views are refined: now the pixels' own gate
                visible &= _errors(points, observed, views, px_from_ray) < gate
            points, views, spread = _adjust(
                points, views, (own, own_information), (observed, px_from_ray / settings.pixel_sigma), visible,
                start, prior,
            )  # fmt: skip
        visible &= _errors(points, observed, views, px_from_ray) < gate
        found = visible.any(axis=0)
        rho[tracked[found]] = points[found, 2]
        refined[tracked[found]] = points[found, :2]
        covariance[tracked[found]] = spread[found]
    known = rho > settings.certainty * np.sqrt(covariance[:, 2, 2])
    return Landmarks(rho, refined, covariance, known, len(tracked), from_depth=False)


def _adjust(
    points: Floats,
    views: Floats,
    own: tuple[Floats, Floats],
    others: tuple[Floats, Floats],
    visible: np.ndarray,
    start: Floats,
    prior: Floats,
) -> tuple[Floats, Floats, Floats]:
    """One Gauss-Newton step over landmarks and views: both, moved, and the landmarks' covariance (M, 3, 3).

    `own` are the keyframe's rays (M, 2) with their information (M, 2, 2), `others` those of the views
    (V, M, 2) with what whitens them (V, M, 2, 2).
    """
    hessian, gradient, *eliminated = _eliminated(points, views, *own, *others, visible)
    # to first order the prior's error moves with the view: log(start^-1 view exp(d)) = log(start^-1 view) + d
    drift = se3.log(se3.between(start, views))
    for v in range(len(views)):
        block = slice(6 * v, 6 * v + 6)
        hessian[block, block] += prior[v]
        gradient[block] += prior[v] @ drift[v]
    view_covariance = np.linalg.inv(hessian)
    view_step = -view_covariance @ gradient
    point_step, covariance = _resolved(view_step, view_covariance, *eliminated)
    return points + point_step, views @ se3.exp(view_step.reshape(-1, 6)), covariance


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _eliminated(points, views, rays, information, observed, whiten, visible):
    """Hessian (6 V, 6 V) and gradient (6 V,) of the views without the landmarks (the Schur complement), and of each
    landmark its covariance (M, 3, 3), gradient (M, 3), and what a step of the views moves it by (M, 6 V, 3)."""
    M, V = len(points), len(views)
    hessian, gradient = np.zeros((6 * V, 6 * V)), np.zeros(6 * V)
    covariance, own_gradient, gains = np.zeros((M, 3, 3)), np.zeros((M, 3)), np.zeros((M, 6 * V, 3))
    cross, own, error = np.empty((6 * V, 3)), np.empty((3, 3)), np.empty(2)
    by_point, by_view = np.empty((2, 3)), np.empty((2, 6))
    for m in range(M):
        cross[:], own[:] = 0.0, 0.0
        own[:2, :2] = information[m]  # the keyframe's own observation constrains x and y
        own[2, 2] = 1e-6  # m^2, a sigma of 1000 /m: a weak prior keeps blocks without a view invertible
        add_moved(own_gradient[m], 0, information[m], points[m, :2] - rays[m])
        for v in range(V):
            if not visible[v, m] or not _linearise(points[m], observed[v, m], views[v], error, by_point, by_view):
                continue
            if not _whiten(whiten[v, m], error, by_point, by_view):
                continue
            add_inner(own, 0, 0, by_point, by_point)
            add_moved(own_gradient[m], 0, by_point, error)
            add_inner(hessian, 6 * v, 6 * v, by_view, by_view)
            add_moved(gradient, 6 * v, by_view, error)
            add_inner(cross, 6 * v, 0, by_view, by_point)
        invert(own, 3, covariance[m])
        product(cross, covariance[m], 1.0, gains[m])
        subtract_moved(gradient, 0, gains[m], own_gradient[m])
        subtract_outer(hessian, 0, 0, gains[m], cross)
    return hessian, gradient, covariance, own_gradient, gains


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _whiten(whiten, error, by_point, by_view):
    """Whiten the error and its derivatives, with Huber's weight at one sigma: beyond it an error counts linearly. False
    where there is none."""
    a, b = whiten[0, 0] * error[0] + whiten[0, 1] * error[1], whiten[1, 0] * error[0] + whiten[1, 1] * error[1]
    root = 1.0 / math.sqrt(max(math.sqrt(a * a + b * b), 1.0))
    error[0], error[1] = root * a, root * b
    if not math.isfinite(error[0] + error[1]):
        return False
    for derivative in (by_point, by_view):
        for i in range(derivative.shape[1]):
            a, b = derivative[0, i], derivative[1, i]
            derivative[0, i] = root * (whiten[0, 0] * a + whiten[0, 1] * b)
            derivative[1, i] = root * (whiten[1, 0] * a + whiten[1, 1] * b)
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _resolved(view_step, view_covariance, covariance, gradient, gains):
    """Steps (M, 3) of the landmarks where the views make theirs (6 V,), and covariances with that of the views."""
    M, size = len(covariance), len(view_step)
    step, total = np.zeros((M, 3)), covariance.copy()
    for m in range(M):
        gain = gains[m]
        for j in range(3):
            for k in range(3):
                step[m, j] -= covariance[m, j, k] * gradient[m, k]
        for i in range(size):
            if gain[i, 0] == gain[i, 1] == gain[i, 2] == 0.0:
                continue
            a = b = c = 0.0
            for k in range(size):
                a += view_covariance[i, k] * gain[k, 0]
                b += view_covariance[i, k] * gain[k, 1]
                c += view_covariance[i, k] * gain[k, 2]
            for j in range(3):
                step[m, j] -= gain[i, j] * view_step[i]
                total[m, j, 0] += gain[i, j] * a
                total[m, j, 1] += gain[i, j] * b
                total[m, j, 2] += gain[i, j] * c
    return step, total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _linearise(point, observed, view, error, by_point, by_view):
    """Write the error (2,) of a landmark in a view, and its derivatives by landmark (2, 3) and by view (2, 6); False
    behind it.

    A view moves as view exp(d), d in the keyframe's camera.
    """
    x, y, rho = point[0], point[1], point[2]
    depth = view[2, 0] * x + view[2, 1] * y + view[2, 2] + view[2, 3] * rho
    if not depth > 0.0:
        return False
    for k in range(2):
        image = (view[k, 0] * x + view[k, 1] * y + view[k, 2] + view[k, 3] * rho) / depth
        error[k] = image - observed[k]
        a = (view[k, 0] - image * view[2, 0]) / depth
        b = (view[k, 1] - image * view[2, 1]) / depth
        c = (view[k, 2] - image * view[2, 2]) / depth
        by_point[k, 0], by_point[k, 1], by_point[k, 2] = a, b, (view[k, 3] - image * view[2, 3]) / depth
        # -(a, b, c) skew((x, y, 1))
        by_view[k, 0], by_view[k, 1], by_view[k, 2] = c * y - b, a - c * x, b * x - a * y
        by_view[k, 3], by_view[k, 4], by_view[k, 5] = a * rho, b * rho, c * rho
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _errors(points, observed, views, px_from_ray):
    """(V, M) reprojection errors in px, by `px_from_ray` (V, M, 2, 2); infinite behind a view, NaN where not
    observed."""
    result = np.full(observed.shape[:2], np.inf)
    for v in range(len(views)):
        view = views[v]
        for m in range(len(points)):
            x, y, rho = points[m, 0], points[m, 1], points[m, 2]
            depth = view[2, 0] * x + view[2, 1] * y + view[2, 2] + view[2, 3] * rho
            if depth > 0.0:
                a = (view[0, 0] * x + view[0, 1] * y + view[0, 2] + view[0, 3] * rho) / depth - observed[v, m, 0]
                b = (view[1, 0] * x + view[1, 1] * y + view[1, 2] + view[1, 3] * rho) / depth - observed[v, m, 1]
                to_px = px_from_ray[v, m]
                result[v, m] = math.hypot(to_px[0, 0] * a + to_px[0, 1] * b, to_px[1, 0] * a + to_px[1, 1] * b)
    return result


def _linear_inverse_depth(rays: Floats, observed: Floats, views: Floats, visible: np.ndarray) -> Floats:
    """(M,) inverse depth by least squares over all views: u (a_z + rho t_z) = a_xy + rho t_xy is linear in rho."""
    bearing = np.column_stack([rays, np.ones(len(rays))])
    turned = bearing @ np.swapaxes(views[:, :3, :3], 1, 2)
    translation = views[:, None, :3, 3]
    a = np.where(visible[..., None], translation[..., :2] - observed * translation[..., 2:], 0.0)
    b = np.where(visible[..., None], observed * turned[..., 2:] - turned[..., :2], 0.0)
    return (a * b).sum(axis=(0, 2)) / np.maximum((a**2).sum(axis=(0, 2)), 1e-12)  # of a rho = b
