"""Bag of bounding boxes, after Tanaka et al., Mining Visual Phrases for Long-Term Visual SLAM, IROS 2014.

The references that explain an image (section III-A), boxes on each of them where the features of a window are found
again (section III-B), and the overlap of boxes on shared references as similarity (Eq. 1). `bobb_paper.py` is the paper
to the letter; here votes have the closed form of `expected_votes.py`, and the other departures are settings.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
import pyarrow as pa
from pydantic import Field, model_validator

from vplog.data import Boxes, Bytes, Features, Float32s, Floats, Int32s, Ints, Reference, SharedReferences
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places import expected_votes
from vplog.places.code_search import BLOCK, CodeIndex, CodeLists, Pairing, Place, build_lists, compare_windows
from vplog.places.columns import RecordState, from_column, to_column
from vplog.places.library_files import RelearnedSettings
from vplog.places.matches import (
    PATCH_WEIGHT,
    KindWeights,
    Matcher,
    Matches,
    Once,
    WeighedMatchSettings,
    index_references,
)
from vplog.places.overlap import list_shared
from vplog.places.self_recognition import misleading_patches

NO_REFERENCE = 65_535
"""Number in place of a reference, where fewer than J share features with the image."""
NO_BOX = 255
"""Number in place of a box, where no feature of a window is found again."""
_MAP_COLUMNS, _MAP_ROWS = 64, 36
"""Cells of a voting map that is drawn: finer than the patches it sums, 10 px of a 640 x 360 image."""


class BobbSettings(WeighedMatchSettings, RelearnedSettings):
    """Bag of bounding boxes, improved: J references of 2 + 1 + I bytes each."""

    kind: Literal["bobb"] = "bobb"
    """Name of the recogniser."""
    references: int = Field(default=10, ge=1, le=1000)
    """J: reference images that explain an image. With nine boxes each takes 12 bytes, so ten stay below 128."""
    candidates: int = Field(default=3, ge=1)
    """Times J: references whose matches are checked for agreement before the best J are taken."""
    agreement: float = Field(default=0.07, gt=0)
    """Matches of an image pair agree when their displacements differ by about this share of the image: a view some
    metres off moves near things by that much more than far ones."""
    agreement_floor: float = Field(default=0.3, ge=0, le=1)
    """Share of its weight that a match keeps when no other agrees; 1 switches agreement off."""
    popularity: float = Field(default=0.5, ge=0)
    """References that explain many others count less, by this power of how much they explain; 0 switches it off."""
    share_power: float = Field(default=0.5, ge=0)
    """A reference's weight is its part in explaining the image to this power. With the root, places of equal boxes
    score the Bhattacharyya coefficient of what explains them; with 1 the first reference decides nearly alone."""
    own: float = Field(default=2.0, ge=0)
    """An image of the library is explained by itself this many times as much as by the best other reference, since no
    other shows all of it; its boxes then lie where the windows are. With 0 it is explained by the others alone, and
    misses the one that a later visit has first."""
    windows_along: int = Field(default=3, ge=1, le=16)
    """Windows along each side; I is their square."""
    window_share: float = Field(default=0.4, gt=0, le=1)
    """Side of a window as a share of the image's: three of them overlap by a quarter of a window."""
    columns: int = Field(default=16, ge=1, le=255)
    """Cells of the voting grid along the width; 16 x 12 leave few enough positions for a byte."""
    rows: int = Field(default=12, ge=1, le=255)
    """Cells of the voting grid along the height."""
    patches_x: int = Field(default=32, ge=1)
    """M: patches of a random partition along the width; the closed form is the average over all of them."""
    patches_y: int = Field(default=16, ge=1)
    """N: patches of a random partition along the height."""
    box_columns: int = Field(default=8, ge=1)
    """Width of a box in cells. A box of half the sides is a window with a tenth around it, and overlaps one that lies
    up to half an image away: how far boxes are apart then tells, where the paper's tenth of the area misses at once."""
    box_rows: int = Field(default=6, ge=1)
    """Height of a box in cells."""
    pairing: Literal["best", "same", "both"] = "both"
    """Boxes of two places compared on one reference: each with the best of the other's (Eq. 1), with that of the same
    window, or the mean of the two: the same window tells a place seen from the same spot, the best a nearer view. In
    the mean all windows may be shifted by one, left or right, where that fits better: the camera has turned."""

    @model_validator(mode="after")
    def _fits_a_byte(self) -> Self:
        if self.box_columns > self.columns or self.box_rows > self.rows:
            raise ValueError(
                f"a box of {self.box_columns} x {self.box_rows} is larger than the grid of {self.columns} x {self.rows}"
            )
        if self.box_columns * self.box_rows > 255:
            raise ValueError(
                f"a box of {self.box_columns} x {self.box_rows} has more than 255 cells; use smaller boxes"
            )
        if (count := np.prod(self.positions)) > NO_BOX:
            raise ValueError(f"a box has {count} positions, and {NO_BOX} is the most; use fewer columns or rows")
        return self

    @property
    def boxes(self) -> int:
        """I: boxes on each reference."""
        return self.windows_along**2

    @property
    def positions(self) -> tuple[int, int]:
        """Positions of a box along the width and along the height."""
        return self.columns - self.box_columns + 1, self.rows - self.box_rows + 1

    def learn(self, references: Iterable[Reference], execution: Execution) -> BobbState:
        """Index the references, and how popular they are. Raises LibraryError where they have no features."""
        state = self.prepare(references, execution)
        state.weights()
        return state

    def prepare(self, references: Iterable[Reference], execution: Execution) -> BobbState:
        """`learn` without the index, which the first image to describe makes: comparing places needs none."""
        matcher = index_references(references, self)
        if isinstance(self.patch_weight, tuple) and len(self.patch_weight) != len(matcher):
            raise LibraryError(
                f"places.patch_weight has {len(self.patch_weight)} numbers for {len(matcher)} reference images. "
                "Give one for each, or a single one."
            )
        if len(matcher) >= NO_REFERENCE:
            raise LibraryError(
                f"A library may have {NO_REFERENCE - 1} reference images, this one {len(matcher)}. Set library.size "
                "lower."
            )

        def votes(weights: KindWeights) -> Floats:
            found = execution.map(lambda one: matcher.match(one.features, weights).votes(), matcher.references)
            return np.array(list(found))

        def weights() -> Weights:
            if self.patch_weight is not None:
                given = np.broadcast_to(self.patch_weight, len(matcher))
                return Weights.of(given, votes((1.0, given)), self.popularity)
            keypoints, patches = votes((1.0, 0.0)), votes((0.0, 1.0))
            used = np.where(misleading_patches(keypoints, patches, matcher.references), 0.0, PATCH_WEIGHT)
            return Weights.of(used, keypoints + used * patches, self.popularity)

        return BobbState(self, matcher, Once(weights))


@dataclass(frozen=True, eq=False)
class Weights:
    """Weights of the references, by a library's own images."""

    patches: Floats
    """(L,) weight of a match of patches on each; one of keypoints weighs 1."""
    rarity: Floats
    """(L,) weight of each reference."""

    @classmethod
    def of(cls, patches: Floats, votes: Floats, popularity: float) -> Weights:
        """Weights from the votes (L, L) that the images of references (rows) give the other references."""
        return cls(patches, _rarity(votes / np.maximum(votes.sum(axis=1, keepdims=True), 1e-9), popularity))


def _rarity(explained: Floats, power: float) -> Floats:
    """(L,) weight of each reference: its part in explaining the other references, against an even part, inverted.

    Fig. 9 of the paper: the most frequent reference is chosen ten times as often as half of the others. A part is
    not taken for less than a twentieth of an even one, which few images cannot tell from none.
    """
    part = explained.mean(axis=0) * len(explained)
    return 1.0 / np.maximum(part, 0.05) ** power


class BobbState(RecordState):
    """A library, indexed when it first describes. Safe to share between threads."""

    record, none = Place, NO_REFERENCE

    def __init__(self, settings: BobbSettings, matcher: Matcher, weights: Once[Weights]) -> None:
        super().__init__(settings, matcher.references)
        s, self.matcher, self.weights = settings, matcher, weights
        self._windows = expected_votes.even_windows(s.windows_along, s.window_share)
        self._along_x = expected_votes.box_sums(s.columns, s.patches_x, s.box_columns)
        self._along_y = expected_votes.box_sums(s.rows, s.patches_y, s.box_rows)

    @property
    def bits(self) -> int:
        """Size of the references, their weights and boxes, as stored."""
        return 8 * self.settings.references * (2 + 1 + self.settings.boxes)

    @property
    def layout(self) -> dict[str, tuple[pa.DataType, tuple[int, ...]]]:
        J, windows = self.settings.references, self.settings.boxes
        return {
            "references": (pa.uint16(), (J,)),
            "weights": (pa.uint8(), (J,)),
            "boxes": (pa.uint8(), (J, windows)),
        }

    def describe(self, features: Features) -> Place:
        """Algorithm 1: the references that explain the features, and a box for each window on each of them."""
        s = self.settings
        references = np.full(s.references, NO_REFERENCE, np.uint16)
        weights = np.zeros(s.references, np.uint8)
        boxes = np.full((s.references, s.boxes), NO_BOX, np.uint8)
        matches = self.matcher.match(features, (1.0, self.weights().patches))
        for j, (reference, share, here, there, agreed) in enumerate(self._retrieve(matches)):
            references[j], weights[j] = reference, max(round(255 * share**s.share_power), 1)
            boxes[j] = expected_votes.best_boxes(
                here, there, agreed, self._windows, self._along_y, self._along_x, NO_BOX
            )
        return Place(references, weights, boxes)

    def _retrieve(self, matches: Matches) -> list[tuple[int, float, Float32s, Float32s, Float32s]]:
        """At most J references that explain most (Alg. 1 line 2), each's share of the best one's, and its matches.

        The first 3 J by the sum of weights are looked at again, with matches that agree in their motion counting more.
        """
        s = self.settings
        rarity = self.weights().rarity
        total = matches.votes() * rarity
        found: list[tuple[int, float, Float32s, Float32s, Float32s]] = []
        for reference in np.argsort(-total, kind="stable")[: s.candidates * s.references].tolist():
            if total[reference] <= 0.0:
                break
            here, there, agreed = self.agreed(matches, reference)
            explained = float(agreed.sum(dtype=np.float64) * rarity[reference])
            if explained > 0.0:  # with a floor of 0 matches that agree with none have no weight
                found.append((reference, explained, here, there, agreed))
        if s.own > 0 and matches.itself >= 0:
            best = max((explained for _, explained, *_ in found), default=1.0)
            found.insert(0, (matches.itself, s.own * best, *self.agreed(matches, matches.itself)))
        found.sort(key=lambda one: -one[1])
        return [(reference, explained / found[0][1], *rest) for reference, explained, *rest in found[: s.references]]  # pyrefly: ignore[bad-return]

    def agreed(self, matches: Matches, reference: int) -> tuple[Float32s, Float32s, Float32s]:
        """Positions of the matches with a reference, (E, 2) in the image and (E, 2) in the reference, as shares of the
        sides, and their weights (E,), higher for matches that move as their neighbours do.

        An image of the library matches itself in all its features.
        """
        if reference == matches.itself:
            return matches.points, matches.points, np.ones(len(matches.points), np.float32)
        s = self.settings
        part = slice(matches.start[reference], matches.start[reference + 1])
        here, there, weight = matches.here[part], matches.there[part], matches.weight[part]
        return here, there, expected_votes.agreement(here, there, weight, s.agreement, s.agreement_floor)

    def windows(self, rank: int) -> Floats:
        """(I, 4) windows x0 y0 x1 y1, the same for references of any rank."""
        return self._windows

    def boxes(self, place: Place) -> Boxes:
        """The boxes of a place as shares of the reference's sides."""
        s = self.settings
        used = place.references != NO_REFERENCE
        codes = place.boxes[used].astype(np.int64)
        row, column = np.divmod(codes, s.positions[0])
        ends = [column / s.columns, row / s.rows, (column + s.box_columns) / s.columns, (row + s.box_rows) / s.rows]
        corners = np.stack(ends, axis=-1)
        corners[codes == NO_BOX] = np.nan
        return Boxes(place.references[used].astype(np.int64), corners)

    def voting_maps(self, features: Features, references: Sequence[int]) -> list[Floats]:
        """(36, 64) expected vote at the middle of every cell, by the closed form of `expected_votes`."""
        matches = self.matcher.match(features, (1.0, self.weights().patches))
        return [self._voting_map(matches, reference) for reference in references]

    def _voting_map(self, matches: Matches, reference: int) -> Floats:
        s = self.settings
        _, there, weight = self.agreed(matches, reference)
        x, y = (np.arange(_MAP_COLUMNS) + 0.5) / _MAP_COLUMNS, (np.arange(_MAP_ROWS) + 0.5) / _MAP_ROWS
        along_x = (1.0 - np.abs(x[:, None] - there[:, 0])) ** (s.patches_x - 1)
        along_y = (1.0 - np.abs(y[:, None] - there[:, 1])) ** (s.patches_y - 1)
        votes = np.einsum("ye,xe,e->yx", along_y, along_x, weight.astype(np.float64))
        return votes / max(float(votes.max()), 1e-12)

    def index(self, descriptors: Sequence[Place]) -> CodeIndex:
        references, weights, boxes = self.arrays(descriptors)
        lists = build_lists(references, weights, boxes, len(self.matcher), BLOCK)
        return CodeIndex(lists, self.overlaps(), self.pairing)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of references, and boxes on each."""
        return len(self.matcher), self.settings.boxes

    @property
    def pairing(self) -> Pairing:
        """Boxes of two places that are compared."""
        return self.settings.pairing

    def lists(self, *columns: pa.Array) -> CodeLists:
        """The inverted lists of the places of tables' columns, one after the other: what an index on disk holds.
        Raises LibraryError where one is of another kind or library."""
        arrays: Any = [self.checked(from_column(column, self.arrow_type)) for column in columns]
        references, weights, boxes = (np.concatenate(part) for part in zip(*arrays, strict=True))
        return build_lists(references, weights, boxes, len(self.matcher), BLOCK)

    def subset(self, references: Ints, execution: Execution) -> BobbState:
        """The recogniser with some of the references alone, in their order, and the weights of patches as they are."""
        patch_weight = tuple(self.weights().patches[references].tolist())
        settings = self.settings.model_copy(update={"patch_weight": patch_weight})
        return settings.prepare([self.references[row] for row in references.tolist()], execution)

    def on_subset(self, column: pa.Array, references: Ints) -> pa.Array:
        """The places of a column by some of the references alone, with the numbers that `subset` gives them."""
        known, weights, boxes = self.checked(from_column(column, self.arrow_type))
        number = np.full(NO_REFERENCE + 1, NO_REFERENCE, np.uint16)
        number[references] = np.arange(len(references), dtype=np.uint16)
        gone = number[known] == NO_REFERENCE
        fields = number[known], np.where(gone, 0, weights), np.where(gone[..., None], NO_BOX, boxes)
        return to_column(self.arrow_type, iter(fields))

    def overlaps(self) -> Bytes:
        """(256, 256) cells that two boxes share, by their numbers."""
        s = self.settings
        return expected_votes.overlaps(s.positions, s.box_columns, s.box_rows)

    def shared(self, places: Sequence[Place], query: Int32s, match: Int32s) -> SharedReferences:
        """Contributions of the references to the scores of pairs (C,) of rows of `places`; equal boxes overlap by 1."""
        s = self.settings
        references, weights, boxes = self.arrays(places)
        table = self.overlaps()

        def compare(rows: Ints, ranks: Ints, others: Ints, other_ranks: Ints) -> tuple[Floats, Floats]:
            cells = table[boxes[rows, ranks][:, :, None], boxes[others, other_ranks][:, None, :]].astype(np.float64)
            by_shift = compare_windows(cells, s.windows_along, s.pairing) / (s.boxes * s.box_columns * s.box_rows)
            worth = by_shift * (weights[rows, ranks] * weights[others, other_ranks].astype(np.int64))[:, None]
            pair = np.unique(np.column_stack([rows, others]), axis=0, return_inverse=True)[1].reshape(-1)
            total = np.zeros((int(pair.max(initial=-1)) + 1, 3))
            np.add.at(total, pair, worth)
            best = np.arange(len(rows)), total.argmax(axis=1)[pair]
            return by_shift[best], worth[best]

        return list_shared(np.where(references == NO_REFERENCE, -1, references.astype(np.int64)), query, match, compare)

    def evidence(self, query: Place, match: Place) -> str:
        """`keypoints`, `patches` or `keypoints and patches`: what contributes most to the score of two places; empty
        where they share no reference."""
        shared, mine, theirs = np.intersect1d(query.references, match.references, return_indices=True)
        known = shared != NO_REFERENCE
        worth = query.weights[mine[known]].astype(np.int64) * match.weights[theirs[known]]
        if not worth.any():
            return ""
        if self.settings.features == 0:
            return "patches"
        used = self.weights().patches[shared[known]] > 0
        return "keypoints and patches" if 2 * worth[used].sum() > worth.sum() else "keypoints"

    def checked(self, fields: Sequence[Any]) -> list[Any]:
        """As `RecordState.checked`. Raises LibraryError also for a box beyond the positions on a reference."""
        references, weights, boxes = super().checked(fields)
        positions = np.prod(self.settings.positions)
        if np.any((boxes >= positions) & (boxes != NO_BOX)):
            raise LibraryError(f"The descriptors name boxes beyond the {positions} that this recogniser knows.")
        return [references, weights, boxes]
