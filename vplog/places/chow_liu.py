"""The tree that best approximates a distribution over binary words: Chow & Liu, IEEE Trans. Inf. Theory 14(3), 1968.

Of all trees, the one with the largest sum of mutual information along its edges is nearest to the true distribution;
it is a maximum spanning tree, and every word then depends on its parent alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vplog.data import Floats, Int32s, Ints

_FIXED_POINT = 2**32
"""Steps of 1 / 2^32 nats: sums of whole numbers are exact, so equal information ties in any order of the sum."""
_HALF = 0.5
"""Images with and without a word that are added to the counted ones: Jeffreys' prior of a share."""


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
    owners = np.repeat(np.arange(len(images), dtype=np.int32), [len(image) for image in images])
    values = np.concatenate([np.zeros(0, np.int32), *(np.asarray(image, np.int32) for image in images)])
    image_start = np.concatenate([[0], np.cumsum([len(image) for image in images])]).astype(np.int64)
    holders = np.bincount(values, minlength=words)
    posting_start = np.concatenate([[0], np.cumsum(holders)]).astype(np.int64)
    postings = owners[np.argsort(values, kind="stable")]
    parent, both = _span(image_start, values, posting_start, postings, _times_log(len(images)))
    N = len(images)
    present = (holders + _HALF).astype(np.float64) / (N + 2 * _HALF)
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
