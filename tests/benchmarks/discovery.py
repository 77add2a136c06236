"""Common pattern discovery against Algorithm 3 as the paper lists it, with NumPy inside its loops."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tests.benchmarks.measure import Figure, one_thread, seconds
from vplog.execution.execution import Execution
from vplog.places import expected_votes, rvp

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.benchmarks.images import Images
    from vplog.data import Bytes, Floats, Int32s, Ints
    from vplog.features.extractors import FeatureSettings
    from vplog.places.bobb import BobbSettings
    from vplog.places.bobb_paper import PaperBobbSettings, PaperBobbState

_TIMES = 200
"""Runs of a fast way that are timed as one: the clock is too coarse for less."""


class Picture(NamedTuple):
    """A reference as Algorithm 3 sees it: W words, one row a feature and word."""

    x: Ints
    """(W,) px."""
    y: Ints
    word: Ints
    """(W,) numbers from 0."""
    width: int
    height: int


def voting_map(H: Ints, picture: Picture, x_cuts: Int32s, y_cuts: Int32s) -> Floats:
    """(height, width) V, lines 1 to 16: every patch of every partition adds its similarity to its pixels."""
    V = np.zeros((picture.height, picture.width))
    for xs, ys in zip(x_cuts, y_cuts, strict=True):
        for x0, x1 in pairwise(xs):
            column = (picture.x >= x0) & (picture.x < x1)
            for y0, y1 in pairwise(ys):
                inside = column & (picture.y >= y0) & (picture.y < y1)
                H_mnk = np.bincount(picture.word[inside], minlength=len(H))
                largest = np.maximum(H, H_mnk).sum()
                V[y0:y1, x0:x1] += np.minimum(H, H_mnk).sum() / largest if largest else 0.0
    return V


def dominant_box(V: Floats, grid_x: Int32s, grid_y: Int32s, shapes: Int32s) -> tuple[float, list[int]]:
    """The most votes in a box, and where, line 17: by the integral image, one box after the other."""
    total = np.zeros((V.shape[0] + 1, V.shape[1] + 1))
    total[1:, 1:] = V.cumsum(axis=0).cumsum(axis=1)
    most, where = 0.0, [0, 0, 0, 0]
    for w, h in shapes.tolist():
        for r in range(len(grid_y) - h):
            for c in range(len(grid_x) - w):
                y0, y1, x0, x1 = grid_y[r], grid_y[r + h], grid_x[c], grid_x[c + w]
                votes = total[y1, x1] - total[y0, x1] - total[y1, x0] + total[y0, x0]
                if votes > most:
                    most, where = float(votes), [c, r, c + w, r + h]
    return most, where


def discovery(
    images: Images, extractor: FeatureSettings, ours: BobbSettings, paper: PaperBobbSettings, bar: float
) -> list[Figure]:
    """Windows of one image found on the reference that explains it best: the three ways, seconds a window."""
    references = images.references(extractor)
    features = extractor(images.images[0])
    with one_thread():
        literal, fast, chosen = _by_partitions(paper.learn(references, Execution()), features)
        closed = _in_closed_form(ours.learn(references, Execution()), features, chosen.windows)
    facts = {
        "pair": f"1 of {images.name}",
        "windows": len(chosen.windows),
        "partitions": paper.partitions,
        "literal_s": round(literal, 3),
    }
    return [
        Figure(
            "discovery, literal / expected votes (bobb)", literal / closed, bar, at_most=False,
            facts={**facts, "ours_ms": round(1000 * closed, 4)},
        ),
        Figure(
            "discovery, literal / partitions (bobb_paper)", literal / fast, bar, at_most=False,
            facts={**facts, "ours_ms": round(1000 * fast, 4), "votes_to_literal": round(chosen.votes, 6)},
        ),
    ]  # fmt: skip


class _Chosen(NamedTuple):
    windows: Floats
    votes: float
    """Votes of the literal map inside the fast way's boxes, to those inside the literal's best: 1 where equal."""


def _by_partitions(state: PaperBobbState, features) -> tuple[float, float, _Chosen]:
    """Seconds a window of the literal algorithm and of ours over the same partitions."""
    s = state.settings
    reference = int(state.describe(features).references[0])
    pattern, size = state.patterns[reference], (features.width, features.height)
    words, windows = state.library.translate(features.descriptors[: s.features]), state._windows[0]
    points = features.points[: s.features]
    picture, histogram = _picture(state, reference, words.values)
    slow, boxes = [], []
    for window in windows:
        x, y = (points[:, 0] + 0.5) / size[0], (points[:, 1] + 0.5) / size[1]
        inside = (x >= window[0]) & (x < window[2]) & (y >= window[1]) & (y < window[3])
        H = histogram(words.values[np.repeat(inside, np.diff(words.start))])
        began = time.process_time()
        V = voting_map(H, picture, pattern.x_cuts, pattern.y_cuts)
        boxes.append((V, *dominant_box(V, pattern.grid_x, pattern.grid_y, state._shapes)))
        slow.append(time.process_time() - began)

    def ours() -> list[Bytes]:
        return [
            rvp.dominant_box(state.votes(words, points, size, reference, window), state._shapes) for window in windows
        ]

    held = best = 0.0
    for (V, most, _), (x0, y0, x1, y1) in zip(boxes, ours(), strict=True):
        held += V[pattern.grid_y[y0] : pattern.grid_y[y1], pattern.grid_x[x0] : pattern.grid_x[x1]].sum()
        best += most
    fast = seconds(lambda: [ours() for _ in range(_TIMES)]) / _TIMES / len(windows)
    return float(np.mean(slow)), fast, _Chosen(windows, held / best if best else 1.0)


def _picture(state: PaperBobbState, reference: int, image_words: Int32s) -> tuple[Picture, Callable[[Int32s], Ints]]:
    """The reference's features by word, and how to make H: words of the pair alone, numbered from 0."""
    library = state.library
    first, last = library.start[reference], library.start[reference + 1]
    starts = library.words.start[first : last + 1]
    values = library.words.values[starts[0] : starts[-1]]
    known = np.union1d(values, image_words)
    width, height = library.size(reference)
    pixel = np.clip(np.floor(library.points[first:last] + 0.5).astype(np.int64), 0, [width - 1, height - 1])
    x, y = np.repeat(pixel, np.diff(starts), axis=0).T
    picture = Picture(x, y, np.searchsorted(known, values), width, height)
    return picture, lambda words: np.bincount(np.searchsorted(known, words), minlength=len(known))


def _in_closed_form(state, features, windows: Floats) -> float:
    """Seconds a window of the expected votes."""
    s, matches = state.settings, state.matcher.match(features)
    reference = int(state.describe(features).references[0])
    part = slice(matches.start[min(reference, len(state.matcher) - 1)], matches.start[reference + 1])
    here, there, weight = matches.here[part], matches.there[part], matches.weight[part]
    along_x = expected_votes.box_sums(s.columns, s.patches_x, s.box_columns)
    along_y = expected_votes.box_sums(s.rows, s.patches_y, s.box_rows)

    def ours() -> None:
        agreed = expected_votes.agreement(here, there, weight, s.agreement, s.agreement_floor)
        expected_votes.best_boxes(here, there, agreed, windows, along_y, along_x, 255)

    ours()
    return seconds(lambda: [ours() for _ in range(_TIMES)]) / _TIMES / len(windows)
