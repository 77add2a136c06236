"""One closure of a finished run in words and in a picture."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vplog import logs
from vplog.data import USED, Bytes, Camera, Closures, Features, Keyframes
from vplog.errors import LibraryError, LogError, ResultError
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.pipeline import Pipeline, recorded_pipeline
from vplog.results import run_record, tables
from vplog.results.run_cameras import recorded_camera
from vplog.run.figures.closure_view import SharedBoxes, find_agreement, find_boxes
from vplog.run.keyframes import row_of
from vplog.run.provenance import reopened
from vplog.stages import BoxState, Log
from vplog.verbs import explain_text
from vplog.verbs.explain_figure import ClosureFigure, draw
from vplog.verbs.report import frames_at, recorded_places


def explain(
    folder: Path,
    closure: tuple[int, ...] | None,
    picture: Path | None = None,
    log: Path | None = None,
    words_only: bool = False,
) -> dict[str, Any]:
    """Explanation of one closure of the run in `folder`: its row, sentences, and the content of the picture.

    `closure` is its row of the ledger, or the rows or stamps in ns of its query and match; None is the one that the
    solved trajectory is furthest from, in sigma.
    `picture` is the .png or .svg to write, `closure-K.png` in the run folder where None. The run's log is read for it,
    or `log` where that has moved. Raises VplogError with one line.
    """
    record = run_record.read_single_run(folder)
    if picture is None and not words_only:
        run_record.check_own_folder(folder, "picture")
    if picture is not None and picture.suffix not in (".png", ".svg"):
        raise ResultError(f"{picture} is neither a .png nor a .svg. Name one with -o.")
    run_record.recorded(record, folder / "run.json", dict, "settings")
    pipeline = recorded_pipeline(folder, record)
    keyframes, world_from_body = tables.read_keyframes(folder / "keyframes.parquet")
    path = folder / "closures.parquet"
    closures = tables.read_closures(path)
    number = _chosen(closure, closures, keyframes)
    row = tables.read_closure(path, number)
    siblings = [closures.verdict[one].value for one in np.flatnonzero(closures.query == row["query"])]
    reason = str(run_record.recorded(record, folder / "run.json", dict, "solution").get("reason", ""))
    explanation = explain_text.describe(row, keyframes, world_from_body, siblings, pipeline, reason)
    explanation = replace(explanation, solver=" ".join([explanation.solver, *run_record.unit_warnings(record)]))
    shown = None
    if not words_only:
        topics = logs.TopicChoice.read(record.get("topics") or {}, f"{folder}/run.json")
        opened = _Opened(folder, record, pipeline, log, reopened(folder, record, log, topics))
        view = _view(number, row, explanation, opened)
        file = picture or folder / f"closure-{number}.png"
        draw(file, view)
        shown = {
            "file": str(file),
            "matches": len(view.agreement.agrees),
            "agree": int(view.agreement.agrees.sum()),
            "agree_with": view.agreement.model,
            "references": [one.reference for one in view.boxes],
            "without_boxes": view.missing,
        }
    return {"run": str(folder), "closure": number, "row": row, **asdict(explanation), "picture": shown}


def _chosen(closure: tuple[int, ...] | None, closures: Closures, keyframes: Keyframes) -> int:
    """Row of the ledger."""
    if closure is None:
        if not len(closures):
            raise ResultError("No closure was proposed in this run: no keyframe has older ones to compare it with.")
        for among in (closures.of(*USED), np.isfinite(closures.residual_after)):
            if np.isfinite(residual := np.where(among, closures.residual_after, np.nan)).any():
                return int(np.nanargmax(residual))
        return int(np.argmax(closures.inliers))
    if len(closure) == 1:
        return closure[0]
    rows = [row_of(keyframes, one) for one in closure]
    if None in rows:
        one, last = closure[rows.index(None)], len(keyframes.stamp_ns) - 1
        raise ResultError(f"No keyframe has the row or stamp {one}. Rows are 0..{last}; stamps are in ns.")
    found = np.flatnonzero((closures.query == rows[0]) & (closures.match == rows[1]))
    if not len(found):
        known = closures.match[closures.query == rows[0]].tolist()
        raise ResultError(
            f"Keyframe {rows[1]} was not proposed for keyframe {rows[0]}. "
            f"Proposed for it: {', '.join(map(str, known)) or 'none'}."
        )
    return int(found[0])


@dataclass(frozen=True, eq=False)
class _Opened:
    """A run and its log."""

    folder: Path
    record: dict[str, Any]
    pipeline: Pipeline
    path: Path | None
    """Path of the log, where it is not the run's own."""
    log: Log


def _view(number: int, row: dict[str, Any], explanation: explain_text.Explanation, opened: _Opened) -> ClosureFigure:
    """Both frames, read again from the log, with their matches and shared boxes."""
    query, match = (_picture(end, row, opened) for end in ("query", "match"))
    pose = se3.from_vectors(np.array([row[name] for name in tables.POSE_COLUMNS], np.float64))
    cameras = query[2], match[2]
    agreement = find_agreement(query[1], match[1], pose, row["inliers"], cameras, opened.pipeline.verify)
    boxes, missing = _boxes(row, (query[1], match[1]), opened)
    return ClosureFigure(number, row, explanation, query[0], match[0], agreement, boxes, missing)


def _picture(end: str, row: dict[str, Any], opened: _Opened) -> tuple[Bytes, Features, Camera]:
    """Image, features and camera of the query or the match. Raises ResultError."""
    log, otherwise = opened.log, f"is it the log of {opened.folder}? Name it with --log."
    stamp_ns = np.array([row[f"{end}_stamp_ns"]], np.int64)
    if number := row[f"{end}_camera"] or 0:
        names = run_record.recorded(opened.record, opened.folder / "run.json", list, "cameras")
        if not 0 < number < len(names) or names[number] not in log.further_cameras():
            raise ResultError(f"{log.name} has no camera {number} of the run: {otherwise}")
        topics = logs.TopicChoice.read(opened.record.get("topics") or {}, f"{opened.folder}/run.json")
        log = reopened(opened.folder, opened.record, opened.path, topics.of_camera(str(names[number])))
        stamps = log.stamps()
        stamp_ns = stamps[[np.abs(stamps - stamp_ns).argmin()]]
    [(image, features)] = frames_at(log, stamp_ns, opened.pipeline, otherwise)
    return image, features, recorded_camera(opened.record, number)


def _boxes(row: dict[str, Any], views: tuple[Features, Features], opened: _Opened) -> tuple[list[SharedBoxes], str]:
    """Boxes that both views share on the library's references, or why they are not known."""
    if not row["shared_references"]:
        return [], f"{opened.pipeline.places.kind} names no reference that both views share"
    try:
        state, column = recorded_places(opened.folder, opened.record, opened.pipeline, Execution())
        if row["query_camera"] or row["match_camera"]:  # descriptors.parquet has those of the first camera
            query, match = map(state.describe, views)
        else:
            query, match = state.from_arrow(column.take([row["query"], row["match"]]))
    except (LibraryError, LogError) as error:
        return [], str(error).rstrip(".")
    return (find_boxes(state, query, match, row["shared_references"]) if isinstance(state, BoxState) else []), ""
