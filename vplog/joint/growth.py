"""A joint graph that grows: a drive is placed among poses that stay, and now and then the whole is solved again.

What is placed costs as much as the drive and its closures, whatever the size of the map. The poses that it is placed
among give way when the whole is solved: by least squares with the closures that were kept, which are held against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vplog.data import EdgeKind, Floats, Ints, PoseGraph
from vplog.geometry import se3
from vplog.graph.consistency import OdometryChain, chi2_quantile, degrees_of_freedom, residual_sigma
from vplog.graph.factors import Factors
from vplog.graph.least_squares import descend
from vplog.graph.solve import decided
from vplog.joint.graph import Between, Joined, JoinSettings, SessionGraph, as_one, log_odds_of, maps_of, middle, places
from vplog.refinement.refine import Refined, RefineSettings, refine, rescaled
from vplog.stages import Optimiser

_STAYS, _LEAVES = 0.99, 0.999999
"""Quantiles of the chi-square of a closure in the solved whole: one that was rejected comes back below the first, one
that was kept leaves above the second. Those of GncSettings; between them what was decided stands."""
_ROUNDS = 3
"""Solves of the whole, each with the closures as the one before has left them."""


class Anchored(NamedTuple):
    """Verified closures of a drive in one whose poses stay."""

    between: Between
    world_from_match: Floats
    """(L, 4, 4) poses of the matched keyframes."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A drive among poses that stay."""

    world_from_body: Floats | None
    """(N, 4, 4); None where too few closures hold."""
    weight: list[Floats]
    """(L,) of each Anchored: 1 for the closures kept, 0 for the others."""
    residual: list[Floats]
    """(L,) sigma of each Anchored to the poses; NaN where it does not hold."""
    apart: dict[int, str]
    """Reason, by Anchored, that not enough of its closures were kept."""


def turned_round(one: Between) -> Between:
    """The closures with the earlier drive's keyframes as queries."""
    turn = se3.adjoint(se3.inverse(one.match_from_query))
    return replace(
        one,
        later=one.earlier,
        earlier=one.later,
        query=one.match,
        match=one.query,
        match_from_query=se3.inverse(one.match_from_query),
        information=np.swapaxes(turn, 1, 2) @ one.information @ turn,
    )


def place(drive: SessionGraph, anchored: Sequence[Anchored], solve: Optimiser, settings: JoinSettings) -> Placed:
    """The drive in the world of drives that it has closures with. Raises GraphError where it cannot be solved.

    While it is decided which closures are true, the drives met may have drifted against each other, as the drive's own
    odometry does over its whole length; each keeps its shape. Then it is solved with them where they are. Drives with
    too few inliers are separated, as in `join`.
    """
    joined = [places(one.between, settings.spacing) >= settings.least_closures for one in anchored]
    weight = [np.zeros(len(one.between.query)) for one in anchored]
    residual = [np.full(len(one.between.query), np.nan) for one in anchored]
    apart: dict[int, str] = {}
    along = np.argsort([np.median(one.between.query) for one in anchored], kind="stable").tolist()
    while any(joined):
        used = [at for at in along if at not in apart]
        graph, rows = _against(drive, [anchored[at] for at in used])
        decision = decided(graph, solve, log_odds=log_odds_of(graph, [anchored[at].between for at in used], rows))
        loose = [
            at
            for at, part in zip(used, rows, strict=True)
            if joined[at]
            and places(anchored[at].between, settings.spacing, decision.solution.weight[part]) < settings.least_closures
        ]
        for at in loose:
            joined[at] = False
            apart[at] = decision.solution.reason
        if loose:
            continue
        held, rows = _against(drive, [anchored[at] for at in used], decision.solution.world_from_body, hold=True)
        anchored_weight = decision.solution.weight[len(graph.a) - len(held.a) :]
        poses = descend(Factors.of(held), anchored_weight, held.world_from_body, 100, 1e-6).world_from_body
        after = residual_sigma(held, poses)
        for at, part in zip(used, rows, strict=True):
            weight[at], residual[at] = anchored_weight[part], after[part]
        return Placed(poses[1:], weight, residual, apart)
    return Placed(None, weight, residual, apart)


def _against(
    drive: SessionGraph, anchored: Sequence[Anchored], start: Floats | None = None, *, hold: bool = False
) -> tuple[PoseGraph, list[slice]]:
    """The graph of a drive and of a pose for each drive that it meets, along its way, and where the edges of each are.

    These poses come first, as a chain that may drift; with `hold` there is one, and what is met is rigid.
    """
    own, count = drive.graph, len(drive.graph.world_from_body)
    centre = [np.argsort(one.between.query, kind="stable")[len(one.between.query) // 2] for one in anchored]
    anchor = np.stack([one.world_from_match[row] for one, row in zip(anchored, centre, strict=True)])
    if hold:
        anchor = anchor[:1]
    number = [0 if hold else at for at in range(len(anchored))]
    first = len(anchor)
    noise = OdometryChain.of(own).covariance(np.array([0], np.int32), np.array([count - 1], np.int32))[0]
    drift = np.repeat([np.trace(noise[:3, :3]) / 3.0, np.trace(noise[3:, 3:]) / 3.0], 3) / max(first - 1, 1)
    world_from_query = [one.world_from_match @ one.between.match_from_query for one in anchored]
    query = [one.between.query for one in anchored]
    if start is None:
        placed = np.concatenate(world_from_query) @ se3.inverse(own.world_from_body[np.concatenate(query)])
        start = np.concatenate([anchor, middle(placed) @ own.world_from_body])
    else:
        start = np.concatenate([anchor, start[-count:]])
    steps, met = np.arange(first - 1), np.repeat(number, [len(rows) for rows in query])
    edges = len(steps) + len(own.a)
    graph = PoseGraph(
        world_from_body=start,
        a=np.concatenate([steps, own.a + first, met]).astype(np.int32),
        b=np.concatenate([steps + 1, own.b + first, np.concatenate(query) + first]).astype(np.int32),
        a_from_b=np.concatenate(
            [
                se3.between(anchor[:-1], anchor[1:]),
                own.a_from_b,
                se3.between(anchor[met], np.concatenate(world_from_query)),
            ]
        ),
        information=np.concatenate(
            [
                np.broadcast_to(np.diag(1.0 / drift), (len(steps), 6, 6)),
                own.information,
                *(one.between.information for one in anchored),
            ]
        ),
        kind=[EdgeKind.ODOMETRY] * len(steps) + list(own.kind) + [EdgeKind.LOOP] * len(met),
    )
    ends = edges + np.cumsum([0, *map(len, query)])
    return graph, [slice(a, b) for a, b in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)]


def solve_again(
    drives: Sequence[SessionGraph],
    between: Sequence[Between],
    weight: Sequence[Floats],
    solve: Optimiser,
    settings: JoinSettings,
    learn: RefineSettings,
) -> Joined:
    """The maps of drives whose poses are in one frame, with the closures that have a `weight` (L,) of each Between.

    Which these are was decided as the drives came; those that the solved whole contradicts leave, and those that it
    agrees with come back. Raises GraphError where a graph cannot be solved.
    """
    weight = [np.array(one) for one in weight]
    residual = [np.full(len(one.query), np.nan) for one in between]
    poses, solved = [drive.graph.world_from_body for drive in drives], dict[tuple[int, ...], Refined]()
    maps = list[tuple[int, ...]]()
    for last in (False,) * (_ROUNDS - 1) + (True,):
        enough = [
            places(one, settings.spacing, w) >= settings.least_closures for one, w in zip(between, weight, strict=True)
        ]
        maps = maps_of(len(drives), between, enough)
        for members in [one for one in maps if len(one) > 1 and one not in solved]:
            inside = set(members)
            ties = [at for at, one in enumerate(between) if {one.later, one.earlier} <= inside]
            here = {
                at: replace(drives[at], graph=replace(drives[at].graph, world_from_body=poses[at])) for at in members
            }
            same = dict.fromkeys(members, np.eye(4))
            graph, of_odometry, starts, rows = as_one(here, members, [between[at] for at in ties], same)
            known = np.ones(len(graph.a))
            for at, part in zip(ties, rows, strict=True):
                known[part] = weight[at]
            refined, after = _least_squares(graph, known > 0.5, of_odometry, solve, learn)
            for member, start in zip(members, starts, strict=True):
                poses[member] = refined.solution.world_from_body[start : start + len(poses[member])]
            stays, leaves = (chi2_quantile(one, degrees_of_freedom(graph)) for one in (_STAYS, _LEAVES))
            now = np.where(after**2 < stays, 1.0, np.where(after**2 > leaves, 0.0, known))
            changed = any((now[part] != known[part]).any() for part in rows)
            for at, part in zip(ties, rows, strict=True):
                residual[at] = after[part]
                weight[at] = weight[at] if last else now[part]
            if last or not changed:
                solved[members] = refined
        if all(one in solved for one in maps if len(one) > 1):
            break
    return Joined(maps, poses, solved, weight, residual, {})


def _least_squares(
    graph: PoseGraph, on: np.ndarray, of_odometry: np.ndarray, solve: Optimiser, learn: RefineSettings
) -> tuple[Refined, Floats]:
    """The solution by the edges `on` (E,), and the residual (E,) sigma of all."""
    edges: Ints = np.flatnonzero(on)
    used = replace(
        graph,
        a=graph.a[edges],
        b=graph.b[edges],
        a_from_b=graph.a_from_b[edges],
        information=graph.information[edges],
        kind=[EdgeKind.KNOWN_LOOP if graph.kind[e] == EdgeKind.LOOP else graph.kind[e] for e in edges.tolist()],
    )
    refined = refine(used, solve(used), of_odometry[edges], learn)
    return refined, residual_sigma(rescaled(graph, [], refined.sigmas), refined.solution.world_from_body)
