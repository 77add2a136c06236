"""The report of a finished run written again: against a truth, or with pictures from the log."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pyarrow import Array

from vplog import logs
from vplog.data import Bytes, Features, Gps, Ints
from vplog.errors import LibraryError, ResultError, TruthError
from vplog.evaluate.closures import closure_sentences
from vplog.execution.execution import Execution
from vplog.features.extraction import extract_frames
from vplog.geometry import se3
from vplog.pipeline import Pipeline, recorded_pipeline
from vplog.results import mcap_read, run_record, tables
from vplog.results.previews import thumbnail
from vplog.results.report.page import Pictures, TruthComparison
from vplog.results.run_cameras import recorded_camera, unit_camera
from vplog.run.figures.run_figures import ClosureInputs, choose_views, reference_pictures, view_closures
from vplog.run.provenance import library_at
from vplog.run.report import write_report
from vplog.stages import BoxState, Log, PlaceState
from vplog.storage.remote_path import original
from vplog.storage.urls import shown
from vplog.verbs.evaluate_run import TruthOptions, evaluate, evaluate_poses, log_truth


def report(
    folder: Path,
    path: Path | None = None,
    truth: str | None = None,
    log: Path | None = None,
    topics: logs.TopicChoice | None = None,
    options: TruthOptions | None = None,
    execution: Execution = Execution(),
) -> dict[str, Any]:
    """Write report.html of the run in `folder`, to `path` where given; what was written.

    `truth` is a TUM file, `gps` or `auto`, and `options` how it is used, as in `evaluate`. `log` takes the place of the
    log that run.json names. It is read for a truth that comes with it, and if result.mcap has no pictures of closures.
    Raises VplogError with one line.
    """
    record = run_record.read_single_run(folder)
    if path is None:
        run_record.check_own_folder(folder, "page")
    options = options or TruthOptions()
    if truth is None and options != TruthOptions():
        raise TruthError("--distance-m, --heading-deg, --align and --truth-offset-s need a truth: give --truth.")
    judged = judge(folder, record, truth, topics, options, log) if truth is not None else None
    pictures = None
    if log is not None and not mcap_read.read_pictures(folder / "result.mcap").views:
        pictures = pictures_from(log, folder, record, execution)
    written = write_report(folder, record, path, judged, pictures)
    return {"report": str(written), "bytes": written.stat().st_size, "truth": truth and shown(truth)}


def judge(
    folder: Path,
    record: dict[str, Any],
    truth: str,
    topics: logs.TopicChoice | None,
    options: TruthOptions,
    log: Path | None = None,
) -> TruthComparison:
    """The run against a TUM file or the log's own GPS. Raises TruthError or ResultError."""
    known = log_truth(folder, record, topics, options, log) if truth == "auto" else None
    if truth == "gps" or isinstance(known, Gps):
        found = evaluate(folder, truth, topics, options, log)
        return TruthComparison(truth, found, found["warnings"])
    found = evaluate_poses(folder, record, truth, options, known)
    keyframes, world_from_body = tables.read_keyframes(folder / "keyframes.parquet")
    at, known, judged = found.truth.at(keyframes.stamp_ns), found.truth.trajectory, found.judged
    mount, solved = unit_camera(record), world_from_body[at.known]
    world_from_truth, units = se3.align(at.world_from_body[at.known], solved, mount)
    true = se3.stretched(at.world_from_body, units, mount)
    # of the truth only what the drive covers, so that the map is that of the drive
    during = (known.stamp_ns >= keyframes.stamp_ns[0]) & (known.stamp_ns <= keyframes.stamp_ns[-1])
    path = se3.transform(world_from_truth, se3.stretched(known.world_from_body[during], units, mount)[:, :3, 3])
    error_m = np.full(len(keyframes.stamp_ns), np.nan)
    error_m[at.known] = np.linalg.norm((world_from_truth @ true[at.known] - solved)[:, :3, 3], axis=1)
    closures = tables.read_closures(folder / "closures.parquet")
    expected = se3.between(true[closures.match], true[closures.query])
    apart_m = np.linalg.norm((expected - closures.match_from_query)[:, :3, 3], axis=1) / units
    return TruthComparison(
        Path(shown(truth)).name,
        found.record,
        [*found.record["warnings"], *closure_sentences(found.record["closures"])],
        path,
        judged.right,
        judged.right | judged.wrong,
        judged.curves,
        judged.at_place,
        error_m / units,
        np.where(at.known[closures.match] & at.known[closures.query] & found.truth.oriented, apart_m, np.nan),
    )


def pictures_from(log: Path, folder: Path, record: dict[str, Any], execution: Execution) -> Pictures:
    """Thumbnails and views of closures from the log itself. Raises LogError or ResultError."""
    pipeline = recorded_pipeline(folder, record)
    keyframes, _ = tables.read_keyframes(folder / "keyframes.parquet")
    closures = tables.read_closures(folder / "closures.parquet")
    state, column = recorded_places(folder, record, pipeline, execution)
    opened = logs.open_drive([log], logs.TopicChoice.read(record.get("topics") or {}, f"{folder}/run.json"))
    rows = choose_views(closures)
    nodes = np.unique(np.concatenate([closures.query[rows], closures.match[rows]])) if rows else np.zeros(0, np.int32)
    stamps = keyframes.stamp_ns[nodes]
    thumbnails: dict[int, bytes] = {}
    features: dict[int, Features] = {}
    found = frames_at(opened, stamps, pipeline, f"is it the log of {folder}?", execution)
    for node, (image, features[node]) in zip(nodes.tolist(), found, strict=True):
        thumbnails[node] = thumbnail(image)
    camera = recorded_camera(record, 0)
    inputs = ClosureInputs(features.__getitem__, camera, state, state.from_arrow(column))
    views = view_closures(rows, inputs, closures, pipeline.verify, execution)
    references = reference_pictures(state.references, pipeline.pictures.quality) if isinstance(state, BoxState) else {}
    return Pictures(views, references, thumbnails)


def frames_at(
    log: Log, stamps: Ints, pipeline: Pipeline, otherwise: str, execution: Execution = Execution()
) -> Iterator[tuple[Bytes, Features]]:
    """Images and features of the frames with these stamps. Raises ResultError where the log lacks one."""
    if not np.isin(stamps, log.stamps()).all():
        raise ResultError(f"{log.name} has no frames of these stamps: {otherwise}")
    for _, frame, features, why in extract_frames(log.frames(stamps), pipeline.features, execution):
        if frame is None or features is None:
            raise ResultError(why)
        yield frame.image, features


def recorded_places(
    folder: Path, record: dict[str, Any], pipeline: Pipeline, execution: Execution
) -> tuple[PlaceState, Array]:
    """The recogniser of a run and the descriptor of each keyframe. Raises LibraryError where its library is not there,
    or where not all keyframes have one."""
    with library_at(folder, record) as library:
        state = pipeline.places.load(library, execution)
        column, made_by = tables.read_first_camera(folder / "descriptors.parquet")
        if made_by != state.hash:
            raise LibraryError(
                f"{original(library)} is not the library of the run in {folder}, so its boxes cannot be drawn."
            )
    if len(column) < len(tables.read_stamps(folder / "keyframes.parquet")):
        raise LibraryError(f"{folder} is of a condensed map, without the places that its boxes are drawn from.")
    return state, column
