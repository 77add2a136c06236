"""Matches of the two frames of a closure that agree with one geometry, and boxes of both on their references."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from vplog.data import Bytes, Camera, Features, Float32s, Floats
from vplog.features.matching import match_features
from vplog.geometry import se3
from vplog.loops import undistort
from vplog.loops.verify import VerifySettings
from vplog.loops.verify_epipolar import epipolar_inliers
from vplog.stages import BoxState

SHOWN = 4
"""References that are shown of a closure: more colours are not distinct."""
_SAME_SPOT_M = 1e-6
"""Two cameras nearer than this differ by a turn alone."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """The feature matches of two frames, and which agree with one geometry."""

    query: Float32s
    """(K, 2) px."""
    match: Float32s
    agrees: np.ndarray
    """(K,) bool."""
    model: str
    """The geometry that they agree with; empty where no more agree with any than would by chance."""


@dataclass(frozen=True, eq=False)
class SharedBoxes:
    """A reference that explains both frames; all places are shares of an image's sides, x0 y0 x1 y1."""

    reference: int
    image: Bytes
    query_boxes: Floats
    """(I, 4) on the reference, NaN where nothing of a window is found."""
    match_boxes: Floats
    query_window: Floats
    """(4,) the part of the query whose box lies on one of the match's best."""
    match_window: Floats
    best: tuple[int, int]
    """The numbers of these two windows."""


def find_agreement(
    query: Features, match: Features, match_from_query: Floats, inliers: int, cameras: tuple[Camera, Camera],
    settings: VerifySettings,
) -> Agreement:  # fmt: skip
    """The matches as in verification, and those within the epipolar lines of the closure's pose (4, 4), which has so
    many inliers; where it is NaN, those of the epipolar geometry with most matches. `cameras` are the query's and the
    match's."""
    mine, theirs = match_features(query, match, settings.matching)
    here, there = query.points[mine], match.points[theirs]
    if np.isfinite(match_from_query).all() and all(one.matrix is not None for one in cameras):
        agrees = _on_epipolar_lines(here, there, match_from_query, cameras, settings.metric.ransac_px)
        model = f"the ledger's pose (verification also requires a known position, and counted {inliers})"
        return Agreement(here, there, agrees, model)
    agrees, by_chance = epipolar_inliers(here, there, query.width, query.height, settings.epipolar)
    if by_chance:
        return Agreement(here, there, np.zeros(len(here), bool), "")
    return Agreement(here, there, agrees, "the epipolar geometry that most agree with")


def _on_epipolar_lines(
    here: Float32s, there: Float32s, body: Floats, cameras: tuple[Camera, Camera], most_px: float
) -> Any:
    """(K,) bool: by Sampson's distance (Hartley & Zisserman 2004, eq. 11.9), and in front of both cameras."""
    match_from_query = se3.inverse(cameras[1].body_from_camera) @ body @ cameras[0].body_from_camera
    rays = [
        np.column_stack([undistort.rays(camera, points), np.ones(len(points))])
        for camera, points in zip(cameras, (here, there), strict=True)
    ]
    turned = rays[0] @ match_from_query[:3, :3].T
    shift, observed = match_from_query[:3, 3], rays[1]
    noise = [undistort.noise_of_rays(camera, one[:, :2], 1.0) for camera, one in zip(cameras, rays, strict=True)]
    with np.errstate(all="ignore"):
        if np.linalg.norm(shift) < _SAME_SPOT_M:
            error = turned[:, :2] / turned[:, 2:] - observed[:, :2]
            return (se3.mahalanobis2(error, noise[1]) < most_px**2) & (turned[:, 2] > 0)
        essential = se3.skew(shift) @ match_from_query[:3, :3]
        line, back = rays[0] @ essential.T, observed @ essential
        ends = ((line, noise[1]), (back, noise[0]))
        variance = sum(np.einsum("ki,kij,kj->k", one[:, :2], by_pixel, one[:, :2]) for one, by_pixel in ends)
        error_px = np.abs((line * observed).sum(axis=1)) / np.sqrt(variance)
        # the depths at which both rays meet, times the square of the sine between them
        across = np.cross(turned, observed)
        square = (across**2).sum(axis=1)
        depth = (np.cross(observed, shift) * across).sum(axis=1), (np.cross(turned, shift) * across).sum(axis=1)
        ahead = (depth[0] > 0) & (depth[1] > 0)
        # parallel within the noise: at infinity, on either side of it
        far = square < (most_px / undistort.focal_px(cameras[0])) ** 2
        return (error_px < most_px) & (ahead | far)


def find_boxes(state: BoxState, query: Any, match: Any, references: list[int]) -> list[SharedBoxes]:
    """The shared references that are drawn, best first: their boxes, and the windows whose boxes agree best.

    Of windows that agree alike one is taken that no other reference has shown yet.
    """
    mine, theirs = state.boxes(query), state.boxes(match)
    result: list[SharedBoxes] = []
    used: list[int] = []
    for reference in references[:SHOWN]:
        ranks, others = (np.flatnonzero(boxes.references == reference) for boxes in (mine, theirs))
        if not (len(ranks) and len(others)):  # described again with a condensed library
            continue
        rank, other = ranks[0], others[0]
        here, there = mine.corners[rank], theirs.corners[other]
        common = _common(here, there)
        if not (common > 0).any():
            continue
        repeated = np.isin(np.arange(len(here)), used)
        i, j = np.unravel_index(np.argmax(common - 1e-6 * repeated[:, None] + 1e-9 * np.eye(len(here))), common.shape)
        used.append(int(i))
        windows = state.windows(int(rank))[i], state.windows(int(other))[j]
        image = state.references[reference].image
        result.append(SharedBoxes(reference, image, here, there, *windows, (int(i), int(j))))
    return result


def _common(a: Floats, b: Floats) -> Floats:
    """(I, I) area that boxes (I, 4) have in common, 0 where there is none."""
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])
    return np.nan_to_num(np.maximum(high - low, 0.0).prod(axis=2))
