"""FAB-MAP's model: which words occur together, how likely an image's words are at a place, and how far to trust that.

"2008" and "2.0" are the papers named in `fabmap.py`, and so are z, e and L. The tree is that of Chow & Liu, IEEE Trans.
Inf. Theory 14(3), 1968: of all trees, the one with the largest sum of mutual information along its edges is nearest to
the true distribution; it is a maximum spanning tree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import scipy
from numpy.typing import NDArray

from vplog.data import Bools, Floats, Int32s, Ints, Reference
from vplog.places.vocabulary import postings

Words = NDArray[np.uint16]


_FIXED_POINT = 2**32
"""Steps of 1 / 2^32 nats: sums of whole numbers are exact, so equal information ties in any order of the sum."""
_JEFFREYS = 0.5
"""Images with and without a word that are added to the counted ones: Jeffreys' prior of a share."""
_ABSENT, _PRESENT, _AVERAGE = 0, 1, 2
"""States of a word at a place: its one image lacks it, has it, or there is no image."""
_LEAST_IMAGES = 10
"""Least images of a drive to calibrate on."""
_MOST_QUERIES = 200
"""Most references used as queries, spread evenly; more do not change the second digit of the weight."""
_NEAR_SHARE = 10
"""An image's place may be seen from a tenth of the drive's images before and after it; the others are far."""
_WEIGHTS = np.geomspace(0.01, 1.0, 201)
"""Weights tried, in steps of 2.3 %: below 0.01 the posterior is the prior, above 1 a word would count twice."""


@dataclass(frozen=True, eq=False)
class ChowLiuTree:
    """A distribution over V binary words."""

    parent: Int32s
    """(V,) the word that each depends on; -1 for the root."""
    present: Floats
    """(V,) p(z_q = 1), in (0, 1)."""
    present_given_parent: Floats
    """(V, 2) p(z_q = 1 | z_parent = 0), p(z_q = 1 | z_parent = 1), in (0, 1); the root's are both p(z_q = 1)."""

    def __len__(self) -> int:
        return len(self.parent)


def learn_tree(images: Sequence[NDArray[np.integer]], words: int, independence: float) -> ChowLiuTree:
    """The tree of the words (each list increasing, below `words`) that the images have. At least one image and word.

    With few images the counts of a pair are mostly chance, so a conditional is counted as if `independence` more
    images of each state of the parent had shown the word as often as all images do (an m-estimate).
    """
    lengths = [len(image) for image in images]
    image_start = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    values = np.concatenate([np.zeros(0, np.int32), *(np.asarray(image, np.int32) for image in images)])
    start, owner, _ = postings(images, words)
    parent, both = _span(image_start, values, start, owner, _times_log(len(images)))
    holders = np.diff(start)
    N = len(images)
    present = (holders + _JEFFREYS).astype(np.float64) / (N + 2 * _JEFFREYS)
    parent_holders = np.where(parent < 0, 0, holders[parent])
    counts = np.stack([holders - both, both], axis=1)
    given = (counts + independence * present[:, None]) / (
        np.stack([N - parent_holders, parent_holders], axis=1) + independence
    )
    return ChowLiuTree(parent, present, np.where(parent[:, None] < 0, present[:, None], given))


def _times_log(count: int) -> Ints:
    """(count + 1,) x ln x of whole x in fixed point; 0 for 0."""
    x = np.arange(count + 1, dtype=np.float64)
    return np.rint(x * np.log(np.maximum(x, 1)) * _FIXED_POINT).astype(np.int64)


@numba.njit(cache=True, nogil=True)
def _span(image_start, values, posting_start, postings, times_log):
    """Maximum spanning tree by Prim's algorithm: (V,) parents and (V,) images that have both a word and its parent.

    Information is computed for the words of one new node at a time, so memory grows with V and not with its square.
    The root is word 0; of equal information the earlier word wins.
    """
    V, N = posting_start.shape[0] - 1, image_start.shape[0] - 1
    parent, both = np.full(V, -1, np.int32), np.zeros(V, np.int64)
    best = np.full(V, -1, np.int64)
    reached = np.zeros(V, np.bool_)
    together = np.zeros(V, np.int64)
    node = 0
    for _ in range(V):
        reached[node] = True
        together[:] = 0
        for e in range(posting_start[node], posting_start[node + 1]):
            for f in range(image_start[postings[e]], image_start[postings[e] + 1]):
                together[values[f]] += 1
        a = posting_start[node + 1] - posting_start[node]
        following = -1
        for word in range(V):
            if reached[word]:
                continue
            b, ab = posting_start[word + 1] - posting_start[word], together[word]
            # N times the mutual information; rounded logarithms put that of independent words a step below zero
            information = max(0, (
                times_log[ab] + times_log[a - ab] + times_log[b - ab] + times_log[N - a - b + ab]
                - times_log[a] - times_log[N - a] - times_log[b] - times_log[N - b] + times_log[N]
            ))  # fmt: skip
            if information > best[word]:
                best[word], parent[word], both[word] = information, node, ab
            if following < 0 or best[word] > best[following]:
                following = word
        node = following
    return parent, both


def log_likelihood_table(tree: ChowLiuTree, p_z_given_e: float, p_z_given_not_e: float) -> Floats:
    """(V, 3, 2, 2) ln p(z_q | z_p, L): by the state of q at L (absent, present, average), then z_p, then z_q.

    The word may or may not exist at the place (2008, section on the observation likelihood):
    p(z_q | z_p, L) = sum over e_q of p(z_q | e_q, z_p) p(e_q | L).
    """
    detector = np.array([[1 - p_z_given_not_e, p_z_given_not_e], [1 - p_z_given_e, p_z_given_e]])  # p(z | e) by e, z
    marginal = np.stack([1 - tree.present, tree.present], axis=1)  # (V, z)
    given_parent = np.stack([1 - tree.present_given_parent, tree.present_given_parent], axis=2)  # (V, z_p, z)
    # p(z_q | e_q, z_p) is proportional to p(z_q | e_q) p(z_q | z_p) / p(z_q): detection does not depend on z_p.
    # The papers write it (1 + alpha / beta)^-1.
    observed = detector[:, None] * (given_parent / marginal[:, None])[:, None]  # (V, e, z_p, z)
    observed /= observed.sum(axis=3, keepdims=True)
    # The place model: the prior p(e_q = 1) is how often the word occurs at all, and the place's one image updates it
    # by Bayes' rule (2008, on the update of the place model).
    exists = np.empty((len(tree), 3))
    for observed_z in (_ABSENT, _PRESENT):
        there, absent = detector[1, observed_z] * tree.present, detector[0, observed_z] * (1 - tree.present)
        exists[:, observed_z] = there / (there + absent)
    exists[:, _AVERAGE] = tree.present
    exists = exists[:, :, None, None]
    return np.log(exists * observed[:, None, 1] + (1 - exists) * observed[:, None, 0])


class Model:
    """The tree's edges and the likelihoods, as the kernels want them."""

    def __init__(self, tree: ChowLiuTree, table: Floats) -> None:
        self.tree, self.table = tree, table
        order = np.argsort(tree.parent, kind="stable").astype(np.int32)
        start = np.searchsorted(tree.parent[order], np.arange(len(tree) + 1))
        self.children, self.child_start = order, start.astype(np.int64)


class Evidence:
    """ln p(Z | L) of every place at once: FAB-MAP 2.0's inverted index.

    The likelihood of an image without any word is summed beforehand, and corrected for the words of the image and their
    children in the tree, at the places that have the word. Rows are in the order given.
    """

    def __init__(self, places: Sequence[Words], model: Model) -> None:
        self._count, self._model = len(places), model
        self._list_start, self._list_place, _ = postings(places, len(model.tree))
        silent = model.table[:, :, 0, 0]
        gain = silent[:, _PRESENT] - silent[:, _ABSENT]
        owners = np.repeat(np.arange(len(places)), [len(place) for place in places])
        gains = gain[np.concatenate([np.zeros(0, np.uint16), *places])]
        self._base = silent[:, _ABSENT].sum() + np.bincount(owners, gains, minlength=len(places))

    def __len__(self) -> int:
        return self._count

    def __call__(self, words: Words, stop: int) -> tuple[Floats, Bools]:
        """(stop,) ln p(Z | L), and whether the place has a word of the image."""
        model, lists = self._model, (self._list_start, self._list_place)
        tree = model.tree.parent, model.child_start, model.children
        return _evidence(words, tree, model.table, lists, self._base[:stop])


@numba.njit(cache=True, nogil=True)
def _evidence(words, tree, table, lists, base):
    """(stop,) float64 log likelihood and bool: starts from `base`, a sum per place; `words` increase."""
    parent, child_start, children = tree
    list_start, list_place = lists
    V, stop = parent.shape[0], base.shape[0]
    present = np.zeros(V, np.bool_)
    for word in words:
        present[word] = True
    result, shared = base.copy(), np.zeros(stop, np.bool_)
    everywhere = 0.0
    for word in words:
        for k in range(-1, child_start[word + 1] - child_start[word]):
            q = np.int64(word) if k < 0 else np.int64(children[child_start[word] + k])
            if k >= 0 and present[q]:
                continue  # it is one of the words itself
            z = 1 if present[q] else 0
            zp = 1 if parent[q] >= 0 and present[parent[q]] else 0
            everywhere += table[q, 0, zp, z] - table[q, 0, 0, 0]
            change = (table[q, 1, zp, z] - table[q, 0, zp, z]) - (table[q, 1, 0, 0] - table[q, 0, 0, 0])
            for e in range(list_start[q], list_start[q + 1]):
                place = list_place[e]
                if place >= stop:
                    break
                result[place] += change
                if z == 1:
                    shared[place] = True
    return result + everywhere, shared


def average_place(words: Words, model: Model) -> float:
    """ln p(Z | the average place): the mean field approximation of a new place (2008, section on new places)."""
    present = np.zeros(len(model.tree), np.int64)
    present[words] = 1
    parent = model.tree.parent
    z_parent = np.where(parent < 0, 0, present[parent])
    return float(model.table[np.arange(len(parent)), _AVERAGE, z_parent, present].sum())


def log_mean(logs: Floats) -> float:
    """ln of the mean of exp: a new place by samples (2008, section on new places)."""
    return float(np.logaddexp.reduce(logs) - np.log(len(logs)))


def calibrate(
    references: Sequence[Reference], images: Sequence[Words], model: Model, drawn: NDArray[np.int64] | None
) -> tuple[float, float]:
    """The weight of the evidence, and nats to add to that of a new place, from the references alone.

    References are queries in turn, and the others of the same drive are the places: neighbours in time show the query's
    place, those far in time do not. The weight is the exponent of the likelihood that makes the neighbours most likely
    (a temperature: Guo et al., On calibration of modern neural networks, ICML 2017, section 4.2; Ribatet, Cooley &
    Davison, Statistica Sinica 22, 2012). With the nats a new place is as probable as it is frequent when each query is
    posed twice, with all other places and with the far ones only. The papers' (1, 0) without enough neighbours.
    """
    queries, others, neighbour, far = _by_time(references)
    if len(queries) < _LEAST_IMAGES:
        return 1.0, 0.0
    evidence = Evidence(images, model)
    log_ratio = np.empty((len(queries), len(images)))
    for k, row in enumerate(queries):
        log_ratio[k] = evidence(images[row], len(images))[0]
        new_place = average_place(images[row], model) if drawn is None else log_mean(log_ratio[k, drawn[drawn != row]])
        log_ratio[k] -= new_place
    surprise = [
        (_log_sum(weight * log_ratio, others) - _log_sum(weight * log_ratio, neighbour)).mean() for weight in _WEIGHTS
    ]
    weight = float(_WEIGHTS[np.argmin(surprise)])
    # both questions together have a new place half of the time: even odds against the mean of the places
    logs = [_log_sum(weight * log_ratio, places) - np.log(places.sum(axis=1)) for places in (others, far)]
    return weight, _even_odds(np.concatenate(logs), len(queries)) / weight


def _by_time(references: Sequence[Reference]) -> tuple[NDArray[np.int64], Bools, Bools, Bools]:
    """(A,) rows of queries, and (A, L) which are the other places of the drive, which its neighbours, which are far."""
    names = {name: number for number, name in enumerate(sorted({reference.drive for reference in references}))}
    drive = np.array([names[reference.drive] for reference in references])
    order = np.lexsort((np.arange(len(drive)), np.array([reference.stamp_ns for reference in references]), drive))
    size = np.bincount(drive)
    position = np.empty(len(drive), np.int64)
    position[order] = np.arange(len(drive)) - (np.cumsum(size) - size)[drive[order]]
    queries = np.flatnonzero(size[drive] >= _LEAST_IMAGES)
    queries = queries[:: -(-len(queries) // _MOST_QUERIES) or 1]
    same = drive[queries, None] == drive
    gap = np.abs(position[queries, None] - position)
    return queries, same & (gap > 0), same & (gap == 1), same & (gap > size[drive] / _NEAR_SHARE) & (gap > 1)


def _log_sum(logs: Floats, chosen: Bools) -> Floats:
    """(A,) ln of the sum of exp over the chosen of (A, L)."""
    return np.logaddexp.reduce(logs, axis=1, where=chosen, initial=-np.inf)


def _even_odds(logs: Floats, new_places: int) -> float:
    """The log likelihood of a new place at which its probabilities against `logs` sum to `new_places`."""
    ends = logs.min() - 50.0, logs.max() + 50.0  # e^-50 is nothing beside 1
    found: Any = scipy.optimize.bisect(lambda middle: scipy.special.expit(middle - logs).sum() - new_places, *ends)
    return found
