"""Images of a stereo pair in two folders, `left` and `right`, without any other files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vplog.errors import LogError
from vplog.logs.datasets.streams import DataSet, camera_streams
from vplog.logs.image_folder import PERIOD_NS, frame_rate_remarks, image_files, natural_order, stamps_of

_SIDES = "left", "right"


def roots(path: Path) -> list[Path]:
    """Return the folder itself if it has images in `left` and in `right`, else nothing."""
    return [path] if all(image_files(path / side) for side in _SIDES) else []


def read(path: Path) -> DataSet:
    """Read the pair. Images with the same name were taken together. The names are times, or they count the images.

    Raises LogError if no image on the left has the name of one on the right.
    """
    files = {side: {file.stem: file for file in image_files(path / side)} for side in _SIDES}
    names = sorted(files["left"] | files["right"], key=natural_order)
    if not files["left"].keys() & files["right"].keys():
        raise LogError(
            f"No image in {path / 'left'} has the name of one in {path / 'right'}. Name both images of a pair alike, "
            "or give the folder of one camera."
        )
    times = stamps_of(names)
    stamp_ns = dict(zip(names, np.arange(len(names)) * PERIOD_NS if times is None else times, strict=True))
    streams = [
        stream
        for side in _SIDES
        for stream in camera_streams(
            side, np.array([stamp_ns[name] for name in files[side]], np.int64), [*files[side].values()], None
        )
    ]
    remarks = [] if times is None else frame_rate_remarks(path, times)
    return DataSet("stereo-images", streams, None, remarks, assumed_times=times is None)
