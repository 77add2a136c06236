"""A COLMAP model (Schoenberger and Frahm, 2016): cameras and images, text or binary, and the folder of its images."""

from __future__ import annotations

import struct
from collections import Counter
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from vplog.data import Floats, Trajectory
from vplog.errors import LogError
from vplog.geometry import se3
from vplog.logs.calibration_file import calibrations_beside
from vplog.logs.datasets.streams import DataSet, calibration_stream, camera_streams, mount_stream
from vplog.logs.datasets.text_tables import lines_of
from vplog.logs.image_folder import by_folder, grouped, image_files, named_stamps, natural_order
from vplog.logs.tf_odometry import are_usable

_MODELS = (".", "sparse", "sparse/*", "colmap/sparse/*", "dslr_calibration_undistorted")
"""Paths of models below the folder of a reconstruction: COLMAP's own, its automatic ones, NeRF's, ETH3D's."""
_ENDINGS = (".txt", ".bin")
"""Endings of the tables of a model, the best last."""
_LARGEST = 2**31
"""Bytes of images.bin; 100,000 images of 1000 points take a third of it."""
_UNITS = (
    "The poses of a COLMAP model have a scale and a frame of their own, unless it was aligned with metres; "
    "`vplog evaluate --truth auto --align sim3` leaves the scale free."
)


class _Image(NamedTuple):
    """An image of the model."""

    name: str
    camera: str
    pose: tuple[float, ...]
    """Quaternion w x y z and translation of camera_from_world."""


def _models_of(path: Path) -> list[Path]:
    """Tables of images of the models at the first of the places that has one: the mapper writes one for each part of
    the images that it cannot join to the others."""
    for place in _MODELS:
        folders = sorted(path.glob(place)) if "*" in place else [path / place]
        each = ([folder / f"{name}{end}" for name in ("images", "cameras")] for folder in folders for end in _ENDINGS)
        found = {table.parent: table for table, cameras in each if table.is_file() and cameras.is_file()}
        if found:
            return [*found.values()]
    return []


def roots(path: Path) -> list[Path]:
    return [path] if _models_of(path) else []


def read(path: Path) -> DataSet:
    """The largest model. The body is the camera of most images, whose poses are the truth. Raises LogError."""
    if not (tables := _models_of(path)):
        raise LogError(f"{path} holds no COLMAP model. Give the folder with cameras and images.")
    table, remarks = max(tables, key=lambda table: table.stat().st_size), [_UNITS]
    images = _binary(table) if table.suffix == ".bin" else _text(table)
    images.sort(key=lambda one: [natural_order(part) for part in PurePosixPath(one.name).parts])
    folder = _folder_of(images, [path, *table.resolve().parents[:3]], table)
    at = {folder / one.name: one for one in images}
    on_disk = {file for one in {file.parent for file in at} for file in image_files(one)}
    if left := len(on_disk - at.keys()):
        which = f", the largest of {len(tables)} models," if len(tables) > 1 else ""
        remarks.append(
            f"{table.parent}{which} does not have {left} of the {len(on_disk)} images in {folder}; they are left out. "
            f"Give {folder} to take all, without a calibration and poses."
        )
    cameras = {one.name: one for one in calibrations_beside(table.with_name(f"cameras{table.suffix}"), remarks)}
    groups = by_folder(folder, [*at]) or {".": [*at]}
    if any(a >= b for a, b in pairwise(named_stamps(groups.get(".", []))[0].tolist())):
        groups = grouped([*at], lambda file: file.relative_to(folder).parent.as_posix())  # each has times of its own
    streams, main = [], max(sorted(groups), key=lambda name: len(groups[name]))
    if len(groups) > 1:
        found = ", ".join(f"{name} ({len(group)})" for name, group in sorted(groups.items()))
        remarks.append(
            f"The model has several cameras by the folders of their images: {found}. Its poses are taken of {main}; "
            "choose a camera with --image-topic."
        )
    for name, files in groups.items():
        topic = folder.name if name == "." else name
        stamp_ns, _ = named_stamps(files)
        streams += camera_streams(topic, stamp_ns, files, None)
        if missing := next((at[one] for one in files if cameras and at[one].camera not in cameras), None):
            raise LogError(f"The COLMAP model has no camera {missing.camera} of {missing.name[:60]}. Copy it again.")
        if cameras:  # COLMAP may have one for every image
            streams.append(calibration_stream(topic, stamp_ns, [cameras[at[one].camera].calibration for one in files]))
    stamp_ns, timed = named_stamps(groups[main])
    stamp_ns, rows = np.unique(stamp_ns, return_index=True)
    streams.append(mount_stream(folder.name if main == "." else main, stamp_ns[:1], np.eye(4)))
    values = np.array([at[groups[main][row]].pose for row in rows], np.float64)
    camera_from_world: Floats = se3.pose(se3.rotation(values[:, [1, 2, 3, 0]]), values[:, 4:])
    truth = Trajectory(stamp_ns, se3.inverse(camera_from_world))
    return DataSet("colmap", streams, truth, remarks, assumed_times=not timed)


def _folder_of(images: list[_Image], near: list[Path], table: Path) -> Path:
    """The folder that most of the first images lie in. Raises LogError."""
    places = [place / name for place in near for name in ("images", "rgb", ".")]
    found: Counter[Path] = Counter()
    for one in images[:20]:
        found.update({place for place in places if (place / one.name).is_file()})
    if not found:
        raise LogError(f"The images that {table} names, as {images[0].name[:60]}, are not near it, in images/ or rgb/.")
    return max(places, key=lambda place: found[place])


def _text(path: Path) -> list[_Image]:
    """`ID QW QX QY QZ TX TY TZ CAMERA NAME`, and a line of points behind each, which may be empty. Raises LogError."""
    found = []
    for number, line in lines_of(path):
        fields = line.split(maxsplit=9)
        if len(fields) < 10 or not fields[0].isdecimal() or not any(map(str.isalpha, fields[9])):
            continue  # points: x, y and the number of a landmark, over and over
        try:
            found.append(_Image(_inside(fields[9], path), fields[8], tuple(map(float, fields[1:8]))))
        except ValueError:
            raise LogError(f"{path}:{number} is not an image of a COLMAP model. Copy it again.") from None
    return _checked(found, path)


def _binary(path: Path) -> list[_Image]:
    """images.bin. Raises LogError."""
    if path.stat().st_size > _LARGEST:
        raise LogError(f"{path} is larger than 2 GB. Give a smaller model.")
    data, found = path.read_bytes(), []
    try:
        (count,), at = struct.unpack_from("<Q", data), 8
        for _ in range(min(count, len(data) // 64)):
            _, *pose, camera = struct.unpack_from("<i7di", data, at)
            end = data.index(b"\0", at + 64)
            (points,) = struct.unpack_from("<Q", data, end + 1)
            found.append(_Image(_inside(data[at + 64 : end].decode(), path), str(camera), tuple(pose)))
            at = min(end + 9 + 24 * points, len(data))
    except (struct.error, ValueError):
        raise LogError(f"{path} ends within an image, or is not a COLMAP model. Copy it again.") from None
    return _checked(found, path)


def _inside(name: str, path: Path) -> str:
    """A name below the folder of the images. Raises LogError."""
    if name.startswith("/") or ".." in name.split("/"):
        raise LogError(f"{path} names {name[:60]}, which is outside its folder. Copy the images into it.")
    return name


def _checked(images: list[_Image], path: Path) -> list[_Image]:
    poses = np.array([one.pose for one in images], np.float64).reshape(-1, 7)
    if not len(poses) or not are_usable(poses[:, [4, 5, 6, 1, 2, 3, 0]]).all():
        raise LogError(f"{path} holds no image with a pose, or one whose pose is none. Copy it again.")
    return images
