from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vplog.places.fabmap_model import ChowLiuTree, learn_tree

IMAGES = st.lists(st.sets(st.integers(0, 6)), min_size=1, max_size=12)


def lists(occurrence: np.ndarray) -> list[np.ndarray]:
    return [np.flatnonzero(row) for row in occurrence]


def edges(tree: ChowLiuTree) -> set[frozenset[int]]:
    return {frozenset((child, int(parent))) for child, parent in enumerate(tree.parent) if parent >= 0}


def information(a: np.ndarray, b: np.ndarray) -> float:
    """Mutual information of two binary columns, straight from its definition."""
    total = 0.0
    for x, y in itertools.product((False, True), repeat=2):
        both = ((a == x) & (b == y)).mean()
        if both:
            total += both * np.log(both / ((a == x).mean() * (b == y).mean()))
    return total


def test_recovers_the_tree_that_made_the_samples() -> None:
    rng = np.random.default_rng(1)
    parent = [-1, 0, 0, 1, 1, 2, 5]
    given_parent = [(0.4, 0.4), (0.1, 0.7), (0.2, 0.9), (0.7, 0.1), (0.05, 0.6), (0.3, 0.8), (0.9, 0.2)]
    samples = np.zeros((20_000, 7), bool)
    for word in range(7):
        state = samples[:, parent[word]].astype(int) if word else np.zeros(20_000, int)
        samples[:, word] = rng.random(20_000) < np.array(given_parent[word])[state]
    tree = learn_tree(lists(samples), 7, 1.0)
    assert list(tree.parent) == parent
    # 20 000 samples, at least a tenth of them in each state: a standard error of at most .012
    assert tree.present_given_parent == pytest.approx(np.array(given_parent), abs=0.04)
    assert tree.present == pytest.approx(samples.mean(axis=0), abs=1e-3)


@given(IMAGES)
@example([{0, 1, 2, 3, 5, 6}, {2, 4}, {0, 1, 3, 4, 5}, {6}])  # words that tell nothing of each other, to rounding
def test_no_spanning_tree_has_more_information(images: list[set[int]]) -> None:
    occurrence = np.zeros((len(images), 7), bool)
    for row, image in enumerate(images):
        occurrence[row, list(image)] = True
    tree = learn_tree(lists(occurrence), 7, 1.0)
    weight = np.array([[information(a, b) for b in occurrence.T] for a in occurrence.T])
    # Kruskal's algorithm, independent of the one under test
    group, best = list(range(7)), 0.0
    for a, b in sorted(itertools.combinations(range(7), 2), key=lambda pair: -weight[pair]):
        if group[a] != group[b]:
            best += weight[a, b]
            group = [group[a] if g == group[b] else g for g in group]
    assert len(edges(tree)) == 6
    assert sum(weight[tuple(edge)] for edge in edges(tree)) == pytest.approx(best, abs=1e-7)


@given(IMAGES, st.floats(0.1, 100))
def test_is_a_tree_of_proper_probabilities(images: list[set[int]], independence: float) -> None:
    tree = learn_tree([np.array(sorted(image), np.uint16) for image in images], 7, independence)
    for leaf in range(7):
        seen, word = set(), leaf
        while word >= 0:
            assert word not in seen
            seen.add(word)
            word = int(tree.parent[word])
        assert 0 in seen  # the one root
    for p in (tree.present, tree.present_given_parent):
        assert np.all((p > 0) & (p < 1))


def test_much_belief_in_independence_leaves_the_shares() -> None:
    occurrence = np.random.default_rng(0).random((30, 5)) < 0.4
    occurrence[:, 4] = occurrence[:, 3]
    counted = learn_tree(lists(occurrence), 5, 1e-9)
    believed = learn_tree(lists(occurrence), 5, 1e9)
    assert believed.present_given_parent == pytest.approx(np.stack([believed.present] * 2, axis=1), abs=1e-6)
    child = 4 if counted.parent[4] == 3 else 3
    assert counted.present_given_parent[child] == pytest.approx([0, 1], abs=1e-6)


def test_a_single_word_and_words_never_seen() -> None:
    assert list(learn_tree([np.array([0])], 1, 1.0).parent) == [-1]
    empty = learn_tree([np.zeros(0, np.uint16)] * 3, 4, 1.0)
    assert sorted(empty.parent)[0] == -1
    assert empty.present == pytest.approx(np.full(4, 0.5 / 4))
