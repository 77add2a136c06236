"""Eq. (1) over a map of places whose boxes are numbers, with weights of the references: exact, in whole numbers.

Only boxes on a shared reference overlap, so a query visits the lists of its own references, block by block of rows, so
that sums stay in the cache. Overlaps are read from a table, summed as integers and scaled once. A search for the best
places compares boxes only where an upper bound of the score reaches the best found so far.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from typing import Literal

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from vplog.data import Bools, Bytes, Float32s, Floats, Ints, Ranking, Uint16s
from vplog.errors import ResultError

Pairing = Literal["best", "same", "both"]


BLOCK = 8192
"""Rows of a block: their bounds take 32 kB, a core's first cache; 4096 to 32768 cost the same to 20 %."""
MOST_ROWS = 65_536
"""Rows that a block may have: an offset has 16 bits."""
STEPS = 255
"""A bound is a product of two unit vectors, each value a whole number of these steps, rounded up."""
_PAIRINGS = {"best": (1, 0, 0), "same": (0, 1, 0), "both": (5, 5, 6)}
"""Weights of a box's best overlap, of that with the same window's box, and of that with the box of the window beside
it, where all windows are shifted by one, to the left or to the right: the picture of a camera that has turned. Of three
windows in a row two are left then; 6 : 5 is about the root of 3 : 2."""
_ROUNDING = 1e-6
"""Scores round to float32, by a share of 6e-8; what is below the worst of the best by more than this is below it."""
_LANES = 8
"""Windows whose overlaps stand side by side in a word of 64 bits."""
_ALL = np.zeros(1, np.int64), np.ones(1, np.bool_)
"""One run of rows, all of which count."""


@dataclass(frozen=True, eq=False)
class Place:
    """J references with a weight each and I boxes on it: 12 bytes a reference with nine boxes."""

    references: Uint16s
    """(J,) best first; one beyond the library where fewer share anything."""
    weights: Bytes
    """(J,) how much each explains, in 255ths of the most."""
    boxes: Bytes
    """(J, I) number of the box that each window is found in, 255 where it is not."""


@dataclass(frozen=True, eq=False)
class CodeLists:
    """N places as E entries, one for each reference of a place, of a library of L references."""

    start: Ints
    """(L, B + 1) the entries of reference r in block b of rows are start[r, b]..start[r, b + 1]."""
    offset: Uint16s
    """(E,) row within the block, rising within a reference's part of it."""
    weight: Bytes
    """(E,) of the reference in its place, as described."""
    share: Bytes
    """(E,) the weight as part of the place's unit vector, in 255ths, rounded up."""
    boxes: Bytes
    """(E, I) numbers of the boxes."""
    square: NDArray[np.uint32]
    """(N,) sum of the squares of the place's weights, at least 1."""
    block: int
    """Rows of a block; the last one may have fewer."""

    def __len__(self) -> int:
        return len(self.square)

    @property
    def parts(self) -> tuple[Ints, Uint16s, Bytes, Bytes, Bytes, NDArray[np.uint32]]:
        """The arrays, in the order in which kernels take them and files hold them."""
        return self.start, self.offset, self.weight, self.share, self.boxes, self.square


def build_lists(references: Uint16s, weights: Bytes, boxes: Bytes, library_size: int, block: int) -> CodeLists:
    """Lists of `references` and `weights` (N, J), a reference beyond the library is none, and `boxes` (N, J, I)."""
    count, per_place, windows = boxes.shape
    flat = references.reshape(-1)
    order = np.argsort(flat, kind="stable")
    order = order[: np.searchsorted(flat[order], library_size)]
    row = order // per_place
    blocks = -(-count // block)
    entries = np.bincount(flat[order].astype(np.int64) * blocks + row // block, minlength=library_size * blocks)
    start = np.pad(entries.reshape(library_size, blocks), ((0, 0), (1, 0))).cumsum().reshape(library_size, blocks + 1)
    square = np.maximum((weights.astype(np.uint32) ** 2).sum(axis=1, dtype=np.uint32), np.uint32(1))
    weight = weights.reshape(-1)[order]
    share = np.ceil(weight * np.float64(STEPS) / np.sqrt(square[row])).astype(np.uint8)
    offset = (row % block).astype(np.uint16)
    return CodeLists(start, offset, weight, share, np.take(boxes.reshape(-1, windows), order, 0), square, block)


def check_lists(lists: CodeLists) -> None:
    """Raises ResultError where a search would read or write beyond the arrays. Only `start` is looked at: whatever the
    other arrays of a stranger's file hold, they give wrong scores at worst."""
    start = lists.start.reshape(-1)
    blocks = -(-len(lists) // lists.block)
    sound = 0 < lists.block <= MOST_ROWS and lists.start.shape[1] == blocks + 1
    ends = len(start) == 0 or (start[0] == 0 and start[-1] == len(lists.offset))
    if not (sound and ends) or np.any(start[1:] < start[:-1]):  # not differences, which wrap round
        raise ResultError("Its lists do not fit together.")


def compare_windows(cells: Floats, along: int, pairing: Pairing) -> Floats:
    """(E, 3) cells that the boxes of I windows share with others', summed by the pairing's weights, for the view as it
    is, and shifted to the right and to the left; `cells` (E, I, I) are those of each two boxes."""
    best, same, beside = np.array(_PAIRINGS[pairing]) / sum(_PAIRINGS[pairing][:2])
    in_row = np.einsum("erarb->eab", cells.reshape(-1, along, along, along, along))  # by the columns of both windows
    shifted = np.column_stack([np.trace(in_row, offset, 1, 2) for offset in (0, -1, 1)])
    return best * cells.max(axis=2).sum(axis=1)[:, None] + shifted * (same, beside, beside)


class CodeIndex:
    """Places of a map; rows are in the order given."""

    def __init__(self, lists: CodeLists, overlap: Bytes, pairing: Pairing) -> None:
        """`overlap` (256, 256) is the cells that two boxes share."""
        self._lists, self._overlap, self._windows = lists, overlap, lists.boxes.shape[1]
        self._most, self._along = overlap.max(axis=1).astype(np.int64), math.isqrt(self._windows)
        self._comparison = ((0,) * self._along,) * self._along, _PAIRINGS[pairing], lists.block
        self._whole = int(overlap.max(initial=1)) * sum(_PAIRINGS[pairing][:2]) * self._windows
        self._longest = int(np.diff(lists.start).max(initial=0))
        for part in lists.parts:
            part.flags.writeable = False  # a kernel is compiled once, for lists in memory and for those of a file

    def __len__(self) -> int:
        return len(self._lists)

    @property
    def nbytes(self) -> int:
        """Bytes of the map: 13 a reference of a place with nine boxes, 4 a place, and 8 a reference of the library and
        block of rows."""
        return sum(part.nbytes for part in self._lists.parts)

    @property
    def blocks(self) -> int:
        """Blocks of rows, which a search may be split by."""
        return self._lists.start.shape[1] - 1

    def scores(self, descriptor: Place, stop: int | None = None) -> Float32s:
        """(stop,) 0..1: mean overlap of the boxes, weighted by the references' weights as unit vectors; 1 is equal. Of
        the three shifts of the view each place has the best, the same on all references."""
        result = np.zeros(self._end(stop), np.float32)
        _score_all(self._query(descriptor), self._comparison, self._lists.parts, result)
        return result

    def query(self, descriptor: Place, k: int, stop: int | None = None) -> Ranking:
        return self.best(descriptor, k, stop=self._end(stop))

    def best(
        self,
        descriptor: Place,
        k: int,
        blocks: tuple[int, int] | None = None,
        least: float = 0.0,
        runs: tuple[Ints, Bools] = _ALL,
        stop: int | None = None,
    ) -> Ranking:
        """The k best places among the rows of blocks first..last that reach a score of `least`, which those found
        elsewhere may set. `runs` are the first rows (D,) of drives, rising from 0, and whether each counts."""
        lists = self._lists
        first, last = (0, self.blocks) if blocks is None else blocks
        extent = first, min(last, -(-self._end(stop) // lists.block)), self._end(stop)
        rows, score = _find_best(
            self._query(descriptor), self._comparison, lists.parts, self._longest, extent, (k, np.float32(least)), runs
        )
        order = np.lexsort((rows, -score))
        return Ranking(rows[order], score[order])

    def _end(self, stop: int | None) -> int:
        return len(self) if stop is None else max(min(stop, len(self)), 0)

    def _query(self, descriptor: Place) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray, float]:
        """The query's references in the library (Q,), their weights (Q,), its side of the bound for each (Q,), the
        (Q, 256, words x 8) cells that a box of any number shares with the box of each of the query's windows, their
        words, and what sums are divided by beside the length of the place's own weights."""
        weights = descriptor.weights.astype(np.int64)
        used = np.flatnonzero(descriptor.references < len(self._lists.start))
        scale = np.sqrt(max(int((weights**2).sum()), 1)) * self._whole
        weights, boxes = weights[used], descriptor.boxes[used]
        cells = np.zeros((len(used), 256, -(-self._windows // _LANES) * _LANES), np.uint8)
        cells[:, :, : self._windows] = self._overlap[boxes].transpose(0, 2, 1)
        most, (best, same, beside) = self._most[boxes].reshape(-1, self._along, self._along), self._comparison[1]
        every, right, left = (part.sum(axis=(1, 2)) for part in (most, most[..., 1:], most[..., :-1]))
        most = best * every + np.maximum(same * every, beside * np.maximum(left, right))
        reach = np.ceil(weights * most * STEPS / scale).astype(np.int32)
        return descriptor.references[used].astype(np.int64), weights, reach, cells, cells.view(np.uint64), scale


@intrinsic
def _larger_bytes(typing, a, b):
    """The larger of each of the eight bytes of two words: one instruction where a compiler would see only words.

    `typing` is what numba hands to every intrinsic; calls leave it out.
    """

    def build(context, builder, signature, arguments):
        eight = ir.VectorType(ir.IntType(8), 8)
        left, right = (builder.bitcast(word, eight) for word in arguments)
        larger = builder.select(builder.icmp_unsigned(">", left, right), left, right)
        return builder.bitcast(larger, ir.IntType(64))

    return types.uint64(types.uint64, types.uint64), build


@numba.njit(cache=True, nogil=True)
def _sum_bytes(word):
    """Sum of the eight bytes of a word: pairs of them in 16 bits each, then all four pairs by one product."""
    pairs = (word & np.uint64(0x00FF00FF00FF00FF)) + ((word >> np.uint64(8)) & np.uint64(0x00FF00FF00FF00FF))
    return np.int64((pairs * np.uint64(0x0001000100010001)) >> np.uint64(48))


@numba.njit(cache=True, nogil=True)
def _compare(cells, words, boxes, e, windows, pairing):
    """Cells that the windows' boxes share with the best box of entry e and with that of the same window, summed, and
    the same with that of the window to the right, and to the left.

    `windows` are rows of tuples for their lengths, which are known when compiled: no loop is left of them.
    """
    best, same, right, left = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    along = len(windows[0])
    e = np.uint64(e)  # unsigned, as all numbers in this loop: a sign would be checked every time
    for part in range((len(windows) * along + _LANES - 1) // _LANES):
        most = np.uint64(0)
        for i in range(len(windows) * along):
            most = _larger_bytes(most, words[boxes[e, np.uint64(i)], np.uint64(part)])  # pyrefly: ignore[missing-argument]
        best += _sum_bytes(most)
    for i in range(len(windows) * along):
        box = cells[boxes[e, np.uint64(i)]]
        same += np.int64(box[np.uint64(i)])
        if i % along > 0:
            right += np.int64(box[np.uint64(i - 1)])
        if i % along < along - 1:
            left += np.int64(box[np.uint64(i + 1)])
    best *= pairing[0]
    return best + pairing[1] * same, best + pairing[2] * right, best + pairing[2] * left


@numba.njit(cache=True, nogil=True)
def _add(total, weight, cells):
    """Add what an entry is worth at each of the three shifts."""
    for shift in range(3):
        total[shift] += weight * cells[shift]


@numba.njit(cache=True, nogil=True)
def _entries(start, offset, b, reference, rows):
    """First and last entry of a reference in block b, of the block's first rows."""
    first, last = start[reference, b], start[reference, b + 1]
    if last > first and offset[last - 1] >= rows:
        last = first + np.searchsorted(offset[first:last], rows)
    return first, last


@numba.njit(cache=True, nogil=True)
def _score_all(query, comparison, lists, result):
    """Write the scores of the first rows into `result`; `comparison` is windows, pairing and rows of a block."""
    references, weights, _, cells, words, scale = query
    windows, pairing, block = comparison
    start, offset, weight, _, coded, square = lists
    stop = result.shape[0]
    total = np.zeros((MOST_ROWS, 3), np.int64)  # an offset of a damaged file may be beyond the block
    for b in range((stop + block - 1) // block):
        rows = min(stop - b * block, block)
        total[:rows] = 0
        for j in range(references.shape[0]):
            first, last = _entries(start, offset, b, references[j], rows)
            row, mass, boxes = offset[first:last], weight[first:last], coded[first:last]
            here, word = cells[j], words[j]
            for e in range(last - first):
                _add(total[row[e]], weights[j] * np.int64(mass[e]), _compare(here, word, boxes, e, windows, pairing))
        for row in range(rows):
            if total[row, 0] > 0:
                place = b * block + row
                length = np.sqrt(np.float64(max(square[place], np.uint32(1))))
                result[place] = max(total[row, 0], total[row, 1], total[row, 2]) / (length * scale)


@numba.njit(cache=True, nogil=True)
def _find_best(query, comparison, lists, longest, extent, wanted, drives):
    """(rows, scores) of the k best rows of blocks begin..end below `stop` that reach the wanted score, in no order."""
    references, weights, reach, cells, words, scale = query
    windows, pairing, block = comparison
    start, offset, weight, share, coded, square = lists
    begin, end, stop = extent
    k, worst = wanted
    runs, counts = drives
    found = [(np.float32(0.0), np.int64(0)) for _ in range(0)]  # a heap: the worst first, of equals the latest row
    bound, total = np.zeros(MOST_ROWS, np.int32), np.zeros((MOST_ROWS, 3), np.int64)  # as for all scores
    touched, candidates = np.empty(MOST_ROWS, np.int64), np.empty(longest + 1, np.int64)
    least = _reached(worst)
    for b in range(begin, end if k > 0 else begin):
        rows = min(stop - b * block, block)
        some, most = np.searchsorted(runs, b * block, side="right") - 1, np.searchsorted(runs, b * block + rows)
        if not counts[some:most].any():
            continue
        bound[:rows] = 0
        for j in range(references.shape[0]):
            first, last = _entries(start, offset, b, references[j], rows)
            row, part, step = offset[first:last], share[first:last], reach[j]
            for e in range(last - first):
                bound[row[e]] += step * np.int32(part[e])
        count = 0
        for j in range(references.shape[0]):
            first, last = _entries(start, offset, b, references[j], rows)
            row, mass, boxes = offset[first:last], weight[first:last], coded[first:last]
            here, word = cells[j], words[j]
            reaching = 0
            for e in range(last - first):  # without a branch, which could not be foreseen
                candidates[reaching] = e
                reaching += bound[row[e]] >= least
            for e in candidates[:reaching]:
                more, worth = _compare(here, word, boxes, e, windows, pairing), weights[j] * np.int64(mass[e])
                if worth * more[0] > 0 and total[row[e], 0] == 0:
                    touched[count] = row[e]
                    count += 1
                _add(total[row[e]], worth, more)
        for row in touched[:count]:
            place = b * block + row
            length = np.sqrt(np.float64(max(square[min(place, stop - 1)], np.uint32(1))))
            score = np.float32(max(total[row, 0], total[row, 1], total[row, 2]) / (length * scale))
            total[row] = 0
            if row < rows and score >= worst and counts[np.searchsorted(runs, place, side="right") - 1]:
                _offer(found, k, score, place)
            worst = found[0][0] if len(found) == k else worst
        least = _reached(worst)
    score, place = np.empty(len(found), np.float32), np.empty(len(found), np.int32)
    for n in range(len(found)):
        score[n], place[n] = found[n][0], -found[n][1]
    return place, score


@numba.njit(cache=True, nogil=True)
def _offer(found, k, score, place):
    """Take a place into a heap of the k best, unless it is worse than all of them."""
    if len(found) < k:
        heapq.heappush(found, (score, -place))
    elif (score, -place) > found[0]:
        heapq.heapreplace(found, (score, -place))


@numba.njit(cache=True, nogil=True)
def _reached(worst):
    """Least bound of a place that may score `worst`."""
    return np.int64(np.float64(worst) * (1.0 - _ROUNDING) * STEPS * STEPS)
