"""report.html of a run, and its content from the files of a folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vplog.data import USED, Closures, Floats, Ints, Keyframes, Odometry, PoseGraph, Trajectory
from vplog.errors import GraphError, ResultError
from vplog.execution.run_warnings import warn
from vplog.geometry import se3
from vplog.results import mcap_read, tables
from vplog.results.geo import Earth
from vplog.results.html import mapping
from vplog.results.mcap import McapContent
from vplog.results.previews import thumbnail
from vplog.results.report.page import (
    Changes,
    ClosureQuestion,
    Pictures,
    ReportContent,
    Tracks,
    TruthComparison,
    false_closures,
    page,
)
from vplog.results.run_cameras import unit_camera
from vplog.run.figures.run_figures import earth_of
from vplog.run.questions import ask_ledger
from vplog.storage.image_file import decode_image
from vplog.storage.scratch import replacing

_QUESTIONS = 10
_MOST_THUMBNAILS = 5000
"""Keyframes with a thumbnail in the page, of some 5 kB: 35 MB in base64."""


def write_report(
    folder: Path,
    record: dict[str, Any],
    path: Path | None = None,
    judged: TruthComparison | None = None,
    pictures: Pictures | None = None,
    changes: Changes | None = None,
) -> Path:
    """Write the page of the run in `folder`, whose run.json holds `record`, as `path` (report.html in it where None).

    `pictures` are those that result.mcap lacks. Raises ResultError.
    """
    path = path or folder / "report.html"
    write_page(replace(gather(folder, record, judged, pictures), changes=changes), path)
    return path


def write_page(content: ReportContent, path: Path) -> None:
    """Write the page of this content."""
    text = page(content)
    with replacing(path) as stream:
        stream.write(text.encode())


def gather_tracks(folder: Path, record: dict[str, Any]) -> Tracks:
    """Raises ResultError where a file of the run is missing or damaged."""
    keyframes, world_from_body = tables.read_keyframes(folder / "keyframes.parquet")
    after, odometry = tables.read_trajectory(folder / "trajectory.parquet")
    found = mcap_read.read_pictures(folder / "result.mcap")
    earth = earth_of(after, found.gps, record.get("gps"), unit_camera(record))
    return tracks_of(keyframes, world_from_body, odometry, after, found, earth)


def tracks_of(
    keyframes: Keyframes,
    world_from_body: Floats,
    odometry: Odometry,
    after: Trajectory,
    found: McapContent,
    earth: Earth | None,
) -> Tracks:
    """The trajectories, with the odometry laid on the first solved keyframe."""
    before = world_from_body[:1] @ se3.inverse(keyframes.odom_from_body[:1]) @ odometry.odom_from_body
    return Tracks(keyframes, world_from_body, Trajectory(odometry.stamp_ns, before), after, found, earth)


def gather(
    folder: Path,
    record: dict[str, Any],
    judged: TruthComparison | None = None,
    pictures: Pictures | None = None,
) -> ReportContent:
    """The content of the page. Raises ResultError where a file of the run is missing or damaged."""
    tracks = gather_tracks(folder, record)
    covariance = tables.read_keyframe_covariance(folder / "keyframes.parquet")
    closures = tables.read_closures(folder / "closures.parquet")
    pictures = pictures or Pictures(tracks.found.views, tracks.found.references)
    column, _ = tables.read_first_camera(folder / "descriptors.parquet")
    count = mapping(record.get("library")).get("references")
    content = ReportContent(
        record, tracks, covariance, closures, pictures, judged=judged, questions=_questions(folder, tracks, closures),
        references=references_of(column, count, len(tracks.keyframes.stamp_ns)),
    )  # fmt: skip
    thumbnails = pictures.thumbnails or _thumbnails(folder, content)
    return replace(content, pictures=replace(pictures, thumbnails=thumbnails))


def _questions(folder: Path, tracks: Tracks, closures: Closures) -> list[ClosureQuestion]:
    """The most important questions; none where the table of edges is damaged."""
    try:
        graph, weight, _ = tables.read_edges(folder / "edges.parquet", tracks.world_from_body)
    except ResultError as error:
        warn(f"No questions are asked: {error}")
        return []
    return questions_of(graph, weight, closures)


def questions_of(graph: PoseGraph, weight: Floats, closures: Closures) -> list[ClosureQuestion]:
    """The most important questions; none where the poses are not determined, or the graph is not that of the ledger."""
    try:
        return ask_ledger(graph, weight, closures)[:_QUESTIONS]
    except (GraphError, ResultError) as error:
        warn(f"No questions are asked: {error}")
        return []


def references_of(column: pa.Array, count: Any, keyframes: int) -> Ints | None:
    """Numbers (N, K) of the references of each keyframe, of `count`, by the descriptors; None of other recognisers."""
    at = column.type.get_field_index("references") if pa.types.is_struct(column.type) else -1
    if at < 0 or not isinstance(count, int) or len(column) != keyframes:
        return None
    found = column.field(at)
    if found.null_count or not pa.types.is_fixed_size_list(found.type):
        return None
    numbers = found.flatten().to_numpy().reshape(len(column), -1).astype(np.int64)
    return np.where(numbers < count, numbers, -1)


def pictured_keyframes(content: ReportContent) -> set[int]:
    """Rows of at most `_MOST_THUMBNAILS` keyframes of closures: those asked about, false ones, those in the solution,
    then the nearest misses, by inliers."""
    closures = content.closures
    in_question = np.isin(np.arange(len(closures)), [row for one in content.questions for row in one.rows])
    nearest = np.lexsort((-closures.inliers, ~closures.of(*USED), ~false_closures(content), ~in_question))
    ends = np.stack([closures.query[nearest], closures.match[nearest]], 1).ravel().tolist()
    return set(list(dict.fromkeys(ends))[:_MOST_THUMBNAILS])


def _thumbnails(folder: Path, content: ReportContent) -> dict[int, bytes]:
    """Small JPEGs of keyframes of closures by row; empty where result.mcap has no pictures."""
    wanted = pictured_keyframes(content)
    row_at = {stamp: row for row, stamp in enumerate(content.tracks.keyframes.stamp_ns.tolist()) if row in wanted}
    found = {
        row_at[one.stamp_ns]: thumbnail(decode_image(one.image))
        for one in mcap_read.read_images(folder / "result.mcap")
        if one.stamp_ns in row_at
    }
    return dict(sorted(found.items()))
