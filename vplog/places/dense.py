"""Places that are one vector each: their column in a table, and exact search over all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from vplog.data import Ranking
from vplog.errors import LibraryError
from vplog.places.columns import check_type, check_values
from vplog.places.relearn import ReferencesState

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from vplog.data import Bytes, Features, Float32s


def best_rows(score: Float32s, k: int) -> Ranking:
    """The k best rows of (N,) scores, ties to the earlier row; rows of score 0 share nothing and are left out."""
    rows = np.flatnonzero(score)
    if len(rows) > k > 0:  # everything as good as the k-th, so that ties do not depend on the partition
        rows = rows[score[rows] >= -np.partition(-score[rows], k - 1)[k - 1]]
    rows = rows[np.lexsort((rows, -score[rows]))][: max(k, 0)]
    return Ranking(rows.astype(np.int32), score[rows])


class VectorIndex:
    """Places of a map; rows are in the order given."""

    def __init__(self, vectors: NDArray, similarity: Callable[[NDArray, NDArray], Float32s]) -> None:
        """`similarity(vectors (N, D), query (D,)) -> (N,) float32`, 0 where they share nothing."""
        self._vectors, self._similarity = np.ascontiguousarray(vectors), similarity

    def __len__(self) -> int:
        return len(self._vectors)

    def scores(self, descriptor: NDArray, stop: int | None = None) -> Float32s:
        """(stop,) similarity of the query to each place."""
        return self._similarity(self._vectors[:stop], descriptor.astype(self._vectors.dtype))

    def query(self, descriptor: NDArray, k: int, stop: int | None = None) -> Ranking:
        """The k best places below row `stop`; ties go to the earlier row."""
        return best_rows(self.scores(descriptor, stop), k)


def thumbnail_of(features: Features) -> Bytes:
    """(THUMBNAIL_SIDE, THUMBNAIL_SIDE) uint8. Raises LibraryError where the features were stored without it."""
    if features.thumbnail is None:
        raise LibraryError(
            "gist and thumbnail compare whole images, but these features came without one; extract them from the log "
            "again, or use a recogniser of features: bobb, bovf, vlad."
        )
    return features.thumbnail


class VectorState(ReferencesState):
    """A state whose places are vectors of one length."""

    arrow_type: Any
    """A fixed-size list of numbers."""

    @property
    def bits(self) -> int:
        return self.arrow_type.list_size * self.arrow_type.value_type.bit_width

    def to_arrow(self, descriptors: Sequence[NDArray]) -> pa.Array:
        return vectors_to_arrow(descriptors, self.arrow_type)

    def from_arrow(self, column: pa.Array) -> list[Any]:
        """The places of a table's column. Raises LibraryError where it is of another kind or length."""
        return vectors_from_arrow(column, self.arrow_type)


def vectors_to_arrow(vectors: Sequence[NDArray], arrow_type: pa.FixedSizeListType) -> pa.Array:
    """One fixed-size list a place."""
    dtype = arrow_type.value_type.to_pandas_dtype()
    values = np.array(vectors, dtype).reshape(-1)
    return pa.FixedSizeListArray.from_arrays(pa.array(values, arrow_type.value_type), type=arrow_type)


def vectors_from_arrow(column: pa.Array, arrow_type: pa.FixedSizeListType) -> list[NDArray]:
    """The vectors of a table's column. Raises LibraryError where it is of another kind, or not finite numbers."""
    check_type(column, arrow_type)
    check_values(column)
    values = column.flatten().to_numpy().reshape(-1, arrow_type.list_size)
    if not np.all(np.isfinite(values)):
        raise LibraryError("Some descriptors have values that are not finite; compute them again with `vplog run`.")
    return list(values)
