"""Places that recognition can do without, found by removing them one after the other.

The next to go is the place that leaves the smallest gap in its drive; of equal gaps the one that loses fewest of the
queries that are answered rightly and, of these, least of the scores of the right answers, the facility location
function. None of these becomes less as others go, or only where an answer becomes right, so a stale cost is a bound and
only the best few are evaluated again (Minoux, Accelerated greedy algorithms, 1978).
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from vplog.data import Bools, Floats, Int32s, Ints, Ranking

_MILLIMETRES = 3
"""Decimals of a gap in m: what differs by less is rounding."""


@dataclass(frozen=True, eq=False)
class OwnQueries:
    """Q queries of a map's own places, each answered rightly by the N places that it is looked for among."""

    best: list[Ranking]
    """Best places of each."""
    deeper: Callable[[int, int], Ranking]
    """The best so many places of a query; fewer where no more share anything with it."""
    right: Callable[[int, Int32s | Ints], Bools]
    """Whether places are right answers to a query."""

    def some(self, chosen: Bools) -> OwnQueries:
        """The queries that are `chosen` (Q,) alone."""
        rows: list[int] = np.flatnonzero(chosen).tolist()
        return OwnQueries(
            [self.best[row] for row in rows],
            lambda query, top: self.deeper(rows[query], top),
            lambda query, others: self.right(rows[query], others),
        )


@dataclass(frozen=True, eq=False)
class RemovalCandidates:
    """The N places of drives, in their order, of which some may be removed."""

    drive: Ints
    """(N,) number of the drive."""
    along_m: Floats
    """(N,) position along the drives."""
    removable: Bools
    """(N,) places that may go."""
    faded: Bools
    """(N,) places that go before all others where they cost no query."""


@dataclass(frozen=True, eq=False)
class Removal:
    """Places in the order in which they are removed."""

    places: Ints
    """(R,) places in the order of their removal."""
    lost: Ints
    """(R,) queries that are not answered rightly any more after each."""


class _Answer(NamedTuple):
    """The answer to a query among the places that are left."""

    top: int
    """Place; -1 without an answer."""
    is_right: bool
    best_right: int
    """The best right place that is known; -1 where none is."""
    score: float
    """Score of that place; 0 without one."""


@dataclass(eq=False)
class _Remaining:
    """The places that are left, and the answers of all queries among them."""

    queries: OwnQueries
    retained: Bools
    best: list[Ranking] = field(default_factory=list)
    right: list[Bools] = field(default_factory=list)
    answers: list[_Answer] = field(default_factory=list)
    users: dict[int, list[int]] = field(default_factory=dict)
    """Queries whose answer or best right place each place is, or was."""
    whole: set[int] = field(default_factory=set)
    """Queries whose lists have every place that shares anything with them."""

    def __post_init__(self) -> None:
        self.best = list(self.queries.best)
        self.right = [self.queries.right(query, one.rows) for query, one in enumerate(self.best)]
        self.answers = [_Answer(-1, False, -1, 0.0)] * len(self.best)
        for query in range(len(self.best)):
            self._update(query)

    def answer(self, query: int, without: int = -1) -> _Answer:
        """The answer without one place more; longer lists of places are looked up where all of one are gone."""
        while True:
            found = self.best[query]
            alive = self.retained[found.rows] & (found.rows != without)
            if alive.any():
                break
            if query in self.whole:
                return _Answer(-1, False, -1, 0.0)
            more = self.queries.deeper(query, 4 * len(found.rows) + 1)
            if len(more.rows) <= 4 * len(found.rows):
                self.whole.add(query)
            self.best[query], self.right[query] = more, self.queries.right(query, more.rows)
        top, good = int(alive.argmax()), alive & self.right[query]
        at = int(good.argmax()) if good.any() else -1
        best_right, score = (int(found.rows[at]), float(found.score[at])) if at >= 0 else (-1, 0.0)
        return _Answer(int(found.rows[top]), bool(self.right[query][top]), best_right, score)

    def cost(self, place: int) -> tuple[int, float]:
        """Queries lost by the removal of a place, and the drop of the scores of right answers."""
        lost, drop, using = 0, 0.0, []
        for query in dict.fromkeys(self.users.get(place, ())):
            now = self.answers[query]
            if place not in (now.top, now.best_right):
                continue
            using.append(query)
            then = self.answer(query, place)
            lost += now.is_right - then.is_right
            drop += now.score - then.score if now.best_right == place else 0.0
        self.users[place] = using
        return lost, drop

    def remove(self, place: int) -> None:
        self.retained[place] = False
        for query in dict.fromkeys(self.users.pop(place, ())):
            self._update(query)

    def _update(self, query: int) -> None:
        self.answers[query] = found = self.answer(query)
        for place in {found.top, found.best_right} - {-1}:
            self.users.setdefault(place, []).append(query)


@dataclass(eq=False)
class Gaps:
    """Distances between the places, or references, of drives that are left, each drive's in a row."""

    along_m: Floats
    ends: Floats
    """(N, 2) where the drive of each begins and ends."""
    before: Ints
    """(N,) the place before each in its drive; itself where it is the first."""
    after: Ints

    @classmethod
    def of(cls, drive: Ints, along_m: Floats) -> Gaps:
        every = np.arange(len(drive))
        first, last = (np.diff(drive, **ends) != 0 for ends in ({"prepend": -1}, {"append": -1}))
        number = np.cumsum(first) - 1
        ends = np.column_stack([along_m[first][number], along_m[last][number]])
        return cls(along_m, ends, np.where(first, every, every - 1), np.where(last, every, every + 1))

    def without(self, places: Ints) -> Floats:
        """The gaps that the removal of each of some places leaves: at the end of a drive twice the distance from there
        to the next one, infinite where there is none."""
        before, after = self.before[places], self.after[places]
        start, end = self.ends[places].T
        is_first, is_last = before == places, after == places
        gap = np.where(is_last, end, self.along_m[after]) - np.where(is_first, start, self.along_m[before])
        return np.where(is_first & is_last, np.inf, np.where(is_first | is_last, 2 * gap, gap))

    def remove(self, place: int) -> None:
        before, after = int(self.before[place]), int(self.after[place])
        self.after[before] = after if after > place else before
        self.before[after] = before if before < place else after


def remove_cross_validated(
    queries: OwnQueries, fold: Bools, places: RemovalCandidates, most_lost: int,
    progress: Callable[[int], None] = lambda _: None,
) -> tuple[Removal, int]:  # fmt: skip
    """Remove as many places (N,) as cost at most `most_lost` of the queries (Q,) their right answer; the removal, and
    how many it costs.

    Queries by which places are chosen lose hardly any of their own answers, unlike a new drive's. So the number of
    places is decided by twofold cross-validation: the queries of one `fold` (Q,) judge what those of the other choose,
    both ways round. The places are chosen by all. Both folds must be spread over the map: more is removed where none
    chooses.
    """
    losses = list[Ints]()
    for choosing in (fold, ~fold):
        judges = queries.some(~choosing)
        losses.append(remove_redundant(queries.some(choosing), places, most_lost, judges=judges).lost)
    count = min(map(len, losses))
    lost = losses[0][:count] + losses[1][:count]
    most = int(np.argmax([*(lost > most_lost), True]))
    removal = remove_redundant(queries, places, len(fold), progress, most=most)
    return removal, int(lost[most - 1]) if most else 0


def remove_redundant(
    queries: OwnQueries, places: RemovalCandidates, most_lost: int, progress: Callable[[int], None] = lambda _: None,
    judges: OwnQueries | None = None, most: int | None = None,
) -> Removal:  # fmt: skip
    """Remove places as long as at most `most_lost` queries lose their right answer: those of `judges`, where given,
    which do not take part in the choice. One place of each drive stays. At most `most` places are removed."""
    drive = places.drive
    remaining = _Remaining(queries, np.ones(len(drive), np.bool_))
    judging = remaining if judges is None else _Remaining(judges, np.ones(len(drive), np.bool_))
    gaps, left, lost, order, losses = Gaps.of(drive, places.along_m), np.bincount(drive), 0, list[int](), list[int]()

    def key(place: int) -> tuple[float, int, float, int]:
        queries_lost, drop = remaining.cost(place)
        spare = places.faded[place] and queries_lost <= 0
        gap = 0.0 if spare else round(float(gaps.without(np.array(place))), _MILLIMETRES)
        return gap, queries_lost, drop, place

    heap = [key(place) for place in np.flatnonzero(places.removable).tolist()]
    heapq.heapify(heap)
    while heap and (most is None or len(order) < most):
        place = heapq.heappop(heap)[-1]
        if left[drive[place]] == 1:
            continue
        now = key(place)
        if heap and now > heap[0]:
            heapq.heappush(heap, now)
            continue
        lost += judging.cost(place)[0]
        if lost > most_lost:
            break
        remaining.remove(place)
        if judging is not remaining:
            judging.remove(place)
        gaps.remove(place)
        left[drive[place]] -= 1
        order.append(place)
        losses.append(lost)
        progress(len(order))
    return Removal(np.array(order, np.int64), np.array(losses, np.int64))
