"""VSLAM-LAB (Fontan et al., 2025): rgb.csv or rgb.txt, calibration.yaml, groundtruth.csv or .txt, imu_0.csv."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vplog.errors import LogError
from vplog.logs.calibration_file import calibrations_beside
from vplog.logs.calibrations.camera import CalibratedCamera
from vplog.logs.datasets import tum_rgbd
from vplog.logs.datasets.streams import DataSet, Stream, camera_streams, depth_stream, imu_stream, mount_stream
from vplog.logs.datasets.text_tables import header_of, listed_images, poses_of, table_unit_ns, unit_ns


def roots(path: Path) -> list[Path]:
    calibrated = (path / "calibration.yaml").is_file()
    return [path] if (path / "rgb.csv").is_file() or ((path / "rgb.txt").is_file() and calibrated) else []


def read(path: Path, depth_per_m: float | None = None) -> DataSet:
    """The body is that of T_BS; without one the IMU, or else the first camera. `depth_per_m` are counts of a
    metre in the depth images, None as calibration.yaml has them. Raises LogError."""
    remarks = list[str]()
    cameras = {one.name: one for one in calibrations_beside(path / "calibration.yaml", remarks)}
    if (path / "rgb.csv").is_file():
        streams = _columns(path, cameras, depth_per_m, remarks)
    else:  # before 2025: one camera, in the lists of TUM RGB-D
        streams, more = tum_rgbd.listed_streams(path, next(iter(cameras.values()), None), depth_per_m)
        remarks += more
    if (imu := path / "imu_0.csv").is_file():
        streams.append(imu_stream("imu_0", imu))  # of the body, so that only T_BS places a camera
    elif all(one.body_from_camera is None for one in cameras.values()):
        streams += [mount_stream(one.channel.topic, one.stamp_ns[:1], np.eye(4)) for one in streams[:1]]
    truth = None
    if (table := path / "groundtruth.csv").is_file():
        truth = poses_of(table, table_unit_ns(table))
    elif (table := path / "groundtruth.txt").is_file():
        truth = poses_of(table, 10**9)
    return DataSet("vslam-lab", streams, truth, remarks)


def _columns(
    path: Path, cameras: dict[str, CalibratedCamera], depth_per_m: float | None, remarks: list[str]
) -> list[Stream]:
    """The streams of rgb.csv, whose columns are `ts_NAME (ns)`, or `(s)`, and `path_NAME` for each."""
    table = path / "rgb.csv"
    names = header_of(table)
    streams: list[Stream] = []
    for column, name in enumerate(names):
        topic = name.removeprefix("path_")
        if topic == name:
            continue
        stamped = next((i for i, other in enumerate(names) if other.split(" ")[0] == f"ts_{topic}"), None)
        if stamped is None:
            raise LogError(f"{table} has a column {name[:40]} without ts_{topic[:40]}. Copy the data set again.")
        listed = listed_images(table, path, unit_ns(names[stamped]), (stamped, column))
        image = topic.replace("depth", "rgb")
        camera = cameras.get(image, cameras.get(image.replace("rgb", "Camera")))  # before its list of cameras
        if not topic.startswith("depth"):
            streams += camera_streams(topic, *listed, camera)
        elif per_m := depth_per_m or (camera and camera.depth_per_m):
            streams.append(depth_stream(topic, *listed, per_m, image))
        else:
            remarks.append(f"{topic} is left out: no calibration has its counts a metre. Give one with --calibration.")
    return streams
