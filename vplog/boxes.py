"""What a recogniser that makes boxes has seen, in one form for pictures: all places are shares of an image's sides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.places import expected_votes, rvp
from vplog.places.bobb import NOBODY, NOWHERE, BobbState
from vplog.places.bobb_paper import PaperBobbState

if TYPE_CHECKING:
    from vplog.data import Features, Floats, Ints, Reference

    BoxState = BobbState | PaperBobbState

_MAP_COLUMNS, _MAP_ROWS = 64, 36
"""Cells of a voting map that is drawn: finer than the patches it sums, 10 px of a 640 x 360 image."""


@dataclass(frozen=True, eq=False)
class Boxes:
    """The boxes of one place."""

    references: Ints
    """(J,) best first; fewer where fewer references share anything."""
    corners: Floats
    """(J, I, 4) x0 y0 x1 y1, NaN where nothing of a window is found."""


def references_of(state: BoxState) -> list[Reference]:
    """The library, in the order that places number it."""
    return state.matcher.references if isinstance(state, BobbState) else state.library.references


def windows_of(state: BoxState, rank: int) -> Floats:
    """(I, 4) windows of an image that are looked for on its reference of that rank."""
    if isinstance(state, BobbState):
        return expected_votes.even_windows(state.settings.windows_along, state.settings.window_share)
    return state._windows[rank]  # pyright: ignore[reportPrivateUsage]


def boxes_of(state: BoxState, place: Any) -> Boxes:
    """The boxes of a place that this state described."""
    if isinstance(state, PaperBobbState):
        used = place.references >= 0
        corners = place.boxes[used] / float(state.settings.grid)
        corners[np.all(place.boxes[used] == 0, axis=-1)] = np.nan
        return Boxes(place.references[used].astype(np.int64), corners)
    s = state.settings
    used = place.references != NOBODY
    codes = place.boxes[used].astype(np.int64)
    row, column = np.divmod(codes, s.columns - s.box_columns + 1)
    ends = [column / s.columns, row / s.rows, (column + s.box_columns) / s.columns, (row + s.box_rows) / s.rows]
    corners = np.stack(ends, axis=-1)
    corners[codes == NOWHERE] = np.nan
    return Boxes(place.references[used].astype(np.int64), corners)


def voting_map(state: BoxState, features: Features, reference: int) -> Floats:
    """(rows, columns) votes that all features of an image give to a reference, 1 the most; zeros without a vote."""
    if isinstance(state, PaperBobbState):
        words = state.library.translate(features.descriptors[: state.settings.features])
        points = features.points[: state.settings.features]
        whole = np.array([0.0, 0.0, 1.0, 1.0])
        cells = state.votes(words, points, (features.width, features.height), reference, whole)
        votes = rvp.voting_map(cells, state.patterns[reference].grid_x, state.patterns[reference].grid_y)
    else:
        votes = _expected(state, features, reference)
    return votes / max(float(votes.max()), 1e-12)


def _expected(state: BobbState, features: Features, reference: int) -> Floats:
    """The expected vote at the middle of every cell, by the closed form of `expected_votes`."""
    s = state.settings
    _, there, weight = state.agreed(state.matcher.match(features), reference)
    x, y = (np.arange(_MAP_COLUMNS) + 0.5) / _MAP_COLUMNS, (np.arange(_MAP_ROWS) + 0.5) / _MAP_ROWS
    along_x = (1.0 - np.abs(x[:, None] - there[:, 0])) ** (s.patches_x - 1)
    along_y = (1.0 - np.abs(y[:, None] - there[:, 1])) ** (s.patches_y - 1)
    return np.einsum("ye,xe,e->yx", along_y, along_x, weight.astype(np.float64))
