"""Calibrations as plain numbers: calib.txt of KITTI, and cameras.txt or cameras.bin of a COLMAP model."""

from __future__ import annotations

import struct

import numpy as np

from vplog.data import Floats
from vplog.logs.calibrations.camera import BadCalibrationError, CalibratedCamera, numbers_of, pinhole, size_of
from vplog.logs.messages.records import CalibrationMessage

_COLMAP = {
    "SIMPLE_PINHOLE": ("", "ffxy", ""),
    "PINHOLE": ("", "fgxy", ""),
    "SIMPLE_RADIAL": ("plumb_bob", "ffxy", "k000"),
    "RADIAL": ("plumb_bob", "ffxy", "kk00"),
    "OPENCV": ("plumb_bob", "fgxy", "kkpp"),
    "OPENCV_FISHEYE": ("equidistant", "fgxy", "kkkk"),
    "FULL_OPENCV": ("rational_polynomial", "fgxy", "kkppkkkk"),
}
"""COLMAP's camera models by their number (src/colmap/sensor/models.h): lens model, focal lengths and centre (`ff` is
one number for both), and the coefficients, where 0 is one that the model lacks."""
_CENTRE_PX = 0.5
"""px that COLMAP's origin, the corner of the image, lies before the centre of its first pixel."""
_MOST_CAMERAS = 100_000


def kitti_cameras(text: str) -> list[CalibratedCamera]:
    """`P0:` to `P3:`, each (3, 4), rectified; the first camera's frame is the body's. Raises BadCalibrationError."""
    rows = [line.partition(":") for line in text.splitlines() if line.startswith("P")]
    found = [(name, np.reshape(_floats(values.split(), 12), (3, 4))) for name, _, values in rows]
    if not found or any(p[0, 0] <= 0 or p[1, 1] <= 0 for _, p in found):
        raise BadCalibrationError("it has no P0 to P3 with twelve numbers each")
    return [CalibratedCamera(f"image_{name[1:]}", "", *_projected(p)) for name, p in found]


def _projected(p: Floats) -> tuple[CalibrationMessage, Floats, Floats]:
    """The calibration of P = K [I | t] (Geiger et al., Vision meets robotics, 2013), and its place."""
    from_first, placed = np.eye(4), np.eye(4)
    from_first[:3, 3] = np.linalg.solve(p[:, :3], p[:, 3])
    placed[:3, 3] = -from_first[:3, 3]
    return CalibrationMessage(0, "", 0, 0, "", np.zeros(0), p[:, :3], p), from_first, placed


def colmap_text(text: str) -> list[CalibratedCamera]:
    """`ID MODEL WIDTH HEIGHT PARAMS...` a line. Raises BadCalibrationError."""
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if not rows or any(len(row) < 5 for row in rows):
        raise BadCalibrationError("it has no line of camera number, model, width, height and parameters")
    return [_colmap(row[0], row[1], _floats(row[2:4], 2), _floats(row[4:], None)) for row in rows[:_MOST_CAMERAS]]


def colmap_binary(data: bytes) -> list[CalibratedCamera]:
    """cameras.bin. Raises BadCalibrationError."""
    found, names = [], [*_COLMAP]
    try:
        (count,), at = struct.unpack_from("<Q", data), 8
        for _ in range(min(count, _MOST_CAMERAS)):
            number, model, width, height = struct.unpack_from("<iiQQ", data, at)
            name = names[model] if 0 <= model < len(names) else str(model)
            values = struct.unpack_from(f"<{_parameters(name)}d", data, at + 24)
            at += 24 + 8 * len(values)
            found.append(_colmap(str(number), name, np.array([width, height], float), np.array(values)))
    except struct.error:
        raise BadCalibrationError("it ends within a camera") from None
    if not found:
        raise BadCalibrationError("it holds no camera")
    return found


def _parameters(model: str) -> int:
    """Count of a model's numbers. Raises BadCalibrationError."""
    if model not in _COLMAP:
        raise BadCalibrationError(f"camera model {model[:40]} is none of {', '.join(_COLMAP)}")
    _, pinhole_numbers, lens = _COLMAP[model]
    return len(set(pinhole_numbers)) + len(lens.replace("0", ""))


def _colmap(number: str, model: str, size: Floats, values: Floats) -> CalibratedCamera:
    if len(values) != _parameters(model):
        raise BadCalibrationError(f"camera {number[:20]} has {len(values)} parameters, {model} {_parameters(model)}")
    kind, layout, lens = _COLMAP[model]
    focal = values[[0, 0 if layout.startswith("ff") else 1]]
    first = len(set(layout))
    given = iter(values[first:])
    coefficients = np.array([0.0 if one == "0" else next(given) for one in lens])
    width, height = size_of(float(size[0])), size_of(float(size[1]))
    calibration = pinhole(focal, values[first - 2 : first] - _CENTRE_PX, (width, height), kind, coefficients)
    return CalibratedCamera(number, "", calibration)


def _floats(words: list[str], count: int | None) -> Floats:
    """Raises BadCalibrationError where they are not so many finite numbers."""
    try:
        return numbers_of([float(word) for word in words[:17]], count)
    except ValueError:
        raise BadCalibrationError(f"{' '.join(words)[:40]!r} are not numbers") from None
