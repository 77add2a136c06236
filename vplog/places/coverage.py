"""Coverage of a drive by reference images: to choose them by, and for the record of a run.

A reference explains a frame as far as the frame's features are found on it, by near descriptors of few strong features.
References are chosen greedily, within 1 - 1/e of the best choice (Nemhauser, Wolsey & Fisher 1978, section 4). For the
record of a run only matches that keep their arrangement count, less the most that do so in permutations of the matches.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import scipy

from vplog.data import Bytes, Features, Float32s, Ints, Keyframes
from vplog.execution.execution import Execution
from vplog.places.library import Library, Words, WordSettings, hnsw, l1_distance
from vplog.places.reference_choice import LEAST_SIZE, PAPER_SIZE, LibrarySettings, evenly

STRONGEST = 200
"""Features of a frame that the choice is made by: a quarter of what describes a place is enough."""
_CANDIDATES_A_REFERENCE = 4
"""Candidates a requested reference: neighbours a quarter of the references' distance apart hardly differ."""
_LEAST_CANDIDATES = 256
"""Least candidates, of 64 references or fewer, as far as there are frames."""
_FRAMES_A_CANDIDATE = 2
"""Frames to be explained for each candidate, so that half of them are no candidates themselves."""
_NEIGHBOURS = 10
"""Nearest neighbours of each feature: the default of a library's own words."""
_MAX_L1 = 0.4
"""L1 distance of two descriptors of unit length that are the same (Tanaka et al. 2014, section III-B)."""
_ENOUGH = 0.5
"""Share of what a frame's best candidate explains that is enough. By R@1 and ANR on Gardens Point with 20 and 50
references, half is better than the plain sum of shares, its root, or fixed caps of 4 and 8 %."""

_MEASURED_FRAMES = 200
"""Frames that the figure of a run is measured on, evenly along it: one standard error is 3.5 % at most."""
_FIRST_FRAMES = 48
"""Frames measured first: one standard error is 7 % at most, and where `POOR` is three away the others do not matter."""
_MEASURED_FEATURES = 400
"""Strongest features of a frame that are translated: half of what describes a place, for half of the time."""
_BEST_REFERENCES = 4
"""References with most matches that are checked: the paper's J."""
_NEAR = 0.2
"""Two matches are neighbours within this share of the image's sides: a view shifts and scales little across it."""
_AGREE = 0.03
"""Neighbours that move together differ in their displacement by less than this share of the image's sides."""
_PAIRINGS = 8
"""Permutations of the matches by which the level of chance is estimated."""
EXPLAINED = 0.01
"""Share of a frame's features, beyond chance, from which on it counts as explained: four of 400. Frames of another site
or light have a median of 0 and at most .013 at the 90th percentile, those of the library's drive .010 to .30."""
POOR = 1 / 3
"""Share of explained frames below which a run is warned. Libraries of the drive or its route in the same light explain
.51 to 1.0 of the frames, of another light or site 0 to .11, by which R@1 falls from .67 to .35 and less."""


def choose_by_coverage(
    count: int, descriptors_of: Callable[[int], Bytes], settings: LibrarySettings, execution: Execution
) -> Ints:
    """Rows, increasing, of the frames among `count` that explain all frames best.

    `descriptors_of` gives the (M, 128) descriptors of a row, strongest first. Rows of several drives are chosen from
    alike: one that no other drive explains gets references of its own. Long drives are looked at in even steps, so
    that the cost depends on the requested size alone.
    """
    if count == 0:
        return np.zeros(0, np.int64)
    frames = evenly(count, frames_needed(settings.size))
    candidates = evenly(len(frames), _candidates(settings.size))
    strong = [np.array(descriptors_of(int(row))[:STRONGEST]) for row in frames]
    found = explanations(strong, candidates, execution)
    most, least = (PAPER_SIZE, LEAST_SIZE) if settings.size is None else (settings.size, settings.size)
    chosen = greedy_cover(found, min(most, len(candidates)))
    if settings.size is None:
        chosen = chosen[: max(_needed_count(found, chosen, settings.least_gain), least)]
    others = np.setdiff1d(np.arange(len(candidates)), chosen)  # where nothing explains more, what is missing, evenly
    chosen = np.concatenate([chosen, others[evenly(len(others), max(least - len(chosen), 0))]])
    return np.sort(frames[candidates[chosen]])


def frames_needed(size: int | None) -> int:
    """Number of frames, evenly along the drives, that a choice of `size` references compares."""
    return _FRAMES_A_CANDIDATE * _candidates(size)


def _candidates(size: int | None) -> int:
    return max(_LEAST_CANDIDATES, _CANDIDATES_A_REFERENCE * (size or 0))


def explanations(descriptors: Sequence[Bytes], candidates: Ints, execution: Execution) -> scipy.sparse.csr_array:
    """(F, C) float32: the share of the features (M, 128) of each frame that each candidate, a row of `descriptors`,
    explains. Columns rise within a row, and no frame explains itself."""
    owners = np.repeat(np.arange(len(candidates)), [len(descriptors[row]) for row in candidates])
    pool = np.concatenate([descriptors[row] for row in candidates])
    number = np.full(len(descriptors), -1)
    number[candidates] = np.arange(len(candidates))
    shape = len(descriptors), len(candidates)
    if len(pool) == 0:
        return scipy.sparse.csr_array(shape, dtype=np.float32)
    settings = WordSettings()
    index = hnsw(pool.astype(np.float32), settings.hnsw_links, settings.hnsw_ef_construction, settings.hnsw_ef_search)

    def explained_by(row: int) -> tuple[Ints, Float32s]:
        found = descriptors[row]
        if len(found) == 0:
            return np.zeros(0, np.int64), np.zeros(0, np.float32)
        near = index.search(found.astype(np.float32), _NEIGHBOURS)[1]
        same = (l1_distance(found, pool, near) < _MAX_L1) & (near >= 0) & (owners[near] != number[row])
        once = np.unique(np.nonzero(same)[0] * len(candidates) + owners[near[same]])  # a feature counts once
        candidate, count = np.unique(once % len(candidates), return_counts=True)
        return candidate, (count / len(found)).astype(np.float32)

    candidate, share = zip(*execution.map(explained_by, range(len(descriptors))), strict=True)
    start = np.concatenate([[0], np.cumsum([len(one) for one in candidate])])
    return scipy.sparse.csr_array((np.concatenate(share), np.concatenate(candidate), start), shape=shape)


def greedy_cover(found: scipy.sparse.csr_array, size: int) -> Ints:
    """At most `size` candidates, the one that adds most first; fewer where none adds anything.

    Maximises the sum over the frames of the worth of their best reference, see `_worth`. Ties go to the first.
    """
    worth: Any = _worth(found)
    columns: Any = scipy.sparse.csc_array(worth)
    best, chosen = np.zeros(worth.shape[0]), list[int]()
    gain = np.bincount(worth.indices, worth.data, worth.shape[1])
    while len(chosen) < size and gain[c := int(np.argmax(gain))] > 1e-9:  # what is left is rounding
        part = slice(columns.indptr[c], columns.indptr[c + 1])
        better = columns.data[part] > best[columns.indices[part]]
        frames, now = columns.indices[part][better], columns.data[part][better]
        others = worth[frames].tocoo()  # what they add to these frames is less now
        less = np.maximum(others.data - best[frames][others.row], 0.0) - np.maximum(others.data - now[others.row], 0.0)
        np.subtract.at(gain, others.col, less)
        best[frames], gain[c] = now, -1.0
        chosen.append(c)
    return np.array(chosen, np.int64)


def _worth(found: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """0..1, of each candidate to each frame: 1 where it explains half as much as the frame's best candidate does.

    Relative to the frame's best, so that a bare wall counts as much as a facade; capped, so that the frames of one
    place share a reference.
    """
    frame = found.tocoo().row
    best = np.zeros(len(found.indptr) - 1)
    np.maximum.at(best, frame, found.data)
    worth = np.minimum(found.data / (_ENOUGH * best[frame]), 1.0)
    return scipy.sparse.csr_array((worth, found.indices, found.indptr), shape=found.shape)


def _needed_count(found: scipy.sparse.csr_array, chosen: Ints, least_gain: float) -> int:
    """Number of the chosen that are needed: the last of them still adds `least_gain` of what is explained."""
    total = np.maximum.accumulate(_worth(found).toarray()[:, chosen], axis=1).sum(axis=0)
    poor = np.flatnonzero(np.diff(total, prepend=0.0) < least_gain * total)
    return int(poor[0]) if len(poor) else len(chosen)


@dataclass(frozen=True)
class Coverage:
    """The part of a drive that a library explains."""

    explained: float
    """Share of the measured frames that are explained, 0..1."""
    median: float
    """Median over the frames of the share of features that the best reference explains beyond chance."""
    frames: int
    """Measured frames."""


def measure_coverage(
    keyframes: Keyframes, features_of: Callable[[int], Features], library: Library, execution: Execution
) -> Coverage:
    """Coverage of a drive's keyframes by the library: 48 of them, evenly, or 200 where that leaves it open
    whether the library is poor. Own images do not count."""
    own = [(row, one) for row, one in enumerate(library.references) if one.drive == keyframes.drive]
    itself, stamp_ns = {one.stamp_ns: row for row, one in own}, keyframes.stamp_ns

    def share(row: int) -> float:
        features = features_of(row)
        words = library.translate(features.descriptors[:_MEASURED_FEATURES])
        size = features.width, features.height
        return explained_share(
            words, features.points[:_MEASURED_FEATURES], size, library, itself.get(int(stamp_ns[row]), -1)
        )

    rows = evenly(len(stamp_ns), _MEASURED_FRAMES)
    first = evenly(len(rows), _FIRST_FRAMES)
    shares = np.array(list(execution.map(share, rows[first].tolist())))
    doubt = 3.0 * np.sqrt(POOR * (1.0 - POOR) / max(len(first), 1))
    if abs(float((shares >= EXPLAINED).mean()) - POOR) < doubt:
        others = np.array(list(execution.map(share, np.delete(rows, first).tolist())))
        shares = np.concatenate([shares, others])
    return Coverage(float((shares >= EXPLAINED).mean()), float(np.median(shares)), len(shares))


def explained_share(
    words: Words, points: Float32s, size: tuple[int, int], library: Library, leave_out: int = -1
) -> float:
    """Share 0..1 of an image's features that the reference explaining it best explains, beyond chance.

    `words` of M features at `points` (M, 2) px of an image of `size` (width, height) px. Counted are matches with
    another one near them in the image that moves the same way, less the largest such count of their permutations.
    Reference `leave_out`, the image itself, does not count.
    """
    if len(points) == 0:
        return 0.0
    sizes = np.array([library.size(row) for row in range(len(library))], np.float64)
    owner = np.searchsorted(library.start, words.values, side="right") - 1
    feature = np.repeat(np.arange(len(points)), np.diff(words.start))
    keep = owner != leave_out
    owner, feature, values = owner[keep], feature[keep], words.values[keep]
    counts = np.bincount(np.unique(owner * len(points) + feature) // len(points), minlength=len(library))
    best = 0.0
    for reference in np.argsort(-counts, kind="stable")[:_BEST_REFERENCES]:
        of = owner == reference
        here = (points[feature[of]] + 0.5) / np.array(size)
        there = (library.points[values[of]] + 0.5) / sizes[reference]
        best = max(best, _beyond_chance(here, there, feature[of], values[of]))
    return best / len(points)


@numba.njit(cache=True, nogil=True)
def _beyond_chance(here, there, feature, value):
    """Features with geometrically consistent matches, less the most among permuted matches (chance); at least 0."""
    m = feature.shape[0]
    if m < 2:
        return 0
    pairings, chance = min(_PAIRINGS, m - 1), 0
    for n in range(pairings):
        chance = max(chance, _consistent(here, there, feature, value, (n + 1) * m // (pairings + 1)))
    return max(_consistent(here, there, feature, value, 0) - chance, 0)


@numba.njit(cache=True, nogil=True)
def _consistent(here, there, feature, value, shift):
    """Features with a match that moves as another match near it does; match a gets the position of a + shift in the
    reference, so that a shift other than 0 permutes the matches."""
    m = feature.shape[0]
    count, last = 0, -1
    for a in range(m):
        if feature[a] == last:
            continue
        ta = (a + shift) % m
        for b in range(m):
            tb = (b + shift) % m
            if feature[a] == feature[b] or value[ta] == value[tb]:
                continue
            x, y = here[a, 0] - here[b, 0], here[a, 1] - here[b, 1]
            if abs(x) > _NEAR or abs(y) > _NEAR or abs(x) + abs(y) < 1e-3:  # one point in two orientations is no two
                continue
            dx, dy = there[ta, 0] - there[tb, 0] - x, there[ta, 1] - there[tb, 1] - y
            if dx * dx + dy * dy < _AGREE * _AGREE:
                count, last = count + 1, feature[a]
                break
    return count


def coverage_warning(coverage: Coverage, frames: int, given: bool, size: int) -> str | None:
    """One line on what to do where the library explains too little of a drive of `frames` frames; None where it does.

    `given`: the library was not made from the drive; `size` is its L.
    """
    if coverage.explained >= POOR:
        return None
    reason = (
        f"The library explains {100 * coverage.explained:.0f} % of the {frames} keyframes, so few returns are found."
    )
    if given:
        return f"{reason} Build one from this drive, or one in the same light: vplog library LOG -o LIB."
    if 2 * size <= frames // 2:
        return f"{reason} Take a larger one: --set library.size={2 * size}."
    return f"{reason} The views share too little: more keyframes may help, --set keyframes.distance_m lower."
