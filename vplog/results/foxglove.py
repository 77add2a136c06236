"""Foxglove messages, each made from arrays by a plain function."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.GeoJSON_pb2 import GeoJSON
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.timestamp_pb2 import Timestamp

from vplog.data import Camera, Floats, Gps
from vplog.geometry import se3

PoseVector = list[float]
"""Position in m and quaternion x y z w of one pose."""
Rgba = tuple[float, float, float, float]

MAP, BODY, CAMERA, GPS = "map", "base_link", "camera", "gps"
"""Frames: the root, the body, the camera and the antenna fixed on it."""
REFERENCE, CLOSURE = "reference", "closure"
"""Frames of the two topics of pictures that are no view of the camera; they stand in the map's origin."""
RERUN_ROOT = "tf#/"
"""The frame that rerun's 3D view begins with; what does not hang on it is not drawn (rerun.io, named transforms)."""
IDENTITY: PoseVector = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
GREY, GREEN, RED, FAINT_RED = (0.6, 0.6, 0.6, 1.0), (0.1, 0.8, 0.2, 1.0), (0.9, 0.1, 0.1, 1.0), (0.9, 0.1, 0.1, 0.25)
BLUE, AMBER = (0.2, 0.5, 1.0, 1.0), (0.95, 0.7, 0.1, 1.0)
_LINE_PX = 2.0
"""Lines keep their width on the screen at any zoom."""
_FONT_PX = 14.0
_HUES: tuple[Rgba, ...] = (
    (1.0, 0.62, 0.18, 1.0), (0.3, 0.76, 1.0, 1.0), (1.0, 0.37, 0.66, 1.0), (0.73, 0.88, 0.29, 1.0),
    (0.72, 0.52, 1.0, 1.0), (1.0, 0.85, 0.2, 1.0), (0.2, 0.9, 0.75, 1.0), (1.0, 0.45, 0.35, 1.0), (0.7, 0.7, 0.7, 1.0),
)  # fmt: skip
"""One for each window, apart from each other and bright on grey pictures; a tenth window has the first."""
_DISTORTION = {"plumb_bob": "plumb_bob", "rational_polynomial": "rational_polynomial", "equidistant": "kannala_brandt"}
"""Our names of distortion models, as Foxglove's schema has them (equidistant in ROS is Kannala and Brandt's)."""


def camera_frame(number: int) -> str:
    """The frame of a camera by its number, the first one's being CAMERA."""
    return f"{CAMERA}_{number}" if number else CAMERA


def _time(stamp_ns: int) -> Timestamp:
    message = Timestamp()
    message.FromNanoseconds(stamp_ns)
    return message


def path(stamp_ns: int, poses: list[PoseVector]) -> PosesInFrame:
    """The poses of a path in the map."""
    message = PosesInFrame(frame_id=MAP, timestamp=_time(stamp_ns))
    for x, y, z, *q in poses:
        message.poses.add(position={"x": x, "y": y, "z": z}, orientation=dict(zip("xyzw", q, strict=True)))
    return message


def points(stamp_ns: int, poses: Floats, color: Rgba) -> PointCloud:
    """The positions of poses (R, 4, 4), all in one colour."""
    packed = np.zeros(len(poses), np.dtype([("position", "<f4", 3), ("color", "u1", 4)]))
    origin = se3.far_origin(poses)
    packed["position"] = poses[:, :3, 3] - origin
    packed["color"] = np.round(255 * np.array(color))
    data = packed.tobytes()
    message = PointCloud(timestamp=_time(stamp_ns), frame_id=MAP, point_stride=packed.itemsize, data=data)
    message.pose.position.SetInParent()  # rerun takes a position that is left out for one without a value
    message.pose.position.x, message.pose.position.y, message.pose.position.z = origin.tolist()
    message.pose.orientation.w = 1.0
    for at, name in enumerate("xyz"):
        message.fields.add(name=name, offset=4 * at, type=PackedElementField.FLOAT32)
    for at, name in enumerate(("red", "green", "blue", "alpha")):
        message.fields.add(name=name, offset=12 + at, type=PackedElementField.UINT8)
    return message


def transforms(stamp_ns: int, edges: Sequence[tuple[str, str, PoseVector]]) -> FrameTransforms:
    """Edges of the transform tree: (parent, child, parent_from_child)."""
    message = FrameTransforms()
    for parent, child, pose in edges:
        one = message.transforms.add(parent_frame_id=parent, child_frame_id=child, timestamp=_time(stamp_ns))
        one.translation.x, one.translation.y, one.translation.z = pose[:3]
        one.rotation.x, one.rotation.y, one.rotation.z, one.rotation.w = pose[3:]
    return message


def lines(stamp_ns: int, named: Sequence[tuple[str, Floats, Rgba]]) -> SceneUpdate:
    """One entity for each name, with its line segments (S, 2, 3) in m."""
    message = SceneUpdate()
    for name, segments, color in named:
        entity = message.entities.add(timestamp=_time(stamp_ns), frame_id=MAP, id=name)
        entity.metadata.add(key="edges", value=str(len(segments)))
        drawn = entity.lines.add(type=LinePrimitive.LINE_LIST, thickness=_LINE_PX, scale_invariant=True)
        drawn.pose.orientation.w = 1.0
        drawn.color.CopyFrom(_color(color))
        for x, y, z in segments.reshape(-1, 3).tolist():
            drawn.points.add(x=x, y=y, z=z)
    return message


def image(stamp_ns: int, frame_id: str, data: bytes) -> CompressedImage:
    """A JPEG."""
    return CompressedImage(timestamp=_time(stamp_ns), frame_id=frame_id, data=data, format="jpeg")


def calibration(stamp_ns: int, camera: Camera, size: tuple[int, int]) -> CameraCalibration:
    """The calibration of images resized to `size` px; (0, 0) is the centre of the top-left pixel before and after."""
    width, height = size
    message = CameraCalibration(timestamp=_time(stamp_ns), frame_id=CAMERA, width=width, height=height)
    if camera.matrix is None:
        return message
    by_x, by_y = width / camera.width, height / camera.height
    # the pixel's centre lies half a pixel from the image's edge at either size
    scale = np.array([[by_x, 0.0, 0.5 * by_x - 0.5], [0.0, by_y, 0.5 * by_y - 0.5], [0.0, 0.0, 1.0]])
    _set_pinhole(message, scale @ camera.matrix)
    if camera.distortion_model in _DISTORTION:
        message.distortion_model = _DISTORTION[camera.distortion_model]
        message.D.extend(camera.distortion.tolist())
    return message


def picture_calibration(stamp_ns: int, frame_id: str, size: tuple[int, int]) -> CameraCalibration:
    """A pinhole with the picture's width as focal length, for a picture that no camera of the drive took: rerun places
    an image by the pinhole of its frame, and marks a view as faulty where there is none."""
    width, height = size
    message = CameraCalibration(timestamp=_time(stamp_ns), frame_id=frame_id, width=width, height=height)
    _set_pinhole(message, np.array([[width, 0.0, (width - 1) / 2], [0.0, width, (height - 1) / 2], [0.0, 0.0, 1.0]]))
    return message


def _set_pinhole(message: CameraCalibration, matrix: Floats) -> None:
    """An unrotated camera (3, 3) without distortion."""
    message.K.extend(matrix.reshape(-1).tolist())
    message.R.extend(np.eye(3).reshape(-1).tolist())
    message.P.extend(np.column_stack([matrix, np.zeros(3)]).reshape(-1).tolist())


def boxes(stamp_ns: int, corners: Floats, size: tuple[int, int], title: str) -> ImageAnnotations:
    """Numbered boxes (I, 4) in shares of an image of that size in px, x0 y0 x1 y1; rows of NaN are left out."""
    message = ImageAnnotations()
    width, height = size
    for number, one in enumerate(corners.tolist()):
        if not np.isfinite(one).all():
            continue
        # each a little smaller than the one before, so that lines that would lie on each other are all visible
        inset = 1.0 + number % len(_HUES)
        x0, y0, x1, y1 = (share * side for share, side in zip(one, (width, height) * 2, strict=True))
        drawn = message.points.add(timestamp=_time(stamp_ns), type=PointsAnnotation.LINE_LOOP, thickness=_LINE_PX)
        drawn.outline_color.CopyFrom(_color(_HUES[number % len(_HUES)]))
        left, right, top, bottom = x0 + inset, x1 - inset, y0 + inset, y1 - inset
        for x, y in ((left, top), (right, top), (right, bottom), (left, bottom)):
            drawn.points.add(x=x, y=y)
        _label(message, stamp_ns, (left + 2.0, bottom - 2.0), str(number), _HUES[number % len(_HUES)])
    if title:
        _label(message, stamp_ns, (4.0, _FONT_PX + 2.0), title, (1.0, 1.0, 1.0, 1.0))
    return message


def _label(message: ImageAnnotations, stamp_ns: int, at: tuple[float, float], text: str, color: Rgba) -> None:
    label = message.texts.add(timestamp=_time(stamp_ns), text=text, font_size=_FONT_PX)
    label.position.x, label.position.y = at
    label.text_color.CopyFrom(_color(color))
    label.background_color.CopyFrom(_color((0.0, 0.0, 0.0, 0.6)))


def fix(gps: Gps, row: int) -> LocationFix:
    """One satellite fix; its covariance is in m^2, east, north, up."""
    message = LocationFix(
        timestamp=_time(int(gps.stamp_ns[row])),
        frame_id=GPS,
        latitude=float(gps.latitude_deg[row]),
        longitude=float(gps.longitude_deg[row]),
        altitude=float(gps.altitude_m[row]),
    )
    if "color" in LocationFix.DESCRIPTOR.fields_by_name:  # of newer schemas; rerun wants a value where it is known
        message.color.CopyFrom(_color(BLUE))
    covariance = gps.covariance[row]
    if np.isfinite(covariance).all():
        message.position_covariance.extend(covariance.reshape(-1).tolist())
        message.position_covariance_type = LocationFix.KNOWN
    return message


def geojson(tree: dict[str, Any]) -> GeoJSON:
    return GeoJSON(geojson=json.dumps(tree, separators=(",", ":"), allow_nan=False))


def _color(rgba: Rgba) -> Color:
    return Color(r=rgba[0], g=rgba[1], b=rgba[2], a=rgba[3])
