"""Closures between drives: which others hold places like a drive's, and which of those places geometry confirms."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Closures, SharedReferences, Verdict
from vplog.loops.propose import Proposals, ProposeSettings, propose
from vplog.loops.verify import calibration_share, verify_between
from vplog.places.sequence import rank_places
from vplog.stages import BoxState, index_of_part

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vplog.data import Bools, Int32s, Ints
    from vplog.graph.joint import JoinSettings
    from vplog.loops.verify import Drive
    from vplog.pipeline import Pipeline
    from vplog.stages import PlaceState

    Progress = Callable[[int, int], None]

_NO_POSE = (Verdict.TOO_FEW_MATCHES, Verdict.TOO_FEW_LANDMARKS, Verdict.TOO_FEW_INLIERS)
"""Verdicts of views that geometry does not show to be of one place."""
_FIRST_SHARE = 8
"""One in so many of the bests is looked at first, whatever the length of the drives: where they share a stretch, its
views are among those that score highest."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """The best candidates of each keyframe of a drive in others, all of those together: by query, then rank."""

    drive: Int32s
    """(C,) number of the other drive."""
    proposals: Proposals
    """C; ranks count those in all drives."""

    def of(self, number: int) -> Proposals:
        """Those in one drive."""
        return taken(self.proposals, self.drive == number)


def no_candidates() -> Candidates:
    """Before any drive was searched."""
    return Candidates(np.empty(0, np.int32), propose([], ProposeSettings()))


def with_drive(
    known: Candidates, number: int, later: Sequence[Any], earlier: Sequence[Any], state: PlaceState,
    pipeline: Pipeline, threads: int = 1,
) -> Candidates:  # fmt: skip
    """The candidates with those of the places `later` in a drive more, whose places are `earlier`."""
    return with_proposals(known, number, proposed_in(later, earlier, state, pipeline, threads), pipeline)


def proposed_in(
    later: Sequence[Any], earlier: Sequence[Any], state: PlaceState, pipeline: Pipeline, threads: int = 1
) -> Proposals:
    """The candidates of the places `later` among those of one drive."""
    stops = np.full(len(later), len(earlier), np.int64)
    index = index_of_part(state, earlier)
    ranked = rank_places(index, later, stops, pipeline.propose.asked, pipeline.sequence, threads)
    return propose(ranked, pipeline.propose)


def with_proposals(known: Candidates, number: int, more: Proposals, pipeline: Pipeline) -> Candidates:
    """The candidates with those in a drive more.

    `propose.per_query` bounds what is kept of a query over all drives, as it does within one: what a drive costs to
    verify does not grow with the map. Ties go to the drive of lower number, in whatever order they are searched.
    """
    drive = np.concatenate([known.drive, np.full(len(more.query), number, np.int32)])
    every = Proposals(**{
        one.name: np.concatenate([getattr(known.proposals, one.name), getattr(more, one.name)])
        for one in fields(Proposals)
    })  # fmt: skip
    order = np.lexsort((every.rank, drive, -every.score, every.query))
    every, drive = taken(every, order), drive[order]
    starts = np.searchsorted(every.query, every.query)
    rank = (np.arange(len(drive)) - starts).astype(np.int32)
    kept = rank < pipeline.propose.per_query
    return Candidates(drive[kept], taken(replace(every, rank=rank), kept))


def likely_drives(candidates: Candidates, settings: JoinSettings) -> list[int]:
    """Numbers of the drives that are worth a look, increasing: those that hold most, and enough to join."""
    numbers, counts = np.unique(candidates.drive, return_counts=True)
    score = np.maximum(candidates.proposals.score, 0.0)  # less than nothing would make more of them less
    weight = np.array([score[candidates.drive == one].sum(dtype=np.float64) for one in numbers])
    enough = np.flatnonzero(counts >= settings.least_closures)
    best = enough[np.lexsort((numbers[enough], -weight[enough]))][: settings.most_drives]
    return np.sort(numbers[best]).tolist()


def closures_between(
    proposals: Proposals,
    later: Drive,
    earlier: Drive,
    settings: JoinSettings,
    threads: int = 1,
    progress: Progress = lambda *_: None,
    share: float | None = None,
    fetch: Callable[[Int32s, Int32s], None] = lambda *_: None,
) -> Closures:
    """The ledger of the candidates of one drive's keyframes (queries) in another (matches) that are worth a look.

    First come the bests of the queries that score highest. Where geometry shows none of them to be of the same place
    the drives do not meet; else the best of each other query follows, and then all candidates of the queries around
    those of the same place: they are for the graph, and left out where no calibration gives them metres. `share` is by
    what the calibrations are wrong, where that is known; `fetch` is told before each look which queries and matches it
    is about. `progress` counts the candidates of each look.
    """
    if share is None:
        share = calibration_of(later, earlier, threads)
    _, best = np.unique(proposals.query, return_index=True)
    by_score = best[np.argsort(-proposals.score[best], kind="stable")]
    count = max(settings.first_look, -(-len(best) // _FIRST_SHARE))
    looks: list[tuple[Ints, Closures]] = []

    def look(rows: Ints) -> None:
        fetch(np.unique(proposals.query[rows]), np.unique(proposals.match[rows]))
        ledger = verify_between(taken(proposals, rows), later, earlier, threads, progress, share)
        looks.append((rows, ledger))

    def held() -> Int32s:
        """Queries whose candidate is of the same place, increasing."""
        return np.unique(np.concatenate([one.query[[v not in _NO_POSE for v in one.verdict]] for _, one in looks]))

    look(np.sort(by_score[:count]))
    if len(held()):
        look(np.sort(by_score[count:]))
        if later.camera.matrix is not None and earlier.camera.matrix is not None:
            others = _near(proposals.query, held(), settings.around)
            others[best] = False
            look(np.flatnonzero(others))
    rows = np.concatenate([rows for rows, _ in looks])
    return _in_order([ledger for _, ledger in looks], np.argsort(rows))


def calibration_of(later: Drive, earlier: Drive, threads: int = 1) -> float:
    """By what the calibrations are wrong at most, as a share of a rotation; 0 where there is none."""
    if later.camera.matrix is None or earlier.camera.matrix is None:
        return 0.0
    return max(calibration_share(drive, threads) for drive in (later, earlier))


def shared_of(
    proposals: Proposals, state: PlaceState, later: Sequence[Any], earlier: Sequence[Any]
) -> SharedReferences:
    """The references that explain both places of each candidate; none where the recogniser has no boxes."""
    if not isinstance(state, BoxState):
        nothing = [np.empty(0, np.uint16)] * len(proposals.query), [np.empty(0, np.float32)] * len(proposals.query)
        return SharedReferences(*nothing)
    both = [*earlier, *later]  # the two drives' places one after the other
    return state.shared(both, proposals.query + np.int32(len(earlier)), proposals.match)


def with_shared(ledger: Closures, proposals: Proposals, shared: SharedReferences) -> Closures:
    """The ledger of some of the proposals, with what is shared by each."""
    pairs = zip(proposals.query.tolist(), proposals.match.tolist(), strict=True)
    row_of = {pair: row for row, pair in enumerate(pairs)}
    rows = [row_of[pair] for pair in zip(ledger.query.tolist(), ledger.match.tolist(), strict=True)]
    return replace(
        ledger,
        shared_references=[shared.references[row] for row in rows],
        shared_overlap=[shared.overlap[row] for row in rows],
    )


def taken(proposals: Proposals, rows: Bools | Ints) -> Proposals:
    """Some of the proposals."""
    return Proposals(**{one.name: getattr(proposals, one.name)[rows] for one in fields(Proposals)})


def _near(query: Int32s, held: Int32s, around: int) -> Bools:
    """(C,) whether a query is at most so many keyframes from one of `held`, which increase."""
    if len(held) == 0:
        return np.zeros(len(query), bool)
    after = np.searchsorted(held, query)
    left, right = held[np.maximum(after - 1, 0)], held[np.minimum(after, len(held) - 1)]
    return np.minimum(np.abs(query - left), np.abs(query - right)) <= around


def _in_order(ledgers: Sequence[Closures], order: Ints) -> Closures:
    """The rows of all ledgers, in this order."""

    def joined(columns: list[Any]) -> Any:
        if isinstance(columns[0], list):
            every = [cell for column in columns for cell in column]
            return [every[row] for row in order.tolist()]
        return np.concatenate(columns)[order]

    return Closures(**{part.name: joined([getattr(one, part.name) for one in ledgers]) for part in fields(Closures)})
