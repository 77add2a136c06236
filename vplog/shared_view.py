"""What two frames of a closure share: the matches that agree with one geometry, and boxes on the references of both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog import geometry
from vplog.boxes import boxes_of, references_of, windows_of
from vplog.loops import undistort
from vplog.loops.matching import match_features
from vplog.loops.verify_epipolar import agreeing
from vplog.places.hybrid import HybridState

if TYPE_CHECKING:
    from vplog.data import Bytes, Camera, Features, Float32s, Floats
    from vplog.loops.verify import VerifySettings

SHOWN = 4
"""References that are shown of a closure: more colours are not told apart."""
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
    """What they agree with; empty where no more agree with any one geometry than would by chance."""


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
    query: Features, match: Features, row: dict[str, Any], camera: Camera, settings: VerifySettings
) -> Agreement:
    """The matches as verification takes them, and those that the closure's pose puts on their epipolar lines.

    Where the ledger has no pose, those of the epipolar geometry with most matches.
    """
    mine, theirs = match_features(query, match, settings.matching)
    here, there = query.points[mine], match.points[theirs]
    if row["tx"] is not None and camera.matrix is not None:
        agrees = _on_epipolar_lines(here, there, row, camera, settings.metric.ransac_px)
        model = f"the ledger's pose (verification also asks for a known position, and counted {row['inliers']})"
        return Agreement(here, there, agrees, model)
    agrees, by_chance = agreeing(here, there, query.width, query.height, settings.epipolar)
    if by_chance:
        return Agreement(here, there, np.zeros(len(here), bool), "")
    return Agreement(here, there, agrees, "the epipolar geometry that most agree with")


def _on_epipolar_lines(here: Float32s, there: Float32s, row: dict[str, Any], camera: Camera, most_px: float) -> Any:
    """(K,) bool: by Sampson's distance (Hartley & Zisserman 2004, eq. 11.9), and in front of both cameras."""
    turn = geometry.rotation(np.array([row["qx"], row["qy"], row["qz"], row["qw"]]))
    body = geometry.pose(turn, np.array([row["tx"], row["ty"], row["tz"]]))
    match_from_query = geometry.inverse(camera.body_from_camera) @ body @ camera.body_from_camera
    rays = [np.column_stack([undistort.rays(camera, points), np.ones(len(points))]) for points in (here, there)]
    turned = rays[0] @ match_from_query[:3, :3].T
    shift, seen = match_from_query[:3, 3], rays[1]
    focal_px = undistort.focal_px(camera)
    with np.errstate(all="ignore"):
        if np.linalg.norm(shift) < _SAME_SPOT_M:
            error = np.linalg.norm(turned[:, :2] / turned[:, 2:] - seen[:, :2], axis=1)
            return (error * focal_px < most_px) & (turned[:, 2] > 0)
        essential = geometry.skew(shift) @ match_from_query[:3, :3]
        line, back = rays[0] @ essential.T, seen @ essential
        error = np.abs((line * seen).sum(axis=1)) / np.sqrt((line[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
        # the depths at which both rays meet, times the square of the sine between them
        across = np.cross(turned, seen)
        square = (across**2).sum(axis=1)
        depth = (np.cross(seen, shift) * across).sum(axis=1), (np.cross(turned, shift) * across).sum(axis=1)
        ahead = (depth[0] > 0) & (depth[1] > 0)
        far = square < (most_px / focal_px) ** 2  # parallel within the noise: at infinity, on either side of it
        return (error * focal_px < most_px) & (ahead | far)


def find_boxes(state: Any, query: Any, match: Any, references: list[int]) -> list[SharedBoxes]:
    """The shared references to draw, best first: their boxes, and the windows whose boxes agree best.

    Of windows that agree alike one is taken that no other reference has shown yet.
    """
    if isinstance(state, HybridState):
        state, query, match = state.bobb, query.boxes, match.boxes
    mine, theirs = boxes_of(state, query), boxes_of(state, match)
    result: list[SharedBoxes] = []
    used: list[int] = []
    for reference in references[:SHOWN]:
        [rank], [other] = (np.flatnonzero(boxes.references == reference) for boxes in (mine, theirs))
        here, there = mine.corners[rank], theirs.corners[other]
        common = _common(here, there)
        if not (common > 0).any():
            continue
        seen = np.isin(np.arange(len(here)), used)
        i, j = np.unravel_index(np.argmax(common - 1e-6 * seen[:, None] + 1e-9 * np.eye(len(here))), common.shape)
        used.append(int(i))
        windows = windows_of(state, int(rank))[i], windows_of(state, int(other))[j]
        image = references_of(state)[reference].image
        result.append(SharedBoxes(reference, image, here, there, *windows, (int(i), int(j))))
    return result


def _common(a: Floats, b: Floats) -> Floats:
    """(I, I) area that boxes (I, 4) have in common, 0 where there is none."""
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])
    return np.nan_to_num(np.maximum(high - low, 0.0).prod(axis=2))
