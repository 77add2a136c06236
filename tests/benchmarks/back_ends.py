"""Back ends that a world is solved by: vplog as users get it, others beside it, and one that knows what is true.

Only the oracle, `true_closures` and, to place sessions, `odometry` know more than the log. In a world with GPS, all but
`optimize` use its fixes and answer in the world's frame; without GPS, any frame will do.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np
from pydantic import TypeAdapter

from vplog.errors import VplogError
from vplog.geometry import se3
from vplog.graph.build import subgraph
from vplog.graph.consistency import chi2_quantile, is_loop
from vplog.graph.solve import GncSettings, OptimiserSettings, decided
from vplog.pipeline import Pipeline
from vplog.refinement.gps_factors import GpsSettings
from vplog.run import back_end

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.benchmarks.worlds import World
    from vplog.data import Bools, Floats, PoseGraph

PROBABILITY = 0.99
"""A true closure passes the bounds of GNC with this probability: the default of GTSAM's GncOptimizer."""
LOOSE = np.array([1.0, 1.0, 1.0, 1e3, 1e3, 1e3])
"""rad and m: fixes on a straight road leave a turn about it open, and a session may be anywhere."""
ITERATIONS = 100
NEWTON_STEPS = 2
"""Of the oracle's shared errors, in which its cost is all but quadratic."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What a back end makes of a world."""

    poses: Floats
    """(N, 4, 4)."""
    kept: Bools
    """(L,) closures."""
    refusal: str = ""
    """Why it gave no answer; the odometry then stands in."""


def answers(world: World) -> dict[str, tuple[Answer, float]]:
    """The answer of every method, and the seconds that it took of the processor."""
    result = {}
    for name, method in METHODS.items():
        if name == "vplog optimize" and world.gps is not None:
            continue
        began = time.process_time()
        answer = method(world)
        result[name] = answer, time.process_time() - began
    return result


# --- vplog ----------------------------------------------------------------------------------------------------------


def vplog_run(world: World) -> Answer:
    """`vplog run --gps` from the verified closures on, by default."""
    settings = Pipeline(gps=GpsSettings(use=world.gps is not None))
    try:
        solved = back_end.solve(world.odometry, world.keyframes, world.closures, world.gps, settings)
    except VplogError as error:
        return replace(odometry(world), refusal=str(error))
    poses = solved.refined.solution.world_from_body
    if solved.refined.world_from_enu is not None:
        poses = world.world_from_enu() @ se3.inverse(solved.refined.world_from_enu) @ poses
    return Answer(poses, np.asarray(solved.closures.weight > 0.5, bool))


def vplog_optimize(world: World) -> Answer:
    """`vplog optimize` by default, of the graph with the noise as claimed."""
    graph = world.graph()
    solution = decided(graph, GncSettings()).solution
    return Answer(solution.world_from_body, np.asarray(solution.weight[is_loop(graph)] > 0.5, bool))


def vplog_method(kind: str) -> Callable[[World], Answer]:
    """A method of `vplog optimize --method` as published, without vplog's look at the odometry afterwards."""

    def solve(world: World) -> Answer:
        graph = replace(world.graph(), world_from_body=_placed(world))
        solution = TypeAdapter(OptimiserSettings).validate_python({"kind": kind})(graph)
        kept = np.asarray(solution.weight[is_loop(graph)] > 0.5, bool)
        if world.gps is None:
            return Answer(solution.world_from_body, kept)
        weighted = replace(graph, information=graph.information * np.maximum(solution.weight, 1e-9)[:, None, None])
        factors, values = _factors(world, weighted, solution.world_from_body, _cauchy(3))
        return Answer(_poses(_least_squares(factors, values)), kept)

    return solve


# --- GTSAM ----------------------------------------------------------------------------------------------------------


def odometry(world: World) -> Answer:
    """The odometry as it is, moved onto the fixes as one where there are any. Each session is placed on the earlier
    ones by one of the true closures."""
    poses = _placed(world, world.is_true)
    return Answer(poses if world.gps is None else _onto_fixes(world, poses), np.zeros(len(world.closures), bool))


def plain(world: World) -> Answer:
    """Levenberg-Marquardt on everything, from the odometry."""
    factors, values = _factors(world, world.graph(), _placed(world))
    return Answer(_poses(_least_squares(factors, values)), np.ones(len(world.closures), bool))


def gnc(world: World) -> Answer:
    """GTSAM's GncLMOptimizer with its own bound, the odometry known to be inliers."""
    graph = world.graph()
    factors, values = _factors(world, graph, _placed(world))
    priors = 1 + len(world.breaks)
    settings = gtsam.GncLMParams()
    settings.setKnownInliers([*range(priors), *(priors + np.flatnonzero(~is_loop(graph))).tolist()])
    optimiser = gtsam.GncLMOptimizer(factors, values, settings)
    optimiser.setInlierCostThresholdsAtProbability(PROBABILITY)
    poses = _poses(optimiser.optimize())
    weight = np.asarray(optimiser.getWeights())[priors : priors + len(graph.a)]
    return Answer(poses, np.asarray(weight[is_loop(graph)] > 0.5, bool))


def true_closures(world: World) -> Answer:
    """Levenberg-Marquardt from the truth on the true closures and sound fixes with the noise as claimed: what is lost
    by not knowing the noise."""
    graph = world.graph()
    edges = graph.odometry.copy()
    edges[~edges] = world.is_true
    graph = subgraph(graph, np.arange(len(world.truth)), np.flatnonzero(edges))
    factors, values = _factors(world, graph, world.truth, covariance=world.fix_claimed)
    return Answer(_poses(_least_squares(factors, values)), world.is_true)


def oracle(world: World) -> Answer:
    """Levenberg-Marquardt from the truth on the true closures and sound fixes, all with their true noise.

    The scale error of the odometry and the depth error of closures are noise that factors share: parameters whose
    sigma is what they are, and whose likeliest values are found around it.
    """
    parameters = world.parameters
    sigma = np.abs([parameters.scale_error, parameters.depth_error])
    shared = np.flatnonzero(sigma)

    def solve(unit: Floats) -> tuple[float, Floats]:
        """Half the chi-square with these shared errors, in sigma, and the poses."""
        errors = np.zeros(2)
        errors[shared] = unit * sigma[shared]
        graph = world.true_graph(*errors)
        factors, values = _factors(world, graph, world.truth, covariance=world.fix_covariance)
        found = _least_squares(factors, values)
        return factors.error(found) + 0.5 * float(unit @ unit), _poses(found)

    unit = np.zeros(len(shared))
    for _ in range(NEWTON_STEPS if len(shared) else 0):
        unit = np.clip(unit - _newton_step(lambda at: solve(at)[0], unit), -3.0, 3.0)
    return Answer(solve(unit)[1], world.is_true)


def _newton_step(cost: Callable[[Floats], float], at: Floats) -> Floats:
    """(K,) by differences half a sigma wide; the curve is 1 at least, which is the prior's."""
    size, width = len(at), 0.5
    side = width * np.eye(size)
    here, up, down = cost(at), [cost(at + one) for one in side], [cost(at - one) for one in side]
    gradient = (np.array(up) - down) / (2.0 * width)
    curve = np.diag(np.maximum((np.array(up) + down - 2.0 * here) / width**2, 1.0))
    if size == 2:
        mixed = (cost(at + side.sum(0)) - up[0] - up[1] + here) / width**2
        bound = 0.99 * float(np.sqrt(curve[0, 0] * curve[1, 1]))
        curve[0, 1] = curve[1, 0] = np.clip(mixed, -bound, bound)
    return np.asarray(np.linalg.solve(curve, gradient), np.float64)


def _factors(
    world: World, graph: PoseGraph, start: Floats, kernel: Any = None, covariance: Floats | None = None
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """A prior of each session, the edges and the fixes of a world, and where to start.

    With a `covariance` (F, 3, 3) of the fixes only the sound ones, and `start` is in the world's frame.
    """
    sound = np.ones(len(world.fix_row), bool) if covariance is None else world.fix_sound
    if covariance is None:
        covariance = world.fix_claimed
        start = start if world.gps is None else _onto_fixes(world, start)
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for row in [0, *(world.breaks + 1).tolist()]:
        sigma = LOOSE if row or world.gps is not None else np.full(6, 1e-6)
        factors.add(gtsam.PriorFactorPose3(row, gtsam.Pose3(start[row]), gtsam.noiseModel.Diagonal.Sigmas(sigma)))
    for a, b, measured, information in zip(graph.a, graph.b, graph.a_from_b, graph.information, strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(information)
        factors.add(gtsam.BetweenFactorPose3(int(a), int(b), gtsam.Pose3(measured), noise))
    for row, enu, spread in zip(world.fix_row[sound], world.fix_enu[sound], covariance[sound], strict=True):
        noise = gtsam.noiseModel.Gaussian.Covariance(spread)
        noise = noise if kernel is None else gtsam.noiseModel.Robust.Create(kernel, noise)
        factors.add(gtsam.GPSFactor(int(row), enu, noise))
    for row, pose in enumerate(start):
        values.insert(row, gtsam.Pose3(pose))
    return factors, values


def _cauchy(degrees: int) -> Any:
    return gtsam.noiseModel.mEstimator.Cauchy.Create(float(np.sqrt(chi2_quantile(PROBABILITY, degrees))))


def _least_squares(factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.Values:
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(ITERATIONS)
    settings.setRelativeErrorTol(1e-6)
    return gtsam.LevenbergMarquardtOptimizer(factors, values, settings).optimize()


def _poses(values: gtsam.Values) -> Floats:
    return np.array([values.atPose3(row).matrix() for row in range(values.size())])


def _placed(world: World, chosen: Bools | None = None) -> Floats:
    """Poses (N, 4, 4) of the odometry, with each session moved to where a closure to earlier sessions has it: of the
    `chosen` closures (default: all) the one whose place is closest to those of the others."""
    poses, session = world.keyframes.odom_from_body.copy(), world.session
    match, query = world.closures.match, world.closures.query
    for later in range(1, len(world.breaks) + 1):
        joins = (session[query] == later) & (session[match] < later) & (chosen if chosen is not None else True)
        if not joins.any():
            continue
        moved = poses[match[joins]] @ world.closures.match_from_query[joins] @ se3.inverse(poses[query[joins]])
        place = se3.transform(moved, poses[session == later, :3, 3].mean(0)[None])[:, 0]
        distance = np.linalg.norm(place[:, None] - place, axis=2).sum(1)
        poses[session == later] = moved[distance.argmin()] @ poses[session == later]
    return poses


def _onto_fixes(world: World, poses: Floats) -> Floats:
    """Poses (N, 4, 4) moved as one onto most of the fixes: rigid, weights of Cauchy's kernel."""
    points, fixes, moved = poses[world.fix_row, :3, 3], world.fix_enu, np.eye(4)
    weight = np.ones(len(fixes))
    for _ in range(10):
        moved = _aligned(points, fixes, weight / weight.sum())
        distance2 = ((se3.transform(moved, points) - fixes) ** 2).sum(1)
        weight = 1.0 / (1.0 + distance2 / max(float(np.median(distance2)), 1e-12))
    return moved @ poses


def _aligned(source: Floats, target: Floats, share: Floats) -> Floats:
    """(4, 4) that moves points (F, 3) onto others by weighted least squares: Umeyama 1991, eq. 40-43."""
    middle, target_middle = share @ source, share @ target
    spread = (share[:, None] * (target - target_middle)).T @ (source - middle)
    left, _, right = np.linalg.svd(spread)
    R = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    return se3.pose(R, target_middle - R @ middle)


METHODS: dict[str, Callable[[World], Answer]] = {
    "vplog run": vplog_run,
    "vplog optimize": vplog_optimize,
    "odometry": odometry,
    "LM (gtsam)": plain,
    "GNC (gtsam)": gnc,
    "Cauchy (vplog)": vplog_method("cauchy"),
    "DCS (vplog)": vplog_method("dcs"),
    "PCM (vplog)": vplog_method("pcm"),
    "true closures": true_closures,
    "oracle": oracle,
}
