"""A folder of images named by their place in UTM, `vplog.geometry.utm_name`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vplog.data import Gps, Trajectory
from vplog.errors import LogError
from vplog.geometry import se3
from vplog.geometry.utm_name import utm_name
from vplog.logs.datasets.streams import DataSet, camera_streams, fix_stream
from vplog.logs.image_folder import image_files, named_stamps, natural_order


def roots(path: Path) -> list[Path]:
    """Return the folder itself if the name of any file in it begins with a position."""
    names = [file.name for file in path.iterdir()] if path.is_dir() else []
    return [path] if any(name.startswith("@") and utm_name(name) for name in names) else []


def read(path: Path) -> DataSet:
    """The truth is positions in UTM, without orientations; without times the images are in the order of their panoramas
    and tiles. Raises LogError where a name has no place."""
    found = {file: utm_name(file.name) for file in image_files(path)}
    named = {file: place for file, place in found.items() if place is not None}
    if bad := sorted(found.keys() - named):
        raise LogError(f"{bad[0]} is not named @utm_east@utm_north@... as the others are. Move it elsewhere.")
    columns = {file: (place.time, place.panorama, place.tile, file.name) for file, place in named.items()}
    files = sorted(named, key=lambda file: [natural_order(column or "0") for column in columns[file]])
    places = [named[file] for file in files]
    stamp_ns, timed = named_stamps([Path(place.time or "-") for place in places])
    if timed and len(np.unique(stamp_ns)) < len(stamp_ns):
        stamp_ns, timed = named_stamps([Path("-")] * len(files))
    streams = camera_streams("images", stamp_ns, files, None)
    position = np.array([[place.east, place.north, place.height_m] for place in places])
    position[~np.isfinite(position)] = 0.0
    latitude_deg, longitude_deg = np.array([[place.latitude_deg, place.longitude_deg] for place in places]).T
    if np.isfinite(latitude_deg + longitude_deg).all():
        unknown = np.full((len(files), 3, 3), np.nan)
        streams.append(fix_stream("position", Gps(stamp_ns, latitude_deg, longitude_deg, position[:, 2], unknown)))
    truth = Trajectory(stamp_ns, se3.pose(np.eye(3), position))
    names = {time_ns: file.name for time_ns, file in zip(stamp_ns.tolist(), files, strict=True)}
    return DataSet("utm-images", streams, truth, names=names, assumed_times=not timed)
