"""Words are the nearest of k-means centres, exactly, and the same whatever the threads."""

from __future__ import annotations

import numpy as np
import pytest

from tests.places.pictures import reference
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.vocabulary import Vocabulary, learn_vocabulary, root_sift

pytestmark = pytest.mark.usefixtures("computed_anew")


def _blobs(blobs: int, each: int, seed: int = 0) -> np.ndarray:
    """(blobs * each, 128) descriptors around far-apart means."""
    rng = np.random.default_rng(seed)
    means = rng.gamma(0.4, 40, (blobs, 1, 128))
    return np.clip(means + rng.normal(0, 2, (blobs, each, 128)), 0, 255).astype(np.uint8).reshape(-1, 128)


def test_root_sift_is_of_unit_length_and_its_products_are_hellinger_kernels() -> None:
    descriptors = _blobs(30, 1)
    roots = root_sift(descriptors).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(roots, axis=1), 1, atol=0.01)
    shares = descriptors / descriptors.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(roots @ roots.T, np.sqrt(shares[:, None] * shares[None]).sum(axis=-1), atol=0.02)
    assert not root_sift(np.zeros((2, 128), np.uint8)).any()


def test_any_number_of_threads_gives_the_same_words() -> None:
    # views apart by their width or more: features seen twice would be words twice, and one of the two is dropped
    descriptors = np.concatenate([reference(seed).features.descriptors for seed in range(0, 52, 4)])
    one, four = (learn_vocabulary(descriptors, 1150, 3, Execution(threads)) for threads in (1, 4))
    assert 1024 < len(one) <= 1150  # more words than are searched exactly
    np.testing.assert_array_equal(one.centres, four.centres)
    np.testing.assert_array_equal(one.quantise(descriptors), four.quantise(descriptors))


def test_the_seed_draws_other_words() -> None:
    descriptors = _blobs(40, 5)
    a, b = (learn_vocabulary(descriptors, 20, seed, Execution()) for seed in (0, 1))
    assert not np.array_equal(a.centres, b.centres)


@pytest.mark.parametrize(("words", "share"), [(300, 1.0), (1100, 0.99)])
def test_a_feature_has_the_word_of_the_nearest_centre(words: int, share: float) -> None:
    descriptors = _blobs(words, 1)
    vocabulary = Vocabulary(root_sift(descriptors))
    noise = np.random.default_rng(1).normal(0, 12, (200, 128))
    queries = np.clip(descriptors[:200] + noise, 0, 255).astype(np.uint8)
    distance = np.square(root_sift(queries)[:, None].astype(np.float64) - vocabulary.centres[None]).sum(axis=-1)
    found = vocabulary.quantise(queries)
    assert found.dtype == np.int32
    nearest = distance[np.arange(len(queries)), found] == distance.min(axis=1)
    assert nearest.mean() >= share


def test_centres_are_the_means_of_their_features() -> None:
    descriptors = _blobs(12, 40)
    vocabulary = learn_vocabulary(descriptors, 12, 0, Execution(2))
    words = vocabulary.quantise(descriptors)
    means = np.array([root_sift(descriptors)[words == word].mean(axis=0) for word in range(len(vocabulary))])
    np.testing.assert_allclose(vocabulary.centres, means, atol=0.51 / 512)


def test_few_features_make_few_words() -> None:
    assert len(learn_vocabulary(_blobs(20, 2), 16_000, 0, Execution(2))) <= 10
    assert len(learn_vocabulary(_blobs(1, 1), 16_000, 0, Execution(2))) == 1
    same = np.repeat(_blobs(1, 1), 50, axis=0)
    assert len(learn_vocabulary(same, 12, 0, Execution(2))) == 1


def test_no_feature_is_an_error_and_no_query_is_none() -> None:
    with pytest.raises(LibraryError, match="not a single feature"):
        learn_vocabulary(np.zeros((0, 128), np.uint8), 10, 0, Execution())
    assert learn_vocabulary(_blobs(5, 5), 5, 0, Execution()).quantise(np.zeros((0, 128), np.uint8)).shape == (0,)
