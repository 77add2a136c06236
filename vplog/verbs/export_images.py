"""A finished run with its pictures, for programs that build scenes: COLMAP, nerfstudio, trainers of splats."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from glob import escape
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vplog import logs
from vplog.data import Bytes, Camera, Features, Floats, Ints, Structure
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import warn
from vplog.features.extraction import describe
from vplog.features.store import FeatureStore
from vplog.geometry import se3
from vplog.loops.structure import pairs_to_match, triangulate
from vplog.pipeline import Pipeline, recorded_pipeline
from vplog.results import colmap, run_record, tables
from vplog.results.previews import jpeg
from vplog.results.run_cameras import camera_pictures, recorded_camera
from vplog.results.staging import check_contents, staged
from vplog.run.provenance import reopened
from vplog.stages import EncodedFrame, Log
from vplog.storage.folders import check_regular, is_below
from vplog.storage.scratch import files_in, scratch
from vplog.version import __version__

_WRITERS = {"colmap": colmap.write_colmap, "nerfstudio": colmap.write_nerfstudio}
FOLDERS = tuple(_WRITERS)
"""Formats that are a folder."""
_RECORD = "export.json"
"""Record of the files of an export, beside them."""
_QUALITY = 95
"""JPEG quality: its loss is below the camera's noise."""


def export_images(
    folder: Path, record: dict[str, Any], kind: str, out: Path, log: Path | None, execution: Execution
) -> list[str]:
    """Write the run in `folder` as one of FOLDERS into `out`, with the pictures of its keyframes from its log, or from
    `log` where that has moved; the files. Raises VplogError."""
    topics = logs.TopicChoice.read(record.get("topics") or {}, f"{folder}/run.json")
    pipeline, closures = recorded_pipeline(folder, record), tables.read_closures(folder / "closures.parquet")
    cameras = _cameras(folder, record, topics, log)
    models = [one.camera for one in cameras]
    for model in models:
        colmap.camera_model(model)  # before the long part
    if kind == "nerfstudio":
        colmap.intrinsics(models)
    number = np.repeat(np.arange(len(cameras)), [len(one.stamp_ns) for one in cameras])
    of_image = [models[one] for one in number.tolist()]
    with staged(out, lambda: _export_in(out)) as made, scratch("features") as place:
        with FeatureStore(place / "features") as store:
            names = list(chain(*(_pictures(one, pipeline, made, store, execution) for one in cameras)))
            world_from_camera = np.concatenate([one.world_from_camera for one in cameras])
            pairs = pairs_to_match({one.number: one.keyframe for one in cameras}, closures)
            matching = pipeline.verify.matching
            found = triangulate(world_from_camera, of_image, store.__getitem__, pairs, matching, execution)
        colours = _colours(made / "images", names, found)
        images = colmap.PosedImages(names, models, number, world_from_camera, found, colours)
        written = [path.relative_to(made) for path in _WRITERS[kind](made, images)]
        run_record.write_run_json(made / _RECORD, {"vplog": __version__, "format": 1, "files": files_in(made)})
    return [str(out / path) for path in written]


@dataclass(frozen=True, eq=False)
class _PosedCamera:
    """A camera's V pictures at the keyframes."""

    number: int
    """Among the cameras of the run."""
    log: Log
    camera: Camera
    folder: str
    """Name of the folder of its pictures, in that of all; empty where it is the only camera."""
    keyframe: Ints
    """(V,) increasing."""
    stamp_ns: Ints
    """(V,)"""
    world_from_camera: Floats
    """(V, 4, 4)."""


def _cameras(folder: Path, record: dict[str, Any], topics: logs.TopicChoice, log: Path | None) -> list[_PosedCamera]:
    """The cameras of a run: the first by the poses of the keyframes, the others that are calibrated by the trajectory
    at their stamps."""
    keyframes, world_from_body = tables.read_keyframes(folder / "keyframes.parquet")
    drive, names = reopened(folder, record, log, topics), record.get("cameras") or []
    first, several = recorded_camera(record, 0), len(names) > 1
    poses, rows = world_from_body @ first.body_from_camera, np.arange(len(keyframes.stamp_ns))
    found = [_PosedCamera(0, drive, first, _folder(first.name) if several else "", rows, keyframes.stamp_ns, poses)]
    for number, topic in enumerate(names[1:], 1):
        other = reopened(folder, record, log, topics.of_camera(topic))
        camera = recorded_camera(record, number)
        if camera.matrix is None:
            warn(f"Camera {camera.name} is not calibrated, so its pictures have no place and are left out.")
            continue
        trajectory, _ = tables.read_trajectory(folder / "trajectory.parquet")
        row, pictures = camera_pictures(folder, number)
        bodies = se3.interpolate_at(trajectory.stamp_ns, trajectory.world_from_body, pictures.stamp_ns)
        poses = bodies @ camera.body_from_camera
        found.append(_PosedCamera(number, other, camera, _folder(camera.name), row, pictures.stamp_ns, poses))
    return found


def _folder(name: str) -> str:
    """A camera's folder: its topic, as one name."""
    return re.sub(r"\W+", "_", name).strip("_")


def _pictures(
    one: _PosedCamera, pipeline: Pipeline, made: Path, store: FeatureStore, execution: Execution
) -> list[str]:
    """Write the pictures and store their features; the pictures' names."""
    (made / "images" / one.folder).mkdir(parents=True)

    def work(encoded: EncodedFrame) -> tuple[str, Features]:
        frame = encoded.decode(colour=True)
        name = f"{one.folder}/{frame.stamp_ns}.jpg".removeprefix("/")
        (made / "images" / name).write_bytes(jpeg(np.asarray(frame.colour)[..., ::-1], _QUALITY))
        return name, describe(pipeline.features, replace(frame, depth=None))

    names = []
    found = execution.map(work, one.log.frames(one.stamp_ns), ahead=2)
    for name, features in execution.counted("pictures", found, len(one.stamp_ns)):
        store.append(features)
        names.append(name)
    return names


def _colours(folder: Path, names: list[str], found: Structure) -> Bytes:
    """(P, 3) colours of the points, each from the first picture that it is in."""
    first = np.unique(found.point, return_index=True)[1]
    rgb = np.empty((len(first), 3), np.uint8)
    for image in np.unique(found.image[first]).tolist():
        picture = np.asarray(cv2.imread(str(folder / names[image])))
        here = found.image[first] == image
        column, row = np.rint(found.px[first[here]]).astype(np.int64).T
        rgb[here] = picture[row.clip(0, len(picture) - 1), column.clip(0, picture.shape[1] - 1), ::-1]
    return rgb


def _export_in(out: Path) -> list[str]:
    """The files of an export in a folder, by its record, which a new one replaces: scenes of others have the same
    names. Raises SettingsError where it holds other things, and ResultError."""
    known = run_record.is_ours(out / _RECORD)
    check_contents(out, "an export", known)
    check_regular(out, _RECORD)
    found = run_record.read_run_json(out / _RECORD).get("files") if known else []
    names = found if isinstance(found, list) else []
    return [_RECORD, *(escape(name) for name in names if is_below(name))]
