"""The references that explain both places of a pair, and the overlap of their boxes: the terms of the score of a
recogniser with boxes, by reference, for the ledger of closures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog.data import SharedReferences

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.data import Float32s, Floats, Int32s, Ints, Uint16s

    Compare = Callable[[Ints, Ints, Ints, Ints], tuple[Floats, Floats]]

_PAIRS = 4096
"""Pairs of places that are compared at once: their references and boxes take some ten MB."""


def list_shared(references: Ints, query: Int32s, match: Int32s, compare: Compare) -> SharedReferences:
    """The references (N, J) of places that two of them share, for C pairs of rows; a negative number is none.

    `compare` gets rows (S,) of the query places, the ranks (S,) of their reference, and the same of the match places,
    and gives the overlap (S,) of their boxes and what it is worth in the score (S,), up to a factor of the pair.
    """
    numbers: list[Uint16s] = []
    shares: list[Float32s] = []
    for start in range(0, len(query), _PAIRS):
        rows, others = query[start : start + _PAIRS].astype(np.int64), match[start : start + _PAIRS].astype(np.int64)
        mine, theirs = references[rows], references[others]
        pair, rank, other_rank = np.nonzero((mine[:, :, None] == theirs[:, None, :]) & (mine >= 0)[:, :, None])
        overlap, worth = compare(rows[pair], rank, others[pair], other_rank)
        number = mine[pair, rank]
        order = np.lexsort((number, -worth, pair))
        ends = np.cumsum(np.bincount(pair, minlength=len(rows)))[:-1]
        numbers += np.split(number[order].astype(np.uint16), ends)
        shares += np.split(overlap[order].astype(np.float32), ends)
    return SharedReferences(numbers, shares)
