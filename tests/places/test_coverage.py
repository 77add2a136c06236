"""Who explains whom, references chosen by it, and the figure of a run."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array

from tests.places.pictures import SMALL, noisy, nothing, reference
from vplog.data import Keyframes, Reference
from vplog.execution.execution import Execution
from vplog.places import coverage as cov
from vplog.places.library import WordSettings
from vplog.places.reference_choice import LEAST_SIZE, LibrarySettings

if TYPE_CHECKING:
    from vplog.data import Bytes, Features
    from vplog.places.bobb_paper import PaperBobbState

pytestmark = pytest.mark.usefixtures("computed_anew")


@pytest.fixture(scope="module")
def state(references: list[Reference]) -> PaperBobbState:
    """With the words of `WordSettings`, as runs measure coverage by them."""
    return SMALL.model_copy(update={"l1_range": WordSettings().l1_range}).learn(references, Execution(2))


def _value(matrix: np.ndarray, chosen: list[int]) -> float:
    """What the choice maximises, written down once more: capped at half of each frame's best."""
    best = np.maximum(matrix.max(axis=1), 1e-12)
    worth = np.minimum(matrix / (0.5 * best[:, None]), 1.0)
    return float(worth[:, chosen].max(axis=1, initial=0.0).sum())


@st.composite
def matrices(draw: st.DrawFn) -> np.ndarray:
    shape = draw(st.tuples(st.integers(1, 12), st.integers(1, 8)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    shares = rng.uniform(0.01, 1.0, shape) * (rng.uniform(size=shape) < draw(st.sampled_from([0.2, 0.5, 0.9])))
    return shares.astype(np.float32)


@given(matrices(), st.integers(1, 4))
@settings(deadline=None, max_examples=40)
def test_greedy_takes_what_adds_most_and_is_near_the_best_choice(matrix: np.ndarray, size: int) -> None:
    chosen = cov.greedy_cover(csr_array(matrix), min(size, matrix.shape[1])).tolist()
    assert len(set(chosen)) == len(chosen)
    for n, candidate in enumerate(chosen):
        gains = [_value(matrix, [*chosen[:n], c]) for c in range(matrix.shape[1])]
        assert gains[candidate] == pytest.approx(max(gains), abs=1e-5)
    if len(chosen) < min(size, matrix.shape[1]):  # nothing was left to add
        assert _value(matrix, chosen) == pytest.approx(_value(matrix, list(range(matrix.shape[1]))), abs=1e-5)
    best = max(_value(matrix, list(some)) for some in combinations(range(matrix.shape[1]), min(size, matrix.shape[1])))
    assert _value(matrix, chosen) >= (1 - 1 / np.e) * best - 1e-5


def _walk(places: int, frames: int, seed: int, features: int = 60) -> list[Bytes]:
    """Descriptors of `frames` frames at each of `places` places that have nothing in common: a place's, with noise."""
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(places):
        place = rng.integers(0, 256, (features, 128)) * (rng.uniform(size=(features, 128)) < 0.4)
        for _ in range(frames):
            near = place + rng.normal(0, 3, place.shape) * (place > 0)
            result.append(np.clip(np.rint(near), 0, 255).astype(np.uint8))
    return result


def _choose(descriptors: list[Bytes], threads: int = 1, **options: object) -> list[int]:
    wanted = LibrarySettings.read({"choose": "coverage", **options}, "test")
    return cov.choose_by_coverage(len(descriptors), descriptors.__getitem__, wanted, Execution(threads)).tolist()


def test_who_explains_whom() -> None:
    descriptors = _walk(places=5, frames=4, seed=0)
    found = cov.explanations(descriptors, np.arange(0, 20, 2), Execution(2))
    for frame, (begin, end) in enumerate(pairwise(np.asarray(found.indptr).tolist())):
        who = 2 * found.indices[begin:end]
        same_place = {row for row in range(0, 20, 2) if row // 4 == frame // 4 and row != frame}
        assert set(who.tolist()) == same_place, "those of its place, and never itself"
        assert np.all(found.data[begin:end] > 0.9)
        assert np.all(found.data[begin:end] <= 1.0)


def test_every_place_gets_a_reference_before_any_gets_two() -> None:
    assert sorted(row // 6 for row in _choose(_walk(10, 6, seed=1), size=10)) == list(range(10))


def test_a_place_seen_for_long_needs_no_more_than_one_seen_in_passing() -> None:
    standing = _walk(1, 40, seed=2) + _walk(8, 3, seed=3)
    chosen = _choose(standing, size=9)
    assert sum(row < 40 for row in chosen) == 1


def test_another_light_gets_references_of_its_own() -> None:
    day, night = _walk(4, 6, seed=4), _walk(4, 6, seed=5)
    chosen = _choose(day + night, size=8)
    assert sum(row >= len(day) for row in chosen) == 4
    assert sum(row >= len(day) for row in _choose(day + _walk(4, 6, seed=4), size=4)) < 4


def test_without_a_size_as_many_as_there_is_to_explain() -> None:
    assert len(_choose(_walk(20, 5, seed=6), least_gain=0.02)) == 20
    assert len(_choose(_walk(20, 5, seed=6))) == 40, "a second one explains the first, for a little more"
    assert len(_choose(_walk(2, 30, seed=6))) == LEAST_SIZE
    assert len(_choose(_walk(20, 5, seed=6), least_gain=0.2)) == LEAST_SIZE


def test_a_size_is_met_where_nothing_explains_more() -> None:
    for size in (1, 7, 30, 60, 1000):
        rows = _choose(_walk(3, 20, seed=7), size=size)
        assert len(rows) == min(size, 60)
        assert rows == sorted(set(rows))


def test_frames_without_features_and_no_features_at_all() -> None:
    none = np.zeros((0, 128), np.uint8)
    assert _choose([]) == []
    assert len(_choose([none] * 30, size=5)) == 5
    assert len(_choose([none] * 3)) <= 3
    assert len(_choose([none, *_walk(3, 4, seed=8), none], size=3)) == 3


def test_the_same_choice_with_any_number_of_threads() -> None:
    descriptors = _walk(12, 5, seed=9)
    assert _choose(descriptors, 1) == _choose(descriptors, 4)


def test_a_long_drive_is_looked_at_in_even_steps() -> None:
    asked = []

    def descriptors_of(row: int) -> Bytes:
        asked.append(row)
        return np.zeros((0, 128), np.uint8)

    cov.choose_by_coverage(100_000, descriptors_of, LibrarySettings(choose="coverage", size=20), Execution())
    assert len(asked) == cov.frames_needed(20) < 1000
    gaps = np.diff(sorted(asked))
    assert gaps.max() - gaps.min() <= 1


def _shuffled(features: Features, seed: int) -> Features:
    """The same features, each at the place of another: what matches by looks and not by arrangement."""
    order = np.random.default_rng(seed).permutation(len(features))
    return replace(features, points=features.points[order])


def _share(state: PaperBobbState, features: Features, leave_out: int = -1) -> float:
    words = state.library.translate(features.descriptors)
    return cov.explained_share(words, features.points, (features.width, features.height), state.library, leave_out)


def test_a_view_is_explained_by_its_own_place_alone(state: PaperBobbState, references: list[Reference]) -> None:
    for row in (0, 11):
        again = noisy(references[row].features, row)
        assert _share(state, again) > 0.2
        assert _share(state, again, leave_out=row) < _share(state, again)
        assert _share(state, _shuffled(again, row)) < 0.1 * _share(state, again)
    for seed in (60, 75, 90):  # other panoramas
        assert _share(state, reference(seed).features) < cov.EXPLAINED
    assert _share(state, nothing()) == 0.0


def test_views_beside_explain_each_other(state: PaperBobbState) -> None:
    """Neighbours share three quarters of the view, so each is explained by the others."""
    for row in range(1, 11):
        assert _share(state, reference(row).features, leave_out=row) > cov.EXPLAINED


def _measure(state: PaperBobbState, seeds: list[int], drive: str = "another", threads: int = 2) -> cov.Coverage:
    frames = [reference(seed) for seed in seeds]
    stamps = np.array([frame.stamp_ns for frame in frames])
    keyframes = Keyframes(drive, stamps, np.tile(np.eye(4), (len(frames), 1, 1)))
    return cov.measure_coverage(keyframes, lambda row: frames[row].features, state.library, Execution(threads))


def test_the_figure_of_a_run(state: PaperBobbState) -> None:
    known, elsewhere = list(range(0, 12, 2)), list(range(60, 72, 2))
    assert _measure(state, known).explained == 1.0
    assert _measure(state, elsewhere).explained == 0.0
    half = _measure(state, known + elsewhere)
    assert (half.explained, half.frames) == (0.5, 12)
    assert half == _measure(state, known + elsewhere, threads=1)


def test_more_frames_are_looked_at_where_few_leave_it_open(
    state: PaperBobbState, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cov, "_FIRST_FRAMES", 8)
    known, elsewhere = [0, 1, 2, 3, 4, 5, 6, 7], [60, 61, 62, 63, 64, 65, 66, 67]
    good = _measure(state, [*known, 8, 9, 10, 11])
    assert (good.explained, good.frames) == (1.0, 8)
    mixed = _measure(state, [row for pair in zip(known, elsewhere, strict=True) for row in pair][1:])
    assert mixed.frames == 15
    assert mixed.explained == pytest.approx(7 / 15)


def test_an_image_does_not_explain_itself() -> None:
    alone = [Reference(r.image, r.features, "one", r.stamp_ns) for r in map(reference, (0, 20, 40, 60))]
    state = SMALL.learn(alone, Execution())
    assert _measure(state, [0, 20, 40, 60], drive="one").explained == 0.0
    assert _measure(state, [0, 20, 40, 60], drive="two").explained == 1.0


def test_a_poor_library_is_said_with_what_to_do() -> None:
    poor, good = cov.Coverage(0.12, 0.003, 200), cov.Coverage(0.9, 0.1, 200)
    assert cov.coverage_warning(good, 850, given=True, size=100) is None
    given_one = cov.coverage_warning(poor, 850, given=True, size=100)
    assert given_one is not None
    assert "explains 12 % of the 850 keyframes" in given_one
    assert "vplog library" in given_one
    own = cov.coverage_warning(poor, 850, given=False, size=100)
    assert own is not None
    assert "--set library.size=200" in own
    full = cov.coverage_warning(poor, 150, given=False, size=100)
    assert full is not None
    assert "library.size" not in full
