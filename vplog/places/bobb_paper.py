"""Bag of bounding boxes: Tanaka et al., Mining Visual Phrases for Long-Term Visual SLAM, IROS 2014.

An image is explained by the J references that share most of its features (section III-A) and, on each of them, by
I boxes: each where the features of one window of the image are found again (section III-B, Algorithm 3).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, Self

import numba
import numpy as np
import pyarrow as pa
from pydantic import Field, PositiveFloat, model_validator

from vplog.data import Boxes, Features, Float32s, Floats, Int32s, Ints, Reference, SharedReferences
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places import library as lib
from vplog.places import rvp
from vplog.places.bobb import NO_REFERENCE
from vplog.places.columns import RecordState
from vplog.places.library_files import RelearnedSettings
from vplog.places.overlap import BoxIndex, BoxPlace, list_shared

_WHOLE_IMAGE = np.array([0.0, 0.0, 1.0, 1.0])


class PaperBobbSettings(lib.WordSettings, RelearnedSettings):
    """Bag of bounding boxes with the paper's numbers (section IV)."""

    kind: Literal["bobb_paper"] = "bobb_paper"
    """Name of the recogniser."""
    l1_range: Literal[1, 2] = 1
    references: int = Field(default=4, ge=1, le=1000)
    """J: reference images that explain an image."""
    boxes: int = Field(default=4, ge=1, le=1000)
    """I: boxes mined on each of them."""
    partitions: int = Field(default=200, ge=1, le=10_000)
    """K: random partitions of a reference."""
    columns: int = Field(default=32, ge=1, le=256)
    """M: patches of a partition along the image's width."""
    rows: int = Field(default=16, ge=1, le=256)
    """N: patches of a partition along the image's height."""
    window_share: float = Field(default=0.4, gt=0, le=1)
    """Side of a window (subimage) as a share of the image's; the paper leaves it open."""
    grid: int = Field(default=64, ge=1, le=255)
    """Boxes begin and end on a grid of this many cells along each side, at most 255: one byte a coordinate."""
    max_box_share: float = Field(default=0.1, gt=0, le=1)
    """Largest share of the reference a box may cover."""
    aspects: tuple[PositiveFloat, ...] = Field(default=(0.25, 0.5, 0.7, 1.0, 1.4, 2.0, 4.0), min_length=1)
    """Width to height of the boxes tried, in units of the image's own; votes never shrink a box, so all are largest."""
    seed: int = Field(default=0, ge=0)
    """Seed of the windows and the partitions."""

    @model_validator(mode="after")
    def _has_boxes(self) -> Self:
        if self.grid**2 * self.max_box_share < 1:
            raise ValueError(
                f"max_box_share {self.max_box_share} of a grid of {self.grid} x {self.grid} is less than one cell"
            )
        return self

    def learn(self, references: Iterable[Reference], execution: Execution) -> PaperBobbState:
        """Index the references and partition them. Raises LibraryError where they are too few or have no features."""
        library = lib.build_library(references, self, execution)
        if len(library) < self.references:
            raise LibraryError(
                f"The library has {len(library)} reference images, but places.references is {self.references}. "
                "Add images, or set places.references lower."
            )
        if len(library) >= NO_REFERENCE:  # the ledger has their numbers in two bytes
            raise LibraryError(
                f"A library may have {NO_REFERENCE - 1} reference images, this one {len(library)}. Set library.size "
                "lower."
            )
        patterns = list(execution.map(lambda row: _prepare(library, row, self), range(len(library))))
        return PaperBobbState(self, library, patterns)


def _prepare(library: lib.Library, row: int, settings: PaperBobbSettings) -> rvp.Pattern:
    """Histograms of all patches of all partitions of one reference (Alg. 3 lines 6-9), as postings and totals."""
    first, last = library.start[row], library.start[row + 1]
    starts = library.words.start[first : last + 1]
    values = library.words.values[starts[0] : starts[-1]]
    owners = np.repeat(np.arange(last - first, dtype=np.int32), np.diff(starts))
    order = np.argsort(values, kind="stable")
    words, counts = np.unique(values, return_counts=True)
    width, height = library.size(row)
    rng = np.random.default_rng([settings.seed, 1, row])
    x_cuts, y_cuts = rvp.draw_partitions(width, height, settings.partitions, settings.columns, settings.rows, rng)
    patches = rvp.patches_of(library.points[first:last], x_cuts, y_cuts)
    return rvp.Pattern(
        words=words.astype(np.int32),
        posting_start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
        posting=owners[order],
        patches=patches,
        totals=rvp.patch_totals(patches, np.diff(starts), settings.columns * settings.rows),
        x_cuts=x_cuts,
        y_cuts=y_cuts,
        grid_x=rvp.grid_cuts(width, settings.grid),
        grid_y=rvp.grid_cuts(height, settings.grid),
    )


class PaperBobbState(RecordState):
    """A library, indexed and partitioned. Shared freely between threads."""

    record, none = BoxPlace, -1

    def __init__(self, settings: PaperBobbSettings, library: lib.Library, patterns: list[rvp.Pattern]) -> None:
        super().__init__(settings, library.references)
        s, self.library, self.patterns = settings, library, patterns
        # Alg. 1 line 4 draws windows at random; one draw serves all images, so that no image's noise can change it
        corners = np.random.default_rng([s.seed, 0]).uniform(0.0, 1.0 - s.window_share, (s.references, s.boxes, 2))
        self._windows = np.concatenate([corners, corners + s.window_share], axis=-1)
        self._shapes = rvp.box_shapes(s.grid, s.max_box_share, s.aspects)

    @property
    def bits(self) -> int:
        """ceil(log2 C(L, J)) for the set of references and, for each of the I x J boxes, which of all boxes it is."""
        s = self.settings
        per_box = math.ceil(math.log2(rvp.count_boxes(s.grid, self._shapes)))
        return math.ceil(math.log2(math.comb(len(self.library), s.references))) + s.references * s.boxes * per_box

    @property
    def layout(self) -> dict[str, tuple[pa.DataType, tuple[int, ...]]]:
        J, windows = self.settings.references, self.settings.boxes
        return {"references": (pa.int32(), (J,)), "boxes": (pa.uint8(), (J, windows, 4))}

    def describe(self, features: Features) -> BoxPlace:
        """Algorithm 1: the references that explain the features, and a box for each window on each of them."""
        s = self.settings
        points = features.points[: s.features]
        words = self.library.translate(features.descriptors[: s.features])
        chosen = self._retrieve(words)
        references = np.full(s.references, -1, np.int32)
        boxes = np.zeros((s.references, s.boxes, 4), np.uint8)
        for j, reference in enumerate(chosen):
            references[j] = reference
            for i in range(s.boxes):
                cells = self.votes(words, points, (features.width, features.height), reference, self._windows[j, i])
                boxes[j, i] = rvp.dominant_box(cells, self._shapes)
        return BoxPlace(references, boxes)

    def _retrieve(self, words: lib.Words) -> Int32s:
        """At most J references, those that share words with most features first (Alg. 1 line 2)."""
        matches = _count_matches(words.start, words.values, self.library.start)
        order = np.lexsort((np.arange(len(matches)), -matches))[: self.settings.references]
        return order[matches[order] > 0].astype(np.int32)

    def votes(
        self, words: lib.Words, points: Float32s, size: tuple[int, int], reference: int, window: Floats
    ) -> Floats:
        """(G, G) votes that the features inside a window (x0 y0 x1 y1, shares of the image) give a reference."""
        pattern = self.patterns[reference]
        shares = (points + 0.5) / np.array(size, points.dtype)
        inside = ((shares >= window[:2]) & (shares < window[2:])).all(axis=1)
        return rvp.vote(*_histogram(words.start, words.values, inside, pattern.words), pattern)

    def windows(self, rank: int) -> Floats:
        """(I, 4) windows that are searched on the reference of that rank."""
        return self._windows[rank]

    def boxes(self, place: BoxPlace) -> Boxes:
        """The boxes of a place as shares of the reference's sides."""
        used = place.references >= 0
        corners = place.boxes[used] / float(self.settings.grid)
        corners[np.all(place.boxes[used] == 0, axis=-1)] = np.nan
        return Boxes(place.references[used].astype(np.int64), corners)

    def voting_maps(self, features: Features, references: Sequence[int]) -> list[Floats]:
        """(N, M) votes of the features of a whole image for each reference, 1 at most."""
        words = self.library.translate(features.descriptors[: self.settings.features])
        points, size, maps = features.points[: self.settings.features], (features.width, features.height), []
        for reference in references:
            cells, pattern = self.votes(words, points, size, reference, _WHOLE_IMAGE), self.patterns[reference]
            votes = rvp.voting_map(cells, pattern.grid_x, pattern.grid_y)
            maps.append(votes / max(float(votes.max()), 1e-12))
        return maps

    def index(self, descriptors: Sequence[BoxPlace]) -> BoxIndex:
        references, boxes = self.arrays(descriptors)
        return BoxIndex(references, boxes, len(self.library), self.settings.grid)

    def shared(self, places: Sequence[BoxPlace], query: Int32s, match: Int32s) -> SharedReferences:
        """Contributions of the references to Eq. (1) of pairs (C,) of rows of `places`; equal boxes overlap by 1."""
        references, boxes = (part.astype(np.int64) for part in self.arrays(places))

        def compare(rows: Ints, ranks: Ints, others: Ints, other_ranks: Ints) -> tuple[Floats, Floats]:
            mine, theirs = boxes[rows, ranks][:, :, None], boxes[others, other_ranks][:, None]
            common = np.minimum(mine[..., 2:], theirs[..., 2:]) - np.maximum(mine[..., :2], theirs[..., :2])
            cells = np.maximum(common, 0).prod(axis=-1).max(axis=2).sum(axis=1).astype(np.float64)
            area = (mine[..., 2:] - mine[..., :2]).prod(axis=-1).sum(axis=(1, 2))
            return cells / np.maximum(area, 1), cells

        return list_shared(references, query, match, compare)

    def checked(self, fields: Sequence[Any]) -> list[Any]:
        """As `RecordState.checked`. Raises LibraryError also for a box beyond the grid."""
        references, boxes = super().checked(fields)
        grid = self.settings.grid
        if len(boxes) and boxes.max() > grid:
            raise LibraryError(f"The descriptors have boxes beyond the grid of {grid} x {grid} cells.")
        return [references, boxes]


@numba.njit(cache=True, nogil=True)
def _count_matches(start, words, reference_start):
    """(L,) int32: features with a word among each reference's features; a feature counts once a reference."""
    L = reference_start.shape[0] - 1
    matches = np.zeros(L, np.int32)
    for f in range(start.shape[0] - 1):
        last = -1
        for e in range(start[f], start[f + 1]):
            reference = np.searchsorted(reference_start, words[e], side="right") - 1
            if reference != last:  # words increase, so those of one reference stand together
                matches[reference] += 1
                last = reference
    return matches


@numba.njit(cache=True, nogil=True)
def _histogram(start, words, inside, vocabulary):
    """(U,) int32 counts of the reference's words among the features inside, and the count of all their words."""
    H = np.zeros(vocabulary.shape[0], np.int32)
    size = 0
    for f in range(start.shape[0] - 1):
        if not inside[f]:
            continue
        size += start[f + 1] - start[f]
        for e in range(start[f], start[f + 1]):
            u = np.searchsorted(vocabulary, words[e])
            if u < vocabulary.shape[0] and vocabulary[u] == words[e]:
                H[u] += 1
    return H, size
