"""`vplog map query` over a map of millions of places on disk, beside indexes of codes and of vectors in memory.

The map is a real one but for its images: made-up places (see `search.py`) in drives of two thousand, each with its
drive.json and its descriptors.parquet, and a library of a thousand references with a few features each, which the
search does not look at.
"""

from __future__ import annotations

import os
import shutil
import statistics
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.benchmarks.faiss_indexes import faiss_indexes
from tests.benchmarks.measure import Figure, one_thread, seconds, wall
from tests.benchmarks.search import BEST, DRIVE, LIBRARY, Places, make_places, make_queries, plain_scores
from vplog.data import Features, Keyframes, Reference
from vplog.execution.execution import Execution
from vplog.maps.search.exact import best_places
from vplog.maps.search.index import update_index
from vplog.maps.storage.layout import sha256_of
from vplog.maps.storage.map_store import Store
from vplog.places.bobb import BobbSettings, BobbState, Place
from vplog.results import run_record, tables

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from vplog.maps.search.index import SegmentView

PART = 250 * DRIVE
"""Places made at a time."""
_SAMPLED = 1009
"""Every so many places one is kept for the queries."""
_CHECKED = 4
"""Queries whose best places are compared with those of a full sort."""


def scale(count: int, folder: Path, queries: int, threads: int, codes: bool, vectors: bool) -> Iterator[Figure]:
    """Build time, bytes, latency and exactness of a map of `count` places, made in `folder` unless it is there, and
    what a scan of codes takes on the same machine, and graphs of `codes` and `vectors`, slow to build: of 10^6 minutes.
    """
    settings = BobbSettings()
    state = made_up_library(settings)
    store = Store(folder / f"map-{count}")
    sample = write_map(store, count, state)
    asked = make_queries(sample, queries, settings)
    yield _building(store, state, count, threads)
    cold = _cold(store, state, asked)
    parts = _parts(store, state, threads)
    exact = are_exact(store, state, parts, asked[:_CHECKED])
    yield _searching(state, parts, asked, threads, {"cold_ms": cold, "checked": _CHECKED, "exact": exact})
    yield from faiss_indexes(count, queries, threads, codes, vectors)


def made_up_library(settings: BobbSettings, references: int = LIBRARY) -> BobbState:
    """References of which each has three features that nothing resembles."""
    rng = np.random.default_rng(5)

    def reference(number: int) -> Reference:
        points = rng.uniform(10, 90, (3, 2)).astype(np.float32)
        sizes, depth = np.full(3, 8, np.float32), np.full(3, np.nan, np.float32)
        found = Features(points, sizes, rng.integers(0, 256, (3, 128), dtype=np.uint8), depth, 100, 100)
        return Reference(np.zeros((100, 100), np.uint8), found, "made up", number)

    return settings.learn([reference(number) for number in range(references)], Execution())


def write_map(store: Store, count: int, state: BobbState, drive: int = DRIVE) -> Places:
    """The run folders of a map of `count` places, and every thousandth of them for queries to be made of."""
    kept = store.root / "sample.npz"
    if kept.is_file():
        with np.load(kept) as arrays:
            return Places(arrays["references"], arrays["weights"], arrays["boxes"])
    samples = []
    for at in range(0, count, PART):
        places = make_places(min(PART, count - at), state.settings, seed=at // PART, drive=drive)
        samples.append(places.rows(slice(None, None, _SAMPLED)))
        cuts = [slice(start, start + drive) for start in range(0, len(places), drive)]
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(lambda s, at=at, p=places: write_drive(store, at + s.start, p.rows(s), state), cuts))
    sample = Places(*(np.concatenate([vars(one)[name] for one in samples]) for name in vars(samples[0])))
    np.savez(kept, **vars(sample))
    return sample


def write_drive(store: Store, first: int, places: Places, state: BobbState) -> None:
    """The run folder of a drive, as far as a query reads it."""
    drive = f"drive-{first:09d}"
    stamps = np.arange(len(places), dtype=np.int64) * 10**8
    keyframes = Keyframes(drive, stamps, np.tile(np.eye(4), (len(places), 1, 1)))
    run = store.root / "runs" / f"drive={drive}"
    run.mkdir(parents=True, exist_ok=True)
    column = state.to_arrow([Place(*one) for one in zip(places.references, places.weights, places.boxes, strict=True)])
    about = tables.TableMetadata(state.settings.model_dump(mode="json"), state.hash)
    tables.write_descriptors(run / "descriptors.parquet", keyframes, column, about)
    key = sha256_of(run / "descriptors.parquet")
    record = {"drive": drive, "log": drive, "key": key, "library": state.hash, "inputs": {}}
    run_record.write_run_json(run / "drive.json", record)


def _parts(store: Store, state: BobbState, threads: int) -> list[SegmentView]:
    return update_index(store, store.drives(), state, Execution(threads))[0]


def _building(store: Store, state: BobbState, count: int, threads: int) -> Figure:
    """From the drives alone, and again with one drive more."""
    shutil.rmtree(store.index, ignore_errors=True)
    began, used = time.perf_counter(), time.process_time()
    parts = _parts(store, state, threads)
    built, used = time.perf_counter() - began, time.process_time() - used
    opened = wall(lambda: _parts(store, state, threads))
    size = sum(part.path.stat().st_size for part in parts if part.path)
    descriptors = [path.stat().st_size for path in store.root.glob("runs/*/descriptors.parquet")]
    new = count + 1
    write_drive(store, new, make_places(DRIVE, state.settings, seed=99), state)
    adding = wall(lambda: _parts(store, state, threads))
    shutil.rmtree(store.run(f"drive-{new:09d}"))
    _parts(store, state, threads)
    facts = {
        "places": count,
        "drives": len(descriptors),
        "threads": threads,
        "build_s": round(built, 2),
        "build_cpu_s": round(used, 2),
        "open_s": round(opened, 3),
        "add_a_drive_s": round(adding, 3),
        "segments": len(parts),
        "index_bytes_per_place": round(size / count, 1),
        "parquet_bytes_per_place": round(sum(descriptors) / count, 1),
    }
    return Figure(f"index of {count:,} places, microseconds a place", 1e6 * built / count, None, True, facts)


def are_exact(store: Store, state: BobbState, parts: Sequence[SegmentView], asked: list[Place]) -> bool:
    """The best places are those of a full sort of Eq. (1) over every place, drive by drive, to the last bit."""
    J, windows, pairing = state.settings.references, state.settings.boxes, state.settings.pairing
    best: list[list[tuple[float, int, int]]] = [[] for _ in asked]
    for number, drive in enumerate(store.drives()):
        column = tables.read_descriptors(store.file(drive, "descriptors.parquet"))[0].cast(state.arrow_type)
        names = ("references", "weights", "boxes")
        references, weights, boxes = (column.field(name).flatten().to_numpy() for name in names)
        places = Places(references.reshape(-1, J), weights.reshape(-1, J), boxes.reshape(-1, J, windows))
        for at, query in enumerate(asked):
            scores = plain_scores(places, query, state.settings, pairing)
            rows = np.lexsort((np.arange(len(scores)), -scores))[:BEST]
            more = [(-float(scores[row]), number, int(row)) for row in rows if scores[row] > 0]
            best[at] = sorted(best[at] + more)[:BEST]
    found = best_places(parts, state, asked, BEST, Execution())
    columns = (-found.score, found.drive, found.keyframe)
    told = [list(zip(*(part[at].tolist() for part in columns), strict=True)) for at in range(len(asked))]
    return told == best


def _cold(store: Store, state: BobbState, asked: list[Place]) -> float:
    """Milliseconds of a view on one thread with nothing of the index in memory; it is opened already."""
    spent = []
    for view in asked[:6]:
        files = [part.path for part in _parts(store, state, 1) if part.path]
        for path in files:  # which nobody has open now
            with path.open("rb") as stream:
                os.fsync(stream.fileno())
                os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        parts = _parts(store, state, 1)
        spent.append(wall(lambda v=view, p=parts: best_places(p, state, [v], BEST, Execution())))
        del parts
    return round(1000 * statistics.median(spent), 1)


def _searching(
    state: BobbState, parts: list[SegmentView], asked: list[Place], threads: int, told: dict[str, Any]
) -> Figure:
    def one(view: Place, cores: int) -> None:
        best_places(parts, state, [view], BEST, Execution(cores))

    count = sum(part.places for part in parts)
    with one_thread():
        for view in asked:  # so that what is compiled or first touched is not counted
            one(view, 1)
        alone = [seconds(lambda v=view: one(v, 1)) for view in asked]
        on_all = [wall(lambda v=view: one(v, threads)) for view in asked]
        together = seconds(lambda: best_places(parts, state, asked, BEST, Execution()))
        together_on_all = [wall(lambda: best_places(parts, state, asked, BEST, Execution(threads))) for _ in range(3)]
    facts = {
        "places": count,
        "one_thread_ms": round(1000 * statistics.median(alone), 2),
        "seen_before_ms": round(1000 * statistics.median(alone[1::2]), 2),
        "new_ms": round(1000 * statistics.median(alone[::2]), 2),
        "of_many_ms": round(1000 * together / len(asked), 2),
        "threads": threads,
        "all_threads_ms": round(1000 * statistics.median(on_all), 2),
        "of_many_all_threads_ms": round(1000 * min(together_on_all) / len(asked), 2),
        **told,
    }
    return Figure(f"map query over {count:,} places, ms a view", 1000 * statistics.median(alone), None, True, facts)
