"""VSLAM-LAB (Fontan et al., 2025): rgb.csv or rgb.txt, calibration.yaml, groundtruth.csv or .txt, imu_0.csv."""

from __future__ import annotations

from pathlib import Path

from vplog.errors import LogError
from vplog.logs.calibration_file import read_calibrations
from vplog.logs.calibrations.camera import CalibratedCamera
from vplog.logs.datasets.streams import DataSet, Stream, camera_streams, depth_stream, imu_stream
from vplog.logs.datasets.text_tables import lines_of, listed_images, poses_of


def roots(path: Path) -> list[Path]:
    calibrated = (path / "calibration.yaml").is_file()
    return [path] if (path / "rgb.csv").is_file() or ((path / "rgb.txt").is_file() and calibrated) else []


def read(path: Path) -> DataSet:
    """The body is that of T_BS. Raises LogError."""
    calibration = path / "calibration.yaml"
    cameras = {one.name: one for one in read_calibrations(calibration)} if calibration.is_file() else {}
    if (path / "rgb.csv").is_file():
        streams = _columns(path, cameras)
    else:  # before 2025: one camera, in the lists of TUM RGB-D
        first = next(iter(cameras.values()))
        streams = camera_streams("rgb", *listed_images(path / "rgb.txt", path, 10**9), first)
    if (imu := path / "imu_0.csv").is_file():
        streams.append(imu_stream("imu_0", imu))
    truths = (("groundtruth.csv", 1), ("groundtruth.txt", 10**9))
    truth = next((poses_of(path / name, unit_ns) for name, unit_ns in truths if (path / name).is_file()), None)
    return DataSet("vslam-lab", streams, truth)


def _columns(path: Path, cameras: dict[str, CalibratedCamera]) -> list[Stream]:
    """The streams of rgb.csv, whose columns are `ts_NAME (ns)` and `path_NAME` for each."""
    table = path / "rgb.csv"
    _, head = next(lines_of(table), (0, ""))
    names = [name.strip() for name in head.split(",")]
    streams: list[Stream] = []
    for column, name in enumerate(names):
        topic = name.removeprefix("path_")
        if topic == name:
            continue
        stamped = next((i for i, other in enumerate(names) if other.split(" ")[0] == f"ts_{topic}"), None)
        if stamped is None:
            raise LogError(f"{table} has a column {name[:40]} without ts_{topic[:40]}. Copy the data set again.")
        listed = listed_images(table, path, 1, (stamped, column))
        camera = cameras.get(topic.replace("depth", "rgb"))
        if not topic.startswith("depth"):
            streams += camera_streams(topic, *listed, camera)
        elif camera is not None and camera.depth_per_m is not None:
            streams.append(depth_stream(topic, *listed, camera.depth_per_m, topic.replace("depth", "rgb")))
    return streams
