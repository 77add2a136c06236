"""A drive as COLMAP's sparse model (text) and as nerfstudio's transforms.json, with the pictures beside.

colmap.github.io/format.html; docs.nerf.studio/quickstart/data_conventions.html. In both (0.5, 0.5) is the centre of the
top-left pixel.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vplog.data import Bytes, Camera, Floats, Ints, Structure
from vplog.errors import ResultError
from vplog.geometry import se3

_OPENCV = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""OpenCV's order of coefficients, of `plumb_bob` and `rational_polynomial`."""


@dataclass(frozen=True, eq=False)
class PosedImages:
    """N pictures of some cameras, where they were taken, and the points in them."""

    names: Sequence[str]
    """(N,) of the files in `images/`."""
    cameras: Sequence[Camera]
    camera: Ints
    """(N,) the one of each picture."""
    world_from_camera: Floats
    """(N, 4, 4)."""
    structure: Structure
    rgb: Bytes
    """(P, 3) colours of the points."""


def camera_model(camera: Camera) -> tuple[str, dict[str, float]]:
    """COLMAP's camera model and its parameters, in COLMAP's order and px. Raises ResultError where it has none."""
    K = camera.matrix
    if K is None:
        raise ResultError(f"Camera {camera.name} is not calibrated, so its images have no place. Give a calibration.")
    if abs(K[0, 1]) > 1e-9 * K[0, 0]:
        raise ResultError(f"Camera {camera.name} has skewed axes, which COLMAP has no model for. Rectify the images.")
    pinhole = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
    coefficients = np.trim_zeros(np.asarray(camera.distortion, np.float64), "b").tolist()
    if camera.distortion_model == "equidistant":
        return "OPENCV_FISHEYE", pinhole | dict(
            zip(("k1", "k2", "k3", "k4"), [*coefficients, 0.0, 0.0, 0.0, 0.0], strict=False)
        )
    if not coefficients or camera.distortion_model == "none":
        return "PINHOLE", pinhole
    if len(coefficients) > len(_OPENCV):
        raise ResultError(
            f"Camera {camera.name} has coefficients of a thin prism, which COLMAP has no model for. Rectify the images."
        )
    model, count = ("OPENCV", 4) if len(coefficients) <= 4 else ("FULL_OPENCV", 8)
    return model, pinhole | dict(zip(_OPENCV[:count], [*coefficients, *[0.0] * 8], strict=False))


def write_colmap(folder: Path, images: PosedImages) -> list[Path]:
    """cameras.txt, images.txt and points3D.txt in `sparse/0` of a folder; the files."""
    texts = {
        "cameras.txt": [
            f"{number + 1} {model} {camera.width} {camera.height} {' '.join(repr(float(v)) for v in values.values())}"
            for number, camera in enumerate(images.cameras)
            for model, values in [camera_model(camera)]
        ],
        "images.txt": _images(images),
        "points3D.txt": _points(images),
    }
    (folder / "sparse" / "0").mkdir(parents=True)
    for name, lines in texts.items():
        with (folder / "sparse" / "0" / name).open("w", encoding="utf-8", newline="\n") as stream:
            stream.writelines(f"{line}\n" for line in lines)
    return [folder / "sparse" / "0" / name for name in texts]


def _images(images: PosedImages) -> Iterator[str]:
    """Two lines for each: its pose, camera from world, and its observations."""
    camera_from_world = se3.inverse(images.world_from_camera)
    turn = se3.quaternion(camera_from_world[:, :3, :3])[:, [3, 0, 1, 2]]
    found = images.structure
    start = np.searchsorted(found.image, np.arange(len(images.names) + 1))
    for row, name in enumerate(images.names):
        pose = [*turn[row].tolist(), *camera_from_world[row, :3, 3].tolist()]
        yield f"{row + 1} {' '.join(f'{value:.12g}' for value in pose)} {images.camera[row] + 1} {name}"
        some = slice(start[row], start[row + 1])
        observed = zip((found.px[some] + 0.5).tolist(), found.point[some].tolist(), strict=True)
        yield " ".join(f"{x:.4f} {y:.4f} {point + 1}" for (x, y), point in observed)


def _points(images: PosedImages) -> Iterator[str]:
    found = images.structure
    within = np.arange(len(found.image)) - np.searchsorted(found.image, found.image)
    order = np.argsort(found.point, kind="stable")
    start = np.searchsorted(found.point[order], np.arange(len(found.world) + 1))
    for point, (place, colour) in enumerate(zip(found.world.tolist(), images.rgb.tolist(), strict=True)):
        track = order[start[point] : start[point + 1]]
        ends = " ".join(f"{image + 1} {at}" for image, at in zip(found.image[track], within[track], strict=True))
        where = " ".join(f"{value:.12g}" for value in place)
        yield f"{point + 1} {where} {' '.join(map(str, colour))} {found.error_px[point]:.4f} {ends}"


def write_nerfstudio(folder: Path, images: PosedImages) -> list[Path]:
    """transforms.json, whose cameras look along -z with y up, and points.ply, from which splats start; the files."""
    own = intrinsics(images.cameras)
    poses = images.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    shared = own[0] if len(own) == 1 else {"camera_model": own[0]["camera_model"]}  # it counts before that of a frame
    of_frame = [{name: value for name, value in one.items() if name not in shared} for one in own]
    frames = [
        {"file_path": f"images/{name}", **of_frame[camera], "transform_matrix": pose}
        for name, camera, pose in zip(images.names, images.camera.tolist(), poses.tolist(), strict=True)
    ]
    tree = {**shared, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(tree, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    _write_ply(folder / "points.ply", images)
    return [folder / "transforms.json", folder / "points.ply"]


def intrinsics(cameras: Sequence[Camera]) -> list[dict[str, Any]]:
    """Fields of transforms.json about each camera. Raises ResultError where nerfstudio has no model for them."""
    own = list(map(_intrinsics, cameras))
    if len({one["camera_model"] for one in own}) > 1:
        raise ResultError("nerfstudio has one camera_model for all cameras, and some are fisheyes. Export colmap.")
    return own


def _intrinsics(camera: Camera) -> dict[str, Any]:
    """Fields of transforms.json about a camera. Raises ResultError where it has none for it."""
    model, parameters = camera_model(camera)
    if model == "FULL_OPENCV" and any(parameters[name] for name in ("k4", "k5", "k6")):
        raise ResultError(
            f"Camera {camera.name} has a rational polynomial, which nerfstudio has no model for. Export colmap."
        )
    names = {"fx": "fl_x", "fy": "fl_y"}
    return {
        "camera_model": "OPENCV_FISHEYE" if model == "OPENCV_FISHEYE" else "OPENCV",
        "w": camera.width,
        "h": camera.height,
        **{names.get(name, name): float(value) for name, value in parameters.items() if name not in ("k5", "k6")},
    }


def _write_ply(path: Path, images: PosedImages) -> None:
    """Points with their colours, little endian (Turk, The PLY polygon file format, 1994); far from the origin in
    doubles."""
    number, size = ("double", "<f8") if se3.far_origin(images.world_from_camera).any() else ("float", "<f4")
    kind = [(name, size) for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(images.rgb), kind)
    for at, name in enumerate("xyz"):
        rows[name] = images.structure.world[:, at]
    for at, name in enumerate(("red", "green", "blue")):
        rows[name] = images.rgb[:, at]
    fields = [f"property {'uchar' if one[1] == 'u1' else number} {one[0]}" for one in kind]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *fields, "end_header", ""]
    path.write_bytes("\n".join(head).encode() + rows.tobytes())
