"""Closures between drives: place recognition proposes pairs of drives and candidates, and geometry verifies them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vplog.data import Closures, Verdict
from vplog.execution.execution import Execution
from vplog.loops.propose import Proposals, ProposeSettings, propose
from vplog.loops.verify import verify_between
from vplog.places.sequence import rank_places
from vplog.run.place_recognition import shared_of
from vplog.run.verification import merged
from vplog.stages import index_of_part

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Mapping, Sequence

    from vplog.data import Bools, Int32s, Ints, SharedReferences
    from vplog.graph.joint import JoinSettings
    from vplog.loops.verify import Drive
    from vplog.pipeline import Pipeline
    from vplog.stages import PlaceState

_NO_POSE = (Verdict.TOO_FEW_MATCHES, Verdict.TOO_FEW_LANDMARKS, Verdict.TOO_FEW_INLIERS)
"""Verdicts of views that geometry does not show to be of one place."""
_FIRST_SHARE = 8
"""One in so many of the bests is looked at first, whatever the length of the drives: where they share a stretch, its
views are among those that score highest."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """The best candidates of each keyframe of a drive in other drives, ranked together: by query, then rank."""

    drive: Int32s
    """(C,) number of the other drive."""
    proposals: Proposals
    """C rows, ranked over all drives."""

    def of(self, number: int) -> Proposals:
        """The candidates in one drive."""
        return self.proposals.rows(self.drive == number)


def no_candidates() -> Candidates:
    """No candidates."""
    return Candidates(np.empty(0, np.int32), propose([], ProposeSettings()))


def proposed_in(
    later: Sequence[Any], earlier: Sequence[Any], state: PlaceState, pipeline: Pipeline, execution: Execution
) -> Proposals:
    """The candidates of the places `later` among those of one drive."""
    stops = np.full(len(later), len(earlier), np.int64)
    index = index_of_part(state, earlier)
    ranked = rank_places(index, later, stops, pipeline.propose.ranked, pipeline.sequence, execution)
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
    every, drive = every.rows(order), drive[order]
    starts = np.searchsorted(every.query, every.query)
    rank = (np.arange(len(drive)) - starts).astype(np.int32)
    kept = rank < pipeline.propose.per_query
    return Candidates(drive[kept], replace(every, rank=rank).rows(kept))


def candidates_among(
    later: Mapping[int, Sequence[Any]],
    earlier: Callable[[int], Sequence[Any]],
    searched: Mapping[int, Container[int]],
    state: PlaceState,
    pipeline: Pipeline,
    execution: Execution,
) -> dict[int, Candidates]:
    """The best candidates of the places of each drive of `later`, by number, in those drives of lower numbers that it
    is `searched` in.

    `earlier` gives the places of the drives that are not among `later`; it is called from any thread. A thread has a
    drive to itself where there are enough of them: a drive of a few hundred views is done too soon to share.
    Progress counts the pairs of drives that were compared.
    """
    found = {number: no_candidates() for number in later}
    inside = Execution(-(-execution.threads // max(later)))
    total, done = sum(number in searched[one] for one in later for number in range(max(later))), 0

    def compare(number: int) -> list[tuple[int, Proposals]]:
        queries = [one for one in later if number in searched[one]]
        if not queries:
            return []
        known = later[number] if number in later else earlier(number)
        return [(one, proposed_in(later[one], known, state, pipeline, inside)) for one in queries]

    for number, proposed in enumerate(execution.map(compare, range(max(later)), ahead=2)):
        for one, more in proposed:
            found[one] = with_proposals(found[one], number, more, pipeline)
        done += len(proposed)
        execution.progress("compare drives", done, total)
    return found


def likely_drives(candidates: Candidates, settings: JoinSettings) -> list[int]:
    """Numbers of the drives that are worth a look, increasing: those that hold most, and enough to join."""
    numbers, counts = np.unique(candidates.drive, return_counts=True)
    score = np.maximum(candidates.proposals.score, 0.0)  # less than nothing would make more of them less
    weight = np.array([score[candidates.drive == one].sum(dtype=np.float64) for one in numbers])
    enough = np.flatnonzero(counts >= settings.least_closures)
    best = enough[np.lexsort((numbers[enough], -weight[enough]))][: settings.most_drives]
    return np.sort(numbers[best]).tolist()


class DrivePair(NamedTuple):
    """The candidates of one drive (queries) in another (matches)."""

    later: int
    """Number of the drive."""
    earlier: int
    proposals: Proposals
    shared: SharedReferences
    """References that explain both places of each of the proposals."""


def likely_pairs(
    found: Mapping[int, Candidates], places: Callable[[int], Sequence[Any]], state: PlaceState, settings: JoinSettings
) -> list[DrivePair]:
    """The pairs of drives whose candidates are worth verifying, by later, then earlier drive."""
    pairs = []
    for later, candidates in found.items():
        own = places(later)
        for earlier in likely_drives(candidates, settings):
            proposals, others = candidates.of(earlier), places(earlier)
            both, query = [*others, *own], proposals.query + np.int32(len(others))
            pairs.append(DrivePair(later, earlier, proposals, shared_of(state, both, query, proposals.match)))
    return pairs


def closures_between(
    proposals: Proposals,
    later: Drive,
    earlier: Drive,
    settings: JoinSettings,
    share: float,
    execution: Execution,
    fetch: Callable[[Int32s, Int32s], None] = lambda *_: None,
) -> Closures:
    """The ledger of the candidates of one drive's keyframes (queries) in another (matches) that are worth a look.

    First come the bests of the queries that score highest. Where geometry shows none of them to be of the same place
    the drives do not meet; else the best of each other query follows, and then all candidates of the queries around
    those of the same place: they are for the graph, and left out where no calibration gives them metres. `share` is the
    larger `calibration_share` of the two drives; `fetch` gets queries and matches before they are verified. Progress
    counts the candidates of each look.
    """
    _, best = np.unique(proposals.query, return_index=True)
    by_score = best[np.argsort(-proposals.score[best], kind="stable")]
    count = max(settings.first_look, -(-len(best) // _FIRST_SHARE))
    looks: list[tuple[Ints, Closures]] = []

    def look(rows: Ints) -> None:
        fetch(np.unique(proposals.query[rows]), np.unique(proposals.match[rows]))
        ledger = verify_between(proposals.rows(rows), later, earlier, execution, share)
        looks.append((rows, ledger))

    def confirmed() -> Int32s:
        """Queries whose candidate is of the same place, increasing."""
        return np.unique(np.concatenate([one.query[[v not in _NO_POSE for v in one.verdict]] for _, one in looks]))

    look(np.sort(by_score[:count]))
    if len(confirmed()):
        look(np.sort(by_score[count:]))
        if later.camera.matrix is not None and earlier.camera.matrix is not None:
            others = _near(proposals.query, confirmed(), settings.around)
            others[best] = False
            look(np.flatnonzero(others))
    return merged([ledger for _, ledger in looks], [rows for rows, _ in looks])


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


def _near(query: Int32s, held: Int32s, around: int) -> Bools:
    """(C,) whether a query is at most so many keyframes from one of `held`, which increase."""
    if len(held) == 0:
        return np.zeros(len(query), bool)
    after = np.searchsorted(held, query)
    left, right = held[np.maximum(after - 1, 0)], held[np.minimum(after, len(held) - 1)]
    return np.minimum(np.abs(query - left), np.abs(query - right)) <= around
