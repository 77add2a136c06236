"""Matches, boxes and votes of a closure in some 2 kB, which a page draws over thumbnails; as a picture, 90 kB."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from vplog.data import Bools, Floats
from vplog.results.report.charts import subsampled

_MOST_AGREEING, _MOST_OTHERS = 80, 40
"""Lines, subsampled: more hide so small a picture."""
VOTES = (18, 32)
"""Rows and columns of a voting map."""


def view(
    query: Floats, match: Floats, agrees: Bools, boxes: Sequence[tuple[int, Floats, Floats]], votes: Sequence[Floats]
) -> dict[str, Any]:
    """The record of a closure for JSON.

    `query` and `match` (K, 2) are the matches as shares of the sides; `boxes` are the numbers of shared references with
    the boxes (I, 4) of both on it, NaN where there is none; `votes` the voting maps of both on the first of them, or
    empty. In the record places are 0 to 255 across an image, in base64: `lines` x y x y of the matches, `agree` the
    number of the first of them that agree with one geometry, `boxes` x0 y0 x1 y1, `votes` 18 rows of 32.
    """
    lines, rows = np.column_stack([query, match]), (np.flatnonzero(agrees), np.flatnonzero(~agrees))
    shown = [subsampled(some, most) for some, most in zip(rows, (_MOST_AGREEING, _MOST_OTHERS), strict=True)]
    return {
        "lines": _packed(lines[np.concatenate(shown)]),
        "agree": len(shown[0]),
        "references": [number for number, _, _ in boxes],
        "boxes": [[_packed(one[np.isfinite(one).all(1)]) for one in pair] for _, *pair in boxes],
        "votes": [_packed(cv2.resize(one, VOTES[::-1], interpolation=cv2.INTER_AREA)) for one in votes],
    }


def checked(record: Any) -> dict[str, Any]:
    """The record of a file that may come from a stranger. Raises ValueError, LookupError or TypeError."""
    fours = [record["lines"], *(one for pair in record["boxes"] for one in pair)]
    sizes = [(one, 4) for one in fours] + [(one, VOTES[0] * VOTES[1]) for one in record["votes"]]
    if any(len(base64.b64decode(one, validate=True)) % size for one, size in sizes):
        raise ValueError("A closure's matches, boxes or votes are cut off.")
    numbers = [int(one) for one in record["references"]]
    return {
        "lines": str(record["lines"]),
        "agree": int(record["agree"]),
        "references": numbers,
        "boxes": [[str(mine), str(theirs)] for mine, theirs in record["boxes"]][: len(numbers)],
        "votes": list(map(str, record["votes"])),
    }


def _packed(shares: Any) -> str:
    packed = np.round(255.0 * shares.clip(0.0, 1.0)).astype(np.uint8)
    return base64.b64encode(packed.tobytes()).decode()
