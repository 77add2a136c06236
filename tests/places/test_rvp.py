"""Common pattern discovery agrees with the paper's algorithm, pixel by pixel."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.places.literal import Picture, all_boxes, box_sum, cell_sums, dominant_sum, voting_image
from tests.places.pictures import SMALL, noisy
from vplog.execution.execution import Execution
from vplog.places import bobb_paper as bobb
from vplog.places import rvp
from vplog.places.bobb_paper import PaperBobbSettings

if TYPE_CHECKING:
    from vplog.data import Int32s, Reference
    from vplog.places.bobb_paper import PaperBobbState
    from vplog.places.library import Words


@dataclass(frozen=True, eq=False)
class Case:
    """A reference with random words, its partitions, and a window's histogram."""

    points: np.ndarray
    picture: Picture
    cuts: tuple[np.ndarray, np.ndarray]
    H: Counter[int]
    grid: int


def _case(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    width, height = (int(n) for n in rng.integers(5, 60, 2))
    count, vocabulary = int(rng.integers(0, 40)), int(rng.integers(1, 30))
    points = rng.uniform(-0.5, [width - 0.5, height - 0.5], (count, 2)).astype(np.float32)
    points[: count // 8] = [width - 1, height - 1]  # the last pixel
    points[count // 8 : count // 6] = [width - 0.01, height - 0.01]  # past its centre, as a foreign file may say
    pixels = np.clip(np.floor(points + np.float32(0.5)).astype(int), 0, [width - 1, height - 1])
    # a feature has each of its words once; features share words
    words = [sorted(rng.choice(vocabulary, rng.integers(0, min(5, vocabulary) + 1), False)) for _ in range(count)]
    K, M, N = (int(n) for n in rng.integers(1, 9, 3))
    cuts = rvp.draw_partitions(width, height, K, M, N, rng)  # small images repeat cuts
    # the window knows words that the reference lacks, and some of the reference's fewer times than it has them
    H = Counter(int(word) for word in rng.integers(0, vocabulary + 3, rng.integers(0, 25)))
    picture = Picture(width, height, [(int(x), int(y)) for x, y in pixels], words)
    return Case(points, picture, cuts, H, int(rng.integers(1, 13)))


def _fast(case: Case) -> tuple[np.ndarray, Int32s, Int32s]:
    """The kernel's cells, fed as bobb feeds it but with the postings made here, and the grid's cuts."""
    words = sorted({word for each in case.picture.words for word in each})
    owners = [[f for f, each in enumerate(case.picture.words) if word in each] for word in words]
    start = np.cumsum([0, *map(len, owners)]).astype(np.int32)
    posting = np.array([f for each in owners for f in each], np.int32)
    patches = rvp.patches_of(case.points, case.cuts[0], case.cuts[1])
    count = (case.cuts[0].shape[1] - 1) * (case.cuts[1].shape[1] - 1)
    totals = rvp.patch_totals(patches, np.array([len(each) for each in case.picture.words]), count)
    grid_x, grid_y = rvp.grid_cuts(case.picture.width, case.grid), rvp.grid_cuts(case.picture.height, case.grid)
    H = np.array([case.H[word] for word in words], np.int32)
    listed = np.array(words, np.int32), start, posting
    cells = rvp.vote(H, case.H.total(), rvp.Pattern(*listed, patches, totals, *case.cuts, grid_x, grid_y))
    return cells, grid_x, grid_y


def test_votes_and_box_agree_with_the_literal_algorithm() -> None:
    voted = bound = 0
    for seed in range(120):
        case = _case(seed)
        cells, grid_x, grid_y = _fast(case)
        V = voting_image(case.H, case.picture, case.cuts[0], case.cuts[1])
        np.testing.assert_allclose(cells, cell_sums(V, grid_x, grid_y), rtol=1e-9, atol=1e-12, err_msg=f"seed {seed}")
        shapes = rvp.box_shapes(case.grid, 0.2, (0.5, 1.0, 2.0)) if case.grid >= 3 else np.array([[1, 1]], np.int32)
        box = rvp.dominant_box(cells, shapes)
        best = dominant_sum(V, grid_x, grid_y, shapes)
        assert box_sum(V, grid_x, grid_y, box) == pytest.approx(best, rel=1e-9), f"seed {seed}"
        assert tuple(box) in all_boxes(case.grid, shapes) or (best == 0 and not box.any())
        voted += V.any()
        held = Counter(word for each in case.picture.words for word in each)
        bound += any(0 < case.H[word] < held[word] for word in held)
    assert min(voted, bound) > 60  # the cases are worth the name


def test_described_boxes_agree_with_the_literal_algorithm(state: PaperBobbState, references: list[Reference]) -> None:
    """End to end: library words, random windows, the reference's own partitions, the box that is kept."""
    tiny = PaperBobbSettings(partitions=3, columns=8, rows=4, features=80, references=2, boxes=2, grid=12)
    learned = tiny.learn(references[:4], Execution())
    features = noisy(references[1].features, 5)
    place = learned.describe(features)
    windows = np.array(learned._windows)
    words = _lists(learned.library.translate(features.descriptors[:80]))
    own = _lists(learned.library.words)
    for j, row in enumerate(place.references):
        pattern = learned.patterns[row]
        first, last = learned.library.start[row], learned.library.start[row + 1]
        pixels = np.floor(learned.library.points[first:last] + 0.5).astype(int)
        picture = Picture(320, 200, [(int(x), int(y)) for x, y in pixels], own[first:last])
        for i in range(tiny.boxes):
            x0, y0, x1, y1 = windows[j, i] * [320, 200, 320, 200]
            H: Counter[int] = Counter()
            for (x, y), each in zip(features.points[:80] + 0.5, words, strict=True):
                if x0 <= x < x1 and y0 <= y < y1:
                    H.update(each)
            V = voting_image(H, picture, pattern.x_cuts, pattern.y_cuts)
            best = dominant_sum(V, pattern.grid_x, pattern.grid_y, rvp.box_shapes(12, 0.1, tiny.aspects))
            assert box_sum(V, pattern.grid_x, pattern.grid_y, place.boxes[j, i]) == pytest.approx(best, rel=1e-9)


def _lists(words: Words) -> list[list[int]]:
    return [words.values[a:b].tolist() for a, b in zip(words.start[:-1], words.start[1:], strict=True)]


def test_partitions_cover_the_image_once() -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        cuts = rvp.draw_partitions(37, 3, 50, 8, 4, rng)
        for xs, length, parts in ((cuts[0], 37, 8), (cuts[1], 3, 4)):
            assert xs.shape == (50, parts + 1)
            assert (xs[:, 0] == 0).all()
            assert (xs[:, -1] == length).all()
            assert (np.diff(xs, axis=1) >= 0).all()


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 4000), st.integers(1, 255))
def test_grid_cells_are_even_to_a_pixel(length: int, cells: int) -> None:
    cuts = rvp.grid_cuts(length, cells)
    assert (cuts[0], cuts[-1], len(cuts)) == (0, length, cells + 1)
    assert np.ptp(np.diff(cuts)) <= 1


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 255), st.floats(0.01, 1.0), st.lists(st.floats(0.05, 20.0), min_size=1, max_size=5))
def test_boxes_are_the_largest_that_are_allowed(grid: int, share: float, aspects: list[float]) -> None:
    if grid * grid * share < 1:
        return
    shapes = rvp.box_shapes(grid, share, tuple(aspects))
    assert 1 <= len(shapes) <= len(aspects)
    for width, height in shapes.tolist():
        assert 1 <= width <= grid
        assert 1 <= height <= grid
        assert width * height <= share * grid * grid
        assert height == grid or width * (height + 1) > int(share * grid * grid)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 9), st.floats(0.15, 1.0))
def test_counted_boxes_are_those_there_are(grid: int, share: float) -> None:
    if grid * grid * share >= 1:
        shapes = rvp.box_shapes(grid, share, (0.3, 1.0, 2.5))
        assert rvp.count_boxes(grid, shapes) == 1 + len(all_boxes(grid, shapes))


def test_ties_go_to_the_first_box() -> None:
    V = np.zeros((8, 8))
    V[2, 5] = V[6, 1] = 1.0
    assert rvp.dominant_box(V, np.array([[2, 2]], np.int32)).tolist() == [4, 1, 6, 3]


def test_no_votes_no_box() -> None:
    assert not rvp.dominant_box(np.zeros((8, 8)), np.array([[2, 2]], np.int32)).any()


def test_windows_lie_in_the_image_and_have_their_share(state: PaperBobbState) -> None:
    windows = np.array(state._windows)
    assert windows.min() >= 0
    assert windows.max() <= 1
    np.testing.assert_allclose(windows[..., 2:] - windows[..., :2], SMALL.window_share)


def test_voting_map_is_the_mean_over_cells() -> None:
    case = next(case for case in map(_case, range(50)) if case.picture.width > 12 < case.picture.height and case.H)
    cells, grid_x, grid_y = _fast(case)
    area = np.outer(np.diff(grid_y), np.diff(grid_x))
    np.testing.assert_allclose(rvp.voting_map(cells, grid_x, grid_y) * area, cells)


def test_a_feature_counts_once_a_reference() -> None:
    # references 0..2 own features 0-3, 4-5, 6-9; feature 0 has two words of reference 0 and one of 2, feature 1 none
    start, values = np.array([0, 3, 3, 4], np.int32), np.array([1, 2, 7, 9], np.int32)
    assert bobb._count_matches(start, values, np.array([0, 4, 6, 10], np.int32)).tolist() == [1, 0, 2]
