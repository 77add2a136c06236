"""Inter-session closures: place recognition proposes pairs of drives and candidates, and geometry verifies them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vplog.data import Closures, Int32s, Ints, SharedReferences, Verdict
from vplog.execution.execution import Execution
from vplog.loops import false_rate
from vplog.loops.propose import Proposals, ProposeSettings, propose
from vplog.loops.verify import Drive, no_closures, verify_between
from vplog.places.sequence import rank_places
from vplog.results.run_cameras import CameraPictures
from vplog.run.cameras import VIEW_BY_VIEW, best_together, of_keyframes, once
from vplog.run.place_recognition import shared_of
from vplog.run.verification import merged
from vplog.stages import PlaceState, index_of_part

if TYPE_CHECKING:
    from vplog.joint.graph import JoinSettings
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


class PlacesByCamera(list[Any]):
    """The places of a drive's pictures, one camera after the other."""

    def __init__(self, cameras: Sequence[Sequence[Any]]) -> None:
        super().__init__(chain.from_iterable(cameras))
        ends = np.cumsum([0, *map(len, cameras)]).tolist()
        self.cameras = [slice(*pair) for pair in pairwise(ends)]


def _cameras(places: Sequence[Any]) -> list[slice]:
    return places.cameras if isinstance(places, PlacesByCamera) else [slice(0, len(places))]


def proposed_by_cameras(
    later: Sequence[Any], earlier: Sequence[Any], state: PlaceState, pipeline: Pipeline, execution: Execution
) -> tuple[Proposals, Proposals]:
    """The candidates of the places `later` among those of one drive: between pictures of the same camera, and between
    those of different ones. The latter are ranked view by view, since two cameras may pass the places of a road in
    opposite order; their scores do not compare with those of sequences."""
    same, crossed = [propose([], ProposeSettings())], [propose([], ProposeSettings())]
    alone = pipeline.model_copy(update={"sequence": VIEW_BY_VIEW})
    others_of = {m: others for m, others in enumerate(_cameras(earlier)) if others.start < others.stop}
    for q, own in enumerate(_cameras(later)):
        found = dict[int, Proposals]()
        for m, others in others_of.items() if own.start < own.stop else ():
            one = proposed_in(later[own], earlier[others], state, pipeline if q == m else alone, execution)
            found[m] = replace(one, query=one.query + np.int32(own.start), match=one.match + np.int32(others.start))
        same += [found.pop(q)] if q in found else []
        crossed += best_together(found, pipeline.propose.per_query).values() if found else []
    return joined(same), joined(crossed)


def joined(parts: Sequence[Proposals]) -> Proposals:
    """All candidates, one part after the other."""
    names = [one.name for one in fields(Proposals)]
    return Proposals(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def proposed_in(
    later: Sequence[Any], earlier: Sequence[Any], state: PlaceState, pipeline: Pipeline, execution: Execution
) -> Proposals:
    """The candidates of the places `later` among those of one drive."""
    stops = np.full(len(later), len(earlier), np.int64)
    index = index_of_part(state, earlier)
    ranked = rank_places(index, later, stops, pipeline.propose.ranked, pipeline.sequence, execution)
    return propose(ranked, pipeline.propose)


def with_proposals(known: Candidates, number: int, more: Proposals, pipeline: Pipeline) -> Candidates:
    """The candidates with those in one more drive.

    `propose.per_query` limits the candidates of a query over all drives, as it does within one: the cost of verifying a
    drive does not grow with the map. Ties go to the drive of lower number, in whatever order they are searched.
    """
    drive = np.concatenate([known.drive, np.full(len(more.query), number, np.int32)])
    every = joined([known.proposals, more])
    order = np.lexsort((every.rank, drive, -every.score, every.query))
    every, drive = every.rows(order), drive[order]
    starts = np.searchsorted(every.query, every.query)
    rank = (np.arange(len(drive)) - starts).astype(np.int32)
    retained = rank < pipeline.propose.per_query
    return Candidates(drive[retained], replace(every, rank=rank).rows(retained))


def candidates_among(
    later: Mapping[int, Sequence[Any]], earlier: Callable[[int], Sequence[Any]],
    searched: Mapping[int, Collection[int]], state: PlaceState, pipeline: Pipeline, execution: Execution,
) -> dict[int, Candidates]:  # fmt: skip
    """The best candidates of the places of each drive of `later`, by number, in those drives of lower numbers that it
    is `searched` in.

    `earlier` gives the places of the drives that are not among `later`; it is called from any thread. A thread has a
    drive to itself where there are enough of them: a drive of a few hundred views is done too soon to share.
    Progress counts the pairs of drives that were compared.
    """
    none = Candidates(np.empty(0, np.int32), propose([], ProposeSettings()))
    found, crossed = dict.fromkeys(later, none), dict.fromkeys(later, none)
    queries: dict[int, list[int]] = {}
    for one in later:
        for number in searched[one]:
            queries.setdefault(number, []).append(one)
    inside = Execution(-(-execution.threads // max(len(queries), 1)))
    total, done, numbers = sum(map(len, queries.values())), 0, sorted(queries)

    def compare(number: int) -> list[tuple[int, tuple[Proposals, Proposals]]]:
        known = later[number] if number in later else earlier(number)
        return [(one, proposed_by_cameras(later[one], known, state, pipeline, inside)) for one in queries[number]]

    for number, proposed in zip(numbers, execution.map(compare, numbers, ahead=2), strict=True):
        for one, (more, others) in proposed:
            found[one] = with_proposals(found[one], number, more, pipeline)
            crossed[one] = with_proposals(crossed[one], number, others, pipeline)
        done += len(proposed)
        execution.progress("compare drives", done, total)
    return {one: _with_crossed(found[one], crossed[one]) for one in later}


def _with_crossed(same: Candidates, crossed: Candidates) -> Candidates:
    """Candidates of the same and of different cameras together, by query."""
    drive, every = np.concatenate([same.drive, crossed.drive]), joined([same.proposals, crossed.proposals])
    order = np.argsort(every.query, kind="stable")
    return Candidates(drive[order], every.rows(order))


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


class CameraDrive(NamedTuple):
    """The pictures of one camera of a drive, as closures are verified."""

    row: Ints
    """(V,) keyframe of each."""
    drive: Drive
    fetch: Callable[[Int32s | Ints], None] = lambda _: None
    """Gets the pictures before they are verified."""


def closures_between(
    proposals: Proposals, later: CameraDrive, earlier: CameraDrive, pipeline: Pipeline, share: float,
    execution: Execution,
) -> Closures:  # fmt: skip
    """The ledger of the verified candidates of one drive's pictures (queries) in another's (matches).

    The best candidates of the highest-scoring queries come first. Where geometry confirms none of them, the drives
    share no place; else the best of each other query follows, and then all candidates of the queries around confirmed
    ones: these are for the graph, and left out without calibration. `p_false` is by candidates with the query mirrored.
    `share` is the larger `calibration_share` of the two drives. Progress counts candidates.
    """
    settings = pipeline.join
    _, best = np.unique(proposals.query, return_index=True)
    by_score = best[np.argsort(-proposals.score[best], kind="stable")]
    count = max(settings.first_look, -(-len(best) // _FIRST_SHARE))
    verified: list[tuple[Ints, Closures]] = []

    def verify_rows(rows: Ints) -> None:
        later.fetch(np.unique(proposals.query[rows]))
        earlier.fetch(np.unique(proposals.match[rows]))
        verified.append((rows, verify_between(proposals.rows(rows), later.drive, earlier.drive, execution, share)))

    def confirmed() -> Int32s:
        """Queries with a geometrically confirmed candidate, increasing."""
        return np.unique(np.concatenate([one.query[[v not in _NO_POSE for v in one.verdict]] for _, one in verified]))

    verify_rows(np.sort(by_score[:count]))
    if len(confirmed()):
        verify_rows(np.sort(by_score[count:]))
        if later.drive.camera.matrix is not None and earlier.drive.camera.matrix is not None:
            near, at = confirmed(), proposals.query.astype(np.int64)
            others = np.searchsorted(near, at - settings.around) < np.searchsorted(near, at + settings.around, "right")
            others[best] = False
            verify_rows(np.flatnonzero(others))
    ledger = merged([ledger for _, ledger in verified], [rows for rows, _ in verified])
    rated, found = pipeline.rating.false_rate, false_rate.evidence(ledger)
    if not found.any() or false_rate.are_unrated(found, 0, rated):
        return ledger
    return _with_false_rate(ledger, later.drive, earlier.drive, rated, execution)


def _with_false_rate(
    ledger: Closures, later: Drive, earlier: Drive, settings: false_rate.FalseRateSettings, execution: Execution
) -> Closures:
    """The ledger with `p_false`, and without what is likelier to be false than `settings.rate`."""
    count = min(false_rate.null_pairs(false_rate.evidence(ledger), settings), len(ledger))
    some = ledger.rows(np.linspace(0, len(ledger) - 1, count).astype(np.int64))
    proposals = Proposals(some.query, some.match, some.rank, some.score, some.support)
    mirror = false_rate.mirrored_evidence(proposals, later, earlier, execution)
    none = np.zeros(0, bool)
    ledger = false_rate.with_p_false(ledger, np.zeros(len(ledger), bool), mirror, np.zeros(0, np.int64), none)
    return ledger if settings.rate is None else false_rate.at_rate(ledger, settings.rate)


def closures_by_cameras(
    pair: DrivePair, later: Sequence[CameraDrive], earlier: Sequence[CameraDrive], pipeline: Pipeline,
    share: Callable[[int, int], float], execution: Execution,
) -> Closures:  # fmt: skip
    """The ledger of the keyframes of two drives, with the references that explain both places: `closures_between` of
    any two cameras with candidates, each pair of keyframes once."""
    query_camera, query = _pictures(pair.proposals.query, later)
    match_camera, match = _pictures(pair.proposals.match, earlier)
    ledgers, keyframes = [no_closures()], [drives[0].drive.keyframes for drives in (later, earlier)]
    for q, m in np.unique(np.stack([query_camera, match_camera], 1), axis=0).tolist():
        rows = np.flatnonzero((query_camera == q) & (match_camera == m))
        proposals = replace(pair.proposals, query=query, match=match).rows(rows)
        queries, matches = later[q], earlier[m]
        ledger = closures_between(proposals, queries, matches, pipeline, share(q, m), execution)
        row_of = dict(zip(zip(proposals.query.tolist(), proposals.match.tolist(), strict=True), rows, strict=True))
        own = [row_of[ends] for ends in zip(ledger.query.tolist(), ledger.match.tolist(), strict=True)]
        references, overlap = pair.shared.references, pair.shared.overlap
        shared = {
            "shared_references": [references[row] for row in own],
            "shared_overlap": [overlap[row] for row in own],
        }
        ledger = replace(ledger, **shared)
        pictures = [CameraPictures(one.row, one.drive.keyframes) for one in (queries, matches)]
        ledgers.append(of_keyframes(ledger, pictures, (q, m), keyframes) if q or m else ledger)
    return once(ledgers)


def _pictures(rows: Int32s, cameras: Sequence[CameraDrive]) -> tuple[Ints, Int32s]:
    """The cameras of rows in `PlacesByCamera`, and the rows among their pictures."""
    first = np.cumsum([0, *(len(one.row) for one in cameras)])
    camera = np.searchsorted(first, rows, side="right") - 1
    return camera, (rows - first[camera]).astype(np.int32)
