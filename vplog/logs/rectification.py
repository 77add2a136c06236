"""A stereo pair from two calibrated cameras: how far apart they are, and how their images are made to share rows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from vplog.data import Bytes, Camera, Floats
from vplog.geometry import se3
from vplog.logs.cameras import is_rectified, resized
from vplog.logs.messages.records import CalibrationMessage

Maps = tuple[np.ndarray, np.ndarray]

_BASELINES_M = (1e-3, 20.0)
"""m; endoscopes have 4 mm, stereo across a lorry's cab 2 m: anything outside is another unit, or another thing."""
MOST_TURN_RAD = np.radians(20.0)
"""Most that the two cameras may be turned: stereo heads are parallel to a few degrees, surround views 55 apart and
more."""
_REMAP_PX = 2**15
"""Sides from which cv2.remap takes no image."""
_CHECKED_FEATURES = 1000
"""ORB features of an image that are matched to see whether rows fit."""
_NEAR_BITS = 40
"""Bits of 256 that two descriptors of one point may differ by: unrelated ones differ by 64 and more (Rublee 2011)."""
_LEAST_MATCHES = 50
"""Matches from which a median is meaningful."""
CHECKED_FRAMES = 5
"""Frames, spread over the drive, whose rows are compared."""
MOST_ROWS_PX = 2.0
"""px; well rectified images are half a px off, and a match further away than this is none for stereo depth."""
_COMMON_ROWS_PX = MOST_ROWS_PX / 2
"""px by which rows of both images may be apart and still count as common."""
_SAME_PX = 0.25
"""px by which a pixel may move in rectification and still count as in its place: below a feature's noise."""


class NoPairError(Exception):
    """Two cameras are not a pair that depth can be had of."""


@dataclass(frozen=True, eq=False)
class Side:
    """One camera of the pair as the log calibrates it."""

    camera: Camera
    """With its matrix and distortion for the images as they come."""
    calibration: CalibrationMessage

    @property
    def rectified(self) -> bool:
        """The images are rectified already."""
        return is_rectified(self.camera.name, self.calibration)


@dataclass(frozen=True, eq=False)
class Pair:
    """A rectified pair."""

    camera: Camera
    """The left one, rectified, with the baseline."""
    maps: tuple[Maps | None, Maps | None]
    """Maps of cv2.remap for left and right images; None where they are rectified already."""
    right_down_px: float = 0.0
    """px by which rectified right images are moved down to share rows with the left ones."""

    def rectify(self, image: Bytes, side: int) -> Bytes:
        """(H, W) or (H, W, 3) uint8 the left (0) or right (1) image on the common rows."""
        # what lies outside the lens' view repeats its border: a black edge would be full of features
        if (found := self.maps[side]) is not None:
            image = np.asarray(cv2.remap(image, *found, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
        if side == 1 and self.right_down_px:
            down, size = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, self.right_down_px]]), image.shape[1::-1]
            image = np.asarray(cv2.warpAffine(image, down, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)
        return image

    def with_common_rows(self, rectified: Iterable[tuple[Bytes, Bytes]]) -> Pair:
        """Return the pair with its right images moved down by the px that rectified left and right images show.

        Raises NoPairError if rows are still `MOST_ROWS_PX` apart.
        """
        apart = rows_apart_px(rectified)
        if len(apart) < _LEAST_MATCHES:
            return self
        down_px = float(np.median(apart))
        down_px = down_px if abs(down_px) > _COMMON_ROWS_PX else 0.0
        if (error_px := float(np.median(np.abs(apart - down_px)))) > MOST_ROWS_PX:
            raise NoPairError(
                f"rectified by its calibration, its rows lie {error_px:.1f} px off those of the left image"
            )
        return replace(self, right_down_px=down_px)


def pair_of(left: Side, right: Side, right_from_left: Floats | None) -> Pair:
    """The pair by P and R of the two calibrations, else by the static transforms between the cameras (4, 4). Raises
    NoPairError with a reason that completes "The right image is not used: ..."."""
    if right.camera.matrix is None:
        raise NoPairError(f"{right.camera.name} is not calibrated")
    sizes = [(side.camera.width, side.camera.height) for side in (left, right)]
    if sizes[0] != sizes[1]:
        raise NoPairError(
            f"the left images have {sizes[0][0]} x {sizes[0][1]} px, the right ones {sizes[1][0]} x {sizes[1][1]}"
        )
    if max(sizes[0]) >= _REMAP_PX:
        raise NoPairError(f"images of {sizes[0][0]} x {sizes[0][1]} px cannot be rectified")
    projections = [_projection(side) for side in (left, right)]
    apart = [p[0, 3] / p[0, 0] if p[0, 0] > 0 else 0.0 for p in projections]
    if all(p[0, 0] > 0 for p in projections) and apart[0] != apart[1]:
        rotations = [_rotation(side.calibration) for side in (left, right)]
    elif right_from_left is not None:
        rotations, projections = _rectification(left, right, right_from_left)
        apart = [0.0, float(projections[1][0, 3] / projections[1][0, 0])]
    else:
        raise NoPairError(
            f"neither P of the calibrations of {left.camera.name} and {right.camera.name} nor static transforms say "
            "how far apart the two are"
        )
    baseline_m = apart[0] - apart[1]
    if -_BASELINES_M[1] < baseline_m < -_BASELINES_M[0]:
        raise NoPairError(
            f"{right.camera.name} lies {-baseline_m:.3f} m to the left of {left.camera.name}; swap --image-topic and "
            "--right-topic"
        )
    if not _BASELINES_M[0] < baseline_m < _BASELINES_M[1]:
        raise NoPairError(f"its distance of {baseline_m:.3g} m to the left camera is not a plausible baseline")
    matrices = [p[:, :3] for p in projections]
    (left_fy, left_cy), (right_fy, right_cy) = ((k[1, 1], k[1, 2]) for k in matrices)
    height = right.camera.height  # rows of rectified images correspond only where these parts of the matrices are equal
    if abs(left_cy - right_cy) + abs(left_fy / right_fy - 1) * height / 2 > _COMMON_ROWS_PX:  # at the edge
        raise NoPairError(f"P of the calibration of {right.camera.name} does not put the two images on common rows")
    maps = tuple(_maps(side, r, k) for side, r, k in zip((left, right), rotations, matrices, strict=True))
    turned = np.eye(4) if maps[0] is None else se3.pose(rotations[0].T, np.zeros(3))
    camera = replace(
        left.camera,
        matrix=matrices[0],
        distortion_model="none",
        distortion=np.zeros(0),
        body_from_camera=left.camera.body_from_camera @ turned,
        baseline_m=float(baseline_m),
        disparity_zero_px=float(matrices[0][0, 2] - matrices[1][0, 2]),
    )
    return Pair(camera, (maps[0], maps[1]))


def rows_apart_px(rectified: Iterable[tuple[Bytes, Bytes]]) -> Floats:
    """(K,) px by which features of left images lie below their matches in right ones."""
    orb, matcher = cv2.ORB.create(nfeatures=_CHECKED_FEATURES), cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    apart: list[float] = []
    for left, right in rectified:
        points, found = orb.detectAndCompute(left, None)
        others, theirs = orb.detectAndCompute(right, None)
        if found is None or theirs is None or not len(points) or not len(others):
            continue
        good = (match for match in matcher.match(found, theirs) if match.distance <= _NEAR_BITS)
        apart += [points[m.queryIdx].pt[1] - others[m.trainIdx].pt[1] for m in good]
    return np.array(apart)


def _projection(side: Side) -> Floats:
    """(3, 4) P for images of the size they really have; zero where unknown."""
    calibration, camera = side.calibration, side.camera
    known = np.isfinite(calibration.projection).all() and min(calibration.projection[[0, 1], [0, 1]]) > 0
    if not known or not (calibration.width and calibration.height):
        return calibration.projection if known else np.zeros((3, 4))
    x, y = camera.width / calibration.width, camera.height / calibration.height
    return resized(x, y) @ calibration.projection


def _rotation(calibration: CalibrationMessage) -> Floats:
    """(3, 3) rectified_from_camera; the identity where none is set. Raises NoPairError where it is no rotation."""
    rotation = calibration.rotation
    if not rotation.any():
        return np.eye(3)
    if not np.isfinite(rotation).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise NoPairError("R of the calibration is not a rotation")
    return rotation


def _rectification(left: Side, right: Side, right_from_left: Floats) -> tuple[list[Floats], list[Floats]]:
    """Rotations and projections that put both images on common rows (Bouguet's method, cv2.stereoRectify)."""
    angle = float(se3.angle(right_from_left[:3, :3]))
    if angle > MOST_TURN_RAD:
        raise NoPairError(f"the static transforms turn it by {np.degrees(angle):.0f} degrees against the left camera")
    shift = right_from_left[:3, 3]
    if abs(shift[1]) > abs(shift[0]) or abs(shift[2]) > 2 * abs(shift[0]):
        raise NoPairError("by the static transforms it does not lie beside the left camera")
    cameras = left.camera, right.camera
    matrices = [np.asarray(camera.matrix) for camera in cameras]
    if left.rectified or right.rectified:  # already on common rows; what is missing is the distance alone
        moved = np.array([[matrices[1][0, 0] * shift[0]], [0.0], [0.0]])
        return [np.eye(3)] * 2, [np.append(matrices[0], np.zeros((3, 1)), 1), np.append(matrices[1], moved, 1)]
    fisheye = [camera.distortion_model == "equidistant" for camera in cameras]
    if fisheye[0] != fisheye[1]:
        raise NoPairError("one camera is a fisheye and the other is not")
    size = cameras[0].width, cameras[0].height
    (k, other_k), (d, other_d) = matrices, [_coefficients(camera) for camera in cameras]
    turn, shift = np.ascontiguousarray(right_from_left[:3, :3]), np.ascontiguousarray(right_from_left[:3, 3:])
    flag = cv2.CALIB_ZERO_DISPARITY
    if fisheye[0]:
        found = cv2.fisheye.stereoRectify(k, d, other_k, other_d, size, turn, shift, flag)
    else:  # alpha 0: no pixel from outside the lens' view
        found = cv2.stereoRectify(k, d, other_k, other_d, size, turn, shift, flags=flag, alpha=0)
    r1, r2, p1, p2 = (np.asarray(part, np.float64) for part in found[:4])
    return [r1, r2], [p1, p2]


def _coefficients(camera: Camera) -> Floats:
    least = 4 if camera.distortion_model == "equidistant" else 5
    return camera.distortion if len(camera.distortion) else np.zeros(least)


def _maps(side: Side, rotation: Floats, matrix: Floats) -> Maps | None:
    """Maps of cv2.remap; None where rectification moves no pixel by more than _SAME_PX."""
    if side.rectified:
        return None
    camera = side.camera
    size, lens = (camera.width, camera.height), (np.asarray(camera.matrix), _coefficients(camera))
    if camera.distortion_model == "equidistant":
        x, y = cv2.fisheye.initUndistortRectifyMap(*lens, rotation, matrix, size, cv2.CV_32FC1)
    else:
        x, y = cv2.initUndistortRectifyMap(*lens, rotation, matrix, size, cv2.CV_32FC1)
    columns, rows = np.arange(size[0], dtype=np.float32), np.arange(size[1], dtype=np.float32)[:, None]
    if max(np.abs(x - columns).max(), np.abs(y - rows).max()) <= _SAME_PX:
        return None
    fixed = cv2.convertMaps(x, y, cv2.CV_16SC2)  # whole px and 32nds: half the memory, and remap is faster with them
    return np.asarray(fixed[0]), np.asarray(fixed[1])
