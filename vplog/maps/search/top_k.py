"""The best places of a map for the views of a log, and how those of its parts become those of all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vplog.data import Float32s, Int32s, Ints, Ranking

NONE = np.float32(-np.inf)
"""Score of no answer."""


@dataclass(frozen=True, eq=False)
class Answers:
    """The best places for Q views, best first: by falling score, then by drive, then by keyframe. Rows are filled up
    to K with none."""

    drive: Int32s
    """(Q, K) number of the drive, in order of IDs."""
    keyframe: Int32s
    """(Q, K) row of the drive's keyframes."""
    score: Float32s
    """(Q, K), NONE where there are fewer."""
    support: Int32s
    """(Q, K) views of the window that agree."""

    @property
    def count(self) -> Ints:
        """(Q,) how many of the K there are."""
        return (self.score > NONE).sum(axis=1)


def no_answers(views: int, top: int) -> Answers:
    """(Q, K) none, to be written to."""
    drive, keyframe, support = np.zeros((3, views, top), np.int32)
    return Answers(drive, keyframe, np.full((views, top), NONE, np.float32), support)


def answers_of(rankings: Iterable[tuple[Ranking, Int32s]], views: int, drive: int, top: int) -> Answers:
    """Of one drive, from the ranking of its rows and their support for each view in order."""
    found = no_answers(views, top)
    found.drive[:] = drive
    for view, (ranking, support) in enumerate(rankings):
        count = len(ranking.rows)
        found.keyframe[view, :count], found.score[view, :count] = ranking.rows, ranking.score
        found.support[view, :count] = support
    return found


def merge(parts: Sequence[Answers], top: int) -> Answers:
    """The best of all parts: exactly those of one search, where each part gives its own best in this order."""
    columns = [np.concatenate([vars(part)[name] for part in parts], axis=1) for name in vars(parts[0])]
    drive, keyframe, score, _ = columns
    order = np.lexsort((keyframe, drive, -score), axis=1)[:, :top]
    return Answers(*(np.take_along_axis(column, order, axis=1) for column in columns))
