"""An even choice of rows for a picture that cannot hold all."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def evenly(rows: NDArray[Any], most: int) -> NDArray[Any]:
    """At most so many rows (N, ...), evenly, the first and the last among them."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(np.int64)]
