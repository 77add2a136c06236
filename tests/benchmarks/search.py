"""Eq. (1) over a large map against what other systems scan: binary codes, and vectors of floats.

Made-up places, for no one has recorded a million. What decides the cost is how long the lists are, how fast weights
fall and how alike neighbours are, so these are as `vplog batch` has them of kitti00 and the Gardens walks, with a
library of the paper's size: reference r is as popular as 1 / (r + L / 18), which makes the first ten times as frequent
as the median one (the paper's Fig. 9; 4 to 12 on real drives); weights fall with rank n as n^-0.8 (mean weights 255,
178, 137, 111, 93, .. 42; real ones 255, 150-169, 112-119, 92-100, 80-89, .. 57-69); 9 % of boxes are nowhere (8 to 12),
and the others anywhere, so that unrelated places overlap by .69 at best and .32 in the same window (.65 and .34 to .37
on real ones). Places follow one another in drives: of ten references the next place has 6.0 again, the fifth 4.7 and
the tenth 3.4 (5.5-6.2, 3.6-4.6, 2.7-4.1), and of the boxes on these 23 % and 16 % are equal (14-25, 7-13).
Half of the queries are map places seen again (three of ten references are others, weights differ by 30 %, 40 % of the
boxes lie elsewhere), half are places that the map does not have, where least can be left out.
"""

from __future__ import annotations

import os
import statistics
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import faiss
import numba
import numpy as np

from tests.benchmarks.measure import Figure, in_turns, one_thread, seconds
from vplog.places import expected_votes
from vplog.places.bobb import NO_BOX, Place
from vplog.places.code_search import BLOCK, CodeIndex, build_lists

if TYPE_CHECKING:
    from vplog.places.bobb import BobbSettings

LIBRARY = 1000
BITS, FLOATS = 512, 512
"""Of the codes and vectors compared with."""
BEST = 20
CHUNK = 100_000
"""Codes and vectors made at a time."""
DRIVE = 2000
"""Places of a drive: one every metre of two kilometres."""
_STAYS, _SEEN = 0.94, 0.8
"""Shares of the references that the next place still has around it, and that a view tells."""
_BOX_STAYS, _BOX_SEEN = 0.9, 0.45
"""The same of boxes."""


@dataclass(frozen=True, eq=False)
class Places:
    references: np.ndarray
    weights: np.ndarray
    boxes: np.ndarray

    def __len__(self) -> int:
        return len(self.references)

    def rows(self, part: slice) -> Places:
        return Places(self.references[part], self.weights[part], self.boxes[part])


def make_places(count: int, settings: BobbSettings, seed: int, library: int = LIBRARY, drive: int = DRIVE) -> Places:
    """`count` places of drives of `drive` places each; see above. With `drive` 1 all are unrelated."""
    J = settings.references
    references, weights = np.empty((count, J), np.uint16), np.empty((count, J), np.uint8)
    boxes = np.empty((count, J, settings.boxes), np.uint8)
    popularity = np.cumsum(1.0 / (np.arange(library) + library / 18))
    popularity /= popularity[-1]
    positions = settings.positions[0] * settings.positions[1]
    for number, at in enumerate(range(0, count, drive)):
        part = slice(at, min(at + drive, count))
        strength = np.empty((part.stop - at, J), np.float32)
        rng = np.random.default_rng((seed, number))
        _follow(rng, popularity, positions, references[part], strength, boxes[part])
        order = np.argsort(-strength, axis=1, kind="stable")
        strength = np.take_along_axis(strength, order, axis=1)
        weights[part] = np.maximum(np.rint(255 * strength / strength[:, :1]), 1)
        references[part] = np.take_along_axis(references[part], order, axis=1)
        boxes[part] = np.take_along_axis(boxes[part], order[..., None], axis=1)
    return Places(references, weights, boxes)


@numba.njit(cache=True, nogil=True)
def _follow(rng, popularity, positions, references, strength, boxes):
    """Places one after the other, their references in no order."""
    length, J, windows = boxes.shape
    around, weighs = np.full(J, 65_535, np.uint16), np.empty(J)
    lie = np.empty((J, windows), np.uint8)
    for step in range(length):
        for j in range(J):
            gone = step == 0 or rng.random() > _STAYS
            if gone:
                around[j] = _another(rng, popularity, around, around)
                weighs[j] = rng.integers(1, J + 1) ** -0.8  # as often a first as a last
            for i in range(windows):
                if gone or rng.random() > _BOX_STAYS:
                    lie[j, i] = _anywhere(rng, positions)
        for j in range(J):
            seen = rng.random() < _SEEN
            references[step, j] = around[j] if seen else _another(rng, popularity, around, references[step, :j])
            weight = weighs[j] if seen else rng.integers(1, J + 1) ** -0.8
            strength[step, j] = weight * np.exp(0.3 * rng.normal())
            for i in range(windows):
                still = seen and rng.random() < _BOX_SEEN
                boxes[step, j, i] = lie[j, i] if still else _anywhere(rng, positions)


@numba.njit(cache=True, nogil=True)
def _another(rng, popularity, some, others):
    """A reference that is in neither."""
    while True:
        found = np.uint16(np.searchsorted(popularity, rng.random(), side="right"))
        if not np.any(some == found) and not np.any(others == found):
            return found


@numba.njit(cache=True, nogil=True)
def _anywhere(rng, positions):
    return np.uint8(NO_BOX if rng.random() < 0.09 else rng.integers(0, positions))


def make_queries(places: Places, count: int, settings: BobbSettings, library: int = LIBRARY) -> list[Place]:
    """Every second one is a place of the map as it might be seen again."""
    rng = np.random.default_rng(1)
    new = make_places(count, settings, seed=2, library=library, drive=1)
    queries = []
    for n in range(count):
        place = Place(new.references[n], new.weights[n], new.boxes[n])
        queries.append(seen_again(places, int(rng.integers(len(places))), place, rng) if n % 2 else place)
    return queries


def seen_again(places: Places, row: int, other: Place, rng: np.random.Generator) -> Place:
    """A place of the map as it might be seen again: three of ten references and 40 % of the boxes are another's."""
    replaced = rng.permutation(len(other.references))[: round(0.3 * len(other.references))]
    fresh = np.setdiff1d(other.references, places.references[row])[: len(replaced)]
    references = places.references[row].copy()
    references[replaced[: len(fresh)]] = fresh
    seen = places.weights[row] * np.exp(rng.normal(0, 0.3, len(references)))
    weights = np.maximum(np.rint(255 * seen / seen.max()), 1).astype(np.uint8)
    return Place(references, weights, np.where(rng.random(other.boxes.shape) < 0.4, other.boxes, places.boxes[row]))


def _table(settings: BobbSettings) -> np.ndarray:
    return expected_votes.overlaps(settings.positions, settings.box_columns, settings.box_rows)


def make_index(places: Places, settings: BobbSettings, pairing: Any, library: int = LIBRARY) -> CodeIndex:
    lists = build_lists(places.references, places.weights, places.boxes, library, BLOCK)
    return CodeIndex(lists, _table(settings), pairing)


def plain_scores(places: Places, query: Place, settings: BobbSettings, pairing: str) -> np.ndarray:
    """(N,) float32 Eq. (1) with weights, as it is written down: every pair of equal references, then one division."""
    table = _table(settings).astype(np.int64)
    total, along = np.zeros((len(places), 3), np.int64), settings.windows_along
    for j, reference in enumerate(query.references):
        row, k = np.nonzero(places.references == reference)
        cells = table[query.boxes[j][None, :, None], places.boxes[row, k][:, None, :]]
        in_row = np.einsum("erarb->eab", cells.reshape(-1, along, along, along, along))
        best, same = cells.max(axis=2).sum(axis=1)[:, None], np.trace(in_row, axis1=1, axis2=2)[:, None]
        beside = np.column_stack([np.trace(in_row, offset, 1, 2) for offset in (-1, 1)])
        both = np.hstack([5 * best + 5 * same, 5 * best + 6 * beside])
        alike = {"best": best, "same": same, "both": both}[pairing]
        np.add.at(total, row, int(query.weights[j]) * places.weights[row, k, None].astype(np.int64) * alike)
    length = np.sqrt((places.weights.astype(np.int64) ** 2).sum(axis=1))
    own = np.sqrt((query.weights.astype(np.int64) ** 2).sum())
    whole = int(table.max()) * (10 if pairing == "both" else 1) * query.boxes.shape[1]
    return (total.max(axis=1) / (length * (own * whole))).astype(np.float32)


def is_exact(index: CodeIndex, places: Places, query: Place, settings: BobbSettings, pairing: str) -> bool:
    """Every score is the plain one to the last bit, and the best rows are those of a full sort, ties by row."""
    plain = plain_scores(places, query, settings, pairing)
    ranking = index.query(query, BEST)
    order = np.lexsort((np.arange(len(plain)), -plain))[:BEST]
    order = order[plain[order] > 0]
    return (
        np.array_equal(index.scores(query), plain)
        and np.array_equal(ranking.rows, order)
        and np.array_equal(ranking.score, plain[order])
    )


def search(count: int, settings: BobbSettings, queries: int, rounds: int, bars: tuple[float, float]) -> list[Figure]:
    """Scores and the best 20 of one query after the other, on one thread: flat scans of codes and vectors to ours."""
    places = make_places(count, settings, seed=0)
    asked = make_queries(places, queries, settings)
    rng = np.random.default_rng(3)
    codes: Any = faiss.IndexBinaryFlat(BITS)
    vectors: Any = faiss.IndexFlatIP(FLOATS)
    for at in range(0, count, CHUNK):
        part = min(CHUNK, count - at)
        codes.add(rng.integers(0, 256, (part, BITS // 8), np.uint8))
        vectors.add(rng.standard_normal((part, FLOATS), np.float32))
    code_queries = rng.integers(0, 256, (queries, 1, BITS // 8), np.uint8)
    vector_queries = rng.standard_normal((queries, 1, FLOATS), np.float32)
    figures = []
    with one_thread():
        for pairing in (settings.pairing, *sorted({"best", "both", "same"} - {settings.pairing})):
            index = make_index(places, settings, pairing)
            exact = all(is_exact(index, places, query, settings, pairing) for query in asked[:4])
            turns_of = {
                "IndexBinaryFlat": (lambda: [codes.search(one, BEST) for one in code_queries], bars[0], BITS // 8),
                "IndexFlatIP": (lambda: [vectors.search(one, BEST) for one in vector_queries], bars[1], 4 * FLOATS),
            }
            for name, (scan, bar, size) in turns_of.items():
                if name == "IndexFlatIP" and pairing != settings.pairing:
                    continue
                turns = in_turns(scan, lambda index=index: [index.query(one, BEST) for one in asked], rounds)
                theirs, ours = (1000 * part / queries for part in turns.medians)
                facts = {
                    "places": count,
                    "library": LIBRARY,
                    "ours_ms": round(ours, 3),
                    "theirs_ms": round(theirs, 3),
                    "all_scores_ms": round(1000 * _a_query(index, asked), 3),
                    "bytes_per_place": round(index.nbytes / count, 1),
                    "bytes_stored": settings.references * (2 + 1 + settings.boxes),
                    "theirs_bytes": size,
                    "exact": exact,
                }
                width = BITS if name == "IndexBinaryFlat" else FLOATS
                title = f"faiss {name} {width} / Eq. (1), top {BEST}, {pairing}, one thread"
                figures.append(Figure(title, turns.ratio if exact else 0.0, bar, at_most=False, facts=facts))
    return figures


def _a_query(index: CodeIndex, asked: list[Place]) -> float:
    """Seconds of the scores of all places."""
    return statistics.median(seconds(lambda one=one: index.scores(one)) for one in asked)


def growth(counts: tuple[int, ...], settings: BobbSettings, queries: int) -> list[Figure]:
    """Milliseconds a query by size of the map, as a ratio to the smallest map's."""
    figures, first = [], 0.0
    with one_thread():
        for count in counts:
            places = make_places(count, settings, seed=0)
            asked = make_queries(places, queries, settings)
            built: list[CodeIndex] = []
            building = seconds(lambda places=places, built=built: built.append(make_index(places, settings, "both")))
            index = built[0]
            index.query(asked[0], BEST)
            spent = [seconds(lambda one=one, index=index: index.query(one, BEST)) for one in asked]
            middle = 1000 * statistics.median(spent)
            first = first or middle
            facts = {
                "places": count,
                "query_ms": round(middle, 3),
                "all_scores_ms": round(1000 * _a_query(index, asked), 3),
                "build_s": round(building, 3),
                "bytes_per_place": round(index.nbytes / count, 1),
            }
            figures.append(Figure(f"Eq. (1) over {count:,} places / {counts[0]:,}", middle / first, None, True, facts))
    return figures


def free_memory_gb() -> float:
    """Memory that this machine has to give, in GB (10^9 bytes)."""
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 1e9
