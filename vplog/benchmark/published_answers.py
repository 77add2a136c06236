"""Answers that were computed elsewhere, from a CSV file: of a paper, or of another program.

    query,match,score
    0,17,0.93
    1.jpg,18.jpg,0.88

Frames are numbers counted from 0, also where images are named by numbers, or the names of images. `score` may be left
out: a query's answers then come best first.
"""

from __future__ import annotations

import math
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from vplog.data import Float32s
from vplog.errors import SettingsError
from vplog.evaluate.image_names import row_finder
from vplog.evaluate.truth_tables import read_lines
from vplog.settings import Settings

if TYPE_CHECKING:
    from vplog.benchmark.traversals import Traversal

_FORMAT = "The header is `query,match` or `query,match,score`; a frame is its number from 0, or the name of its image."


class AnswersSettings(Settings):
    """Answers from a file, in place of a recogniser."""

    LOCATIONS: ClassVar = frozenset({"file"})

    kind: Literal["answers"] = "answers"
    """No recogniser: only `compare` takes it."""
    file: str = ""
    """CSV file with columns query, match and, if there is one, score."""


def fill_scores(settings: AnswersSettings, query: Traversal, other: Traversal, scores: Float32s) -> int:
    """Fill `scores` (Q, M) with the answers, NaN elsewhere; how many there are. Raises SettingsError with the line that
    does not fit. Frames that are not compared are passed over."""
    scores[:] = np.nan
    sides, ranks, count = (_Frames(query), _Frames(other)), dict[int, int](), 0
    headers = ["query", "match"], ["query", "match", "score"]
    for where, line in islice(read_lines(Path(settings.file), headers, _FORMAT, SettingsError), 1, None):
        rows = [side.row(cell, where) for side, cell in zip(sides, line, strict=False)]
        if rows[0] is None or rows[1] is None:
            continue
        ranks[rows[0]] = ranks.get(rows[0], 0) + 1
        score = _score(line[2], where) if len(line) > 2 else 1.0 / ranks[rows[0]]
        if not scores[rows[0], rows[1]] >= score:  # named twice, the better counts
            scores[rows[0], rows[1]] = score
        count += 1
    if not count:
        raise SettingsError(f"{settings.file} answers none of {len(query)} frames. {_FORMAT}")
    return count


class _Frames:
    """Rows of a traversal by what a file calls its frames."""

    def __init__(self, traversal: Traversal) -> None:
        self._drive, self._count = traversal.name, len(traversal.log.stamps())
        self._rows = {number: row for row, number in enumerate(traversal.frames.tolist())}
        self._named = row_finder(traversal.log.file_names(), traversal.name)

    def row(self, cell: str, where: str) -> int | None:
        """None where the frame is not among those compared. Raises SettingsError where there is none."""
        number = int(cell) if cell.isdecimal() and len(cell) < 10 else self._named(cell)
        if number is None or number >= self._count:
            text = f"{where}: {cell[:80]!r} is no frame of {self._drive}, which has {self._count}. {_FORMAT}"
            raise SettingsError(text)
        return self._rows.get(number)


def _score(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not abs(value) <= np.finfo(np.float32).max:
        raise SettingsError(f"{where}: {cell[:80]!r} is not a score. {_FORMAT}")
    return value
