"""Where in a map the views of a log are."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vplog import logs
from vplog.errors import LibraryError, LogError, ResultError
from vplog.extract import extract_frames, map_in_order, one_thread_each
from vplog.keyframes import select_keyframes
from vplog.maps import store as map_store
from vplog.maps.info import other_library, row_count
from vplog.pipeline import Pipeline
from vplog.places.sequence import SequenceSettings, rank_places
from vplog.results import tables
from vplog.results.atomic import replacing

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from vplog.data import Float32s, Int32s, Ints
    from vplog.maps.store import Store
    from vplog.stages import Log, PlaceState

    Progress = Callable[[str, int, int], None]

PLACED = pa.schema(
    [
        pa.field("query", pa.int32(), False, metadata={"unit": "row", "description": "View of the log, 0 the first."}),
        pa.field("query_stamp_ns", pa.int64(), False, metadata={"unit": "ns", "description": "Its stamp."}),
        pa.field("rank", pa.int32(), False, metadata={"unit": "1", "description": "0 is the view's best answer."}),
        pa.field("drive", pa.string(), False, metadata={"unit": "", "description": "Drive of the place."}),
        pa.field("keyframe", pa.int32(), False, metadata={"unit": "row", "description": "Keyframe of that drive."}),
        pa.field("stamp_ns", pa.int64(), False, metadata={"unit": "ns", "description": "Stamp of the keyframe."}),
        pa.field("score", pa.float32(), False, metadata={"unit": "1", "description": "The recogniser's similarity."}),
        pa.field("support", pa.int32(), False, metadata={"unit": "1", "description": "Neighbours that agree."}),
    ]
)
"""What a query answers, in order of the views, then of rank. `drive` and `keyframe` join with MAP/keyframes."""


@dataclass(frozen=True, eq=False)
class Answers:
    """The best places of a map for Q views, best first; a row beyond `count` is none."""

    count: Ints
    """(Q,) how many of the K there are."""
    drive: Int32s
    """(Q, K) number of the drive, in order of IDs."""
    keyframe: Int32s
    """(Q, K) row of the drive's keyframes."""
    score: Float32s
    support: Int32s


def query_map(
    root: Path,
    path: Path,
    topics: logs.TopicChoice | None = None,
    top: int = 10,
    sequence: int | None = None,
    out: Path | None = None,
    threads: int = 1,
    progress: Progress = lambda *_: None,
) -> dict[str, Any]:
    """The `top` places of the map that are most like each view of a log, in `out` too where given.

    Views are chosen and described as the map's drives were, with its library; drives are searched one by one, exactly,
    so memory is that of the largest. With `sequence` views in a window (None: as the map's settings say; 1: each view
    for itself) lines run within a drive. Raises VplogError with one line.
    """
    store = map_store.Store(root)
    head = store.head()
    drives = store.drives()
    if head.library is None or not drives:
        raise ResultError(f"{root} has no finished drive yet. Add some: vplog batch LOG... -o {root}")
    for drive, about in drives.items():
        if about["library"] != head.library:
            raise LibraryError(other_library(store, drive, about["library"], head.library))
    pipeline = Pipeline.read(head.settings, f"{root}/map.json")
    state = pipeline.places.load(store.library(head.library), threads)
    log = logs.open(path, topics)
    stamps, descriptors, warnings = describe_log(log, pipeline, state, threads, progress)
    settings = pipeline.sequence
    if sequence is not None:
        settings = SequenceSettings.read({**settings.model_dump(), "length": sequence}, "--sequence")
    top = min(top, sum(row_count(store.run(drive) / "descriptors.parquet") for drive in drives))
    answers = search(store, list(drives), state, head.library, descriptors, top, settings, threads, progress)
    table = _table(store, list(drives), answers, stamps)
    if out is not None:
        about = tables.TableMetadata(head.settings, head.library).record()
        with replacing(out) as stream:
            pq.write_table(
                table.replace_schema_metadata({**about, "vplog.table": "placed"}), stream, compression="zstd"
            )
    return {
        "map": str(root),
        "log": str(path),
        "written": None if out is None else str(out),
        "views": len(stamps),
        "answered": int((answers.count > 0).sum()),
        "best_by_drive": {
            drive: int((answers.drive[answers.count > 0, 0] == number).sum()) for number, drive in enumerate(drives)
        },
        "warnings": log.warnings + warnings,
        "answers": table.to_pylist(),
    }


def describe_log(
    log: Log, pipeline: Pipeline, state: PlaceState, threads: int, progress: Progress = lambda *_: None
) -> tuple[Ints, list[Any], list[str]]:
    """Stamps (Q,) and descriptors of the keyframes of a log, and what was lost; of all frames without odometry.

    A descriptor takes some hundred bytes, and no image or feature is kept.
    """
    odometry, stamps, warnings = log.odometry(), log.stamps(), []
    if odometry is not None and len(odometry.stamp_ns) > 1:
        keyframes, warnings = select_keyframes(log.name, stamps, odometry, pipeline.keyframes)
        stamps = keyframes.stamp_ns
    else:
        warnings.append(f"{log.name} has no odometry, so every frame is looked for.")
    frames = extract_frames(log.frames(stamps), pipeline.features, threads, pipeline.stereo)

    def describe(found: Any) -> tuple[int, Any, str]:
        stamp_ns, _, features, why = found
        return stamp_ns, None if features is None else state.describe(features), why

    seen, descriptors, lost = [], [], []
    with ThreadPoolExecutor(threads, initializer=one_thread_each) as pool:
        for stamp_ns, descriptor, why in map_in_order(pool, describe, frames, ahead=4 * threads):
            if descriptor is None:
                lost.append(why)
            else:
                seen.append(stamp_ns)
                descriptors.append(descriptor)
            progress("describe", len(seen) + len(lost), len(stamps))
    if not seen:
        raise LogError(f"{log.name}: none of {len(stamps)} frames could be decoded. {' '.join(lost[:1])}")
    if lost:
        warnings.append(f"{len(lost)} of {len(stamps)} views were lost to damaged images. First: {lost[0]}")
    return np.array(seen, np.int64), descriptors, warnings


def search(
    store: Store,
    drives: Sequence[str],
    state: PlaceState,
    library: str,
    descriptors: Sequence[Any],
    top: int,
    settings: SequenceSettings,
    threads: int = 1,
    progress: Progress = lambda *_: None,
) -> Answers:
    """The `top` best places of all drives for each of Q views in order; ties go to the earlier drive, then row.

    The score of a single view does not depend on the other places of an index, so the best of the drives' best are
    those of all. That of a sequence is how much more alike it is than is usual in its drive, in the same unit. Raises
    LibraryError where a drive's descriptors are of another library.
    """
    count = len(descriptors)
    best = Answers(
        np.zeros(count, np.int64), np.zeros((count, top), np.int32), np.zeros((count, top), np.int32),
        np.full((count, top), -np.inf, np.float32), np.zeros((count, top), np.int32),
    )  # fmt: skip
    for number, drive in enumerate(drives):
        column, made_by = tables.read_descriptors(store.run(drive) / "descriptors.parquet")
        if made_by != library:
            raise LibraryError(other_library(store, drive, made_by, library))
        try:
            column = column.cast(state.arrow_type)  # the names of list items change in Parquet, nothing else may
        except pa.ArrowException:
            raise ResultError(
                f"{store.run(drive)}/descriptors.parquet is of another recogniser. Remove the drive's folders."
            ) from None
        index = state.index(state.from_arrow(column))
        stops = np.full(count, len(column), np.int64)
        for row, (ranking, support) in enumerate(rank_places(index, descriptors, stops, top, settings, threads)):
            _merge(best, row, number, ranking.rows, ranking.score, support)
        progress("search", number + 1, len(drives))
    return best


def _merge(best: Answers, row: int, number: int, rows: Int32s, score: Float32s, support: Int32s) -> None:
    """Take a drive's ranking into the answers of a view, in place."""
    had, top = int(best.count[row]), best.score.shape[1]
    every = np.concatenate([best.score[row, :had], score])
    order = np.argsort(-every, kind="stable")[:top]  # stable: what was there is of an earlier drive
    for kept, more in (
        (best.drive, np.full(len(rows), number, np.int32)),
        (best.keyframe, rows),
        (best.support, support),
        (best.score, score),
    ):
        kept[row, : len(order)] = np.concatenate([kept[row, :had], more])[order]
    best.count[row] = len(order)


def _table(store: Store, drives: Sequence[str], answers: Answers, stamps: Ints) -> pa.Table:
    """One row for every answer."""
    stamped = [pq.read_table(store.run(drive) / "descriptors.parquet", columns=["stamp_ns"]) for drive in drives]
    there = np.arange(answers.score.shape[1]) < answers.count[:, None]
    query, rank = np.nonzero(there)
    number, keyframe = answers.drive[there], answers.keyframe[there]
    known = [table["stamp_ns"].to_numpy() for table in stamped]
    stamp = np.array([known[one][row] for one, row in zip(number.tolist(), keyframe.tolist(), strict=True)], np.int64)
    columns = [
        query.astype(np.int32), stamps[query], rank.astype(np.int32), [drives[one] for one in number.tolist()],
        keyframe, stamp, answers.score[there], answers.support[there],
    ]  # fmt: skip
    arrays = [pa.array(values, field.type) for values, field in zip(columns, PLACED, strict=True)]
    return pa.Table.from_arrays(arrays, schema=PLACED)
