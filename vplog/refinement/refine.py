"""The odometry's noise and scale, estimated after the robust solve from the inlier closures and GPS fixes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from pydantic import Field

from vplog.data import Bools, Floats, PoseGraph, Solution
from vplog.graph.consistency import residual_sigma, runs
from vplog.graph.factors import Factors
from vplog.graph.least_squares import Objective, minimised
from vplog.graph.lm import half_chi2
from vplog.graph.marginals import SharedScale, positions_redundancy
from vplog.graph.variance_components import Sigmas, claimed_times, estimate
from vplog.refinement.gps_factors import Fixes, inlier_fixes, with_fixes, with_noise_of, world_from_enu
from vplog.settings import Settings

_STEP = 1e-4
"""Step of the scale for differences: far above rounding, far below what any drive determines."""
_SMALL = 0.05
"""Change of a scale in its sigma at which it is settled."""
_STEPS = 20
"""Most steps of least squares: each starts from the last round's best poses."""
_LONGEST = 0.05
"""Largest change of the scale in one round."""
_LONG = 10.0
"""Length of closures in sigma from which their scale is estimated: noise makes lengths too long by the inverse square
of this, a hundredth."""
_STEADY = 0.025
"""Change of a sigma in a round, as a share, below which it is settled."""
_LEAST_FACTOR = 2.0**-7
"""Smallest noise factor. It keeps exact data solvable, such as those of a simulation."""
_LEAST_CLOSURES = 0.5
"""Smallest noise factor of closures. Those of neighbouring keyframes share landmarks, so they agree with each other
better than they are right."""
_LEAST_OF_ODOMETRY = 2.0
"""Smallest noise factor of closures as a multiple of the odometry's, if that is smaller. If the noise of closures is
claimed far too large, their factor would otherwise be estimated at the expense of the odometry's, down to zero."""
_AS_CLAIMED = Sigmas()


class RefineSettings(Settings):
    """Noise and scale of the odometry, estimated from the inlier constraints."""

    noise: bool = True
    """Estimate by what factor the odometry's covariance is too large or too small."""
    scale: bool = True
    """Estimate by what factor metres are too short: the odometry's by GPS, the closures' by the odometry. Closures tell
    nothing of the odometry's metres: where the two differ, a shared error of depth is likelier, and does less harm."""
    scale_sigma: float = Field(default=0.02, gt=0)
    """Prior standard deviation of the odometry's scale about 1: wheel and visual odometry lose 1-2 % of the way."""
    closure_scale_sigma: float = Field(default=0.05, gt=0)
    """How far the scale of closures with metres of their own is expected from 1: 5 % are a millimetre of a stereo
    pair's baseline, or a depth camera's error at 4 m."""
    significance: float = Field(default=3.0, ge=0)
    """A scale is applied where it is so many sigmas from 1; neighbouring closures count as one."""
    max_rounds: int = Field(default=12, ge=1)
    """Rounds after which it gives up; drives take 3-6."""


@dataclass(frozen=True, eq=False)
class Scale:
    """A factor of the metres of some edges."""

    of: str
    """Kind of the edges: "odometry" or "closures"."""
    edges: Bools
    """(E,)."""
    sigma: float
    """Prior standard deviation about 1."""
    significance: float
    """Sigmas that it must be from 1 to be applied."""
    value: float = 1.0
    witnesses: float = 1.0
    """Independent ones among the edges, as a share: neighbouring closures see the same landmarks."""

    def is_sure(self, sigma: float) -> bool:
        return abs(self.value - 1.0) > self.significance * sigma / self.witnesses**0.5


@dataclass(frozen=True, eq=False)
class _Measurements:
    """The weighted edges of a graph, and GPS fixes where there are any."""

    graph: PoseGraph
    weight: Floats
    """(E,)."""
    fixes: Fixes | None
    inlier: Floats
    """(F,) 1 for the fixes that are used, 0 for the others."""

    def objective(self, scales: list[Scale], sigmas: Sigmas, poses: Floats) -> Objective:
        """All of them with these metres and sigmas, the fixes in the world of the poses (N, 4, 4)."""
        factors = Factors.of(rescaled(self.graph, scales, sigmas))
        if self.fixes is None:
            return Objective(factors, self.weight)
        return with_fixes(factors, self.weight, poses, self.fixes, self.inlier)


@dataclass(frozen=True, eq=False)
class Refined:
    """A solution with the noise and the scale of the sensors that it implies."""

    graph: PoseGraph
    """The graph as solved: metres of the odometry multiplied by `scale`, its covariance by the squares of `sigmas`."""
    solution: Solution
    sigmas: Sigmas
    """Factors of the claimed sigmas, 1 where they were not judged."""
    scale: float
    """Factor of the odometry's metres, 1 where it was not judged."""
    fixes: Fixes | None
    """GPS with its covariance as estimated."""
    inlier: Floats
    """(F,) 1 for the GPS fixes that were kept, 0 for the others; empty without GPS."""
    world_from_enu: Floats | None
    """(4, 4) from the plane of the first fix, None without GPS."""
    unknown: list[SharedScale] = field(default_factory=list)
    """Remaining errors of scale: metric scale of odometry and closures, and rotations."""


def about_odometry(refined: Refined) -> dict[str, float]:
    """Record of the odometry in run.json: factors of its claimed sigmas, and of its metres."""
    sigmas = refined.sigmas
    return {
        "sigma_factor": sigmas.translation,
        "rotation_sigma_factor": sigmas.rotation,
        "scale": refined.scale,
    }


def refine(
    graph: PoseGraph,
    solution: Solution,
    of_odometry: Bools,
    settings: RefineSettings,
    fixes: Fixes | None = None,
    sigmas: Sigmas = _AS_CLAIMED,
    scale: float = 1.0,
) -> Refined:
    """Solve again with the noise and the scale of the sensors as the inliers imply them, and with GPS if there is any.

    `of_odometry` (E,) marks edges whose metres are the odometry's: its own, and closures whose scale is taken from it.
    `sigmas` and `scale`, of the odometry, are those of the solution. The weights of edges stay as they are. Raises
    GraphError where too few fixes agree.
    """
    weight, poses, inlier = solution.weight, solution.world_from_body, np.zeros(0)
    loops = ~graph.odometry
    scales = []
    if fixes is not None:
        scales = [Scale("odometry", of_odometry, settings.scale_sigma, settings.significance, scale)]
    metric = loops & ~of_odometry & (weight > 0.5)
    if metric.any() and np.median(_lengths(graph, metric)) >= _LONG:
        own, expected = loops & ~of_odometry, settings.closure_scale_sigma
        witnesses = sum(1 for _ in runs(graph, np.flatnonzero(metric))) / float(metric.sum())
        scales.append(Scale("closures", own, expected, settings.significance, witnesses=witnesses))
    checked = bool((weight[loops] > 0).any())
    if fixes is not None:
        poses, inlier = inlier_fixes(Factors.of(rescaled(graph, scales, sigmas)), weight, poses, fixes)
        checked = True
    left: dict[str, float] = {}
    if not checked or not (settings.noise or settings.scale):
        refined = _refined(rescaled(graph, [], sigmas), solution, poses, sigmas, [], fixes, inlier)
        return replace(refined, unknown=_unknown(of_odometry, loops, left, settings))

    scales = scales if settings.scale else []
    measured = _Measurements(graph, weight, fixes, inlier)
    for _ in range(settings.max_rounds):
        objective = measured.objective(scales, sigmas, poses)
        poses = minimised(objective, poses, _STEPS, 1e-6).world_from_body
        before, factor = sigmas, 1.0
        if settings.noise:
            sigmas = _no_surer(estimate(objective, poses, sigmas))
        moved = [_scale_step(measured, scales, number, sigmas, poses) for number in range(len(scales))]
        left |= {one.of: sigma / one.witnesses**0.5 for one, (_, sigma) in zip(scales, moved, strict=True)}
        if fixes is not None:
            fixes, inlier, factor = with_noise_of(fixes, inlier, poses, positions_redundancy(objective, poses))
            measured = replace(measured, fixes=fixes, inlier=inlier)
        scales = [replace(one, value=one.value + step) for one, (step, _) in zip(scales, moved, strict=True)]
        steady = abs(np.log(factor)) <= 2.0 * _STEADY and not sigmas.differ(before, _STEADY)
        if not steady or any(abs(step) > _SMALL * sigma for step, sigma in moved):
            continue
        # what is not sure is left out, and the rest estimated without it
        sure = [one for one, (_, sigma) in zip(scales, moved, strict=True) if one.is_sure(sigma)]
        if len(sure) == len(scales):
            break
        scales = sure
    else:
        scales = []  # no convergence
    poses = minimised(measured.objective(scales, sigmas, poses), poses, _STEPS, 1e-6).world_from_body
    refined = _refined(rescaled(graph, scales, sigmas), solution, poses, sigmas, scales, fixes, inlier)
    return replace(refined, unknown=_unknown(of_odometry, loops, left, settings))


def _no_surer(sigmas: Sigmas) -> Sigmas:
    """Return the noise factors, or their lower bounds if these are larger."""
    odometry, closures = np.reshape(np.maximum(sigmas, _LEAST_FACTOR), (2, 2))
    least = np.minimum(_LEAST_OF_ODOMETRY * odometry, _LEAST_CLOSURES)
    return Sigmas(*odometry.tolist(), *np.maximum(closures, least).tolist())


def _unknown(of_odometry: Bools, loops: Bools, left: dict[str, float], settings: RefineSettings) -> list[SharedScale]:
    """Shared errors of metres: as the priors have them, or with the sigmas `left` where they were estimated; closures
    whose scale was held against the odometry's share the odometry's too."""
    own = loops & ~of_odometry
    sigma = {"odometry": settings.scale_sigma, "closures": settings.closure_scale_sigma} | left
    return [
        SharedScale(of_odometry | own if "closures" in left else of_odometry, sigma["odometry"]),
        SharedScale(own, min(sigma["closures"], settings.closure_scale_sigma)),
    ]


def _lengths(graph: PoseGraph, edges: Bools) -> Floats:
    """Lengths (K,) of the edges in their own sigma."""
    shift = graph.a_from_b[edges, :3, 3]
    return np.sqrt(np.einsum("ki,kij,kj->k", shift, graph.information[edges, 3:, 3:], shift))


def rescaled(graph: PoseGraph, scales: list[Scale], sigmas: Sigmas) -> PoseGraph:
    """The graph with metres of some edges multiplied, and its sigmas.

    What is multiplied has its noise multiplied too. With the noise left alone every constraint would be met best by a
    world of no size, and the estimate would be too small.
    """
    if sigmas == _AS_CLAIMED and not scales:
        return graph
    graph = claimed_times(graph, sigmas)
    a_from_b, information = graph.a_from_b.copy(), graph.information.copy()
    for scale in scales:
        a_from_b[scale.edges, :3, 3] *= scale.value
        information[scale.edges, 3:] /= scale.value
        information[scale.edges, :, 3:] /= scale.value
    return replace(graph, a_from_b=a_from_b, information=information)


def _scale_step(
    measured: _Measurements, scales: list[Scale], number: int, sigmas: Sigmas, poses: Floats
) -> tuple[float, float]:
    """A secant step towards the scale of least error, poses following it, and the sigma of what it leads to.

    At the best poses for a scale the error does not change with the poses, so its slope is that with the poses fixed.
    """
    one, weight = scales[number], measured.weight

    def at(value: float) -> list[Scale]:
        return [*scales[:number], replace(one, value=value), *scales[number + 1 :]]

    def chi2(value: float, best: Floats) -> float:
        return float((weight * residual_sigma(rescaled(measured.graph, at(value), sigmas), best) ** 2).sum())

    def gradient(value: float) -> float:
        best = minimised(measured.objective(at(value), sigmas, poses), poses, _STEPS, 1e-8).world_from_body
        slope = (chi2(value + _STEP, best) - chi2(value - _STEP, best)) / (4.0 * _STEP)
        return slope + (value - 1.0) / one.sigma**2

    aside = one.sigma / 4.0
    here, there = gradient(one.value), gradient(one.value + aside)
    curve = (there - here) / aside
    if curve <= 0.0:  # nothing to find: the prior alone would curve it upwards
        return 0.0, one.sigma
    return float(np.clip(-here / curve, -_LONGEST, _LONGEST)), curve**-0.5


def _refined(
    graph: PoseGraph,
    solution: Solution,
    poses: Floats,
    sigmas: Sigmas,
    scales: list[Scale],
    fixes: Fixes | None,
    inlier: Floats,
) -> Refined:
    """The refined solution, with the estimates in its reason."""
    world, sentences = None, []
    if sigmas.translation != 1.0:
        sentences.append(
            f"The odometry's noise is {sigmas.translation:.2g} times what was assumed in translation, "
            f"{sigmas.rotation:.2g} times in rotation."
        )
    scale = {one.of: one.value for one in scales}
    for of, value in scale.items():
        too = "long" if value < 1.0 else "short"
        whose = "odometry's" if of == "odometry" else "closures'"
        sentences.append(f"The {whose} metres are {abs(1.0 / value - 1.0):.2%} too {too}.")
    if fixes is not None:
        world = world_from_enu(poses, fixes, np.maximum(inlier, 1e-9))
        sentences.append(f"{int(inlier.sum())} of {len(fixes)} GPS fixes were used.")
    error, reason = half_chi2(graph, solution.weight, poses), " ".join([solution.reason.strip(), *sentences])
    refined = replace(solution, world_from_body=poses, error_after=error, reason=reason)
    return Refined(graph, refined, sigmas, scale.get("odometry", 1.0), fixes, inlier, world)
