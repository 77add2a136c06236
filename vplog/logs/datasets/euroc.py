"""EuRoC's ASL layout (Burri et al., 2016), and TUM VI's: mav0 with camN, imuN and a ground truth."""

from __future__ import annotations

from pathlib import Path

from vplog.logs.calibration_file import calibrations_beside
from vplog.logs.datasets.streams import DataSet, Stream, camera_streams, imu_stream
from vplog.logs.datasets.text_tables import listed_images, poses_of, table_unit_ns
from vplog.logs.image_folder import below, image_files, named_stamps

_POSES = ("state_groundtruth_estimate0", "gt0", "mocap0", "vicon0")
"""Folders with poses, the best first: of the body, of the IMU in TUM VI, of a marker."""


def roots(path: Path) -> list[Path]:
    """The folder that holds the sensors, with `mav0` or `path` itself."""
    return [folder for folder in (path, path / "mav0") if (folder / "cam0" / "data").is_dir()][:1]


def read(path: Path) -> DataSet:
    """The body is that of T_BS, EuRoC's IMU. Raises LogError."""
    streams, remarks = list[Stream](), list[str]()
    for folder in below(path):
        if folder.name.startswith("cam"):
            streams += _camera(folder, remarks)
        elif folder.name.startswith("imu") and (folder / "data.csv").is_file():
            streams.append(imu_stream(folder.name, folder / "data.csv"))
    truths = [path / name / "data.csv" for name in _POSES]
    found = next((file for file in truths if file.is_file()), None)
    truth = None if found is None else poses_of(found, table_unit_ns(found), scalar_first=True)
    return DataSet("euroc", streams, truth, remarks)


def _camera(folder: Path, remarks: list[str]) -> list[Stream]:
    if (table := folder / "data.csv").is_file():
        stamp_ns, files = listed_images(table, folder / "data", table_unit_ns(table))
    else:
        files = image_files(folder / "data")
        stamp_ns, _ = named_stamps(files)
    camera = next(iter(calibrations_beside(folder / "sensor.yaml", remarks)), None)
    return camera_streams(folder.name, stamp_ns, files, camera)
