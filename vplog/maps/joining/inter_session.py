"""Inter-session closures: place recognition proposes pairs of drives and candidates, and geometry verifies them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vplog.data import Bools, Closures, Int32s, Ints, SharedReferences, Verdict
from vplog.execution.execution import Execution
from vplog.loops.propose import Proposals, ProposeSettings, propose
from vplog.loops.verify import Drive, verify_between
from vplog.places.sequence import rank_places
from vplog.run.place_recognition import shared_of
from vplog.run.verification import merged
from vplog.stages import PlaceState, index_of_part

if TYPE_CHECKING:
    from vplog.graph.joint import JoinSettings
    from vplog.pipeline import Pipeline

_NO_POSE = (Verdict.TOO_FEW_MATCHES, Verdict.TOO_FEW_LANDMARKS, Verdict.TOO_FEW_INLIERS)
"""Verdicts without geometric evidence that both views are of one place."""
_FIRST_SHARE = 8
"""One in so many of the best candidates is verified first, whatever the length of the drives: where they share a
stretch, its views are among those that score highest."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """The best candidates of each keyframe of a drive in other drives, ranked together: by query, then rank."""

    drive: Int32s
    proposals: Proposals
    """C rows, ranked over all drives."""

    def of(self, number: int) -> Proposals:
        """The candidates in one drive."""
        return self.proposals.rows(self.drive == number)


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

    `propose.per_query` limits the candidates of a query over all drives, as it does within one: the cost of verifying a
    drive does not grow with the map. Ties go to the drive of lower number, in whatever order they are searched.
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
    retained = rank < pipeline.propose.per_query
    return Candidates(drive[retained], replace(every, rank=rank).rows(retained))


def candidates_among(
    later: Mapping[int, Sequence[Any]],
    earlier: Callable[[int], Sequence[Any]],
    searched: Mapping[int, Collection[int]],
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
    found = dict.fromkeys(later, Candidates(np.empty(0, np.int32), propose([], ProposeSettings())))
    queries: dict[int, list[int]] = {}
    for one in later:
        for number in searched[one]:
            queries.setdefault(number, []).append(one)
    inside = Execution(-(-execution.threads // max(len(queries), 1)))
    total, done, numbers = sum(map(len, queries.values())), 0, sorted(queries)

    def compare(number: int) -> list[tuple[int, Proposals]]:
        known = later[number] if number in later else earlier(number)
        return [(one, proposed_in(later[one], known, state, pipeline, inside)) for one in queries[number]]

    for number, proposed in zip(numbers, execution.map(compare, numbers, ahead=2), strict=True):
        for one, more in proposed:
            found[one] = with_proposals(found[one], number, more, pipeline)
        done += len(proposed)
        execution.progress("compare drives", done, total)
    return found


def likely_drives(candidates: Candidates, settings: JoinSettings) -> list[int]:
    """Numbers of the drives to verify, increasing: those with the largest sums of scores, and candidates enough to
    join."""
    numbers, counts = np.unique(candidates.drive, return_counts=True)
    score = np.maximum(candidates.proposals.score, 0.0)  # a negative score would count against its drive
    weight = np.array([score[candidates.drive == one].sum(dtype=np.float64) for one in numbers])
    enough = np.flatnonzero(counts >= settings.least_closures)
    best = enough[np.lexsort((numbers[enough], -weight[enough]))][: settings.most_drives]
    return np.sort(numbers[best]).tolist()


class DrivePair(NamedTuple):
    """The candidates of one drive (queries) in another (matches)."""

    later: int
    earlier: int
    proposals: Proposals
    shared: SharedReferences
    """References that explain both places of each of the proposals."""


def likely_pairs(
    found: Mapping[int, Candidates], places: Callable[[int], Sequence[Any]], state: PlaceState, settings: JoinSettings
) -> list[DrivePair]:
    """The pairs of drives to verify, by later, then earlier drive."""
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
    """The ledger of the candidates of one drive's keyframes (queries) in another (matches), those that are verified.

    The best candidates of the highest-scoring queries come first. Where geometry confirms none of them, the drives
    share no place; else the best of each other query follows, and then all candidates of the queries around confirmed
    ones: these are for the graph, and left out without calibration. `share` is the larger `calibration_share` of the
    two drives; `fetch` gets queries and matches before they are verified. Progress counts candidates.
    """
    _, best = np.unique(proposals.query, return_index=True)
    by_score = best[np.argsort(-proposals.score[best], kind="stable")]
    count = max(settings.first_look, -(-len(best) // _FIRST_SHARE))
    verified: list[tuple[Ints, Closures]] = []

    def verify_rows(rows: Ints) -> None:
        fetch(np.unique(proposals.query[rows]), np.unique(proposals.match[rows]))
        ledger = verify_between(proposals.rows(rows), later, earlier, execution, share)
        verified.append((rows, ledger))

    def confirmed() -> Int32s:
        """Queries with a geometrically confirmed candidate, increasing."""
        return np.unique(np.concatenate([one.query[[v not in _NO_POSE for v in one.verdict]] for _, one in verified]))

    verify_rows(np.sort(by_score[:count]))
    if len(confirmed()):
        verify_rows(np.sort(by_score[count:]))
        if later.camera.matrix is not None and earlier.camera.matrix is not None:
            others = _near_confirmed(proposals.query, confirmed(), settings.around)
            others[best] = False
            verify_rows(np.flatnonzero(others))
    return merged([ledger for _, ledger in verified], [rows for rows, _ in verified])


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


def _near_confirmed(query: Int32s, confirmed_queries: Int32s, around: int) -> Bools:
    """(C,) whether a query is at most so many keyframes from one of `confirmed_queries`, which increase."""
    if len(confirmed_queries) == 0:
        return np.zeros(len(query), bool)
    after = np.searchsorted(confirmed_queries, query)
    left, right = (
        confirmed_queries[np.maximum(after - 1, 0)],
        confirmed_queries[np.minimum(after, len(confirmed_queries) - 1)],
    )
    return np.minimum(np.abs(query - left), np.abs(query - right)) <= around
