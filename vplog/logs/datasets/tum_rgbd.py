"""TUM RGB-D (Sturm et al., 2012): rgb.txt and depth.txt with a stamp and a file a line, groundtruth.txt."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from vplog.logs.calibrations.camera import CalibratedCamera, pinhole
from vplog.logs.datasets.streams import DataSet, Stream, camera_streams, depth_stream, mount_stream
from vplog.logs.datasets.text_tables import listed_images, poses_of

_PER_M = 5000.0
"""Counts of a metre in the depth images (cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats)."""
_ASSUMED = (
    "No calibration names the counts of a metre in the depth images; 5000 are taken, as in TUM RGB-D. --calibration "
    "takes them from a file (RGBD.DepthMapFactor of ORB-SLAM)."
)
_CALIBRATIONS = {
    "1": ((517.3, 516.5), (318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0), (325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2), (320.1, 247.6), ()),
}
"""Focal lengths, principal point and lens of the colour cameras freiburg1 to 3 as they are published beside the data
(file_formats, Intrinsic Camera Calibration of the Kinect); no file of a sequence holds them."""
_SIZE = (640, 480)


def roots(path: Path) -> list[Path]:
    found = (path / "rgb.txt").is_file() and not (path / "calibration.yaml").is_file()
    return [path] if found else []


def read(path: Path, depth_per_m: float | None = None) -> DataSet:
    """The body is the colour camera, whose poses are the truth. `depth_per_m` are counts of a metre in the depth
    images, where they are known. Raises LogError."""
    streams, remarks = listed_streams(path, _calibration(path), depth_per_m)
    streams.append(mount_stream("rgb", streams[0].stamp_ns[:1], np.eye(4)))
    truth = path / "groundtruth.txt"
    return DataSet("tum-rgbd", streams, poses_of(truth, 10**9) if truth.is_file() else None, remarks)


def listed_streams(
    path: Path, camera: CalibratedCamera | None, depth_per_m: float | None
) -> tuple[list[Stream], list[str]]:
    """The streams of rgb.txt and depth.txt, and remarks. Raises LogError."""
    streams, remarks = camera_streams("rgb", *listed_images(path / "rgb.txt", path, 10**9), camera), []
    if (path / "depth.txt").is_file():
        per_m = depth_per_m or (camera and camera.depth_per_m)
        if per_m is None:
            remarks = [_ASSUMED]
        listed = listed_images(path / "depth.txt", path, 10**9)
        streams.append(depth_stream("depth", *listed, per_m or _PER_M, "rgb"))
    return streams, remarks


def _calibration(path: Path) -> CalibratedCamera | None:
    """Calibration of the camera that the folder or the comments of its lists name."""
    with (path / "rgb.txt").open("rb") as stream:
        named = re.search(r"freiburg([123])", f"{path.resolve().name} {stream.read(1000)!r}")
    if named is None:
        return None
    focal, centre, lens = (np.array(values, np.float64) for values in _CALIBRATIONS[named[1]])
    return CalibratedCamera("rgb", "", pinhole(focal, centre, _SIZE, "plumb_bob", lens), depth_per_m=_PER_M)
