"""From odometry and verified closures to the trajectory: build, solve, hold against the odometry, refine, judge."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from vplog.cache.steps import step
from vplog.data import EdgeKind, Verdict
from vplog.errors import GraphError
from vplog.graph import build, consistency, correct_trajectory
from vplog.graph.consistency import is_loop
from vplog.graph.factors import Factors
from vplog.graph.gps_factors import cost_of_fixes, fixes_on, with_fixes, with_noise_of
from vplog.graph.hypotheses import claimed_times
from vplog.graph.least_squares import Objective
from vplog.graph.marginals import pose_covariances
from vplog.graph.noise import edge_covariance
from vplog.graph.refine import refine
from vplog.graph.solve import decided

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vplog.data import Closures, Floats, Gps, Ints, Keyframes, Odometry, PoseGraph, Trajectory
    from vplog.graph.gps_factors import Fixes, GpsSettings
    from vplog.graph.noise import NoiseSettings
    from vplog.graph.refine import Refined, RefineSettings
    from vplog.graph.solve import OptimiserSettings


_log = logging.getLogger(__name__)


class BackEnd(Protocol):
    """The settings that these steps take."""

    @property
    def noise(self) -> NoiseSettings: ...
    @property
    def solve(self) -> OptimiserSettings: ...
    @property
    def refine(self) -> RefineSettings: ...
    @property
    def gps(self) -> GpsSettings: ...


@dataclass(frozen=True, eq=False)
class Solved:
    """What came of a drive's constraints."""

    closures: Closures
    """The ledger, judged."""
    refined: Refined
    fixes: Fixes | None
    """Of GPS, with `gps.use`."""
    trajectory: Trajectory
    noise_source: str
    """Source of the odometry's noise, as `edge_covariance` names it."""
    warnings: list[str]


@step("solve")
def solve(odometry: Odometry, keyframes: Keyframes, closures: Closures, gps: Gps | None, settings: BackEnd) -> Solved:
    """The best trajectory of a drive; fixes are used with `gps.use` alone. Raises GraphError where there is none."""
    covariance, doubts, source = edge_covariance(odometry, keyframes.stamp_ns, settings.noise)
    graph, rows, repairs = build.build_graph(keyframes, covariance, closures)
    fixes = fixes_on(gps, odometry, keyframes, settings.gps) if settings.gps.use else None
    if fixes is None:
        decision = decided(graph, settings.solve)
    else:
        alone = np.where(is_loop(graph), 0.0, 1.0)
        fixes = with_noise_of(Factors.of(graph), alone, graph.world_from_body, fixes, settings.gps)
        decision = decided(graph, settings.solve, partial(cost_of_fixes, fixes=fixes, settings=settings.gps))
    solution = decision.solution
    if fixes is not None:
        present = Factors.of(claimed_times(decision.graph, decision.sigmas))
        fixes = with_noise_of(present, solution.weight, solution.world_from_body, fixes, settings.gps)
    of_odometry = by_odometry(graph, closures, rows)
    refined = refine(decision.graph, solution, of_odometry, settings.refine, fixes, settings.gps, decision.sigmas)
    warnings = doubts + repairs + (fixes.warnings if fixes else [])
    for warning in warnings:
        _log.warning(warning)
    return Solved(
        judge(closures, graph, refined, rows),
        refined,
        fixes,
        correct_trajectory.correct_trajectory(odometry, keyframes, refined.solution.world_from_body),
        source,
        warnings,
    )


def by_odometry(graph: PoseGraph, closures: Closures, rows: Ints) -> NDArray[np.bool_]:
    """(E,) edges whose metres are the odometry's: its own, and closures (ledger `rows`) with its scale."""
    result = np.array([kind == EdgeKind.ODOMETRY for kind in graph.kind], bool)
    result[~result] = [closures.scale[row] == "odometry" for row in rows.tolist()]
    return result


def about_gps(solved: Solved) -> dict[str, Any] | None:
    """What run.json says of GPS: how many fixes were kept, and where on earth the trajectory's frame is."""
    fixes, refined = solved.fixes, solved.refined
    if fixes is None or refined.world_from_enu is None:
        return None
    latitude, longitude, altitude = fixes.origin
    return {
        "fixes": len(fixes),
        "kept": int(refined.inlier.sum()),
        "origin": {"latitude_deg": latitude, "longitude_deg": longitude, "altitude_m": altitude},
        "world_from_enu": refined.world_from_enu.tolist(),
    }


def keyframe_covariances(solved: Solved) -> Floats | None:
    """(N, 6, 6) of the keyframes as the graph has them in the end, with the noise as estimated and the GPS fixes kept;
    None where edges and fixes do not determine them."""
    refined, fixes = solved.refined, solved.fixes
    factors, poses, weight = Factors.of(refined.graph), refined.solution.world_from_body, refined.solution.weight
    objective = Objective(factors, weight)
    if fixes is not None and refined.inlier.any():
        objective = with_fixes(factors, weight, poses, fixes, refined.inlier)
    try:
        return pose_covariances(objective, poses)
    except GraphError as error:
        _log.warning("The covariance of the keyframes is not known: %s", error)
        return None


def judge(closures: Closures, graph: PoseGraph, refined: Refined, rows: Ints) -> Closures:
    """The ledger with what the solve made of the closures in the graph: residuals, weights, verdicts.

    Residuals before are to the odometry as it was assumed to be, those after to the odometry as it turned out.
    """
    solution = refined.solution
    loops = is_loop(graph)
    before, after, weight = (np.full(len(closures), np.nan) for _ in range(3))
    before[rows] = consistency.residual_before(graph)[loops]
    after[rows] = consistency.residual_sigma(refined.graph, solution.world_from_body)[loops]
    weight[rows] = solution.weight[loops]
    verdict = list(closures.verdict)
    for row in rows.tolist():
        if weight[row] < 0.5 and verdict[row] is Verdict.ACCEPTED:
            verdict[row] = Verdict.REJECTED_BY_SOLVER
    return replace(closures, residual_before=before, residual_after=after, weight=weight, verdict=verdict)
