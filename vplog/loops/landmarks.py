"""3D landmarks of the features of one keyframe, with their covariance: from measured depth, or from motion.

A landmark is (x, y, rho): its normalised image coordinates in the keyframe's camera and its inverse depth in 1/m
(Civera, Davison & Montiel 2008). Inverse depth is close to Gaussian for near and far points alike, and depth sensors
that measure disparity have one constant error in it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from vplog.data import Camera, Features, Floats, Keyframes
from vplog.features import matching
from vplog.geometry import se3
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


def landmarks_of(
    row: int,
    keyframes: Keyframes,
    camera: Camera,
    features: FeaturesOf,
    match: matching.MatchSettings,
    settings: LandmarkSettings,
) -> Landmarks:
    """The landmarks of keyframe `row`: from depth where its features have any, else from motion."""
    own = features(row).rows(slice(match.features))  # those that matching looks at
    rays = undistort.rays(camera, own.points)
    if np.isfinite(own.depth_m).any():
        return from_depth(rays, own.depth_m.astype(np.float64), camera, settings)
    first, last = max(row - settings.neighbours, 0), min(row + settings.neighbours + 1, len(keyframes.stamp_ns))
    rows = [other for other in range(first, last) if other != row]
    observed = np.full((len(rows), len(rays), 2), np.nan)
    for view, other in enumerate(rows):
        theirs = features(other)
        mine, found = matching.match_features(own, theirs, match)
        observed[view, mine] = undistort.rays(camera, theirs.points[found])
    motion = se3.between(keyframes.odom_from_body[rows], keyframes.odom_from_body[row])
    views = se3.inverse(camera.body_from_camera) @ motion @ camera.body_from_camera
    return from_motion(rays, observed, views, camera, settings)


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
    (rays, information), (observed, whiten) = own, others
    visible = visible & np.isfinite(_errors(points, observed, views, whiten))
    residual, by_point, by_view = _linearise(points, observed, views)
    whiten = np.where(visible[..., None, None], whiten, 0.0)
    # whitened, and Huber at one sigma: beyond it an error counts linearly
    error = (whiten @ np.where(visible[..., None], residual, 0.0)[..., None])[..., 0]
    root = 1.0 / np.sqrt(np.maximum(np.linalg.norm(error, axis=2), 1.0))
    error, whiten = error * root[..., None], whiten * root[..., None, None]
    by_point, by_view = whiten @ by_point, whiten @ by_view
    by_view_t, by_point_t = np.swapaxes(by_view, 2, 3), np.swapaxes(by_point, 2, 3)
    # the keyframe's own observation constrains x and y; a weak prior on rho keeps blocks without a view invertible
    point_hessian = (by_point_t @ by_point).sum(axis=0)
    point_hessian[:, :2, :2] += information
    point_hessian[:, 2, 2] += 1e-6  # m^2, a sigma of 1000 /m: a millimetre of depth
    point_gradient = (by_point_t @ error[..., None])[..., 0].sum(axis=0)
    point_gradient[:, :2] += (information @ (points[:, :2] - rays)[..., None])[..., 0]
    # to first order the prior's error moves with the view: log(start^-1 view exp(d)) = log(start^-1 view) + d
    size = 6 * len(views)
    view_hessian = np.zeros((size, size))
    view_gradient = np.zeros(size)
    for v in range(len(views)):
        block, rows = slice(6 * v, 6 * v + 6), by_view[v].reshape(-1, 6)
        view_hessian[block, block] = rows.T @ rows + prior[v]
        drift = se3.log(se3.between(start[v], views[v]))
        view_gradient[block] = rows.T @ error[v].ravel() + prior[v] @ drift
    # the landmarks are eliminated: Schur complement
    cross = np.moveaxis(by_view_t @ by_point, 0, 1).reshape(len(points), size, 3)
    point_covariance = np.linalg.inv(point_hessian)
    gain = cross @ point_covariance
    gains, crosses = (np.moveaxis(m, 1, 0).reshape(size, -1) for m in (gain, cross))
    view_covariance = np.linalg.inv(view_hessian - gains @ crosses.T)
    view_step = -view_covariance @ (view_gradient - gains @ point_gradient.ravel())
    gain_t = np.swapaxes(gain, 1, 2)
    point_step = -(point_covariance @ point_gradient[..., None])[..., 0] - gain_t @ view_step
    covariance = point_covariance + (gain_t.reshape(-1, size) @ view_covariance).reshape(gain_t.shape) @ gain
    return points + point_step, views @ se3.exp(view_step.reshape(-1, 6)), covariance


def _project(points: Floats, views: Floats) -> tuple[Floats, Floats, Floats]:
    """Landmarks as rays (M, 3), and their image (V, M, 2) and depth times rho (V, M, 1) in each view; infinite depth
    behind it."""
    bearing = np.column_stack([points[:, :2], np.ones(len(points))])
    moved = bearing @ np.swapaxes(views[:, :3, :3], 1, 2) + points[:, 2, None] * views[:, None, :3, 3]
    depth = np.where(moved[..., 2:] > 0, moved[..., 2:], np.inf)
    return bearing, moved[..., :2] / depth, depth


def _linearise(points: Floats, observed: Floats, views: Floats) -> tuple[Floats, Floats, Floats]:
    """Residuals (V, M, 2) and their derivatives by landmark (V, M, 2, 3) and by view (V, M, 2, 6).

    A view moves as view exp(d), d in the keyframe's camera.
    """
    rotation, translation = views[:, None, :3, :3], views[:, None, :3, 3]
    bearing, image, depth = _project(points, views)
    by_moved = np.zeros((*image.shape, 3))
    by_moved[..., 0, 0] = by_moved[..., 1, 1] = 1.0 / depth[..., 0]
    by_moved[..., :, 2] = -image / depth
    turned = by_moved @ rotation
    by_point = np.concatenate([turned[..., :2], by_moved @ translation[..., None]], axis=-1)
    by_view = np.concatenate([-turned @ se3.skew(bearing), turned * points[:, 2, None, None]], axis=-1)
    return image - observed, by_point, by_view


def _errors(points: Floats, observed: Floats, views: Floats, px_from_ray: Floats) -> Floats:
    """(V, M) reprojection errors in px, by `px_from_ray` (V, M, 2, 2); infinite behind a view, NaN where not
    observed."""
    _, image, depth = _project(points, views)
    error = (px_from_ray @ (image - observed)[..., None])[..., 0]
    return np.where(np.isfinite(depth[..., 0]), np.linalg.norm(error, axis=2), np.inf)


def _linear_inverse_depth(rays: Floats, observed: Floats, views: Floats, visible: np.ndarray) -> Floats:
    """(M,) inverse depth by least squares over all views: u (a_z + rho t_z) = a_xy + rho t_xy is linear in rho."""
    bearing = np.column_stack([rays, np.ones(len(rays))])
    turned = bearing @ np.swapaxes(views[:, :3, :3], 1, 2)
    translation = views[:, None, :3, 3]
    a = np.where(visible[..., None], translation[..., :2] - observed * translation[..., 2:], 0.0)
    b = np.where(visible[..., None], observed * turned[..., 2:] - turned[..., :2], 0.0)
    return (a * b).sum(axis=(0, 2)) / np.maximum((a**2).sum(axis=(0, 2)), 1e-12)  # of a rho = b
