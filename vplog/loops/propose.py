"""Candidate closures: earlier keyframes that a keyframe may be a return to, by place recognition."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
from pydantic import Field

from vplog.data import Bools, Float32s, Int32s, Ints, Keyframes, Ranking
from vplog.settings import Settings


class ProposeSettings(Settings):
    """Selection of the candidates. The gaps count keyframes, whose spacing follows the drive's own scale:
    a car's is metres, a hand-held camera's centimetres."""

    per_query: int = Field(default=10, ge=1)
    """Candidates kept for each keyframe."""
    gap_keyframes: int = Field(default=30, ge=0)
    """A match is at least this many keyframes earlier, but never more than a quarter of the drive: until then much of
    the view is still the same, and a closure adds nothing to odometry."""
    gap_steps: float = Field(default=30.0, ge=0)
    """Also at least this many times the drive's median keyframe spacing earlier along the path, so that standing still
    makes no closures, however long it takes."""
    gap_s: float = Field(default=0.0, ge=0, le=1e9)
    """Also at least this many seconds earlier; 0 leaves it to the other gaps."""
    gap_m: float = Field(default=0.0, ge=0)
    """Also at least this many metres of path earlier; 0 leaves it to the other gaps."""
    suppress: int = Field(default=1, ge=0)
    """Candidates within this many keyframes of a better one of the same query are left out: they show what it shows."""

    @property
    def ranked(self) -> int:
        """Rows that a recogniser ranks for each query: each one taken may suppress 2 x suppress others."""
        return self.per_query * (2 * self.suppress + 1)


@dataclass(frozen=True, eq=False)
class Proposals:
    """C candidate closures, ordered by query, then rank."""

    query: Int32s
    """(C,) keyframe row, the later one."""
    match: Int32s
    """(C,) keyframe row, the earlier one."""
    rank: Int32s
    """(C,) 0 is the query's best."""
    score: Float32s
    """(C,) the recogniser's similarity."""
    support: Int32s
    """(C,) neighbours of the pair that agree by sequence; 0 where no sequence was used."""

    def rows(self, rows: Ints | Bools) -> Proposals:
        """Some of the candidates."""
        return Proposals(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})


def candidate_stops(keyframes: Keyframes, settings: ProposeSettings) -> Ints:
    """(N,) int64: keyframe i may match rows below stops[i] only. They never decrease."""
    count = len(keyframes.stamp_ns)
    if count == 0:
        return np.empty(0, np.int64)
    step_m = np.linalg.norm(np.diff(keyframes.odom_from_body[:, :3, 3], axis=0), axis=1)
    path_m = np.concatenate([[0.0], np.cumsum(step_m)])
    moving = step_m[step_m > 0]
    gap_m = max(settings.gap_m, settings.gap_steps * float(np.median(moving)) if len(moving) else 0.0)
    # of a short drive too, the last quarter can return to the first
    gap_rows = min(settings.gap_keyframes, count // 4)
    gap_ns = int(settings.gap_s * 1e9)
    by_rows = np.arange(count) - max(gap_rows, 1) + 1
    by_time = np.searchsorted(keyframes.stamp_ns, keyframes.stamp_ns - gap_ns, side="right")
    # even spacing puts a keyframe right on the gap, where the rounding of the sum must not decide
    by_path = np.searchsorted(path_m, path_m - gap_m * (1.0 - 1e-6), side="right")
    return np.maximum(np.minimum(np.minimum(by_rows, by_time), by_path), 0).astype(np.int64)


def propose(rankings: Iterable[tuple[Ranking, Int32s]], settings: ProposeSettings) -> Proposals:
    """Candidates from every keyframe's ranking of the rows below its stop, in order, with the support of each row.

    A ranking holds `settings.ranked` rows, or fewer where no more score above chance.
    """
    found = []
    for ranking, support in rankings:
        chosen = _suppress(ranking.rows, settings.suppress, settings.per_query)
        found.append((ranking.rows[chosen], ranking.score[chosen], support[chosen]))
    counts = np.array([len(rows) for rows, _, _ in found], np.int64)
    return Proposals(
        query=np.repeat(np.arange(len(found)), counts).astype(np.int32),
        match=np.concatenate([rows for rows, _, _ in found] or [[]]).astype(np.int32),
        rank=np.concatenate([np.arange(n) for n in counts] or [[]]).astype(np.int32),
        score=np.concatenate([score for _, score, _ in found] or [[]]).astype(np.float32),
        support=np.concatenate([support for _, _, support in found] or [[]]).astype(np.int32),
    )


def _suppress(rows: Int32s, within: int, keep: int) -> list[int]:
    """Positions of the first `keep` rows, best first, that are not within `within` rows of a better one."""
    chosen: list[int] = []
    better: list[int] = []  # the rows of those
    for at, row in enumerate(rows.tolist()):
        for other in better:
            if -within <= row - other <= within:
                break
        else:
            chosen.append(at)
            better.append(row)
            if len(chosen) == keep:
                break
    return chosen
