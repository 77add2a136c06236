"""The camera of a drive: its matrix from a calibration, its place on the body from static transforms."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from vplog.data import Camera, Floats, Odometry
from vplog.geometry import se3
from vplog.logs.formats.container import Notes
from vplog.logs.messages.records import CalibrationMessage
from vplog.logs.tf_odometry import BODIES, FrameTree, frame_name

_LENSES = {
    "plumb_bob": ("plumbbob", "radtan", "radialtangential", "brownconrady", "rationalpolynomial", ""),
    "equidistant": ("equidistant", "equid", "kannalabrandt", "fisheye", "opencvfisheye"),
}
"""Names that drivers (RealSense: brown_conrady, kannala_brandt4) and calibration tools (Kalibr: radtan, equid4) write,
letters alone, by vplog's: OpenCV's polynomial, which is plumb_bob where it has no denominator, and its fisheye."""
_COUNTS = {
    "plumb_bob": dict.fromkeys((4, 5), "plumb_bob") | dict.fromkeys((8, 12, 14), "rational_polynomial"),
    "equidistant": {4: "equidistant"},
}
"""Numbers of coefficients that OpenCV takes of each lens, and the model that they make."""
BODY = "base_link"
"""The body's frame where the odometry names none: ROS REP 105."""
AHEAD = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""body_from_camera of a camera that looks along the body's x, upright: ROS REP 103."""
_UP = 0.7
"""Least z of an axis that points up, within 45 degrees: cameras are pitched by less."""
_STRAIGHT = 0.9
"""Share of an odometry's way along the x of a body that goes ahead along it, as wheels do. A camera carried by hand has
less along any axis."""
_LARGEST_PX = 1e7
"""px; a longer focal length is damage: telescopes have 1e6."""
_SAME_PX = 1.0
"""px that a calibration that came later may move the image's corners without being another: focus moves them."""
_CENTRED = 0.2
"""Share of an image that its principal point may lie off the middle in both axes: lenses are a few % off, images that
were cropped in one of them; in images of half or twice the size it lies off by 0.5 or 0.25."""
_OFF = 0.08
"""Share of an image that a principal point is off the middle in one axis where K is that of larger ones: KITTI's by .1
to .18; lenses are a few % off."""
_SAME_SHAPE = 0.01
"""Relative difference of the scales in x and y below which a resized image still fits its calibration: rounding."""


def camera_of(name: str, calibration: CalibrationMessage | None, size: tuple[int, int], notes: Notes) -> Camera:
    """The camera of images of `size` (width, height; 0 unknown), body_from_camera still the identity. Images of a topic
    named image_rect... are rectified: their matrix is that of P, without distortion (sensor_msgs/CameraInfo)."""
    width, height = size
    unknown = Camera(name, None, "none", np.zeros(0), width, height, np.eye(4))
    if calibration is None:
        return unknown
    matrix, model, distortion = calibration.matrix, calibration.model, calibration.distortion
    if is_rectified(name, calibration) and calibration.projection[0, 0] > 0:
        matrix, model, distortion = calibration.projection[:, :3], "", np.zeros(0)
        if not is_rectified(name):
            notes.add(
                f"The images of {name} are taken to be rectified, as those of kitti2bag: the centre of K is not that "
                "of the images, that of P is. Where they are raw, give another calibration with --calibration."
            )
    if not ((np.abs(matrix) < _LARGEST_PX).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        notes.add(f"{name} is uncalibrated: its K is not set (K[0] = {matrix[0, 0]:g}). Give one with --calibration.")
        return unknown
    known = _model(model, distortion)
    if known is not None and known[0] == "equidistant" and not known[1].any():
        notes.add(
            f"The calibration of {name} is that of a fisheye without coefficients, an ideal one. Where its images are "
            "rectified, give the matrix of a pinhole with --calibration."
        )
    if known is None:
        notes.add(
            f"The calibration of {name} has {len(distortion)} coefficients of the distortion model {model[:40]!r}, "
            "which is none of plumb_bob, rational_polynomial, equidistant, so the camera is uncalibrated. "
            "Give one with --calibration."
        )
        return unknown
    camera = replace(unknown, distortion_model=known[0], distortion=known[1])
    return _fit(camera, matrix, calibration, notes)


def camera_from_image(camera: Camera, size: tuple[int, int], calibration: CalibrationMessage | None) -> Floats | None:
    """(2, 3) from px of an image of `size` to px of the camera, the identity where they differ by less than a px. By
    the image's own calibration; else, where the shape is the same, by scale. None where it is another."""
    if calibration is None and size == (camera.width, camera.height):
        return np.eye(2, 3)
    own = None if calibration is None else camera_of(camera.name, calibration, size, Notes())
    if camera.matrix is not None and own is not None and own.matrix is not None:
        found = (camera.matrix @ np.linalg.inv(own.matrix))[:2]
    else:
        x, y = camera.width / size[0], camera.height / size[1]
        if abs(x - y) > _SAME_SHAPE * max(x, y):
            return None
        found = resized(x, y)[:2]
    corners = np.array([[0, 0, 1], [size[0], 0, 1], [0, size[1], 1], [*size, 1]], np.float64)
    moved = np.abs(corners @ found.T - corners[:, :2]).max()
    return np.eye(2, 3) if size == (camera.width, camera.height) and moved < _SAME_PX else found


def resized(x: float, y: float) -> Floats:
    """(3, 3) from px of an image to those of it scaled by x and y: about its corner, which lies at -0.5."""
    return np.array([[x, 0.0, (x - 1) / 2], [0.0, y, (y - 1) / 2], [0.0, 0.0, 1.0]])


def is_rectified(topic: str, calibration: CalibrationMessage | None = None) -> bool:
    """image_proc and stereo_image_proc name their output so. kitti2bag does not, and its `calibration` has K of the raw
    images, which are larger: its axis is far off the middle, that of P is not. Of cropped raw images both axes are off
    by one angle."""
    if "image_rect" in topic or calibration is None:
        return "image_rect" in topic
    raw, rectified = calibration.matrix, calibration.projection[:, :3]
    size = np.array([calibration.width, calibration.height], np.float64)
    if not size.all() or min(*raw[[0, 1], [0, 1]], *rectified[[0, 1], [0, 1]]) <= 0:
        return False
    off_px = [k[:2, 2] - size / 2 for k in (raw, rectified)]
    angles = [np.linalg.norm(off / k[[0, 1], [0, 1]]) for off, k in zip(off_px, (raw, rectified), strict=True)]
    return bool((off_px[0] > 0).all() and (off_px[0] > _OFF * size).any() and angles[1] < angles[0] / 2)


def lens_of(name: str) -> str | None:
    """`plumb_bob` (OpenCV's polynomial, whatever its length) or `equidistant`; None where the name is not known."""
    letters = re.sub(r"[^a-z]", "", name.lower())
    return next((lens for lens, names in _LENSES.items() if letters in names), None)


def _model(name: str, coefficients: Floats) -> tuple[str, Floats] | None:
    """Model and coefficients in vplog's names; None where the model is not known. As in OpenCV their number tells which
    polynomial it is; zeros behind the last (RealSense's fisheye has five) are left out."""
    if not np.isfinite(coefficients).all():
        return None
    if not coefficients.any():
        return ("equidistant", np.zeros(4)) if lens_of(name) == "equidistant" else ("none", np.zeros(0))
    given, used = len(coefficients), int(np.flatnonzero(coefficients)[-1]) + 1
    counts = _COUNTS.get(lens_of(name) or "", {})
    count = given if given in counts else min((n for n in counts if used <= n < given), default=0)
    return (counts[count], coefficients[:count]) if count else None


def _fit(camera: Camera, matrix: Floats, calibration: CalibrationMessage, notes: Notes) -> Camera:
    """The camera for the size its images really have."""
    width, height, images = calibration.width, calibration.height, (camera.width, camera.height)
    unknown = replace(camera, distortion_model="none", distortion=np.zeros(0))
    if not (width and height) and all(images) and np.abs(matrix[:2, 2] / images - 0.5).min() > _CENTRED:
        notes.add(
            f"{camera.name} is uncalibrated: the centre of its calibration, which has no size, at "
            f"({matrix[0, 2]:.1f}, {matrix[1, 2]:.1f}) px is far from that of images of {images[0]} x {images[1]} px. "
            "Is it of images of another size? Give one with its size with --calibration."
        )
        return unknown
    if not (width and height) or images in ((width, height), (0, 0)):
        size = (camera.width or width, camera.height or height)
        return replace(camera, matrix=matrix, width=size[0], height=size[1])
    x, y = camera.width / width, camera.height / height
    sizes = f"{camera.width} x {camera.height} px, its calibration {width} x {height}"
    if abs(x - y) > _SAME_SHAPE * max(x, y):
        notes.add(f"{camera.name} is uncalibrated: its images have {sizes}. Give another with --calibration.")
        return unknown
    notes.add(f"The images of {camera.name} have {sizes}; the matrix is scaled to the images.")
    return replace(camera, matrix=resized(x, y) @ matrix)


def optical_frame(tree: FrameTree, body: str, frame: str, odometry: Odometry | None, notes: Notes) -> str:
    """Frame of a camera, z ahead. Where `frame`, that of its images, has x ahead, as of drivers that know no other and
    are placed without a turn, it is added to the tree, with a note. z is up in a base_link (REP 103), unless it is the
    way that the odometry mostly goes."""
    placed = tree.between(body, frame) if _is_base(body) and "optical" not in frame else None
    if placed is None or abs(placed[2, 2]) < _UP or np.argmax(_along(odometry)) == 2:
        return frame
    if placed[2, 2] < 0:
        notes.add(
            f"{frame} looks down by the static transforms. Where it has x ahead (REP 103) and hangs upside down, "
            "give its mount with --calibration."
        )
        return frame
    notes.add(
        f"{frame} looks up by the static transforms; it is taken for a frame with x ahead (REP 103), not an optical "
        "one. Where the camera does look up, give its mount with --calibration."
    )
    tree.add(frame_name(frame), optical := f"{frame_name(frame)} (optical)", AHEAD)
    return optical


def _is_base(body: str) -> bool:
    return body.rsplit("/", 1)[-1] in BODIES


def _along(odometry: Odometry | None) -> Floats:
    """(3,) shares of an odometry's way along the body's axes; zero where it does not move."""
    if odometry is None:
        return np.zeros(3)
    steps = se3.between(odometry.odom_from_body[:-1], odometry.odom_from_body[1:])[:, :3, 3]
    return np.abs(steps).sum(0) / max(float(np.linalg.norm(steps, axis=1).sum()), 1e-9)


def _drives(odometry: Odometry | None) -> bool:
    """Whether the body goes ahead along its x and turns about its z, as a vehicle; a camera that looks aside and goes
    along x turns about its y."""
    if odometry is None or _along(odometry)[0] < _STRAIGHT:
        return False
    steps = se3.between(odometry.odom_from_body[:-1], odometry.odom_from_body[1:])
    turned = np.abs(se3.so3_log(steps[:, :3, :3])).sum(0)
    return bool(steps[:, 0, 3].sum() > 0 and turned[2] == turned.max())


def body_from_camera(
    tree: FrameTree, body: str, frame: str, notes: Notes, odometry: Odometry | None = None, ahead: bool = False
) -> Floats:
    """(4, 4) through the static transforms; without a chain a guess, noted: a camera that looks along x where `ahead`,
    on a base_link (REP 103), and where `odometry` goes along x; else, and where it goes along z, the identity. `body`
    is the odometry's child frame, empty where its type has none; `frame` is the image's frame_id."""
    if not body and BODY in tree:
        body = BODY
        if not ahead:
            notes.add(f"The odometry names no body frame; {BODY} of the static transforms is taken.")
    if body and frame and (found := tree.between(body, frame)) is not None:
        tree.note_changes(body, frame, notes)
        return found
    if ahead:
        if len(tree):  # a folder of images has none
            notes.add(
                "The static transforms do not place the camera; it is assumed at the body's origin, looking ahead."
            )
        return AHEAD.copy()
    along_x = np.argmax(_along(odometry)) != 2 if _is_base(body) else "optical" not in body and _drives(odometry)
    if len(tree) or (body and frame) or along_x:
        notes.add(
            f"No static transforms lead from the body {body or '(not named)'} to the camera's frame "
            f"{frame or '(not named)'}; the camera is taken to sit at the body and look along its "
            f"{'x' if along_x else 'z'}. Where it does not, give its mount with --calibration."
        )
    return AHEAD.copy() if along_x else np.eye(4)
