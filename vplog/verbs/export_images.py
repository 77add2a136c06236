"""A finished run with its pictures, for programs that build scenes: COLMAP, nerfstudio, trainers of splats."""

from __future__ import annotations

from dataclasses import replace
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vplog import logs
from vplog.data import Bytes, Features, Ints, Structure
from vplog.features.extraction import describe
from vplog.features.store import FeatureStore
from vplog.loops.structure import pairs_to_match, triangulate
from vplog.pipeline import recorded_pipeline
from vplog.results import colmap, run_record, tables
from vplog.results.previews import jpeg
from vplog.results.staging import check_contents, staged
from vplog.run.provenance import reopened
from vplog.storage.folders import check_regular, is_below
from vplog.storage.scratch import files_in, scratch
from vplog.version import __version__

if TYPE_CHECKING:
    from vplog.execution.execution import Execution
    from vplog.pipeline import Pipeline
    from vplog.stages import EncodedFrame, Log

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
    drive, pipeline = reopened(record, log, topics), recorded_pipeline(folder, record)
    keyframes, world_from_body = tables.read_keyframes(folder / "keyframes.parquet")
    closures = tables.read_closures(folder / "closures.parquet")
    camera = drive.camera()
    colmap.lens(camera)  # before the long part
    with staged(out, lambda: _export_in(out)) as made, scratch("features") as place:
        with FeatureStore(place / "features") as store:
            names = _pictures(drive, keyframes.stamp_ns, pipeline, made, store, execution)
            world_from_camera = world_from_body @ camera.body_from_camera
            pairs = pairs_to_match(len(names), closures)
            found = triangulate(
                world_from_camera, camera, store.__getitem__, pairs, pipeline.verify.matching, execution
            )
        images = colmap.PosedImages(names, camera, world_from_camera, found, _colours(made / "images", names, found))
        written = [path.relative_to(made) for path in _WRITERS[kind](made, images)]
        run_record.write_run_json(made / _RECORD, {"vplog": __version__, "format": 1, "files": files_in(made)})
    return [str(out / path) for path in written]


def _pictures(
    drive: Log, stamp_ns: Ints, pipeline: Pipeline, made: Path, store: FeatureStore, execution: Execution
) -> list[str]:
    """Write the pictures and store their features; the pictures' names."""
    (made / "images").mkdir()

    def work(encoded: EncodedFrame) -> tuple[str, Features]:
        frame = encoded.decode(colour=True)
        name = f"{frame.stamp_ns}.jpg"
        (made / "images" / name).write_bytes(jpeg(np.asarray(frame.colour)[..., ::-1], _QUALITY))
        return name, describe(pipeline.features, replace(frame, depth=None))

    names = []
    found = execution.map(work, drive.frames(stamp_ns), ahead=2)
    for name, features in execution.counted("pictures", found, len(stamp_ns)):
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
