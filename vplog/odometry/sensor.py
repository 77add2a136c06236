"""Measurements of one frame: rays of its points, and their inverse depths where it has depth or a right image."""

from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np

from vplog.data import Bytes, Camera, Float32s, Floats, Frame
from vplog.features.sift import depth_at
from vplog.features.stereo_depth import StereoSettings
from vplog.loops import undistort
from vplog.loops.landmarks import LandmarkSettings, for_stereo, inverse_depth

_WINDOW = (13, 13)
"""px of the patch that is followed: OpenCV's 21 spans more edges between near and far, and doubles the drift."""
_LEVELS = 4
"""Pyramid levels above the image: a patch is found up to some 100 px away."""
_BACK_PX = 1.0
"""px by which a point followed there and back may miss itself: more is another point."""
_EDGE_SHARE = 0.05
"""Relative difference of the depths around a point above which it lies on an edge, whose depth is either side's."""
_LEAST_DISPARITY_PX = 0.05
"""px; noise may make a disparity zero or less. A point at infinity still constrains the rotation."""


@dataclass(frozen=True, eq=False)
class Points:
    """K points of one frame."""

    px: Float32s
    """(K, 2)."""
    rays: Floats
    """(K, 2) normalised image coordinates."""
    noise: Floats
    """(K, 2, 2) their covariance."""
    rho: Floats
    """(K,) inverse depth in 1/m, NaN where it was not measured."""
    variance: Floats
    """(K,) of rho."""

    def rows(self, rows: np.ndarray) -> Points:
        """Some of the points."""
        return Points(self.px[rows], self.rays[rows], self.noise[rows], self.rho[rows], self.variance[rows])

    def joined(self, other: Points) -> Points:
        """These points, then the others."""
        names = [field.name for field in fields(self)]
        return Points(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in names))


class Sensor:
    """A calibrated camera; `metric` where its frames have depth or a right image."""

    def __init__(self, camera: Camera, metric: bool = True) -> None:
        self.camera, self.focal_px, self.metric = camera, undistort.focal_px(camera), metric
        noise, self._baseline_m = LandmarkSettings(), camera.baseline_m
        self._noise = noise if camera.baseline_m is None else for_stereo(noise, self.focal_px, camera.baseline_m)

    @property
    def pixel_sigma(self) -> float:
        return self._noise.pixel_sigma

    def rho_variance(self, rho: Floats) -> Floats:
        """(K,) of inverse depths (K,) as if measured."""
        return self._noise.depth_sigma**2 + (self._noise.depth_share * rho) ** 2

    def measure(self, frame: Frame, px: Float32s) -> Points:
        """The points at (K, 2) px of a frame; those that the lens gives no ray have none, NaN."""
        rays = undistort.rays(self.camera, px)
        noise = undistort.noise_of_rays(self.camera, rays, self.pixel_sigma)
        rho, variance = inverse_depth(self._depth_m(frame, px), self._noise)
        return Points(px, rays, noise, rho, variance)

    def _depth_m(self, frame: Frame, px: Float32s) -> Floats:
        """(K,) NaN unknown."""
        if self._baseline_m is not None and frame.right is not None:
            disparity = disparities(frame.image, frame.right, px) - self.camera.disparity_zero_px
            return self.focal_px * self._baseline_m / np.maximum(disparity, _LEAST_DISPARITY_PX)
        depth = depth_at(px, frame.depth).astype(np.float64)
        if frame.depth is not None:
            kernel = np.ones((3, 3), np.uint8)
            known = np.nan_to_num(frame.depth, nan=0.0)
            nearest = depth_at(px, np.asarray(cv2.erode(known, kernel), np.float32))
            furthest = depth_at(px, np.asarray(cv2.dilate(known, kernel), np.float32))
            depth[(furthest - nearest) > _EDGE_SHARE * furthest] = np.nan
        return depth


def disparities(left: Bytes, right: Bytes, px: Float32s) -> Floats:
    """(K,) px by which points lie further left in the right image of a rectified pair; NaN where they are not found."""
    found = follow(left, right, px, px)
    step = px - found
    rows = StereoSettings().rows_px
    good = np.isfinite(found).all(axis=1) & (np.abs(step[:, 1]) < rows) & (step[:, 0] > -rows)
    return np.where(good, step[:, 0], np.nan).astype(np.float64)


def follow(image: Bytes, other: Bytes, px: Float32s, guess: Float32s) -> Float32s:
    """(K, 2) where points (K, 2) of an image lie in another, searched from a guess; NaN where they are not found.

    Lucas & Kanade 1981 on pyramids, there and back.
    """
    if not len(px):
        return np.zeros((0, 2), np.float32)
    options = {"winSize": _WINDOW, "maxLevel": _LEVELS, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    there, found, _ = cv2.calcOpticalFlowPyrLK(image, other, px, guess.copy(), **options)  # type: ignore[call-overload]
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, image, there, px.copy(), **options)  # type: ignore[call-overload]
    height, width = other.shape
    inside = ((there > 0) & (there < np.array([width - 1, height - 1], np.float32))).all(axis=1)
    near = np.linalg.norm(back - px, axis=1) < _BACK_PX
    good = (found.ravel() > 0) & (returned.ravel() > 0) & inside & near
    return np.where(good[:, None], there, np.float32(np.nan)).astype(np.float32)
