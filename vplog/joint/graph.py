"""Several drives in one graph: which of them closures join, and where each then lies in their common map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydantic import Field

from vplog.data import Bools, EdgeKind, Floats, Ints, PoseGraph
from vplog.geometry import se3
from vplog.graph.build import parts
from vplog.graph.consistency import residual_sigma
from vplog.graph.solve import decided
from vplog.refinement.refine import Refined, RefineSettings, refine
from vplog.settings import Settings
from vplog.stages import Optimiser


class JoinSettings(Settings):
    """Closures between two drives that are enough to put them into one map."""

    least_closures: int = Field(default=3, ge=1)
    """Closures between two drives that the solve must keep, each at a place of its own in both. Nothing but another
    one can speak against a closure that alone joins two drives; a second may be of the same mistake, seldom a third at
    another place."""
    spacing: int = Field(default=5, ge=1)
    """Keyframes from one such place to the next: neighbours show the same things, and what looks like another place
    does so from all of them."""
    most_drives: int = Field(default=32, ge=1)
    """Drives that one is verified against: those whose places are most like its own. With `propose.per_query`, which
    bounds the candidates of a keyframe in all drives together, what a drive costs does not grow with their number."""
    apart_m: float = Field(default=200.0, gt=0)
    """Metres between the bounds of two drives on earth, of those that have satellite fixes, beyond which they are not
    searched in one another: far more than fixes are wrong by."""
    first_look: int = Field(default=32, ge=1)
    """Keyframes, those whose best candidate in another drive scores highest, of which this candidate is verified first,
    or an eighth of them where that is more. Where geometry shows none of these to be of the same place, the others are
    not looked at: of two drives that meet, ten times `least_closures` would all have to fail."""
    around: int = Field(default=10, ge=0)
    """Keyframes either side of one whose best candidate in another drive is of the same place by geometry, of which
    all candidates there are verified: half the window of `sequence.length`. Elsewhere the best alone is; so it is where
    one of the drives has no calibration, for then no candidate can join them."""
    judged_anew: int = Field(default=32, ge=2)
    """Drives of a joint graph up to which a new one has all closures judged again and all poses solved. In a larger one
    it is placed among the poses that are there, by the closures that it has with them."""
    grown_share: float = Field(default=0.02, gt=0)
    """Drives placed so, as a share of those solved as a whole, beyond which the whole is solved again: the error that
    is left by then is a few percent, and what a drive costs for it stays the same."""
    keep_features: bool = True
    """Whether a map keeps the features of its keyframes that verification looks at, 0.1 MB each, so that a new drive
    needs neither the logs of those before it nor to extract from them again."""


@dataclass(frozen=True, eq=False)
class SessionGraph:
    """The pose graph of one drive, as its own closures leave it."""

    graph: PoseGraph
    """Its odometry and its own closures that were kept, with the noise that its own solve found, from its own first
    pose on; 3D."""
    of_odometry: Bools
    """(E,) edges whose metres are the odometry's."""


@dataclass(frozen=True, eq=False)
class Between:
    """Verified closures from a later drive's keyframes to an earlier one's."""

    later: int
    """Number of the drive."""
    earlier: int
    query: Ints
    """(L,) rows of the later drive's poses."""
    match: Ints
    """(L,) rows of the earlier drive's poses."""
    match_from_query: Floats
    """(L, 4, 4)."""
    information: Floats
    """(L, 6, 6), in the frame of the query."""
    of_odometry: Bools
    """(L,) closures whose metres are the odometry's."""
    log_odds: Floats
    """(L,) of being false by recognition, 0 where nothing is known of it."""


@dataclass(frozen=True, eq=False)
class Joined:
    """Drives in maps."""

    maps: list[tuple[int, ...]]
    """Numbers of the drives of each map, in order of their first ones."""
    world_from_body: list[Floats]
    """Poses of each drive, in the frame of its map's first drive."""
    solved: dict[tuple[int, ...], Refined]
    """Solution of each map of several drives: its graph has their poses one after the other."""
    weight: list[Floats]
    """(L,) of each Between: 1 for the closures kept, 0 for all of those that do not hold."""
    residual: list[Floats]
    """(L,) sigma of each Between after the solve, NaN where it does not hold."""
    apart: dict[int, str]
    """Reason, by Between, that the solve did not accept enough of its closures."""


def join(
    drives: Sequence[SessionGraph],
    between: Sequence[Between],
    solve: Optimiser,
    settings: JoinSettings,
    learn: RefineSettings,
) -> Joined:
    """The maps that the drives make. Raises GraphError where a graph cannot be solved.

    Drives joined by enough closures are solved as one, with all closures between them. Pairs with too few inliers are
    separated and the rest is solved again, until every pair has enough; other drives keep their own poses.
    """
    joined = [places(one, settings.spacing) >= settings.least_closures for one in between]
    weight = [np.zeros(len(one.query)) for one in between]
    residual = [np.full(len(one.query), np.nan) for one in between]
    poses = [drive.graph.world_from_body for drive in drives]
    solved: dict[tuple[int, ...], Refined] = {}
    apart: dict[int, str] = {}
    while pending := [map_ for map_ in maps_of(len(drives), between, joined) if len(map_) > 1 and map_ not in solved]:
        members = pending[0]
        inside = set(members)
        ties = [
            at
            for at, one in enumerate(between)
            if at not in apart and len(one.query) and one.later in inside and one.earlier in inside
        ]
        graph, of_odometry, starts, rows = as_one(drives, members, [between[at] for at in ties])
        decision = decided(graph, solve, log_odds=log_odds_of(graph, [between[at] for at in ties], rows))
        weights = decision.solution.weight
        loose = [
            at
            for at, part in zip(ties, rows, strict=True)
            if joined[at] and places(between[at], settings.spacing, weights[part]) < settings.least_closures
        ]
        if loose:
            for at in loose:
                joined[at] = False
                apart[at] = decision.solution.reason
            continue
        refined = refine(decision.graph, decision.solution, of_odometry, learn, sigmas=decision.sigmas)
        solved[members] = refined
        after = residual_sigma(refined.graph, refined.solution.world_from_body)
        for at, part in zip(ties, rows, strict=True):
            weight[at], residual[at] = weights[part], after[part]
        for member, start in zip(members, starts, strict=True):
            count = len(drives[member].graph.world_from_body)
            poses[member] = refined.solution.world_from_body[start : start + count]
    return Joined(maps_of(len(drives), between, joined), poses, solved, weight, residual, apart)


def log_odds_of(graph: PoseGraph, between: Sequence[Between], rows: Sequence[slice]) -> Floats:
    """(E,) log of the odds of being false: what each Between has at its `rows`, 0 of other edges."""
    result = np.zeros(len(graph.a))
    for one, part in zip(between, rows, strict=True):
        result[part] = one.log_odds
    return result


def places(one: Between, spacing: int, weight: Floats | None = None) -> int:
    """Places of the drive that has fewer, of closures with weight (L,): keyframes so far from one to the next."""
    accepted = slice(None) if weight is None else weight > 0.5
    return min(spaced_apart(one.query[accepted], spacing), spaced_apart(one.match[accepted], spacing))


def spaced_apart(keyframes: Ints, spacing: int) -> int:
    """The most of the keyframes that are so far from each other."""
    count, last = 0, -spacing
    for one in np.unique(keyframes).tolist():
        if one >= last + spacing:
            count, last = count + 1, one
    return count


def maps_of(count: int, between: Sequence[Between], joined: Sequence[bool]) -> list[tuple[int, ...]]:
    """The drives of each map, in order of their first ones."""
    ties = [one for one, good in zip(between, joined, strict=True) if good]
    number = parts(count, np.array([t.earlier for t in ties], np.int64), np.array([t.later for t in ties], np.int64))
    return [tuple(np.flatnonzero(number == one).tolist()) for one in range(int(number.max()) + 1)]


def as_one(
    drives: Sequence[SessionGraph] | Mapping[int, SessionGraph],
    members: Sequence[int],
    between: Sequence[Between],
    placed: Mapping[int, Floats] | None = None,
) -> tuple[PoseGraph, Bools, list[int], list[slice]]:
    """One graph of some drives and the closures between them: with it, which edges have the odometry's metres, where
    each drive's poses start, and where each Between's edges are. `placed` are (4, 4) map_from_drive, if known."""
    counts = [len(drives[member].graph.world_from_body) for member in members]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).tolist()
    start_of = dict(zip(members, starts, strict=True))
    own = [drives[member].graph for member in members]
    placed = placed or _placed(drives, members, between)
    ends = np.cumsum([sum(len(graph.a) for graph in own), *(len(one.query) for one in between)])
    rows = [slice(*pair) for pair in pairwise(ends.tolist())]
    graph = PoseGraph(
        world_from_body=np.concatenate(
            [placed[member] @ g.world_from_body for member, g in zip(members, own, strict=True)]
        ),
        a=np.concatenate(
            [g.a + start for g, start in zip(own, starts, strict=True)]
            + [one.match + start_of[one.earlier] for one in between]
        ).astype(np.int32),
        b=np.concatenate(
            [g.b + start for g, start in zip(own, starts, strict=True)]
            + [one.query + start_of[one.later] for one in between]
        ).astype(np.int32),
        a_from_b=np.concatenate([g.a_from_b for g in own] + [one.match_from_query for one in between]),
        information=np.concatenate([g.information for g in own] + [one.information for one in between]),
        kind=[kind for g in own for kind in g.kind] + [EdgeKind.LOOP] * sum(len(one.query) for one in between),
    )
    of_odometry = np.concatenate(
        [drives[member].of_odometry for member in members] + [one.of_odometry for one in between]
    )
    return graph, of_odometry, starts, rows


def _placed(
    drives: Sequence[SessionGraph] | Mapping[int, SessionGraph], members: Sequence[int], between: Sequence[Between]
) -> dict[int, Floats]:
    """(4, 4) map_from_drive of each, a start for the solve: by what most closures of a pair say, pair after pair."""
    placed = {members[0]: np.eye(4)}
    while len(placed) < len(members):
        for one in between:
            known = [one.later in placed, one.earlier in placed]
            if all(known) or not any(known):
                continue
            match = drives[one.earlier].graph.world_from_body[one.match]
            query = drives[one.later].graph.world_from_body[one.query]
            earlier_from_later = match @ one.match_from_query @ se3.inverse(query)
            typical = middle(earlier_from_later)
            if known[1]:
                placed[one.later] = placed[one.earlier] @ typical
            else:
                placed[one.earlier] = placed[one.later] @ se3.inverse(typical)
    return placed


def middle(poses: Floats) -> Floats:
    """The one of the poses (L, 4, 4) with the least sum of distances to the others, a rad counting as 10 m; of many,
    among 500 evenly spread."""
    poses = poses[np.unique(np.linspace(0, len(poses) - 1, min(len(poses), 500)).astype(int))]
    apart = [np.linalg.norm(se3.log(se3.between(pose, poses)) * [10, 10, 10, 1, 1, 1], axis=1).sum() for pose in poses]
    return poses[int(np.argmin(apart))]
