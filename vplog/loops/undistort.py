"""Pixels to rays and back, for the distortion models of camera_info."""

from __future__ import annotations

import cv2
import numpy as np

from vplog.data import Camera, Floats
from vplog.errors import LogError

MODELS = ("none", "plumb_bob", "rational_polynomial", "equidistant")
_STEPS = 10
"""Newton steps after OpenCV's start: a handful of fixed-point steps, which leave px of error in wide lenses."""
_CONVERGED_PX = 1e-6
"""Far below any feature's noise, and above the rounding of pixels in double precision."""
_ROUND_TRIP_PX = 0.5
"""A ray whose projection is further than this from its pixel has no inverse: no ray is better than a wrong one."""


def rays(camera: Camera, points: np.ndarray) -> Floats:
    """(M, 2) normalised image coordinates (x/z, y/z) of pixels (M, 2); NaN where the lens model has no inverse.

    Raises LogError for an unknown distortion model or a camera without a matrix.
    """
    matrix, distortion, fisheye = _model(camera)
    pixels = np.ascontiguousarray(points, np.float64).reshape(-1, 1, 2)
    if len(pixels) == 0:
        return np.empty((0, 2))
    if distortion.size == 0:
        return _pinhole_rays(matrix, pixels[:, 0])
    undistort = cv2.fisheye.undistortPoints if fisheye else cv2.undistortPoints
    result = np.asarray(undistort(pixels, matrix, distortion), np.float64).reshape(-1, 2)
    with np.errstate(all="ignore"):
        for _ in range(_STEPS):
            error = pixels[:, 0] - _project_rays(camera, result)
            if not (np.abs(error) > _CONVERGED_PX).any():
                break
            step = (_ray_from_px(camera, result) @ error[..., None])[..., 0]
            result += np.where(np.isfinite(step).all(axis=1, keepdims=True), step, 0.0)
        error = pixels[:, 0] - _project_rays(camera, result)
        J = px_from_ray(camera, result)
        # beyond the fold of a polynomial it leads back to pixels that other rays have
        unfolded = (J[:, 0, 0] * J[:, 1, 1] > J[:, 0, 1] * J[:, 1, 0]) & (J[:, 0, 0] + J[:, 1, 1] > 0)
    result[~unfolded | ~(np.abs(error).max(axis=1) < _ROUND_TRIP_PX)] = np.nan
    return result


def project(camera: Camera, points: Floats) -> Floats:
    """(M, 2) px of points (M, 3) in the camera's frame; NaN for points that are not in front of it."""
    matrix, distortion, fisheye = _model(camera)
    result = np.full((len(points), 2), np.nan)
    front = points[:, 2] > 0
    if not front.any():
        return result
    in_front = np.ascontiguousarray(points[front], np.float64).reshape(-1, 1, 3)
    zero = np.zeros(3)
    if fisheye:
        pixels, _ = cv2.fisheye.projectPoints(in_front, zero, zero, matrix, distortion)
    else:
        pixels, _ = cv2.projectPoints(in_front, zero, zero, matrix, distortion if distortion.size else None)
    result[front] = np.asarray(pixels).reshape(-1, 2)
    return result


def focal_px(camera: Camera) -> float:
    """One focal length for both axes: what a pixel of noise is in normalised coordinates, at the image's centre."""
    matrix, _, _ = _model(camera)
    return float(np.sqrt(matrix[0, 0] * matrix[1, 1]))


def px_from_ray(camera: Camera, at: Floats) -> Floats:
    """(M, 2, 2) derivative of pixels by normalised image coordinates at rays (M, 2): what a pixel of noise is there."""
    if _model(camera)[1].size == 0:
        return np.tile(_model(camera)[0][:2, :2], (len(at), 1, 1))
    step = 1e-6  # of normalised coordinates, about 1e-3 px: the best of a one-sided difference in double precision
    here = _project_rays(camera, at)
    return np.stack([(_project_rays(camera, at + step * axis) - here) / step for axis in np.eye(2)], axis=2)


def noise_of_rays(camera: Camera, at: Floats, pixel_sigma: float) -> Floats:
    """(M, 2, 2) covariance of rays (M, 2) seen with standard deviation `pixel_sigma` px along each axis: beyond 70
    degrees of a fisheye a ray is ten times less sure than at its centre. NaN where the lens bends it no further out."""
    J_inv = _ray_from_px(camera, at)
    return pixel_sigma**2 * J_inv @ np.swapaxes(J_inv, 1, 2)


def _ray_from_px(camera: Camera, at: Floats) -> Floats:
    """(M, 2, 2) inverse of `px_from_ray`; NaN where the model is singular."""
    J = px_from_ray(camera, at)
    determinant = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        J_inv = np.stack([J[:, 1, 1], -J[:, 0, 1], -J[:, 1, 0], J[:, 0, 0]], axis=1) / determinant[:, None]
    return np.where(np.isfinite(J_inv).all(1, keepdims=True), J_inv, np.nan).reshape(-1, 2, 2)


def _project_rays(camera: Camera, at: Floats) -> Floats:
    return project(camera, np.column_stack([at, np.ones(len(at))]))


def _pinhole_rays(matrix: Floats, pixels: Floats) -> Floats:
    y = (pixels[:, 1] - matrix[1, 2]) / matrix[1, 1]
    x = (pixels[:, 0] - matrix[0, 2] - matrix[0, 1] * y) / matrix[0, 0]
    return np.column_stack([x, y])


def _model(camera: Camera) -> tuple[Floats, Floats, bool]:
    """Matrix, coefficients (empty where none bends anything) and whether it is a fisheye."""
    if camera.matrix is None:
        raise LogError(f"Camera {camera.name!r} has no matrix. Metric closures need a camera_info with K.")
    if camera.distortion_model not in MODELS:
        raise LogError(
            f"Camera {camera.name!r} has the distortion model {camera.distortion_model!r}. "
            f"Known models: {', '.join(MODELS)}. Rectify the images or convert the calibration."
        )
    matrix = np.ascontiguousarray(camera.matrix, np.float64)
    distortion = np.ascontiguousarray(camera.distortion, np.float64).ravel()
    fisheye = camera.distortion_model == "equidistant"
    if camera.distortion_model == "none" or (not fisheye and not distortion.any()):
        distortion = np.empty(0)
    if fisheye and distortion.size != 4:  # without coefficients it still is not a pinhole
        distortion = np.resize(np.append(distortion, np.zeros(4)), 4)
    return matrix, distortion, fisheye
