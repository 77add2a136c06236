from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.benchmarks.graphs import city, spoiled
from vplog.graph.clique import largest_clique
from vplog.graph.consistency import chi2_quantile, is_loop
from vplog.graph.pcm import PcmSettings, consistency


def random_matrix(count: int, share: float, seed: int) -> np.ndarray:
    upper = np.triu(np.random.default_rng(seed).random((count, count)) < share, 1)
    return upper | upper.T


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 11), st.sampled_from([0.2, 0.5, 0.8, 1.0]), st.integers(0, 1000))
def test_the_clique_is_one_and_the_largest(count: int, share: float, seed: int) -> None:
    joined = random_matrix(count, share, seed)
    members, exact = largest_clique(joined, 10**6)
    assert exact
    assert all(joined[one, other] for one, other in combinations(members.tolist(), 2))
    for size in range(count, len(members), -1):
        for group in combinations(range(count), size):
            assert not all(joined[one, other] for one, other in combinations(group, 2))


def test_a_hidden_clique_is_found_within_few_steps_and_twice_the_same() -> None:
    joined = random_matrix(300, 0.3, 0)
    hidden = np.sort(np.random.default_rng(1).choice(300, 40, replace=False))
    joined[np.ix_(hidden, hidden)] = True
    for steps in (100, 10**6):
        members, _ = largest_clique(joined, steps)
        np.testing.assert_array_equal(members, hidden)


def test_a_clique_larger_than_the_steps_is_found() -> None:
    joined = random_matrix(400, 0.3, 0)
    joined[:300, :300] = True
    members, exact = largest_clique(joined, 50)
    np.testing.assert_array_equal(members, np.arange(300))
    assert not exact


def test_a_cut_search_says_so() -> None:
    joined = random_matrix(120, 0.9, 0)
    members, exact = largest_clique(joined, 50)
    assert not exact
    assert all(joined[one, other] for one, other in combinations(members.tolist(), 2))
    assert len(largest_clique(np.zeros((0, 0), bool), 5)[0]) == 0


@pytest.mark.parametrize("written", ["forward", "backward"])
def test_true_closures_agree_and_false_ones_do_not(written: str) -> None:
    graph, false = spoiled(city(300, seed=3), 0.4, 0)
    loops = np.flatnonzero(is_loop(graph))
    if written == "backward":
        turn = loops[::2]
        graph.a[turn], graph.b[turn] = graph.b[turn], graph.a[turn].copy()
        graph.a_from_b[turn] = np.linalg.inv(graph.a_from_b[turn])
    joined = consistency(graph, loops, chi2_quantile(0.99, 3))
    np.testing.assert_array_equal(joined, joined.T)
    true = ~false[loops]
    assert joined[np.ix_(true, true)].mean() > 0.97
    assert joined[np.ix_(true, ~true)].mean() < 0.35
    kept, _ = PcmSettings().consistent(graph, loops)
    assert false[kept].sum() == 0


def test_more_closures_than_are_compared_are_thinned() -> None:
    graph, false = spoiled(city(300, seed=3), 0.4, 0)
    loops = np.flatnonzero(is_loop(graph))
    kept, exact = PcmSettings(most_closures=10).consistent(graph, loops)
    assert len(kept) <= 10
    assert not exact
    assert false[kept].sum() == 0
