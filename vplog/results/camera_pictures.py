"""The pictures of each camera of a run, by its tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vplog.data import Ints, Keyframes
from vplog.errors import ResultError
from vplog.geometry import se3
from vplog.results import tables


class CameraPictures(NamedTuple):
    """The pictures of one camera."""

    row: Ints
    """(V,) keyframe of each picture, increasing."""
    keyframes: Keyframes
    """Stamps of the V pictures, and the odometry's poses there."""


def camera_pictures(folder: Path, camera: int) -> CameraPictures:
    """The pictures of a camera of a run, by its number; of a further one in a condensed map those that it describes.
    Raises ResultError."""
    keyframes, _ = tables.read_keyframes(folder / "keyframes.parquet")
    if camera == 0:
        return CameraPictures(np.arange(len(keyframes.stamp_ns)), keyframes)
    described = folder / "descriptors.parquet"
    row, of = tables.read_pictures(described)
    row, stamp_ns = row[of == camera].astype(np.int64), tables.read_stamps(described)[of == camera]
    _, odometry = tables.read_trajectory(folder / "trajectory.parquet")
    if len(row) and not row[-1] < len(keyframes.stamp_ns):
        raise ResultError(f"{described} is damaged: it has pictures of keyframes that are not there. Run it again.")
    poses = se3.interpolate_at(odometry.stamp_ns, odometry.odom_from_body, stamp_ns)
    return CameraPictures(row, Keyframes(keyframes.drive, stamp_ns, poses))


def camera_topics(record: dict[str, Any]) -> list[str]:
    """The topics of a run's cameras by its run.json, the first one's first; of an older run one without a name."""
    names = record.get("cameras")
    return list(map(str, names)) if isinstance(names, list) and names else [""]
