"""A drive that goes round a tilted ring twice, with odometry that drifts and closures of known truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Closures, EdgeKind, Keyframes, Odometry, PoseGraph, Verdict
from vplog.geometry import se3
from vplog.graph.build import build_graph

if TYPE_CHECKING:
    from vplog.data import Floats

ODOMETRY_SIGMA = np.repeat([0.004, 0.03], 3)
CLOSURE_SIGMA = np.repeat([0.005, 0.05], 3)


@dataclass(frozen=True, eq=False)
class Drive:
    true: Floats
    keyframes: Keyframes
    odometry: Odometry
    graph: PoseGraph
    false: np.ndarray
    """(E,) whether the edge is a false closure."""


def ring(n: int = 120, loops: int = 20, false: int = 0, seed: int = 0, noise: float = 1.0) -> Drive:
    """`n` keyframes on two laps; `loops` true closures join the laps, `false` ones join anything."""
    random = np.random.default_rng(seed)
    turn = np.linspace(0.0, 4.0 * np.pi, n)
    zero = np.zeros(n)
    position = np.stack([20.0 * np.cos(turn), 20.0 * np.sin(turn), 0.3 * turn], axis=1)
    tilt = se3.so3_exp(np.stack([0.1 * np.sin(turn), zero, zero], axis=1))
    true = se3.pose(se3.so3_exp(np.stack([zero, zero, turn], axis=1)) @ tilt, position)
    step = se3.between(true[:-1], true[1:]) @ se3.exp(noise * random.normal(size=(n - 1, 6)) * ODOMETRY_SIGMA)
    measured = np.empty_like(true)
    measured[0] = true[0]
    for k in range(n - 1):
        measured[k + 1] = measured[k] @ step[k]

    query = np.concatenate([random.integers(n // 2, n, loops), random.integers(n // 3, n, false)])
    match = np.maximum(query - n // 2, 0)
    match[loops:] = random.integers(0, n // 3 - 5, false)
    z = se3.between(true[match], true[query]) @ se3.exp(noise * random.normal(size=(loops + false, 6)) * CLOSURE_SIGMA)
    z[loops:] = se3.exp(random.normal(size=(false, 6)) * np.array([0.1, 0.1, 0.5, 1.0, 1.0, 0.3]))
    stamps = np.arange(n, dtype=np.int64) * 500_000_000 + 1_000_000_000_000
    keyframes = Keyframes("ring", stamps, measured)
    covariance = np.broadcast_to(np.diag(ODOMETRY_SIGMA**2), (n - 1, 6, 6)).copy()
    graph, _, _ = build_graph(keyframes, covariance, ledger(query, match, z))
    wrong = np.concatenate([np.zeros(n - 1 + loops, bool), np.ones(false, bool)])
    return Drive(true, keyframes, Odometry(stamps, measured, None), graph, wrong)


def ledger(query: np.ndarray, match: np.ndarray, match_from_query: Floats) -> Closures:
    """Rows that geometry accepted."""
    n = len(query)
    whole, share = np.zeros(n, np.int32), np.zeros(n, np.float32)
    return Closures(
        query=query.astype(np.int32),
        match=match.astype(np.int32),
        rank=whole,
        score=share,
        support=whole,
        shared_references=[np.empty(0, np.uint16)] * n,
        shared_overlap=[np.empty(0, np.float32)] * n,
        matches=whole,
        landmarks=whole,
        inliers=whole,
        spread=share,
        reverse_inliers=whole,
        scale=["odometry"] * n,
        match_from_query=match_from_query,
        information=np.broadcast_to(np.diag(CLOSURE_SIGMA**-2.0), (n, 6, 6)).copy(),
        verdict=[Verdict.ACCEPTED] * n,
        p_false=np.full(n, np.nan),
        residual_before=np.full(n, np.nan),
        residual_after=np.full(n, np.nan),
        weight=np.full(n, np.nan),
        query_camera=whole,
        match_camera=whole,
    )


def with_entry(array: np.ndarray, index: tuple[int, ...], value: float) -> np.ndarray:
    copy = np.array(array)
    copy[index] = value
    return copy


def without_loops(graph: PoseGraph) -> PoseGraph:
    keep = np.array([kind == EdgeKind.ODOMETRY for kind in graph.kind])
    return replace(
        graph,
        a=graph.a[keep],
        b=graph.b[keep],
        a_from_b=graph.a_from_b[keep],
        information=graph.information[keep],
        kind=[EdgeKind.ODOMETRY] * int(keep.sum()),
    )


def position_error(estimate: Floats, true: Floats) -> float:
    """Root mean square position error, m, the first poses being one."""
    return float(np.sqrt(((estimate - true)[:, :3, 3] ** 2).sum(1).mean()))
