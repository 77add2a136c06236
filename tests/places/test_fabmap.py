from __future__ import annotations

import itertools
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.places.pictures import noisy
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.fabmap import FabmapSettings, FabmapState
from vplog.places.fabmap_model import ChowLiuTree, Model, log_likelihood_table
from vplog.places.vocabulary import Vocabulary

if TYPE_CHECKING:
    from vplog.data import Reference

V = 5
TREE = ChowLiuTree(
    parent=np.array([-1, 0, 0, 2, 2], np.int32),
    present=np.array([0.4, 0.3, 0.25, 0.1, 0.6]),
    present_given_parent=np.array([[0.4, 0.4], [0.1, 0.6], [0.2, 0.325], [0.05, 0.25], [0.7, 0.3]]),
)
"""A toy world of five words."""
ALL = [np.flatnonzero(bits).astype(np.uint16) for bits in itertools.product((0, 1), repeat=V)]
"""Every image there can be."""
PLACES = [ALL[0], ALL[5], ALL[17], ALL[30], ALL[31], ALL[17]]
PLAIN = FabmapSettings(smoothing=1.0, calibrate=False)


def toy(choice: FabmapSettings, weight: float = 1.0, nats: float = 0.0) -> FabmapState:
    model = Model(TREE, log_likelihood_table(TREE, choice.seen_if_there, choice.seen_if_absent))
    return FabmapState(choice, [], Vocabulary(np.zeros((V, 128), np.float32)), model, None, weight, nats)


def bits(words: np.ndarray) -> list[int]:
    return [int(word in words) for word in range(V)]


def exact(image: np.ndarray, place: np.ndarray | None, choice: FabmapSettings) -> float:
    """p(Z | L) by summing over all 2^V states of existence, in the papers' own form; no place: the average one."""
    detector = {(1, 1): choice.seen_if_there, (0, 1): 1 - choice.seen_if_there}
    detector |= {(1, 0): choice.seen_if_absent, (0, 0): 1 - choice.seen_if_absent}  # (z, e)
    z = bits(image)
    known = None if place is None else bits(place)
    total = 0.0
    for e in itertools.product((0, 1), repeat=V):
        product = 1.0
        for q in range(V):
            marginal = [1 - TREE.present[q], TREE.present[q]]
            exists = marginal[e[q]]
            if known is not None:
                both = [detector[known[q], s] * marginal[s] for s in (0, 1)]
                exists = both[e[q]] / sum(both)
            parent = TREE.parent[q]
            given = TREE.present_given_parent[q][z[parent] if parent >= 0 else 0]
            given = [1 - given, given]
            alpha = marginal[z[q]] * detector[1 - z[q], e[q]] * given[1 - z[q]]
            beta = marginal[1 - z[q]] * detector[z[q], e[q]] * given[z[q]]
            product *= exists * (beta / (alpha + beta))
        total += product
    return total


@pytest.mark.parametrize("choice", [PLAIN, PLAIN.model_copy(update={"seen_if_absent": 0.05, "seen_if_there": 0.7})])
def test_likelihoods_are_those_of_enumeration_and_sum_to_one(choice: FabmapSettings) -> None:
    index = toy(choice).index(PLACES)
    found = [index.log_likelihood(image) for image in ALL]
    places, new = np.exp([f[0] for f in found]), np.exp([f[1] for f in found])
    assert places == pytest.approx(np.array([[exact(z, place, choice) for place in PLACES] for z in ALL]), rel=1e-9)
    assert new == pytest.approx([exact(z, None, choice) for z in ALL], rel=1e-9)
    assert places.sum(axis=0) == pytest.approx(np.ones(len(PLACES)))
    assert new.sum() == pytest.approx(1)


@pytest.mark.parametrize("prior", [0.0, 0.3, 0.9])
@pytest.mark.parametrize("stop", [1, 4, None])
def test_posterior_is_the_exact_one(prior: float, stop: int | None) -> None:
    choice = PLAIN.model_copy(update={"new_place_prior": prior})
    index = toy(choice).index(PLACES)
    known = PLACES[:stop]
    for image in ALL:
        joint = [exact(image, place, choice) * (1 - prior) / len(known) for place in known]
        joint.append(exact(image, None, choice) * prior)
        want = np.array(joint) / sum(joint)
        places, new = index.posterior(image, stop)
        assert np.append(places, new) == pytest.approx(want, abs=1e-6)
        assert places.sum() + new == pytest.approx(1, abs=1e-12)
        assert index.scores(image, stop) == pytest.approx(np.log(want[:-1]), rel=1e-5, abs=1e-6)


def test_smoothing_and_weight_by_their_formulas() -> None:
    choice = PLAIN.model_copy(update={"smoothing": 0.8, "new_place_prior": 0.3})
    index = toy(choice, weight=0.4, nats=-1.5).index(PLACES)
    for image in ALL[::5]:
        tempered = [exact(image, place, choice) ** 0.4 for place in PLACES]
        tempered.append((exact(image, None, choice) * np.exp(-1.5)) ** 0.4)
        smooth = 0.8 * np.array(tempered) / sum(tempered) + 0.2 / (len(PLACES) + 1)
        joint = smooth * np.append(np.full(len(PLACES), 0.7 / len(PLACES)), 0.3)
        places, new = index.posterior(image)
        assert np.append(places, new) == pytest.approx(joint / joint.sum(), abs=1e-9)
        unsmoothed = np.array(tempered) * np.append(np.full(len(PLACES), 0.7 / len(PLACES)), 0.3)
        assert index.scores(image) == pytest.approx(np.log(unsmoothed / unsmoothed.sum())[:-1], rel=1e-5)


@given(st.integers(0, 2**32 - 1), st.integers(2, 40), st.floats(0.05, 0.95), st.floats(0, 0.04))
@settings(max_examples=40)
def test_inverted_evaluation_is_the_direct_one(seed: int, count: int, there: float, absent: float) -> None:
    rng = np.random.default_rng(seed)
    parent = np.array([-1, *(rng.integers(0, word) for word in range(1, count))], np.int32)
    renamed = rng.permutation(count)  # parents may come after their children
    shuffled = np.empty(count, np.int32)
    shuffled[renamed] = np.where(parent < 0, -1, renamed[parent])
    present, given_parent = rng.uniform(0.02, 0.98, count), rng.uniform(0.02, 0.98, (count, 2))
    tree = ChowLiuTree(shuffled, present, given_parent)
    table = log_likelihood_table(tree, there, absent)
    state = replace(toy(PLAIN), model=Model(tree, table))
    images = rng.random((8, count)) < 0.3
    places = [np.flatnonzero(image).astype(np.uint16) for image in images]
    words = np.arange(count)
    for image, query in zip(images, places, strict=True):
        of_parent = np.where(shuffled < 0, 0, image[shuffled]).astype(int)
        direct = [table[words, place.astype(int), of_parent, image.astype(int)].sum() for place in images]
        average = table[words, 2, of_parent, image.astype(int)].sum()
        found, new, _ = state.index(places).log_likelihood(query)
        assert found == pytest.approx(np.array(direct), rel=1e-9, abs=1e-9)
        assert new == pytest.approx(average, rel=1e-9, abs=1e-9)
        assert np.array_equal(state.index(places).log_likelihood(query, 3)[0], found[:3])


def test_ranking_leaves_out_what_shares_nothing_and_breaks_ties_by_row() -> None:
    index = toy(PLAIN).index(PLACES)
    query = PLACES[2]
    ranking = index.query(query, 10)
    assert sorted(ranking.rows) == [row for row, place in enumerate(PLACES) if set(place) & set(query)]
    assert list(ranking.rows[:2]) == [2, 5] or ranking.score[0] > ranking.score[list(ranking.rows).index(2)]
    assert np.all(np.diff(ranking.score) <= 0)
    rows = list(ranking.rows)
    assert rows.index(2) + 1 == rows.index(5)  # the same place twice: the earlier row first
    assert np.array_equal(ranking.score, index.scores(query)[ranking.rows])
    assert list(index.query(query, 2).rows) == rows[:2]
    assert set(index.query(query, 10, 3).rows) <= {0, 1, 2}
    assert len(index.query(np.zeros(0, np.uint16), 10).rows) == len(index.query(query, 0).rows) == 0


def test_without_places_the_place_is_new() -> None:
    index = toy(PLAIN).index(PLACES)
    places, new = index.posterior(PLACES[1], 0)
    assert len(places) == len(index.scores(PLACES[1], 0)) == len(index.query(PLACES[1], 5, 0).rows) == 0
    assert new == 1.0
    assert len(toy(PLAIN).index([])) == 0


SMALL = FabmapSettings(words=150, features=250)


@pytest.fixture(scope="module")
def learned(references: list[Reference]) -> FabmapState:
    return SMALL.learn(references, Execution(2))


def test_finds_the_same_picture_again_and_knows_a_new_one(learned: FabmapState, references: list[Reference]) -> None:
    index = learned.index([learned.describe(reference.features) for reference in references[:10]])
    found = [index.query(learned.describe(noisy(r.features, 1)), 1).rows[0] for r in references[:10]]
    assert found == list(range(10))
    assert index.posterior(learned.describe(references[4].features))[1] < index.posterior(np.zeros(0, np.uint16))[1]


def test_a_sampled_new_place_converges_to_the_mean_over_all(references: list[Reference]) -> None:
    rng = np.random.default_rng(0)
    errors = []
    for samples in (2, 6, 12):
        sampled = SMALL.model_copy(update={"new_place": "sampled", "samples": samples, "calibrate": False})
        distance = []
        for seed in range(3):
            state = sampled.model_copy(update={"seed": seed}).learn(references, Execution())
            index = state.index([state.describe(reference.features) for reference in references])
            for _ in range(50):
                query = np.flatnonzero(rng.random(len(state.vocabulary)) < 0.4).astype(np.uint16)
                places, new, _ = index.log_likelihood(query)
                distance.append(abs(new - np.log(np.exp(places - places.max()).mean()) - places.max()))
        errors.append(np.mean(distance))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] == pytest.approx(0, abs=1e-9)


def test_evidence_is_weighed_less_where_neighbours_are_hard_to_tell(references: list[Reference]) -> None:
    order = np.random.default_rng(3).permutation(len(references))
    in_order = [replace(r, drive="one", stamp_ns=row) for row, r in enumerate(references)]
    at_random = [replace(references[at], drive="one", stamp_ns=row) for row, at in enumerate(order)]
    weights = [SMALL.learn(given, Execution()).weight for given in (in_order, at_random)]
    assert 0.01 <= weights[1] < weights[0] <= 1
    # as they are the references are 12 of three drives, too few of each to say anything: the papers' own
    few = SMALL.learn(references, Execution())
    assert (few.weight, few.new_place_nats) == (1.0, 0.0)
    unweighed = SMALL.model_copy(update={"calibrate": False}).learn(in_order, Execution())
    assert (unweighed.weight, unweighed.new_place_nats) == (1.0, 0.0)


def test_any_number_of_threads_learns_the_same(references: list[Reference]) -> None:
    given = [replace(r, drive="one", stamp_ns=row) for row, r in enumerate(references)]
    one, four = SMALL.learn(given, Execution()), SMALL.learn(given, Execution(4))
    assert one.hash == four.hash
    assert (one.weight, one.new_place_nats) == (four.weight, four.new_place_nats)
    assert one.model.table.tobytes() == four.model.table.tobytes()


def test_a_column_is_no_larger_than_it_says(learned: FabmapState, references: list[Reference]) -> None:
    column = learned.to_arrow([learned.describe(reference.features) for reference in references])
    assert column.nbytes * 8 <= learned.bits * len(references) + 32


def test_refuses_foreign_descriptors(learned: FabmapState) -> None:
    kind = learned.arrow_type
    for column, why in [
        (pa.array([[1, len(learned.vocabulary)]], kind), "does not have"),
        (pa.array([[2, 2]], kind), "twice or out of order"),
        (pa.array([[0], [3, 1]], kind), "twice or out of order"),
    ]:
        with pytest.raises(LibraryError, match=why):
            learned.from_arrow(column)


def test_refuses_what_cannot_be_learned(references: list[Reference]) -> None:
    with pytest.raises(LibraryError, match="at least two"):
        SMALL.learn(references[:1], Execution())
    with pytest.raises(ValidationError, match="must be below"):
        FabmapSettings(seen_if_there=0.1, seen_if_absent=0.2)
