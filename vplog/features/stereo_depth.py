"""Depth of the features of a rectified stereo pair: matches along rows, and the depth of their disparity."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from vplog.data import Features, Float32s
from vplog.features.matching import squared_distances
from vplog.settings import Settings


class StereoSettings(Settings):
    """Stereo matching of the features of two rectified images."""

    rows_px: float = Field(default=2.0, gt=0)
    """Most px that a point may lie above or below its match: rectification leaves half a px, and each feature has as
    much noise again, so that this is about three sigmas."""
    size_ratio: float = Field(default=1.5, ge=1)
    """Most that the sizes of two matched features may differ, as a factor: both cameras see a point at one distance,
    and SIFT's sizes step by 2^(1/3) within an octave."""
    ratio: float = Field(default=0.8, gt=0, le=1)
    """A match is kept when its distance is below this share of the second best's on its rows: Lowe 2004, section 7.1;
    the few rivals on a row allow more than a whole image does."""
    max_distance: float = Field(default=300.0, gt=0)
    """Longest distance of matched descriptors: on rows without a rival the ratio has no meaning. SIFT's have a length
    of 512; unrelated ones are about 500 apart, two views of a point seldom 300."""
    min_disparity_px: float = Field(default=1.0, gt=0)
    """Disparities below this are no depth: with half a px of noise in each image they may as well be zero."""
    nearest_depths: float = Field(default=2.0, gt=0)
    """Least depth as a multiple of the baseline: nearer points leave the other image, or look another way."""


def stereo_depth(
    left: Features,
    right: Features,
    focal_px: float,
    baseline_m: float,
    settings: StereoSettings,
    zero_px: float = 0.0,
) -> Float32s:
    """(M,) float32 depth in m along the left camera's z of the M features of the left image, NaN where unknown.

    Both images are rectified (sensor_msgs/CameraInfo: P): rows correspond, and a point at depth z lies
    focal_px baseline_m / z + zero_px further left in the right one; `zero_px` is the difference of the principal
    points, left less right. A match is the nearest descriptor of its rows in both directions, and distinct there.
    Distances are exact whole numbers, and equal ones go to the stronger feature. Raises ValueError where focal length
    or baseline is not positive.
    """
    if not (0 < focal_px < np.inf and 0 < baseline_m < np.inf):
        raise ValueError(
            f"A stereo pair needs a positive focal length and baseline, not {focal_px} px, {baseline_m} m."
        )
    depth = np.full(len(left), np.nan, np.float32)
    if len(left) == 0 or len(right) == 0:
        return depth
    disparity = left.points[:, None, 0].astype(np.float64) - right.points[None, :, 0] - zero_px
    reach = focal_px / settings.nearest_depths
    possible = (disparity > -settings.rows_px) & (disparity < reach)
    possible &= np.abs(left.points[:, None, 1] - right.points[None, :, 1]) <= settings.rows_px
    larger = left.sizes[:, None] / np.maximum(right.sizes[None], np.float32(1e-6))
    possible &= (larger <= settings.size_ratio) & (larger >= 1.0 / settings.size_ratio)
    distance = np.where(possible, squared_distances(left.descriptors, right.descriptors), np.inf).astype(np.float64)
    rows = np.arange(len(left))
    best = distance.argmin(axis=1)
    least = distance[rows, best]
    mutual = distance.argmin(axis=0)[best] == rows
    # a second orientation of the best match is no rival: the same point
    same = (right.points[best][:, None] == right.points[None]).all(axis=2)
    second = np.where(same, np.inf, distance).min(axis=1)
    found = disparity[rows, best]
    good = (least <= settings.max_distance**2) & (least < settings.ratio**2 * second)
    good &= mutual & (found >= settings.min_disparity_px)
    depth[good] = focal_px * baseline_m / found[good]
    return depth
