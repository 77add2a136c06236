"""What indexes of binary codes and of vectors take in memory, by a scan and by graphs: faiss, beside a map's own."""

from __future__ import annotations

import statistics
import sys
import time
from typing import TYPE_CHECKING, Any, cast

import faiss
import numpy as np

from tests.benchmarks.measure import Figure, one_thread, seconds, wall
from tests.benchmarks.search import BEST, BITS, DRIVE, FLOATS, free_memory_gb

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_LINKS = {"IndexBinaryHNSW": 16, "IndexHNSWFlat": 32, "IndexHNSWSQ": 32}
"""Of a node of a graph, on every layer but the lowest, which has twice as many: for vectors 32 (HNSW32), with the
efConstruction of 40 and the efSearch of 16 that faiss has by itself; for codes 16. IndexHNSWSQ is the graph of vectors
again, of floats of 16 bits."""
_ROOM = 0.8
"""Of the free memory what a graph may take: what is added needs some, too."""
_ADDED = 10 * DRIVE
"""Codes and vectors made and added at a time: 41 MB of floats, of which there are three copies meanwhile."""
_TOLD_S = 10.0
"""Between two lines about a graph that is built."""


def faiss_indexes(count: int, queries: int, threads: int, codes: bool, vectors: bool) -> Iterator[Figure]:
    """What faiss takes. Codes and vectors of a drive change step by step, as places do: unrelated ones are the worst
    that a graph can be given."""
    kinds: dict[str, tuple[Callable[[], Any], int]] = {"IndexBinaryFlat": (lambda: faiss.IndexBinaryFlat(BITS), 1)}
    if codes:
        kinds["IndexBinaryHNSW"] = (lambda: faiss.IndexBinaryHNSW(BITS, _LINKS["IndexBinaryHNSW"]), 1)
    if vectors:
        fits = count * _bytes_per_place("IndexHNSWFlat", 32) < _ROOM * 1e9 * free_memory_gb()
        graph, wide = ("IndexHNSWFlat", 32) if fits else ("IndexHNSWSQ", 16)
        kinds[graph] = (lambda: _graph_of_vectors(graph, count), wide)
    for name, (make, wide) in kinds.items():
        index = make()
        spent, cpu, asked, best = _filled(index, name, count, queries, threads, wide == 1)
        with one_thread():
            one = [seconds(lambda i=i, a=asked, x=index: x.search(a[i : i + 1], BEST)) for i in range(queries)]
        faiss.omp_set_num_threads(threads)
        on_all = [wall(lambda i=i, a=asked, x=index: x.search(a[i : i + 1], BEST)) for i in range(queries)]
        together = min(wall(lambda a=asked, x=index: x.search(a, BEST)) for _ in range(3))
        facts = {
            "places": count,
            "one_thread_ms": round(1000 * statistics.median(one), 3),
            "threads": threads,
            "all_threads_ms": round(1000 * statistics.median(on_all), 3),
            "of_many_all_threads_ms": round(1000 * together / queries, 3),
            "build_s": round(spent, 1),
            "build_cpu_s": round(cpu, 1),
            "bytes_per_place": _bytes_per_place(name, wide),
            "of_the_best": round(_found(index.search(asked, BEST), best), 3),
        }
        title = f"faiss {name} {BITS if wide == 1 else FLOATS} over {count:,} places, ms a view"
        yield Figure(title, 1000 * statistics.median(one), None, True, facts)
        del index


def _bytes_per_place(name: str, wide: int) -> int:
    """Of values of so many bits, and of links on the lowest layer of a graph."""
    return (BITS if wide == 1 else FLOATS) * wide // 8 + 2 * 4 * _LINKS.get(name, 0)


def _graph_of_vectors(name: str, count: int) -> Any:
    """An empty one with room for all vectors: else twice their memory is taken while they grow."""
    if name == "IndexHNSWFlat":
        index = faiss.IndexHNSWFlat(FLOATS, _LINKS[name], faiss.METRIC_INNER_PRODUCT)
    else:
        half: Any = faiss.ScalarQuantizer.QT_fp16  # the stubs know another constructor
        index = faiss.IndexHNSWSQ(FLOATS, half, _LINKS[name], faiss.METRIC_INNER_PRODUCT)
        index.is_trained = True  # nothing is learned for these
    storage = cast("Any", faiss.downcast_index(index.storage))
    storage.codes.resize(storage.code_size * count)
    storage.codes.resize(0)
    return index


def _filled(
    index: Any, name: str, count: int, queries: int, threads: int, binary: bool
) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Fill an index. Seconds by the wall and of all cores that it took, without making what goes in; some of that to
    ask for, of the first drives; and (queries,) how far the last of the truly best is."""
    faiss.omp_set_num_threads(threads)
    spent = cpu = 0.0
    asked, best = np.empty((0, 0)), np.empty((queries, 0))
    said = began = time.perf_counter()
    for at in range(0, count, _ADDED):
        values = _walking(min(_ADDED, count - at), at, binary)
        asked = values[:: max(len(values) // queries, 1)][:queries].copy() if not at else asked
        best = np.sort(np.concatenate([best, _distances(asked, values)], axis=1), axis=1)[:, :BEST]
        start = time.perf_counter(), time.process_time()
        index.add(values)
        spent, cpu = spent + time.perf_counter() - start[0], cpu + time.process_time() - start[1]
        done, now = at + len(values), time.perf_counter()
        if now - said > _TOLD_S:
            said = now
            left = (now - began) * (count - done) / done
            print(f"{name}: {done:,} of {count:,}, some {left / 60:.0f} min left", file=sys.stderr, flush=True)
    return spent, cpu, asked, best[:, -1]


def _distances(asked: np.ndarray, values: np.ndarray) -> np.ndarray:
    """As faiss has them, but so that less is nearer."""
    if values.dtype == np.uint8:
        return np.stack([np.bitwise_count(values ^ one).sum(axis=1, dtype=np.int32) for one in asked])
    return -(asked @ values.T)


def _found(answers: tuple[np.ndarray, np.ndarray], least: np.ndarray) -> float:
    """Of the truly best what share is among the answers, where as near counts as well."""
    distances = np.abs(answers[0]) if answers[0].dtype.kind == "i" else -answers[0]
    return float((distances <= least[:, None] + 1e-5).mean())  # a product has another last bit by another way


def _walking(count: int, seed: int, binary: bool) -> np.ndarray:
    rng = np.random.default_rng((7, seed))
    steps = -(-count // DRIVE)
    values = np.empty((DRIVE, steps, FLOATS), np.float32)
    values[0] = rng.standard_normal((steps, FLOATS))
    for step in range(1, DRIVE):
        values[step] = 0.97 * values[step - 1] + 0.243 * rng.standard_normal((steps, FLOATS), np.float32)
    values = values.transpose(1, 0, 2).reshape(-1, FLOATS)[:count]
    if binary:
        return np.packbits(values > 0, axis=1)
    return values / np.linalg.norm(values, axis=1, keepdims=True)
