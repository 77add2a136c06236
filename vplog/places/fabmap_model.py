"""FAB-MAP's observation model: how likely an image's words are at a place, from the Chow-Liu tree and the detector.

"2008" and "2.0" are the papers named in `fabmap.py`, and so are z, e and L.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vplog.data import Bools, Floats
    from vplog.places.chow_liu import ChowLiuTree

    Words = NDArray[np.uint16]

_ABSENT, _PRESENT, _AVERAGE = 0, 1, 2
"""States of a word at a place: its one image lacks it, has it, or there is no image."""


def log_likelihood_table(tree: ChowLiuTree, seen_if_there: float, seen_if_absent: float) -> Floats:
    """(V, 3, 2, 2) ln p(z_q | z_p, L): by what is known of q at L (unseen, seen, nothing), then z_p, then z_q.

    The word may or may not exist at the place (2008, section on the observation likelihood):
    p(z_q | z_p, L) = sum over e_q of p(z_q | e_q, z_p) p(e_q | L).
    """
    detector = np.array([[1 - seen_if_absent, seen_if_absent], [1 - seen_if_there, seen_if_there]])  # [e, z]
    marginal = np.stack([1 - tree.present, tree.present], axis=1)  # (V, z)
    given_parent = np.stack([1 - tree.present_given_parent, tree.present_given_parent], axis=2)  # (V, z_p, z)
    # p(z_q | e_q, z_p) is proportional to p(z_q | e_q) p(z_q | z_p) / p(z_q): detection does not depend on z_p.
    # The papers write it (1 + alpha / beta)^-1.
    observed = detector[:, None] * (given_parent / marginal[:, None])[:, None]  # (V, e, z_p, z)
    observed /= observed.sum(axis=3, keepdims=True)
    # The place model: the prior p(e_q = 1) is how often the word occurs at all, and the place's one image updates it
    # by Bayes' rule (2008, on the update of the place model).
    exists = np.empty((len(tree), 3))
    for known in (_ABSENT, _PRESENT):
        there, absent = detector[1, known] * tree.present, detector[0, known] * (1 - tree.present)
        exists[:, known] = there / (there + absent)
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
        lengths = [len(place) for place in places]
        owners = np.repeat(np.arange(len(places), dtype=np.int32), lengths)
        words = np.concatenate([np.zeros(0, np.int64), *(place.astype(np.int64) for place in places)])
        order = np.argsort(words, kind="stable")
        self._list_start = np.searchsorted(words[order], np.arange(len(model.tree) + 1)).astype(np.int64)
        self._list_place = owners[order]
        silent = model.table[:, :, 0, 0]
        gain = (silent[:, _PRESENT] - silent[:, _ABSENT])[words]
        self._base = silent[:, _ABSENT].sum() + np.bincount(owners, gain, minlength=len(places))

    def __len__(self) -> int:
        return self._count

    def __call__(self, words: Words, stop: int) -> tuple[Floats, Bools]:
        """(stop,) ln p(Z | L), and whether the place has a word of the image."""
        model = self._model
        return _evidence(
            words, model.tree.parent, model.child_start, model.children, model.table,
            self._list_start, self._list_place, self._base[:stop],
        )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _evidence(words, parent, child_start, children, table, list_start, list_place, base):
    """(stop,) float64 log likelihood and bool: starts from `base`, a sum per place; `words` increase."""
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
