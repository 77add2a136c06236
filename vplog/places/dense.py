"""Places that are one vector each: their column in a table, and exact search over all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numba
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from vplog.data import Bytes, Features, Float32s, Ranking
from vplog.errors import LibraryError
from vplog.places.columns import from_column, to_column
from vplog.places.library_files import ReferencesState


def best_rows(score: Float32s, k: int) -> Ranking:
    """The k best rows of (N,) scores, ties to the earlier row; rows of score 0 share nothing and are left out."""
    rows = np.flatnonzero(score)
    if len(rows) > k > 0:  # everything as good as the k-th, so that ties do not depend on the partition
        rows = rows[score[rows] >= -np.partition(-score[rows], k - 1)[k - 1]]
    return ranked(rows, score, k)


def ranked(rows: NDArray, score: Float32s, k: int) -> Ranking:
    """The k best of some rows of (N,) scores, ties to the earlier row."""
    rows = rows[np.lexsort((rows, -score[rows]))][: max(k, 0)]
    return Ranking(rows.astype(np.int32), score[rows])


class VectorIndex:
    """Places of a map, in the order given; `similarity(vectors (N, D), query (D,)) -> (N,) float32`, 0 where they
    share nothing."""

    def __init__(self, vectors: NDArray, similarity: Callable[[NDArray, NDArray], Float32s]) -> None:
        self._vectors, self._similarity = np.ascontiguousarray(vectors), similarity

    def __len__(self) -> int:
        return len(self._vectors)

    def scores(self, descriptor: NDArray, stop: int | None = None) -> Float32s:
        return self._similarity(self._vectors[:stop], descriptor.astype(self._vectors.dtype))

    def query(self, descriptor: NDArray, k: int, stop: int | None = None) -> Ranking:
        return best_rows(self.scores(descriptor, stop), k)


def thumbnail_of(features: Features) -> Bytes:
    """(THUMBNAIL_SIDE, THUMBNAIL_SIDE) uint8. Raises LibraryError where the features were stored without it."""
    if features.thumbnail is None:
        raise LibraryError(
            "gist and thumbnail compare whole images, but these features came without one; extract them from the log "
            "again, or use a recogniser of features: bobb, bovf, vlad."
        )
    return features.thumbnail


# no BLAS: its threads would compete with ours. Between halves, multiples of 2^-24, float64 sums are exact in any order
@numba.njit(cache=True, nogil=True, fastmath={"reassoc"})
def products(vectors, query):
    """(N,) float32 products of (N, D) and (D,); of unit vectors, their cosines."""
    result = np.zeros(vectors.shape[0], np.float32)
    for row in range(vectors.shape[0]):
        total = 0.0
        for d in range(vectors.shape[1]):
            total += np.float64(vectors[row, d]) * np.float64(query[d])
        result[row] = total
    return result


@numba.njit(cache=True, nogil=True, fastmath={"reassoc"})
def nearness(vectors, query):
    """(N,) float32: 1 / (1 + L2 distance) of (N, D) to (D,)."""
    result = np.zeros(vectors.shape[0], np.float32)
    for row in range(vectors.shape[0]):
        total = 0.0
        for d in range(vectors.shape[1]):
            difference = np.float64(vectors[row, d]) - np.float64(query[d])
            total += difference * difference
        result[row] = 1 / (1 + np.sqrt(total))
    return result


class VectorState(ReferencesState):
    """A state whose places are vectors of one length."""

    arrow_type: Any
    """A fixed-size list of numbers."""
    similarity: Callable[[NDArray, NDArray], Float32s] = staticmethod(products)
    """See `VectorIndex`; of unit vectors, the cosine."""
    compared: Any = np.float32
    """Type of the numbers that are compared."""

    @property
    def bits(self) -> int:
        return self.arrow_type.list_size * self.arrow_type.value_type.bit_width

    def matrix(self, descriptors: Sequence[NDArray], dtype: Any) -> NDArray:
        """(N, D) places, one a row."""
        return np.array(descriptors, dtype).reshape(-1, self.arrow_type.list_size)

    def index(self, descriptors: Sequence[NDArray]) -> VectorIndex:
        return VectorIndex(self.matrix(descriptors, self.compared), self.similarity)

    def to_arrow(self, descriptors: Sequence[NDArray]) -> pa.Array:
        dtype = self.arrow_type.value_type.to_pandas_dtype()
        return to_column(self.arrow_type, iter([self.matrix(descriptors, dtype)]))

    def from_arrow(self, column: pa.Array) -> list[Any]:
        return list(*from_column(column, self.arrow_type))


def unit(vector: Float32s) -> Float32s:
    """The vector at unit length; zeros where it has none."""
    return vector / np.maximum(np.linalg.norm(vector), np.float32(1e-9))
