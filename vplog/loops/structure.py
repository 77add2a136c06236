"""Points of a drive in its solved frame: matches joined to tracks, and triangulated from the keyframes' poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import scipy

from vplog.data import Bools, Camera, Closures, Float32s, Floats, Ints, Structure
from vplog.features.matching import MatchSettings, match_features
from vplog.geometry import se3
from vplog.loops import undistort
from vplog.loops.landmarks import FeaturesOf

if TYPE_CHECKING:
    from vplog.execution.execution import Execution

_NEIGHBOURS = 3
"""Keyframes before each that its features are matched with."""
_LEAST_ANGLE = np.radians(1.5)
"""Between the rays of a point: COLMAP's own least (Schoenberger & Frahm, CVPR 2016)."""
_GATE_PX = 4.0
"""Reprojection error beyond which an observation leaves its track, as COLMAP's."""
_STEPS = 4
"""Gauss-Newton steps before each look at the errors; the linear start is within px."""


def pairs_to_match(keyframe: Mapping[int, Ints], closures: Closures) -> list[tuple[int, int]]:
    """Pairs (a, b), a < b, of images that share a view: neighbours, and the accepted closures that count. The images
    are those of one camera after the other, at the rows `keyframe` by its number, increasing."""
    begin = np.cumsum([0, *map(len, keyframe.values())])
    images = {one: image for image, one in enumerate((n, row) for n in keyframe for row in keyframe[n].tolist())}
    pairs = {
        (row - back, row)
        for first, end in pairwise(begin.tolist())
        for back in range(1, _NEIGHBOURS + 1)
        for row in range(first + back, end)
    }
    used = closures.rows(np.flatnonzero(closures.weight > 0.5))  # NaN where the solver never had it
    for a, row_a, b, row_b in zip(used.query_camera, used.query, used.match_camera, used.match, strict=True):
        ends = sorted(images[one] for one in ((a, row_a), (b, row_b)) if one in images)
        if len(ends) == 2:  # a condensed map describes some of the pictures alone
            pairs.add((ends[0], ends[1]))
    return sorted(pairs)


def triangulate(
    world_from_camera: Floats,
    cameras: Sequence[Camera],
    features: FeaturesOf,
    pairs: Sequence[tuple[int, int]],
    matching: MatchSettings,
    execution: Execution,
) -> Structure:
    """Points of images (N, 4, 4) of N cameras by the matches of `pairs`, two observations or more each."""

    def matches(pair: tuple[int, int]) -> tuple[Ints, Ints]:
        return match_features(features(pair[0]), features(pair[1]), matching)

    found = list(execution.counted("match", execution.map(matches, pairs), len(pairs)))
    counts = [len(features(row)) for row in range(len(world_from_camera))]
    image, row, track = tracks(counts, pairs, found)
    px = np.empty((len(image), 2), np.float32)
    for one in np.unique(image).tolist():
        here = image == one
        px[here] = features(one).points[row[here]]
    return points_of(world_from_camera, cameras, image, track, px)


def tracks(
    counts: Sequence[int], pairs: Sequence[tuple[int, int]], found: Sequence[tuple[Ints, Ints]]
) -> tuple[Ints, Ints, Ints]:
    """Image, row of its feature, and track of each observation (O,), by image, of images with `counts` features.

    A track that has two features of one image joins two points, and is left out.
    """
    start = np.concatenate([[0], np.cumsum(counts)])
    ends = [(start[a] + rows[0], start[b] + rows[1]) for (a, b), rows in zip(pairs, found, strict=True)]
    first, second = (np.concatenate([np.empty(0, np.int64), *(end[i] for end in ends)]) for i in (0, 1))
    graph = scipy.sparse.coo_matrix((np.ones(len(first), bool), (first, second)), shape=(start[-1], start[-1]))
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    node = np.unique(np.concatenate([first, second]))
    image = np.searchsorted(start, node, side="right") - 1
    _, number, size = np.unique(label[node] * len(counts) + image, return_inverse=True, return_counts=True)
    clean = np.ones(label.max(initial=-1) + 1, bool)
    clean[label[node[size[number] > 1]]] = False
    node, image = node[clean[label[node]]], image[clean[label[node]]]
    return image, node - start[image], np.unique(label[node], return_inverse=True)[1]


def points_of(
    world_from_camera: Floats, cameras: Sequence[Camera], image: Ints, track: Ints, px: Float32s
) -> Structure:
    """Points of tracks of observations `px` (O, 2) in images (O,) of N cameras, by least squares of the reprojection
    error; what is more than _GATE_PX off leaves its track."""
    rays, px_from_ray = np.empty((len(px), 2)), np.full((len(px), 2, 2), np.nan)
    for one in np.unique(image).tolist():
        here = np.flatnonzero(image == one)
        rays[here] = undistort.rays(cameras[one], px[here])
        known = here[np.isfinite(rays[here]).all(axis=1)]
        px_from_ray[known] = undistort.px_from_ray(cameras[one], rays[known])
    rows = np.flatnonzero(np.isfinite(rays).all(axis=1))
    camera_from_world = se3.inverse(world_from_camera)
    points, error_px = np.empty((0, 3)), np.full(len(rays), np.nan)
    for gate in (4 * _GATE_PX, _GATE_PX):
        rows = rows[np.bincount(track[rows], minlength=1)[track[rows]] > 1]
        own, view = np.unique(track[rows], return_inverse=True)[1], camera_from_world[image[rows]]
        points, wide = _linear(world_from_camera[image[rows]], rays[rows], own)
        for _ in range(_STEPS):
            error, jacobian, _ = _residuals(points, view, rays[rows], px_from_ray[rows], own)
            points = points - _step(error, jacobian, own, len(points))
        error, _, front = _residuals(points, view, rays[rows], px_from_ray[rows], own)
        length = np.linalg.norm(error, axis=1)
        good = front & (length < gate) & wide[own]
        error_px[:] = np.nan
        error_px[rows[good]] = length[good]
        last, rows = rows, rows[good]
    return _structure(points, image[last], np.unique(track[last], return_inverse=True)[1], px[last], error_px[last])


def _structure(points: Floats, image: Ints, track: Ints, px: Float32s, error_px: Floats) -> Structure:
    """Points with two observations of known error or more."""
    good = np.isfinite(error_px)
    good &= np.bincount(track[good], minlength=len(points))[track] > 1
    used, track = np.unique(track[good], return_inverse=True)
    mean = np.bincount(track, error_px[good], len(used)) / np.maximum(np.bincount(track, minlength=len(used)), 1)
    return Structure(points[used], mean, track, image[good], px[good])


def _linear(world_from_camera: Floats, rays: Floats, track: Ints) -> tuple[Floats, Bools]:
    """(P, 3) nearest to the rays of each track, and whether these open by _LEAST_ANGLE.

    The least eigenvalue of the sum of I - d d^T is 1 - cos of the angle of two directions d.
    """
    direction = np.column_stack([rays, np.ones(len(rays))])
    direction = (world_from_camera[:, :3, :3] @ direction[..., None])[..., 0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    across = np.eye(3) - direction[:, :, None] * direction[:, None]
    count = track.max(initial=-1) + 1
    total = _sums(across, track, count)
    target = _sums(across @ world_from_camera[:, :3, 3:], track, count)
    wide = np.linalg.eigvalsh(total)[:, 0] >= 1 - np.cos(_LEAST_ANGLE)
    return np.asarray(np.linalg.solve(total + 1e-12 * np.eye(3), target)[..., 0], np.float64), wide


def _residuals(
    points: Floats, camera_from_world: Floats, rays: Floats, px_from_ray: Floats, track: Ints
) -> tuple[Floats, Floats, Bools]:
    """Errors (O, 2) in px, their derivatives (O, 2, 3) by the point, and which points lie before their camera."""
    rotation = camera_from_world[:, :3, :3]
    in_camera = (rotation @ points[track][..., None])[..., 0] + camera_from_world[:, :3, 3]
    front = in_camera[:, 2] > 0
    depth = np.where(front, in_camera[:, 2], 1.0)[:, None]
    image = in_camera[:, :2] / depth
    by_camera = np.concatenate([np.tile(np.eye(2), (len(image), 1, 1)), -image[..., None]], axis=2) / depth[..., None]
    error = (px_from_ray @ (image - rays)[..., None])[..., 0]
    jacobian = px_from_ray @ by_camera @ rotation
    jacobian[~front] = 0.0
    return error, jacobian, front


def _step(error: Floats, jacobian: Floats, track: Ints, count: int) -> Floats:
    """(P, 3) Gauss-Newton step with Huber's weights: beyond a px an error counts linearly."""
    weight = 1.0 / np.maximum(np.linalg.norm(error, axis=1), 1.0)
    transposed = np.swapaxes(jacobian, 1, 2) * weight[:, None, None]
    hessian = _sums(transposed @ jacobian, track, count)
    hessian += (1e-9 * np.trace(hessian, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
    return np.linalg.solve(hessian, _sums(transposed @ error[..., None], track, count))[..., 0]


def _sums(values: Floats, track: Ints, count: int) -> Floats:
    """Sum of the values (O, ...) of each of `count` tracks."""
    flat = values.reshape(len(values), -1)
    ones = np.ones(len(track)), (track, np.arange(len(track)))
    summed = scipy.sparse.coo_matrix(ones, shape=(count, len(track))).tocsr() @ flat
    return summed.reshape(count, *values.shape[1:])
