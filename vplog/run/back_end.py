"""Pose graph optimisation of one drive: build, robust solve, refine, and the closures' verdicts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vplog.data import (
    Closures,
    EdgeKind,
    Floats,
    Gps,
    Ints,
    Keyframes,
    Odometry,
    PoseGraph,
    Solution,
    Trajectory,
    Verdict,
)
from vplog.errors import GraphError
from vplog.execution.run_warnings import warn
from vplog.geometry import se3
from vplog.graph import build, consistency, correct_trajectory
from vplog.graph.consistency import is_loop
from vplog.graph.factors import Factors
from vplog.graph.least_squares import Objective
from vplog.graph.marginals import SharedScale, pose_covariances
from vplog.graph.noise import NoiseSettings, broken_edges, edge_covariance
from vplog.graph.search import bounded
from vplog.graph.solve import Decision, OptimiserSettings, about_slips, decided
from vplog.graph.variance_components import Sigmas, claimed_times
from vplog.joint.pieces import pieces_placed
from vplog.loops.false_rate import log_odds_false
from vplog.refinement.gps_factors import GpsSettings, cost_of_fixes, fixes_on, noisier, with_fixes
from vplog.refinement.refine import Refined, RefineSettings, Scale, refine, rescaled
from vplog.run.cache.steps import step

_FIXES_OF_A_PIECE = 2
"""Satellite fixes that place a piece of the trajectory on earth, and by which way it heads."""
_CONFIRMED = 0.99
"""Probability that the noise of a true closure leaves it within the bound of its distance to the solution."""


class BackEnd(Protocol):
    """The settings that these steps take."""

    noise: NoiseSettings
    solve: OptimiserSettings
    refine: RefineSettings
    gps: GpsSettings


@dataclass(frozen=True, eq=False)
class BackEndResult:
    """Result of the back end."""

    closures: Closures
    """The ledger, judged."""
    refined: Refined
    trajectory: Trajectory
    noise_source: str
    """Source of the odometry's noise, as `edge_covariance` names it."""
    warnings: list[str]
    of_images: bool = False
    """Whether the odometry is that of the images."""
    pieces: int = 1
    """Pieces of the trajectory that nothing relates to each other."""

    @property
    def caution(self) -> Sigmas:
        """Factors of the sigmas of `refined.graph` in the covariance of the keyframes.

        Estimated factors below 1 show agreement between measurements. If these share calibration and landmarks, as
        visual odometry and closures do, they share errors too. Agreement then is not accuracy, and claims are kept.
        """
        return Sigmas(*(1.0 / min(factor, 1.0) for factor in self.refined.sigmas[:2])) if self.of_images else Sigmas()


@step("solve")
def solve(
    odometry: Odometry, keyframes: Keyframes, closures: Closures, gps: Gps | None, settings: BackEnd
) -> BackEndResult:
    """The best trajectory of a drive; fixes are used with `gps.use`, unless the odometry has found no metres, and where
    they are the odometry. Raises GraphError where there is none."""
    covariance, noise_warnings, source = edge_covariance(odometry, keyframes.stamp_ns, settings.noise)
    graph, rows, build_warnings = build.build_graph(keyframes, covariance, closures)
    broken = broken_edges(odometry, keyframes.stamp_ns)
    graph = pieces_placed(graph, broken)
    of_odometry = by_odometry(graph, closures, rows)
    fixes, cost, scale, present = None, None, 1.0, graph
    if (settings.gps.use and odometry.metric) or not odometry.drifts:
        fixes = fixes_on(gps, odometry, keyframes, settings.gps)
        odometry_alone = Solution(graph.world_from_body, np.where(is_loop(graph), 0.0, 1.0), 0.0, 0.0, 0, True, "")
        # with the odometry's noise as claimed, or it would follow errors of satellites that closures then contradict
        stiff = settings.refine.model_copy(update={"noise": False})
        by_gps = refine(graph, odometry_alone, of_odometry, stiff, fixes)
        fixes, scale = noisier(fixes, by_gps.fixes), by_gps.scale
        present = rescaled(graph, [Scale("odometry", of_odometry, 0.0, 0.0, scale)], Sigmas())
        cost = partial(cost_of_fixes, fixes=fixes)
    log_odds = np.zeros(len(graph.a))
    log_odds[~graph.odometry] = log_odds_false(closures)[rows]
    decision = decided(present, settings.solve, cost, log_odds)
    measured = decision.slipping.applied(bounded(graph), decision.sigmas)
    refined = refine(measured, decision.solution, of_odometry, settings.refine, fixes, decision.sigmas, scale)
    turns = SharedScale(graph.odometry | odometry.of_images, settings.noise.turn_per_radian, of_rotation=True)
    refined = replace(refined, unknown=[*refined.unknown, turns])
    warnings = noise_warnings + build_warnings + (fixes.warnings if fixes else [])
    warnings += about_slips(decision, np.arange(len(keyframes.stamp_ns)))
    apart, pieces = _apart(broken, graph, refined)
    if len(apart):
        seconds = (keyframes.stamp_ns[apart[0] + 1] - odometry.stamp_ns[0]) / 1e9
        warnings.append(
            f"{len(apart)} of {len(broken)} breaks of the odometry have no closure across them, the first at "
            f"{seconds:.1f} s: the poses after it are not known relative to those before it."
        )
    warnings += _contradicted(present, partial(decided, optimiser=settings.solve, cost=cost))
    warnings += _confirmed(closures, refined.solution.world_from_body)
    for warning in warnings:
        warn(warning)
    trajectory = correct_trajectory.correct_trajectory(odometry, keyframes, refined.solution.world_from_body)
    return BackEndResult(
        judged_ledger(closures, graph, refined, rows), refined, trajectory, source, warnings, odometry.of_images,
        pieces,
    )  # fmt: skip


def _apart(broken: Ints, graph: PoseGraph, refined: Refined) -> tuple[Ints, int]:
    """The breaks of the odometry (edges) whose sides no accepted closure and no fixes relate, directly or by other
    pieces, and the number of pieces that remain."""
    accepted = ~graph.odometry & (refined.solution.weight > 0.5)
    a, b, earth = broken.searchsorted(graph.a[accepted]), broken.searchsorted(graph.b[accepted]), len(broken) + 1
    if refined.fixes is not None:
        fixes = np.bincount(broken.searchsorted(refined.fixes.row[refined.inlier > 0.5]), minlength=earth)
        placed = np.flatnonzero(fixes >= _FIXES_OF_A_PIECE)
        a, b = np.append(a, placed), np.append(b, np.full(len(placed), earth))
    label = build.parts(earth + 1, a, b)[:earth]
    return broken[label[1:] != label[:-1]], len(np.unique(label))


def _contradicted(graph: PoseGraph, solve: Callable[[PoseGraph], Decision]) -> list[str]:
    """A warning of each closure accepted by decision that the robust solve rejects where none is known to be true."""
    known = np.array([kind == EdgeKind.KNOWN_LOOP for kind in graph.kind], bool)
    if not known.any():
        return []
    kind = [EdgeKind.ODOMETRY if one == EdgeKind.ODOMETRY else EdgeKind.LOOP for one in graph.kind]
    weight = solve(replace(graph, kind=kind)).solution.weight
    return [
        f"Decision to accept keyframes {graph.b[edge]} and {graph.a[edge]}: the robust solve without decisions rejects "
        f"this closure. Look at it: vplog explain RUN --closure {graph.b[edge]}:{graph.a[edge]}"
        for edge in np.flatnonzero(known & (weight < 0.5)).tolist()
    ]


def _confirmed(closures: Closures, poses: Floats) -> list[str]:
    """A warning of each closure rejected by decision that the solution predicts within the noise of its own pose."""
    rejected = closures.of(Verdict.REJECTED_BY_DECISION) & np.isfinite(closures.information).all((1, 2))
    query, match = closures.query[rejected], closures.match[rejected]
    error = se3.log(se3.between(closures.match_from_query[rejected], se3.between(poses[match], poses[query])))
    sigma = np.sqrt(np.einsum("ki,kij,kj->k", error, closures.information[rejected], error))
    return [
        f"Decision to reject keyframes {one} and {other}: the other constraints have them {value:.1f} sigma from the "
        "pose that geometry finds, so it seems to be a true closure."
        for one, other, value in zip(query.tolist(), match.tolist(), sigma.tolist(), strict=True)
        if value**2 < consistency.chi2_quantile(_CONFIRMED, 6)
    ]


def by_odometry(graph: PoseGraph, closures: Closures, rows: Ints) -> NDArray[np.bool_]:
    """(E,) edges whose metres are the odometry's: its own, and closures (ledger `rows`) with its scale."""
    result = graph.odometry.copy()
    result[~result] = [closures.scale[row] == "odometry" for row in rows.tolist()]
    return result


def about_gps(solved: BackEndResult) -> dict[str, Any] | None:
    """Field `gps` of run.json: number of inlier fixes, and the georeference of the trajectory's frame."""
    fixes, refined = solved.refined.fixes, solved.refined
    if fixes is None or refined.world_from_enu is None:
        return None
    latitude, longitude, altitude = fixes.origin
    return {
        "fixes": len(fixes),
        "kept": int(refined.inlier.sum()),
        "origin": {"latitude_deg": latitude, "longitude_deg": longitude, "altitude_m": altitude},
        "world_from_enu": refined.world_from_enu.tolist(),
    }


def about_covariance(solved: BackEndResult) -> dict[str, Any]:
    """Return field `covariance` of run.json, with which edges.parquet gives the covariance of the keyframes."""
    return {"sigma_factors": solved.caution, "shared_scales": [scale.record() for scale in solved.refined.unknown]}


def keyframe_covariances(solved: BackEndResult) -> Floats | None:
    """Return the covariance (N, 6, 6) of the keyframes, or None if edges and fixes do not determine the poses.

    The solved graph has its estimated noise times `BackEndResult.caution`. The inlier GPS fixes and the unknown scales
    are included.
    """
    refined, fixes = solved.refined, solved.refined.fixes
    graph = claimed_times(refined.graph, solved.caution)
    factors, poses, weight = Factors.of(graph), refined.solution.world_from_body, refined.solution.weight
    objective = Objective(factors, weight)
    if fixes is not None and refined.inlier.any():
        objective = with_fixes(factors, weight, poses, fixes, refined.inlier)
    try:
        return pose_covariances(objective, poses, refined.unknown)
    except GraphError as error:
        warn(f"The covariance of the keyframes is not known: {error}")
        return None


def judged_ledger(closures: Closures, graph: PoseGraph, refined: Refined, rows: Ints) -> Closures:
    """The ledger with residuals, weights and verdicts of the solve.

    Residuals before are relative to the assumed odometry noise, those after to the estimated one.
    """
    solution = refined.solution
    loops = ~graph.odometry
    before, after, weight = (np.full(len(closures), np.nan) for _ in range(3))
    before[rows] = consistency.residual_before(graph)[loops]
    after[rows] = consistency.residual_sigma(refined.graph, solution.world_from_body)[loops]
    weight[rows] = solution.weight[loops]
    verdict = list(closures.verdict)
    for row in rows.tolist():
        if weight[row] < 0.5 and verdict[row] is Verdict.ACCEPTED:
            verdict[row] = Verdict.REJECTED_BY_SOLVER
    return replace(closures, residual_before=before, residual_after=after, weight=weight, verdict=verdict)
