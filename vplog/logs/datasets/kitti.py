"""KITTI odometry (Geiger et al., 2012): sequences/NN with image_0 to image_3, calib.txt and times.txt; poses/NN.txt."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vplog.data import Ints, Trajectory
from vplog.errors import LogError
from vplog.geometry import se3
from vplog.logs.calibration_file import read_calibrations
from vplog.logs.datasets.streams import DataSet, camera_streams
from vplog.logs.datasets.text_tables import numbers_of, rows_of, stamps_ns
from vplog.logs.image_folder import below, image_files

_CAMERAS = ("image_0", "image_1", "image_2", "image_3")
"""Grey left and right, colour left and right."""
_FARTHEST_M, _ROTATED = 1e9, 0.1
"""m beyond which a number is damage, and the least that some entry of a rotation has: three make a unit row."""


def is_root(path: Path) -> bool:
    return (path / "times.txt").is_file() and any((path / name).is_dir() for name in _CAMERAS)


def roots(path: Path) -> list[Path]:
    """The sequences of a folder of KITTI's, or the folder itself."""
    return [path] if is_root(path) else [folder for folder in below(path / "sequences") if is_root(folder)]


def read(path: Path) -> DataSet:
    """The body is the grey left camera, whose poses are the truth. Raises LogError."""
    times = path / "times.txt"
    stamp_ns = stamps_ns(times, [row[0] for row in rows_of(times, 1)], 10**9)
    calibration = path / "calib.txt"
    cameras = {one.name: one for one in read_calibrations(calibration)} if calibration.is_file() else {}
    streams = []
    for name in _CAMERAS:
        files = [file for file in image_files(path / name) if file.stem.isdecimal()]
        if rows := [int(file.stem) for file in files]:
            if max(rows) >= len(stamp_ns):
                raise LogError(
                    f"{path / name} has an image {max(rows)}, and times.txt {len(stamp_ns)} rows only. Copy it again."
                )
            streams += camera_streams(name, stamp_ns[rows], files, cameras.get(name))
    return DataSet("kitti", streams, *_truth(path, stamp_ns))


def _truth(path: Path, stamp_ns: Ints) -> tuple[Trajectory | None, list[str]]:
    """poses/NN.txt beside the sequences: rows of world_from_camera (3, 4), one for each image; those without a pose are
    left out; and remarks."""
    named = (path.absolute(), path.resolve())  # of a link both: poses are a download of their own
    files = (one.parent.parent / "poses" / f"{one.name}.txt" for one in named)
    if (file := next((one for one in files if one.is_file()), None)) is None:
        return None, []
    rows, remarks = rows_of(file, 12), []
    if len(rows) != len(stamp_ns):
        remarks = [f"{file.name} has {len(rows)} poses, times.txt {len(stamp_ns)} rows: they are of the first images."]
    values = numbers_of(file, rows[: len(stamp_ns)], 0, 12).reshape(-1, 3, 4)
    usable = (np.abs(values) < _FARTHEST_M).all((1, 2)) & (np.abs(values[:, :, :3]).max((1, 2)) > _ROTATED)
    if not usable.any():
        raise LogError(f"{file} holds no pose. Copy the data set again.")
    u, _, v = np.linalg.svd(values[usable, :, :3])  # the nearest rotations: they have seven digits
    return Trajectory(stamp_ns[: len(values)][usable], se3.pose(u @ v, values[usable, :, 3])), remarks
