"""Feature matches between two images: mutual nearest neighbours that pass Lowe's ratio test."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from pydantic import Field

from vplog.data import Bytes, Features, Ints
from vplog.settings import Settings

_EXACT = 1 << 24
"""Integers up to 2^24 are exact in float32, so no order of summation changes a distance (IEEE 754)."""


_REMEMBERED = 4096
"""Pairs of images whose matches are kept, some 40 MB: those of 2000 keyframes with their neighbours."""


class MatchSettings(Settings):
    """Matching of the features of two images."""

    features: int = Field(default=1000, ge=1)
    """Number of features matched of each image, the strongest ones; time grows with its square, and 1000 SIFT
    already give hundreds of matches for a revisit."""
    ratio: float = Field(default=0.75, gt=0.0, le=1.0)
    """A match is kept when its distance is below this share of the second best's: Lowe 2004, section 7.1, fig. 11,
    where 0.8 drops 90 % of the wrong matches; 0.75 halves the rest, so that most wrong candidates end here."""
    first_look: int = Field(default=400, ge=1)
    """Strongest features by which a candidate is first judged, at a sixth of the time: where they hold less than their
    part of the required matches, it ends there. True candidates hold twice as many and more."""


def match(a: Bytes, b: Bytes, ratio: float) -> tuple[Ints, Ints]:
    """Rows (K,) int64 of `a` and of `b` that match, by increasing row of `a`.

    `a` (A, D) and `b` (B, D) are uint8 descriptors compared by Euclidean distance. Distances are integers and exact,
    so every machine, BLAS and thread count gives the same matches. Equal distances go to the lower row.
    """
    if len(a) == 0 or len(b) < 2:  # no second best, no ratio test
        return np.empty(0, np.int64), np.empty(0, np.int64)
    return _distinct(squared_distances(a, b), ratio)


def _distinct(distances: np.ndarray, ratio: float) -> tuple[Ints, Ints]:
    """Rows and columns of mutual nearest neighbours that pass the ratio test along their row."""
    rows = np.arange(len(distances))
    best_b = distances.argmin(axis=1)
    best = distances[rows, best_b]
    mutual = best == distances.min(axis=0)[best_b]
    distances[rows, best_b] = np.inf
    second = distances.min(axis=1)
    distances[rows, best_b] = best
    # in double, where both sides are exact up to one rounding of ratio^2
    distinct = best.astype(np.float64) < ratio**2 * second.astype(np.float64)
    chosen = np.flatnonzero(mutual & distinct)
    # rows of a at the same distance: the first
    chosen = chosen[distances[:, best_b[chosen]].argmin(axis=0) == chosen]
    return chosen, best_b[chosen]


def match_features(a: Features, b: Features, settings: MatchSettings) -> tuple[Ints, Ints]:
    """`match` of the strongest features of two images, one match for each pair of positions.

    SIFT gives a point one descriptor for each strong orientation; counted twice they would be two votes of one point.
    """
    found = match(a.descriptors[: settings.features], b.descriptors[: settings.features], settings.ratio)
    return _once(a, b, *found)


def _once(a: Features, b: Features, rows_a: Ints, rows_b: Ints) -> tuple[Ints, Ints]:
    """The first match of each pair of positions."""
    positions = np.concatenate([a.points[rows_a], b.points[rows_b]], axis=1) + np.float32(0)  # so that -0 is 0
    _, first = np.unique(positions.view(f"V{positions.itemsize * 4}"), return_index=True)  # faster than by axis=0
    first.sort()
    return rows_a[first], rows_b[first]


class PairMatches:
    """`match_features` of pairs of a drive's images, each compared once for both orders: neighbours are matched from
    either side, and again by later steps. Safe to share between threads."""

    def __init__(self, features: Callable[[int], Features], settings: MatchSettings) -> None:
        def both(a: int, b: int) -> tuple[tuple[Ints, Ints], tuple[Ints, Ints]]:
            one, other = features(a), features(b)
            if min(len(one), len(other)) < 2:
                return match_features(one, other, settings), match_features(other, one, settings)
            distances = squared_distances(*(each.descriptors[: settings.features] for each in (one, other)))
            turned = np.ascontiguousarray(distances.T)
            return (
                _once(one, other, *_distinct(distances, settings.ratio)),
                _once(other, one, *_distinct(turned, settings.ratio)),
            )

        self._both = lru_cache(_REMEMBERED)(both)

    def __call__(self, a: int, b: int) -> tuple[Ints, Ints]:
        """Rows (K,) of the features of image `a` and of image `b` that match."""
        return self._both(a, b)[0] if a < b else self._both(b, a)[1]


def first_matches(a: Features, b: Features, settings: MatchSettings, needed: int) -> int | None:
    """Matches among the strongest features where they are too few for `needed` among all; None where all must tell."""
    share = settings.first_look / settings.features
    if share >= 1.0 or min(len(a), len(b)) <= settings.first_look:
        return None
    found, _ = match_features(a, b, settings.model_copy(update={"features": settings.first_look}))
    return len(found) if len(found) < share * needed else None


def squared_distances(a: Bytes, b: Bytes) -> np.ndarray:
    """(A, B) squared Euclidean distances from one matrix product: [-2a, 1, |a|^2] . [b, |b|^2, 1]."""
    length = a.shape[1]
    kind = np.float32 if 2 * length * 255**2 < _EXACT else np.float64  # float32 up to 129 dimensions
    left = np.empty((len(a), length + 2), kind)
    right = np.empty((len(b), length + 2), kind)
    left[:, :length], right[:, :length] = a, b
    left[:, length], right[:, length + 1] = 1, 1
    left[:, length + 1] = np.einsum("ij,ij->i", left[:, :length], left[:, :length])
    right[:, length] = np.einsum("ij,ij->i", right[:, :length], right[:, :length])
    left[:, :length] *= -2
    return left @ right.T
