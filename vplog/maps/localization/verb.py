"""`vplog localize`: pictures or a log in, their poses in a run or a map out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vplog import logs
from vplog.data import Keyframes, Trajectory, Verdict
from vplog.errors import GraphError, LogError, ResultError, plural
from vplog.execution.execution import Execution
from vplog.geometry import se3, tum
from vplog.maps.localization.localize import TOP, LocalizedPicture, localize_log
from vplog.maps.localization.places import Places, opened
from vplog.maps.localization.trajectory import join_by_odometry
from vplog.maps.search.query import select_views
from vplog.results.tables import TableMetadata, write_localized
from vplog.stages import Log
from vplog.storage.scratch import check_file_output

_AT_ODDS = "At odds with the other pictures by the log's odometry, so it has no pose."


def localize_paths(
    root: Path, paths: Sequence[Path], topics: logs.TopicChoice | None = None, out: Path | None = None,
    execution: Execution = Execution(), top: int = TOP,
) -> dict[str, Any]:  # fmt: skip
    """The poses of pictures, or of the keyframes of a log, in a run or a map. Raises VplogError with one line.

    `out` is a table (.parquet) or a trajectory (.tum): of the cameras of pictures, or of the body of a log.
    """
    if out is not None:
        if out.suffix not in (".parquet", ".tum"):
            raise ResultError(f"Cannot write {out}: poses are a table or a trajectory. Name FILE.parquet or FILE.tum.")
        check_file_output(out)
    is_log = len(paths) == 1 and not logs.is_image_file(paths[0])
    log = logs.open(paths[0], topics) if is_log else logs.open_images(paths, topics)
    with opened(root, execution) as places:
        stamps, keyframes, warnings = select_views(log, places.pipeline.keyframes)
        found = list(localize_log(places, log, stamps, execution, top))
        joined = None
        if keyframes is not None:
            try:
                found, joined = _joined(log, keyframes, found, places)
            except GraphError as error:  # as of a robot that stands still, which has one keyframe
                warnings.append(f"Not joined by odometry: {error}")
        records = [one.record() for one in found]
        if out is not None:
            header = TableMetadata(places.pipeline.model_dump(mode="json"), places.state.hash)
            warnings = warnings + _write(out, records, found, joined, log.file_names() is None, header)
        return {
            "map": str(root),
            "log": " ".join(map(str, paths)),
            "pictures": len(found),
            "localized": sum(one.localized for one in found),
            "verdicts": dict(Counter(one.found.verdict.value for one in found)),
            "joined_by_odometry": joined is not None,
            "written": None if out is None else str(out),
            "warnings": log.warnings + warnings + places.warnings,
            "answers": records,
        }


def _joined(
    log: Log, keyframes: Keyframes, found: list[LocalizedPicture], places: Places
) -> tuple[list[LocalizedPicture], Trajectory | None]:
    """The pictures of a log, without those at odds with its odometry, and its trajectory in the frame of most; None
    where none is localised, or no two agree with the odometry. Raises GraphError."""
    odometry = log.odometry()
    frames = Counter(one.frame for one in found if one.localized)
    if odometry is None or not frames:
        return found, None
    frame = frames.most_common(1)[0][0]
    rows = np.flatnonzero([one.localized and one.frame == frame for one in found])
    poses, covariances = zip(*(_of_body(found[row]) for row in rows.tolist()), strict=True)
    trajectory, agrees = join_by_odometry(
        odometry, keyframes, rows, np.stack(poses), np.stack(covariances), places.pipeline
    )
    if not agrees.any():
        return found, None
    for row in rows[~agrees].tolist():
        lost = replace(found[row].found, verdict=Verdict.REJECTED_BY_SOLVER, world_from_camera=None, covariance=None)
        found[row] = replace(found[row], found=lost, sentence=_AT_ODDS, earth_deg_m=None)
    return found, trajectory


def _of_body(one: LocalizedPicture) -> tuple[Any, Any]:
    """world_from_body (4, 4) and its covariance (6, 6) in the body."""
    if one.camera is None or one.found.world_from_camera is None or one.found.covariance is None:
        raise LogError(f"{one.name} is not localised.")
    Ad = se3.adjoint(one.camera.body_from_camera)
    return one.found.world_from_camera @ se3.inverse(one.camera.body_from_camera), Ad @ one.found.covariance @ Ad.T


def _write(
    out: Path, records: list[dict[str, Any]], found: list[LocalizedPicture], joined: Trajectory | None, is_log: bool,
    header: TableMetadata,
) -> list[str]:  # fmt: skip
    """Warnings. A trajectory without odometry has the poses in the frame of most."""
    if out.suffix == ".parquet":
        write_localized(out, records, header)
        return []
    if joined is not None:
        tum.write_tum(out, joined)
        return []
    localized = [one for one in found if one.localized]
    if not localized:
        raise ResultError(f"None of {len(found)} pictures is localised, so {out} is not written.")
    frame, count = Counter(one.frame for one in localized).most_common(1)[0]
    among = [one for one in localized if one.frame == frame]
    poses = [_of_body(one)[0] if is_log else one.found.world_from_camera for one in among]
    known = {one.stamp_ns: pose for one, pose in zip(among, poses, strict=True) if pose is not None}
    tum.write_tum(out, Trajectory(np.array([*known], np.int64), np.stack([*known.values()])))
    if count == len(localized):
        return []
    others = plural(len(localized) - count, "picture")
    return [f"{out} is in the frame of {frame}, and lacks {others} localised in drives that are not joined with it."]
