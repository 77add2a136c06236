"""Closures of random worlds: true ones where a drive comes back, false ones that claim a displaced world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tests.benchmarks.world_drives import JOINTS, joining, place_radius, revisits, true_pairs
from vplog.data import Closures, Verdict
from vplog.geometry import se3

if TYPE_CHECKING:
    from tests.benchmarks.world_drives import Drive
    from tests.benchmarks.world_parameters import Parameters
    from vplog.data import Bools, Floats, Ints

FALSE_BEYOND = 5.0
"""Sigmas of a closure's translation by which a false one is off at least; and half of the radius."""
PLACES = 20
"""Pairs of places tried, of which the one that most of a drive agrees with is the one that looks alike."""
ELSEWHERE = 6.0
"""Tolerances between two places that look alike, where no next aisle says: three radii. The shift that most of a drive
agrees with would be the least one allowed otherwise."""
SEEN_FOR = 2
"""Keyframes within which neighbouring closures see the same landmarks, and so share a part of their error."""
STALL_SHARE = 0.5
"""Largest share of the true closures that is reserved for stalled keyframes. There are as many if enough exist."""
MOST_FALSE = 400
"""Closures, so that worlds stay fast."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Closures before they are measured."""

    match: Ints
    """(L,) keyframe, and below the later one that sees the same place, or claims to."""
    query: Ints
    run: Ints
    """(L,) number of the run of neighbouring keyframes that each is of."""
    displaced: Floats
    """(L, 4, 4) D by which a closure claims that the world moved between its two visits; identity for true ones."""
    is_true: Bools
    """(L,)."""


def draw_pairs(parameters: Parameters, made: Drive, random: np.random.Generator) -> Pairs:
    """Draw the closures of a drive, in order of query, then match."""
    share = parameters.false_share
    true = _true_runs(parameters, made, round(parameters.closures * (1.0 - share)), random)
    # as many as their share of all is, where the drive comes back less often than was wanted, too
    count = parameters.closures if parameters.no_true else round(_count(true) * share / (1.0 - share))
    if parameters.spacing > 1:
        count = min(count, len(made.truth) // parameters.spacing)
    false = _false_runs(parameters, made, min(count, MOST_FALSE), random)
    if parameters.false_kind == "family" and not parameters.no_true:
        true = _some(true, max(int(_count([run for run, _ in false]) / random.uniform(1.05, 1.5)), 3))
    claims: dict[tuple[int, int], tuple[int, Floats, bool]] = {}
    runs = [*((run, np.eye(4), True) for run in true), *((run, D, False) for run, D in false)]
    if parameters.spacing > SEEN_FOR:
        runs = [(run[k : k + 1], D, is_true) for run, D, is_true in runs for k in range(len(run))]
    for number, (run, D, is_true) in enumerate(runs):
        for a, b in run.tolist():
            claims.setdefault((b, a), (number, D, is_true))
    query, match = np.array(sorted(claims), np.int64).reshape(-1, 2).T
    number, displaced, is_true = (
        zip(*(claims[pair] for pair in sorted(claims)), strict=True) if claims else ((), (), ())
    )
    return Pairs(
        match,
        query,
        np.array(number, np.int64),
        np.array(displaced, np.float64).reshape(-1, 4, 4),
        np.array(is_true, bool),
    )


def _true_runs(parameters: Parameters, made: Drive, count: int, random: np.random.Generator) -> list[Ints]:
    """Select up to `count` true pairs, in runs (K, 2): those that join sessions and stalled ones first."""
    pairs = true_pairs(parameters, made)
    runs = _runs(pairs, parameters, random)
    joints = [joining(made, pairs, later) for later in range(1, int(made.session[-1]) + 1)]
    first = [joint[[k]] for joint in joints if len(joint) for k in np.linspace(0, len(joint) - 1, JOINTS, dtype=int)]
    if parameters.stratum == "stalled":
        stalled = np.flatnonzero(made.is_wrong) + 1
        first += _some([run for run in runs if np.isin(run, stalled).any()], int(STALL_SHARE * count))
    return _some(_distinct([*first, *runs]), count)


def _distinct(runs: list[Ints]) -> list[Ints]:
    """The runs without the pairs that an earlier run has."""
    seen: set[tuple[int, int]] = set()
    distinct = []
    for run in runs:
        is_new = [pair not in seen for pair in map(tuple, run.tolist())]
        seen.update(map(tuple, run.tolist()))
        if any(is_new):
            distinct.append(run[is_new])
    return distinct


def _runs(pairs: Ints, parameters: Parameters, random: np.random.Generator) -> list[Ints]:
    """The pairs in runs that are neighbours at both ends, cut to at most `parameters.run`, in random order."""
    if not len(pairs):
        return []
    spacing, most = parameters.spacing, parameters.run
    jumps = (np.diff(pairs[:, 1]) > SEEN_FOR * spacing) | (np.abs(np.diff(pairs[:, 0])) > 2 * SEEN_FOR * spacing)
    runs = []
    for run in np.split(pairs, np.flatnonzero(jumps) + 1):
        start = 0
        while start < len(run):
            size = int(random.integers(1, most + 1))
            runs.append(run[start : start + size])
            start += size
    return [runs[k] for k in random.permutation(len(runs))]


def _some(runs: list[Ints], count: int) -> list[Ints]:
    """The first runs that have so many pairs together."""
    chosen, left = [], count
    for run in runs:
        if left <= 0:
            break
        chosen.append(run[:left])
        left -= len(run[:left])
    return chosen


def _count(runs: list[Ints]) -> int:
    return sum(len(run) for run in runs)


def _false_runs(
    parameters: Parameters, made: Drive, count: int, random: np.random.Generator
) -> list[tuple[Ints, Floats]]:
    """Runs of pairs (K, 2), each with the displacement D (4, 4) that it claims, `count` pairs in all or fewer."""
    if parameters.false_kind == "none" or count <= 0:
        return []
    if parameters.false_kind in ("aliased", "family"):
        return _displaced(parameters, made, count, random)
    found: list[tuple[Ints, Floats]] = []
    left, truth, spacing = count, made.truth, parameters.spacing
    for _ in range(50 * count):
        if left <= 0:
            break
        a, b = np.sort(random.integers(0, len(truth), 2)).tolist()
        most = int(random.integers(4, 21)) if parameters.false_kind == "grouped" else 1
        b -= b % spacing
        size = min(most, left, (b - a - 10) // spacing, (len(truth) - 1 - b) // spacing + 1)
        if size < 1:
            continue
        D = _claimed_displacement(parameters, truth, a, b, random)
        run = np.array([a, b]) + spacing * np.arange(size)[:, None]
        run = run[_is_false(parameters, truth, run, D) & _looks_near(parameters, truth, run, D)]
        if len(run):
            found.append((run, D))
            left -= len(run)
    return found


def _claimed_displacement(parameters: Parameters, truth: Floats, a: int, b: int, random: np.random.Generator) -> Floats:
    """D (4, 4) by which keyframe b looks as if it were at a, give or take what two views of one place may differ."""
    near = random.normal(size=6) * ([0.02, 0.02, 0.2, *[place_radius(parameters, truth) / 3.0] * 3])
    if not parameters.spatial:
        near[5] *= 0.05
    return truth[a] @ se3.exp(near) @ se3.inverse(truth[b])


def _displaced(
    parameters: Parameters, made: Drive, count: int, random: np.random.Generator
) -> list[tuple[Ints, Floats]]:
    """Pairs that one D explains, the same for all: the next aisle, or the place of two that are most alike."""
    truth, shift = made.truth, made.aisle_shift
    if shift is not None:
        sides = [se3.pose(np.eye(3), side * shift) for side in (1.0, -1.0)]
    else:
        sides = []
        for _ in range(PLACES):
            a, b = np.sort(random.integers(0, len(truth), 2)).tolist()
            if b - a > 10:
                sides.append(_claimed_displacement(parameters, truth, a, b, random))
    best, chosen = np.zeros((0, 2), np.int64), np.eye(4)
    for D in sides:
        pairs = revisits(parameters, made, D, 2.0)
        pairs = pairs[_is_false(parameters, truth, pairs, D, 1.0 if shift is not None else ELSEWHERE)]
        if len(pairs) > len(best):
            best, chosen = pairs, D
    return [(run, chosen) for run in _some(_runs(best, parameters, random), count)]


def _is_false(parameters: Parameters, truth: Floats, pairs: Ints, D: Floats, times: float = 1.0) -> Bools:
    """(K,) whether a claim is further from the truth than its tolerance, or some times that."""
    claimed = se3.between(truth[pairs[:, 0]], D @ truth[pairs[:, 1]])
    error = claimed[:, :3, 3] - se3.between(truth[pairs[:, 0]], truth[pairs[:, 1]])[:, :3, 3]
    return np.asarray(np.linalg.norm(error, axis=1) > times * tolerance_m(parameters, truth))


def tolerance_m(parameters: Parameters, truth: Floats) -> float:
    """How far a closure may be off and still be true: 5 sigma, the largest that is drawn, and half a place's radius."""
    return max(FALSE_BEYOND * 2.0 * parameters.sigma, 0.5 * place_radius(parameters, truth))


def _looks_near(parameters: Parameters, truth: Floats, pairs: Ints, D: Floats) -> Bools:
    """(K,) whether the claim is one of two views of one place."""
    claimed = se3.between(truth[pairs[:, 0]], D @ truth[pairs[:, 1]])
    return np.asarray(np.linalg.norm(claimed[:, :3, 3], axis=1) < 3.0 * place_radius(parameters, truth))


def _marginal(parameters: Parameters, count: int, random: np.random.Generator) -> Floats:
    """(L, 6, 6) true covariance of each closure by itself: of half to twice the drawn sigma."""
    size = np.exp(random.uniform(np.log(0.5), np.log(2.0), count))
    sigma = size[:, None] * np.array([*[parameters.sigma_turn] * 3, *[parameters.sigma] * 3])
    return np.asarray(sigma[:, :, None] ** 2 * np.eye(6), np.float64)


def measure(
    parameters: Parameters, truth: Floats, pairs: Pairs, random: np.random.Generator
) -> tuple[Floats, Floats, Floats, list[str], Bools]:
    """match_from_query (L, 4, 4), its covariance (L, 6, 6) by itself and as in World, where its metres are from, and
    whether the depth error is in them."""
    count, run = len(pairs.run), pairs.run
    marginal = _marginal(parameters, count, random)
    measured = se3.between(truth[pairs.match], pairs.displaced @ truth[pairs.query])
    share, runs = parameters.common_share, int(run.max(initial=-1)) + 1
    common, own = random.normal(size=(runs, 6))[run], random.normal(size=(count, 6))
    source = random.integers(0, len(parameters.scales), runs)[run]
    scale = [parameters.scales[one] for one in source.tolist()]
    stretch = np.where(source == 0, 1.0 + parameters.depth_error, 1.0)
    stretch[[one == "odometry" for one in scale]] *= 1.0 + parameters.scale_error
    measured[:, :3, 3] *= stretch[:, None]
    sigma = np.sqrt(np.diagonal(marginal, axis1=1, axis2=2))
    measured = measured @ se3.exp(sigma * (np.sqrt(share) * common + np.sqrt(1.0 - share) * own))
    size = np.bincount(run, minlength=runs)[run].astype(float)
    covariance = marginal * (size * share + 1.0 - share)[:, None, None]
    return measured, marginal, covariance, scale, np.asarray(source == 0, bool)


def ledger(pairs: Pairs, measured: Floats, information: Floats, scale: list[str]) -> Closures:
    """The closures, all of them verified."""
    count, query = len(pairs.query), pairs.query
    many, unknown = np.full(count, 50, np.int32), np.full(count, np.nan)
    rank = np.arange(count) - np.searchsorted(query, query)
    return Closures(
        query=query.astype(np.int32),
        match=pairs.match.astype(np.int32),
        rank=rank.astype(np.int32),
        score=np.ones(count, np.float32),
        support=np.zeros(count, np.int32),
        shared_references=[np.zeros(0, np.uint16)] * count,
        shared_overlap=[np.zeros(0, np.float32)] * count,
        matches=many,
        landmarks=many,
        inliers=many,
        spread=np.full(count, 0.5, np.float32),
        reverse_inliers=many,
        scale=scale,
        match_from_query=measured,
        information=information,
        verdict=[Verdict.ACCEPTED] * count,
        p_false=unknown,
        residual_before=unknown,
        residual_after=unknown,
        weight=unknown,
        query_camera=np.zeros(count, np.int32),
        match_camera=np.zeros(count, np.int32),
    )
