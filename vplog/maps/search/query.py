"""Queries: the places of a map that are most like the views of a log."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vplog import logs
from vplog.data import Floats, Ints, Keyframes
from vplog.errors import LibraryError, LogError, ResultError
from vplog.execution.execution import Execution
from vplog.features.extraction import extract_frames
from vplog.loops.match_probability import LookAlikes
from vplog.maps.geo_bounds import Box, DriveBounds, box_of_fixes
from vplog.maps.search.exact import RankedPlaces, best_places
from vplog.maps.search.index import SegmentView, check_content, pictures_of, read_column, update_index
from vplog.maps.search.probability import answer_probabilities
from vplog.maps.search.sequences import EXACT_PLACES, PLACES_A_VIEW, LineSearch, best_lines, drives_by_votes
from vplog.maps.storage import map_store
from vplog.maps.storage.contents import damage_warnings, skip_damaged
from vplog.maps.storage.damage import reading_drive
from vplog.maps.storage.download_cache import Cache
from vplog.maps.storage.layout import PICTURES
from vplog.maps.storage.map_store import Store
from vplog.pipeline import Pipeline
from vplog.places.library_files import check_descriptors
from vplog.places.sequence import SequenceSettings
from vplog.places.views import views_of
from vplog.results import tables
from vplog.results.run_record import read_run_json
from vplog.run.keyframes import KeyframeSettings, select_keyframes
from vplog.stages import CodedState, EvidenceState, FrameState, Log, PlaceState, StoredState
from vplog.storage.remote_path import RemotePath
from vplog.storage.scratch import check_file_output


@dataclass(frozen=True)
class MapQuery:
    """A query of a map, and what it is answered with."""

    top: int = 10
    """Places for each view."""
    sequence: int | None = None
    """Views in a window, within which lines run; 1: each view for itself; None: as the map's settings have it."""
    out: Path | None = None
    """Table of the answers."""
    executor: Executor | None = None
    """Workers that search the map, whose folder they see under the same path."""
    cache: Cache | None = None
    """Where the files of a map on an object store are read from, but for its manifests."""
    drives: Sequence[str] = ()
    """The drives to search; all if there are none."""
    box: Box | None = None
    """Only drives that may have places in it are searched."""
    near_fixes_m: float | None = None
    """Only drives that may have places as near to the log's own satellite fixes are searched."""
    as_of: str | None = None
    """Version or time of a map on an object store; None: the newest."""


def query_map(
    root: Path, path: Path, topics: logs.TopicChoice | None = None, query: MapQuery = MapQuery(),
    execution: Execution = Execution(),
) -> dict[str, Any]:  # fmt: skip
    """The `top` places of the map that are most like each view of a log, or a picture.

    Views are chosen and described as the map's drives were, with its library. Raises VplogError with one line.
    """
    if (out := query.out) is not None:
        check_file_output(out)
    with map_store.reading(root, query.cache, query.as_of) as store:
        known, pipeline, state = open_map(store, execution)
        settings = pipeline.sequence
        if query.sequence is not None:
            settings = SequenceSettings.read({**settings.model_dump(), "length": query.sequence}, "--sequence")
        log = logs.open_images([path], topics) if logs.is_image_file(path) else logs.open(path, topics)
        if query.near_fixes_m is not None:
            query = replace(query, box=box_of_fixes(log.gps(), query.near_fixes_m, log.name))
        DriveBounds(known).within(query.drives, query.box, str(store))  # before any work
        views, keyframes, unspaced = select_views(log, pipeline.keyframes)
        if query.sequence is None and keyframes is None and settings.length > 1:  # spaced as they come
            settings = settings.model_copy(update={"length": 1})
            if log.file_names() is None:
                unspaced.append(
                    "Its views are not spaced evenly, so single ones are searched, unless --sequence is given."
                )
        stamps, descriptors, warnings = describe_log(log, views, pipeline, state, execution)
        warnings = unspaced + warnings

        def attempt() -> tuple[list[str], RankedPlaces, list[str], pa.Table, list[dict[str, Any]]]:
            drives = map_store.common_library(store)[1]
            names = list(drives)
            numbers, short = DriveBounds(drives).within(query.drives, query.box, str(store))
            numbered = {number: names[number] for number in numbers.tolist()}
            short += _short_drives(store, numbered.values(), settings.length)
            part = replace(query, drives=list(numbered.values()))
            known = None if settings.length == 1 else LookAlikes.of(len(descriptors))
            answers, more = search(store, drives, state, descriptors, part, LineSearch(settings, known), execution)
            p_match = answer_probabilities(store, numbered, state, descriptors, answers, known, execution)
            table = _table(store, drives, answers, stamps, p_match)
            named = _named(store, drives, table, log)
            if isinstance(state, EvidenceState):
                _add_evidence(named, store, names, answers, state, descriptors)
            return list(drives), answers, short + more, table, named

        drives, answers, more, table, named = skip_damaged(store, attempt)
        warnings += damage_warnings(store)
    if out is not None:
        pipeline = pipeline.model_copy(update={"sequence": settings})
        tables.write_placed(out, table, tables.TableMetadata(pipeline.model_dump(mode="json"), state.hash))
    answered = answers.count > 0
    best = answers.drive[answered, :1]
    return {
        "map": str(root),
        "log": str(path),
        "library": state.hash,
        "top": query.top,
        "sequence": settings.length,
        "written": None if out is None else str(out),
        "views": len(stamps),
        "answered": int(answered.sum()),
        "best_by_drive": {drive: int((best == number).sum()) for number, drive in enumerate(drives)},
        "warnings": log.warnings + warnings + more,
        "answers": named,
    }


def index_map(root: Path, execution: Execution = Execution(), cache: Cache | None = None) -> dict[str, Any]:
    """Bring the index of a map up to its drives, which the next query would do; that of a map on an object store in
    the cache. Raises VplogError with one line."""
    if isinstance(root, RemotePath) and cache is None:
        raise ResultError(f"The index of {root} is stored in a cache only, and there is none. Name one with --cache.")
    with map_store.reading(root, cache) as store:
        _, _, state = open_map(store, execution)
        if not isinstance(state, CodedState):
            raise ResultError(f"{root} is of another recogniser than bobb, and is searched without an index.")

        def update() -> tuple[dict[str, Any], list[SegmentView], list[str]]:
            drives = map_store.common_library(store)[1]
            return drives, *update_index(store, drives, state, execution)

        drives, parts, warnings = skip_damaged(store, update)
        files = [part.path for part in parts if part.path is not None]
        return {
            "map": str(root),
            "drives": list(drives),
            "places": sum(part.places for part in parts),
            "segments": [str(path) for path in files],
            "bytes": sum(path.stat().st_size for path in files),
            "warnings": damage_warnings(store) + warnings,
        }


def open_map(store: Store, execution: Execution) -> tuple[dict[str, dict[str, Any]], Pipeline, PlaceState]:
    """The drives of a map, its settings, and the library that describes its places. Raises VplogError."""
    library, drives = map_store.common_library(store)
    pipeline = Pipeline.read(store.head().settings, f"{store}/map.json")
    folder = store.library(library)
    if not (folder / "library.json").is_file():
        raise LibraryError(
            f"{store} has lost its library {library}. Copy it back to {folder}, or describe the map again: vplog "
            f"map redescribe {store} --library LIB -o MAP"
        )
    return drives, pipeline, pipeline.places.load(folder, Execution(execution.threads))


def select_views(log: Log, settings: KeyframeSettings) -> tuple[Ints, Keyframes | None, list[str]]:
    """Stamps (Q,) of the keyframes of a log, or of all its frames where no two have odometry, and warnings."""
    odometry, stamps = log.odometry(), log.stamps()
    if odometry is None or len(odometry.stamp_ns) < 2:
        without = [] if log.file_names() else [f"{log.name} has no odometry, so every frame is a query."]
        return stamps, None, without  # pictures never have any
    if len(stamps) < 2:
        return stamps, None, []
    try:
        keyframes, warnings = select_keyframes(log.name, stamps, odometry, settings)
    except LogError as error:
        return stamps, None, [f"{error} Every frame is a query."]
    return keyframes.stamp_ns, keyframes, warnings


def describe_log(
    log: Log, stamps: Ints, pipeline: Pipeline, state: PlaceState, execution: Execution, *, query: bool = True
) -> tuple[Ints, list[Any], list[str]]:
    """Stamps (Q,) and descriptors of the frames of a log with some stamps, and what was lost.

    `query` is False for a log that becomes a drive of the map. A descriptor takes some hundred bytes, and no image or
    feature is kept.
    """
    described, descriptors, lost, warnings = [], [], [], list[str]()
    found = _descriptors(log, stamps, pipeline, state, execution, query)
    for stamp_ns, descriptor, why in execution.counted("describe", found, len(stamps)):
        if descriptor is None:
            lost.append(why)
        else:
            described.append(stamp_ns)
            descriptors.append(descriptor)
    if not described:
        raise LogError(f"{log.name}: none of {len(stamps)} frames could be decoded. {' '.join(lost[:1])}")
    if lost:
        warnings.append(f"{len(lost)} of {len(stamps)} views were lost to damaged images. First: {lost[0]}")
    return np.array(described, np.int64), descriptors, warnings


def _descriptors(
    log: Log, stamps: Ints, pipeline: Pipeline, state: PlaceState, execution: Execution, query: bool
) -> Iterator[tuple[int, Any, str]]:
    """Stamp and descriptor of each frame, which is None, with the reason, where it does not decode."""
    if isinstance(state, FrameState | StoredState):
        views = views_of(state, log, stamps, lambda _: None, query)

        def view(given: tuple[int, Any]) -> tuple[int, Any, str]:
            try:
                return given[0], views.describe(views.load(given[1])), ""
            except LogError as error:
                return given[0], None, str(error)

        return execution.map(view, zip(stamps.tolist(), views.items, strict=True), ahead=2)

    references = getattr(state, "references", ())

    def features(found: Any) -> tuple[int, Any, str]:
        stamp_ns, _, features, why = found
        if features is None:
            return stamp_ns, None, why
        check_descriptors(references, features)
        return stamp_ns, state.describe(features), why

    return execution.map(features, extract_frames(log.frames(stamps), pipeline.features, execution, pipeline.stereo))


def search(
    store: Store, drives: Mapping[str, Mapping[str, Any]], state: PlaceState, descriptors: Sequence[Any],
    query: MapQuery, lines: LineSearch, execution: Execution = Execution(),
) -> tuple[RankedPlaces, list[str]]:  # fmt: skip
    """The best places of the map's drives, or of `query.drives` of them, for each of Q views in order, and warnings.

    Ties go to the earlier drive, then row. Single views are ranked exactly, by the map's index where the recogniser is
    `bobb`. Lines are drawn in every drive of a map of up to EXACT_PLACES, else in the likely ones (`sequences.py`).
    """
    wanted = set(query.drives or drives)
    numbered = {number: drive for number, drive in enumerate(drives) if drive in wanted}
    count, warnings, executor = len(numbered), list[str](), query.executor
    if not isinstance(state, CodedState):
        places = sum(store.rows("descriptors", drive) for drive in numbered.values())
        if executor is not None:
            warnings.append("Ray was not used: a map of another recogniser than bobb is searched here.")
    else:
        parts, warnings = update_index(store, drives, state, execution)
        parts = [part for one in parts if (part := one.of(numbered)).places]
        if store.mirror is not None:  # workers elsewhere do not see these files, and fetch those of the bucket
            parts = [replace(part, path=None, stored=store.mirror.stored_index(part.path)) for part in parts]
        places = sum(part.places for part in parts)
        if lines.settings.length == 1:
            return best_places(parts, state, descriptors, min(query.top, places), execution, executor), warnings
        if places > EXACT_PLACES:
            single = best_places(parts, state, descriptors, PLACES_A_VIEW, execution, executor)
            numbered = {number: numbered[number] for number in drives_by_votes(single, lines.settings.length).tolist()}
            warnings.append(f"Sequences were searched in the {len(numbered)} of {count} drives most like single views.")
        elif executor is not None:
            warnings.append(f"Ray was not used: sequences in maps of up to {EXACT_PLACES} places are searched here.")
    top = min(query.top, places)
    return best_lines(store, numbered, state, descriptors, top, lines, execution), warnings


def _short_drives(store: Store, drives: Iterable[str], length: int) -> list[str]:
    """A warning where a window of views is longer than drives: they have too few places for its statistics."""
    short = [drive for drive in drives if store.rows("keyframes", drive) < length] if length > 1 else []
    if not short:
        return []
    more = f" and {len(short) - 1} more have" if len(short) > 1 else " has"
    return [
        f"{short[0]}{more} fewer keyframes than the window of {length} views, so matches there are missed. Search "
        "single views: --sequence 1"
    ]


def _named(
    store: Store, drives: Mapping[str, Mapping[str, Any]], table: pa.Table, log: Log
) -> list[dict[str, Any]]:  # fmt: skip
    """The answers as records, with the file names of pictures, as `query_name` and `match_name`."""
    own = log.file_names()
    row = {} if own is None else dict(zip(log.stamps().tolist(), own, strict=True))
    known: dict[str, Any] = {}
    for drive in set(table["drive"].to_pylist()):
        if drives[drive].get(PICTURES):
            known[drive] = read_run_json(store.file(drive, "run.json")).get("names")
    records = table.to_pylist()
    for one in records:
        if (name := row.get(one["query_stamp_ns"])) is not None:
            one["query_name"] = name
        names = known.get(one["drive"])
        if isinstance(names, list) and one["keyframe"] < len(names):
            one["match_name"] = str(names[one["keyframe"]])
    return records


def _add_evidence(
    named: Sequence[dict[str, Any]], store: Store, drives: Sequence[str], answers: RankedPlaces, state: EvidenceState,
    descriptors: Sequence[Any],
) -> None:  # fmt: skip
    """Write into the best answer of each view what most of its score is of, as `evidence`."""
    found: dict[int, str] = {}
    answered = np.flatnonzero(answers.count > 0)
    for number in np.unique(answers.drive[answered, 0]).tolist():
        views = answered[answers.drive[answered, 0] == number]
        column = read_column(store, drives[number], state)
        places = state.from_arrow(column.take(pa.array(answers.keyframe[views, 0])))
        pairs = zip(views.tolist(), places, strict=True)
        found |= {view: state.evidence(descriptors[view], place) for view, place in pairs}
    for one in named:
        if one["rank"] == 0 and found.get(one["query"]):
            one["evidence"] = found[one["query"]]


def _table(
    store: Store, drives: Mapping[str, Mapping[str, Any]], answers: RankedPlaces, stamps: Ints, p_match: Floats
) -> pa.Table:  # fmt: skip
    there = np.arange(answers.score.shape[1]) < answers.count[:, None]
    query, rank = np.nonzero(there)
    number, keyframe = answers.drive[there], answers.keyframe[there]
    stamp, camera = np.empty(len(query), np.int64), np.empty(len(query), np.int32)
    numbers: list[int] = number.tolist()
    each = list(drives)
    for one in set(numbers):
        path = store.file(each[one], "descriptors.parquet")
        with reading_drive(each[one]):
            known, (keyframe_of, camera_of) = tables.read_stamps(path), pictures_of(store, each[one])
        check_content(store, each[one], drives[each[one]])
        rows = keyframe[number == one]
        stamp[number == one], keyframe[number == one], camera[number == one] = (
            values[rows] for values in (known, keyframe_of, camera_of)
        )
    names = [each[one] for one in numbers]
    return tables.placed_table(
        [
            query.astype(np.int32), stamps[query], rank.astype(np.int32), names, keyframe, stamp,
            answers.score[there], answers.support[there], np.where(rank == 0, p_match[query], np.nan), camera,
        ]
    )  # fmt: skip
