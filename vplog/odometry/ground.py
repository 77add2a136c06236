"""Metres for odometry in units of its own, by the known height of the camera over the ground.

Landmarks before the vehicle and below the camera are of the road, or of what stands on it: the ground is where the
lowest agree. Its slope to the camera's mount is one for the drive, its height one for each view (Song & Chandraker 2014
say how such heights hold a monocular scale).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import sparse

from vplog.data import SCALE_WANDER, Camera, Floats, Ints, Odometry
from vplog.odometry.metric_scale import random_walk, scaled, without_scale

_DEPRESSION = np.sin(np.radians(4.0))
"""Sine of the angle below the horizon: what is farther is low by a small error of the pitch alone."""
_LATERAL = 1.5
"""Heights to either side: a lane of 5 m from a car; beyond are kerbs and houses."""
_LEAST = 5
"""Landmarks of a view that give a height."""
_LEAST_VIEWS = 5
"""Views that show the ground, and their least share of all."""
_LEAST_SHARE = 0.2
_SPREAD = 0.15
"""Most relative deviation of landmarks below the ground, and of its height from view to view: more is no ground."""
_TUNING = 3.0
"""Sigmas beyond which a landmark is none of the ground (Tukey)."""
_FINEST = 0.01
"""Least relative deviation that is distinguished from zero."""
_ROUNDS = 40
_ACROSS = 1.0
"""Sigma of the log of the scale across a break."""
_HUBER = 2.0


class Below(NamedTuple):
    """Landmarks below the camera in one view."""

    row: int
    """Row of the frame in the odometry."""
    points: Floats
    """(K, 3) below, ahead, left of the camera in the axes of the body, in units."""


def below(row: int, points: Floats, camera: Camera) -> Below:
    """Landmarks of the ground, as far as their direction tells, among (K, 3) in the axes of the camera."""
    axes = camera.body_from_camera[[2, 0, 1], :3] * np.array([[-1.0], [1.0], [1.0]])
    found = points @ axes.T
    low = found[:, 0] > _DEPRESSION * np.linalg.norm(found, axis=1)
    return Below(row, found[low & (np.abs(found[:, 2]) < _LATERAL * found[:, 0]) & (found[:, 1] > 0)])


def by_height(odometry: Odometry, views: list[Below], height_m: float, camera: Camera) -> Odometry | None:
    """The odometry in metres, its scale as it wanders; None where the views do not show a ground."""
    known = [view for view in views if len(view.points) >= _LEAST]
    if len(known) < max(_LEAST_VIEWS, _LEAST_SHARE * len(views)):
        return None
    heights, spread = _heights(known)
    if spread > _SPREAD or not (heights > 0).all():
        return None
    rows = np.array([view.row for view in known])
    log_scale, left = _smoothed(odometry, rows, np.log(height_m / heights), spread)
    if left > _SPREAD:
        return None
    since, count = odometry.stamp_ns - odometry.stamp_ns[0], len(odometry.stamp_ns)
    bounds = np.concatenate([[0], odometry.breaks, [count]])
    piece_of = np.searchsorted(bounds, rows, "right") - 1
    scale, unmeasured = np.full(count, float(np.median(log_scale))), list[tuple[int, int]]()
    for piece, (a, b) in enumerate(pairwise(bounds.tolist())):
        inside = piece_of == piece
        if inside.any():
            scale[a:b] = np.interp(since[a:b], since[rows[inside]], log_scale[inside])
        else:
            unmeasured.append((a, b))
    metric = replace(scaled(odometry, np.exp(scale), camera), metric=True)
    return without_scale(metric, unmeasured, "view of the ground")


def _heights(views: list[Below]) -> tuple[Floats, float]:
    """(V,) of the camera over the ground in each view, and the relative deviation of landmarks of the ground. What
    stands on it is above, so that those below it tell their noise."""
    view = np.repeat(np.arange(len(views)), [len(one.points) for one in views])
    points = np.concatenate([one.points for one in views])
    height = np.array([np.median(one.points[:, 0]) for one in views])
    slope, spread = np.zeros(2), 0.0
    for _ in range(_ROUNDS):
        off = (points[:, 0] + points[:, 1:] @ slope) / height[view] - 1.0
        lower = off[off > 0]
        spread = max(1.4826 * float(np.median(lower)), _FINEST) if len(lower) else _FINEST
        weight = np.maximum(1.0 - (off / (_TUNING * spread)) ** 2, 0.0) ** 2 + 1e-6
        total = np.bincount(view, weight)
        mean = np.stack([np.bincount(view, weight * column) / total for column in points.T], axis=1)
        rest = (points - mean[view]) / height[view, None]
        A, b = rest[:, 1:] * weight[:, None], rest[:, 0]
        slope = -np.linalg.solve(A.T @ rest[:, 1:] + 1e-9 * np.eye(2), A.T @ b)
        height = np.maximum(mean[:, 0] + mean[:, 1:] @ slope, 1e-6)
    return height / np.sqrt(1.0 + slope @ slope), spread


def _smoothed(odometry: Odometry, rows: Ints, measured: Floats, spread: float) -> tuple[Floats, float]:
    """(V,) logs of a scale that wanders slowly, by those measured, and the deviation of these from it."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(odometry.odom_from_body[:, :3, 3], axis=0), axis=1))])
    sigma = SCALE_WANDER * np.sqrt(np.diff(way[rows]) + 1e-6)
    sigma[np.diff(np.searchsorted(odometry.breaks, rows, "right")) > 0] = _ACROSS
    smooth = random_walk(sigma)
    x, left = np.full(len(rows), float(np.median(measured))), spread
    for _ in range(_ROUNDS):
        weight = np.sqrt(np.minimum(1.0, _HUBER * left / np.maximum(np.abs(measured - x), 1e-9))) / left
        A = sparse.vstack([sparse.diags_array(weight), smooth])
        x = sparse.linalg.spsolve((A.T @ A).tocsc(), weight**2 * measured)
        left = max(1.4826 * float(np.median(np.abs(measured - x))), _FINEST)
    return x, left
