"""Depth of a depth camera beside the images' camera, brought to the px of the images."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vplog.data import Camera, Float32s, Floats
from vplog.errors import LogError
from vplog.geometry import se3
from vplog.logs.formats.container import Notes
from vplog.logs.rectification import MOST_TURN_RAD
from vplog.logs.tf_odometry import FrameTree, frame_name

_SAME_M, _SAME_RAD, _SAME_PX = 1e-3, np.radians(0.1), 1.0
"""Least distance and turn between two cameras, and difference of their matrices: below these it is a px or less."""
_STEPS, _CONVERGED = 50, 1e-5
"""Most fixed-point steps of undistortion, and the ray's change, a hundredth of a px, from which it goes no further:
OpenCV's five steps leave px of error in wide lenses."""


@dataclass(frozen=True, eq=False)
class DepthRegistration:
    """Mapping of the px of a depth image to those of the camera: register of depth_image_proc, with the lenses of both
    cameras, and without holes where the images have the finer px."""

    rays: Float32s
    """(H, W, 3) of the depth's px in the axes of the images' camera, of length 1 along the z of the depth's."""
    shift_m: Floats
    """(3,) the depth camera in the other one."""
    pinhole: Floats
    """fx, fy, cx, cy of a pinhole camera that sees all that the images show."""
    lens: Float32s
    """(H, W, 2) px of the images by px of the pinhole camera."""
    scales: Floats
    """px of the images by px of the pinhole camera, along x and y, and by px of the depth at equal depth."""

    def register(self, depth_m: Float32s) -> Float32s:
        """(H, W) m along the camera's z, NaN where none was measured; the nearest where several were."""
        from vplog.logs.depth_splat import splat  # numba loads here

        result = np.full(self.lens.shape[:2], np.nan, np.float32)
        splat(depth_m, self.rays, self.shift_m, self.pinhole, self.lens, self.scales, result)
        return result


def registration_of(
    depth: Camera, camera: Camera, frames: tuple[str, str], tree: FrameTree, notes: Notes
) -> DepthRegistration | None:
    """Registration of depth images, both cameras with the sizes of their images, by the names of the camera's and the
    depth's frames; None where they are registered already, or, with a note, where nothing says how. Raises LogError
    where they cannot be used, which completes "Depth is not used: "."""
    theirs, own = map(frame_name, frames)
    named = all(frame.strip("0123456789") for frame in (theirs, own))  # realsense-viewer names every frame 0
    camera_from_depth = tree.between(theirs, own) if named else None
    calibrated = depth.matrix is not None and camera.matrix is not None
    equal = not calibrated or float(np.abs(np.asarray(depth.matrix) - np.asarray(camera.matrix)).max()) < _SAME_PX
    fits = (depth.width, depth.height) == (camera.width, camera.height)
    apart = named and theirs != own
    if camera_from_depth is not None and calibrated:
        angle, distance_m = float(se3.angle(camera_from_depth)), float(np.linalg.norm(camera_from_depth[:3, 3]))
        if angle > MOST_TURN_RAD:
            raise LogError(f"{depth.name} looks another way than the images, by {np.degrees(angle):.0f} degrees.")
        if not fits or (apart and not (equal and angle < _SAME_RAD and distance_m < _SAME_M)):
            notes.add(f"{depth.name} is registered to the images by its calibration and the static transforms.")
            return _registration(depth, camera, camera_from_depth)
    if not fits:
        sizes = f"{depth.width} x {depth.height} px, the images {camera.width} x {camera.height}"
        raise LogError(f"{depth.name} has {sizes}.")
    if apart and (camera_from_depth is None or not calibrated):
        lacking = "calibration of both" if camera_from_depth is not None else "static transform between them"
        notes.add(
            f"{depth.name} is taken to be registered to the images, though its frame is {own} and theirs {theirs}: the "
            f"log has no {lacking} to register it by."
        )
    elif not apart and not equal:
        notes.add(f"{depth.name} is taken to be registered to the images, though its calibration is not theirs.")
    return None


@np.errstate(all="ignore")  # of a damaged calibration NaN comes, which is no depth
def _registration(depth: Camera, camera: Camera, camera_from_depth: Floats) -> DepthRegistration:
    px = np.stack(np.meshgrid(np.arange(depth.width), np.arange(depth.height)), axis=-1).reshape(-1, 1, 2)
    px, matrix, lens, zero = px.astype(np.float64), np.asarray(depth.matrix), depth.distortion, np.zeros(3)
    if depth.distortion_model == "equidistant":
        xy = cv2.fisheye.undistortPoints(px, matrix, lens)
    else:
        xy = cv2.undistortPoints(px, matrix, None)
        pinhole = xy.copy()
        for _ in range(_STEPS if lens.any() else 0):
            step = pinhole - cv2.projectPoints(cv2.convertPointsToHomogeneous(xy), zero, zero, np.eye(3), lens)[0]
            xy += step
            if np.abs(step).max() < _CONVERGED:
                break
    rays = cv2.convertPointsToHomogeneous(xy)[:, 0] @ camera_from_depth[:3, :3].T
    k, lens, size = np.asarray(camera.matrix), camera.distortion, (camera.width, camera.height)
    if camera.distortion_model == "equidistant":
        pinhole = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(k, lens, size, np.eye(3), balance=1.0)
        maps = cv2.fisheye.initUndistortRectifyMap(k, lens, np.eye(3), pinhole, size, cv2.CV_32FC1)
    else:
        pinhole = cv2.getOptimalNewCameraMatrix(k, lens, size, 1.0)[0] if lens.any() else k
        maps = cv2.initUndistortRectifyMap(k, lens if lens.any() else None, np.eye(3), pinhole, size, cv2.CV_32FC1)
    focal = np.array([pinhole[0, 0], pinhole[1, 1], matrix[0, 0], matrix[1, 1]])
    return DepthRegistration(
        rays.reshape(depth.height, depth.width, 3).astype(np.float32),
        camera_from_depth[:3, 3].copy(),
        np.array([pinhole[0, 0], pinhole[1, 1], pinhole[0, 2], pinhole[1, 2]]),
        np.stack(maps, axis=-1).astype(np.float32),
        np.array([k[0, 0], k[1, 1], k[0, 0], k[1, 1]]) / focal,
    )
