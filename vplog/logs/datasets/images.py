"""Images of one camera in a folder, or in folders of it: in natural order of their names or by the times in them."""

from __future__ import annotations

from collections.abc import Collection
from itertools import pairwise
from pathlib import Path

import numpy as np

from vplog.logs.datasets.streams import DataSet, camera_streams
from vplog.logs.image_folder import PERIOD_NS, frame_rate_remarks, natural_order, select_camera, stamps_of
from vplog.logs.topic_selection import EVERY_IMAGE, TopicChoice


def read(path: Path, files: list[Path], damaged: Collection[Path], choice: TopicChoice) -> DataSet:
    """`damaged` are those of `files` that are named like images, and are none: they had their time all the same.

    `choice.image` is the camera of several, as `left_*.png`. Raises LogError where none of them is chosen.
    """
    files = sorted(files, key=lambda file: [natural_order(part) for part in file.relative_to(path).parts])
    if choice.image != EVERY_IMAGE:
        files = select_camera(path, files, choice.image)
    times, remarks = stamps_of([file.stem for file in files]), []
    if times is not None and files[0].relative_to(path).parts[1:] and any(a >= b for a, b in pairwise(times)):
        times = None  # several folders, each with times of its own
    if assumed := times is None:
        times = [number * PERIOD_NS for number in range(len(files))]
        if choice.odometry_file is not None or choice.odometry == "visual":  # who compares pictures uses no times
            remarks = [f"The names in {path.name} are not times; its images are assumed to be 0.1 s apart."]
    else:
        remarks = frame_rate_remarks(path, times)
    names = {
        time_ns: file.relative_to(path).as_posix() for time_ns, file in reversed([*zip(times, files, strict=True)])
    }
    streams = camera_streams(path.name, np.array(times, np.int64), files, None, damaged)
    return DataSet("images", streams, None, remarks, names, assumed)
