"""A second generator of test drives, independent of `tests.benchmarks.worlds`, and back ends compared on its drives.

It shares no design with the first generator, and only the error's code, so a figure that agrees in both does not depend
on one of them.
Cars, robots, hand-held cameras and drones move in their own ways. Odometry has noise, bias and failures. True closures
are revisits in the same direction. False closures are mistakes, or matches of places that look alike.

Run with `python -m tests.benchmarks second [--drives N] [--seed S]`.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np
from scipy.ndimage import gaussian_filter1d

from tests.benchmarks.worlds import position_error
from vplog.data import Bools, EdgeKind, Floats, Ints, PoseGraph
from vplog.geometry import se3
from vplog.graph.consistency import chi2_quantile
from vplog.graph.gnc import GncSettings

if TYPE_CHECKING:
    from collections.abc import Sequence

DEGREE = np.pi / 180
CLAIM_FACTORS, CLAIM_SHARES = (1.0, 0.5, 3.0), (0.5, 0.25, 0.25)
"""Claimed over true standard deviation of odometry or closures, and how often each factor is drawn."""
EVENTS = ("slip", "short", "frozen", "swerve", "stall", "rough")
"""Failures of odometry: too long and too short steps, no motion, a sudden turn, wheels spinning on the spot, noise."""
FALSE_KINDS = ("mistake", "scattered", "facade", "repeat", "shift")
"""Kinds of false closures, which `_false_closures` describes."""
PROBABILITY = 0.99
"""Share of true closures below the bounds of GNC and Cauchy: the default of GTSAM's GncOptimizer."""
METHODS = ("odometry", "vplog", "LM (gtsam)", "GNC (gtsam)", "Cauchy (gtsam)", "DCS (gtsam)", "true closures")
MIN_GAP_KEYFRAMES = 15
"""Fewest keyframes between the two ends of a closure."""
KINDS = {
    "city car": (3, 3.0, 6.0, 6.0),
    "corridor robot": (2, 0.4, 1.0, 1.5),
    "race laps": (2, 1.0, 3.0, 3.0),
    "figure eight": (3, 1.0, 3.0, 3.0),
    "one loop": (3, 2.0, 5.0, 6.0),
    "field rows": (3, 0.8, 1.5, 2.0),
    "aisles": (2, 0.5, 1.0, 1.2),
    "storeys": (3, 0.6, 1.2, 1.5),
    "room scan": (3, 0.06, 0.12, 0.6),
    "drone orbit": (3, 1.0, 2.5, 4.0),
    "open road": (3, 3.0, 8.0, 6.0),
}
"""Dimension, least and greatest keyframe spacing in m, greatest distance in m between the ends of a true closure."""


@dataclass(frozen=True, eq=False)
class Drive:
    """A simulated drive: the true poses (N, 4, 4), the pose graph, and which of its closures are true (L,)."""

    kind: str
    truth: Floats
    graph: PoseGraph
    is_true: Bools


def draw_drive(index: int, seed: int) -> Drive:
    """Draw a drive. The kind follows from the index, everything else from the random numbers of seed and index."""
    rng = np.random.default_rng([seed, index])
    kind = list(KINDS)[index % len(KINDS)]
    dimension, least_spacing, greatest_spacing, radius = KINDS[kind]
    active = np.array([dimension == 3, dimension == 3, True, True, True, dimension == 3])
    spacing, count = rng.uniform(least_spacing, greatest_spacing), int(rng.integers(150, 801))
    truth, shift = _motion(kind, rng, count, spacing, dimension)
    tilt, sideways = rng.uniform(0.3, 1.0, 2)
    yaw_sigma, forward_sigma = _log_uniform(rng, 0.03, 0.3) * DEGREE, _log_uniform(rng, 0.005, 0.03) * spacing
    sigma = active * np.array([tilt, tilt, 1, 0, 0, 0]) * yaw_sigma
    sigma += active * np.array([0, 0, 0, 1, sideways, sideways]) * forward_sigma
    steps = _odometry(rng, truth, sigma, spacing)

    a, b, measured = _true_closures(rng, truth, radius, int(max(MIN_GAP_KEYFRAMES, 5 * radius / spacing)))
    share = 0.0 if rng.random() < 0.2 and len(a) else rng.uniform(0.05, 0.7)
    wanted = round(share / (1 - share) * (len(a) or count / 15))
    false_a, false_b, false_measured = _false_closures(rng, truth, radius, shift, active, wanted)
    is_true = np.arange(len(a) + len(false_a)) < len(a)
    closures = np.concatenate([measured, false_measured])
    closure_sigma = active * np.repeat(
        [_log_uniform(rng, 0.2, 1.5) * DEGREE, _log_uniform(rng, 0.01, 0.08) * radius], 3
    )
    sigmas = closure_sigma * np.exp(0.3 * rng.normal(size=(len(closures), 1)))
    closures = closures @ se3.exp(sigmas * rng.normal(size=sigmas.shape))
    claims = rng.choice(CLAIM_FACTORS, 2, p=CLAIM_SHARES)
    claimed = np.concatenate([np.tile(sigma * claims[0], (len(steps), 1)), sigmas * claims[1]])
    information = np.zeros((len(claimed), 6, 6))
    information[:, active, active] = claimed[:, active] ** -2.0
    odometry = [np.eye(4)]
    for step in steps:
        odometry.append(odometry[-1] @ step)
    ends = [np.concatenate([np.arange(count - 1), a, false_a]), np.concatenate([np.arange(1, count), b, false_b])]
    kinds = [EdgeKind.ODOMETRY] * len(steps) + [EdgeKind.LOOP] * len(closures)
    graph = PoseGraph(
        np.array(odometry), ends[0].astype(np.int32), ends[1].astype(np.int32), np.concatenate([steps, closures]),
        information, kinds, dimension,
    )  # fmt: skip
    return Drive(kind, truth, graph, is_true)


def _log_uniform(rng: np.random.Generator, least: float, greatest: float) -> float:
    return float(np.exp(rng.uniform(np.log(least), np.log(greatest))))


# --- Motion ---------------------------------------------------------------------------------------------------------


def _motion(
    kind: str, rng: np.random.Generator, count: int, spacing: float, dimension: int
) -> tuple[Floats, Floats | None]:
    """Return the true poses (count, 4, 4), and the shift (3,) in m between places that look alike, if there is one."""
    length, shift = 1.3 * count * spacing, None
    if kind == "room scan":
        at, yaw, pitch = (np.array([_wave(rng, count, 20) for _ in range(n)]).T for n in (3, 1, 1))
        return _poses(at * [2.0, 1.5, 0.3], 2.0 * yaw[:, 0], 0.3 * pitch[:, 0], 0.1 * _wave(rng, count, 10)), None
    if kind in ("city car", "corridor robot"):
        block = rng.uniform(60, 110) if kind == "city car" else rng.uniform(10, 20)
        corners = _street_walk(rng, length, block, 0.1 * block * (kind == "city car"))
    elif kind in ("race laps", "figure eight", "one loop", "drone orbit"):
        laps = 1.0 + rng.uniform(0.05, 0.2) if kind == "one loop" else rng.uniform(2, 6)
        corners = _laps(rng, kind, laps, count * spacing)
    elif kind == "storeys":
        shift = np.array([0, 0, rng.uniform(2.8, 4.0)])
        corners = _storeys(rng, length, shift[2])
    elif kind == "open road":
        heading = np.cumsum(rng.normal(0, 0.12, int(length / 20) + 2))
        heading = 0.7 * np.sin(heading)
        corners = np.cumsum(20 * np.array([np.cos(heading), np.sin(heading), 0 * heading]).T, axis=0)
        if rng.random() < 0.5:  # back on the other side of the road: never seen from the same direction
            middle = corners[: len(corners) // 2]
            corners = np.concatenate([middle, middle[::-1] + np.array([0, 4, 0])])
    else:
        pitch = rng.uniform(2.5, 4.0) if kind == "aisles" else rng.uniform(0.8, 1.8)
        shift = np.array([0, 2 * pitch, 0]) if kind == "aisles" else None
        corners = _rows(rng, length, pitch, rng.uniform(15, 40), int(rng.integers(6, 14)), kind == "aisles")
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.cumsum(spacing * rng.uniform(0.8, 1.2, count))
    at *= min(1.0, travelled[-1] / at[-1])
    points = np.array([np.interp(at, travelled, corners[:, axis]) for axis in range(3)]).T
    points = gaussian_filter1d(points, 1.2, axis=0, mode="nearest")
    aside = 0.1 * KINDS[kind][3]
    points[:, :2] += aside * np.array([_wave(rng, count, 15) for _ in range(2)]).T
    if dimension == 2:
        return _poses(points, _headings(points), np.zeros(count), np.zeros(count)), shift
    if kind not in ("storeys", "drone orbit"):  # hills, the same whenever they are passed
        for size in spacing * rng.uniform(40, 120, 3):
            points[:, 2] += 0.01 * size * np.sin(points[:, :2] @ rng.normal(size=2) / size + rng.uniform(0, 6))
    climb = np.gradient(points[:, 2]) / np.maximum(np.linalg.norm(np.gradient(points, axis=0), axis=1), 1e-9)
    bumps = rng.uniform(0.2, 1.5) * DEGREE * rng.normal(size=(2, count))
    yaw = _headings(points)
    if kind == "drone orbit":  # the camera looks at the middle
        yaw, climb = np.arctan2(-points[:, 1], -points[:, 0]), 0 * climb
    return _poses(points, yaw, bumps[0] - np.arcsin(climb), bumps[1]), shift


def _wave(rng: np.random.Generator, count: int, smooth: float) -> Floats:
    """Return a smooth random signal (count,) with standard deviation 1."""
    signal = gaussian_filter1d(rng.normal(size=count + int(8 * smooth)), smooth)[int(4 * smooth) :][:count]
    return np.asarray(signal * np.sqrt(2 * np.sqrt(np.pi) * smooth), np.float64)


def _headings(points: Floats) -> Floats:
    forward = np.gradient(points, axis=0)
    return np.asarray(np.arctan2(forward[:, 1], forward[:, 0]), np.float64)


def _poses(points: Floats, yaw: Floats, pitch: Floats, roll: Floats) -> Floats:
    about = [
        se3.so3_exp(angle[:, None] * axis) for angle, axis in zip((yaw, pitch, roll), np.eye(3)[::-1], strict=True)
    ]
    return se3.pose(about[0] @ about[1] @ about[2], points)


def _street_walk(rng: np.random.Generator, length: float, block: float, jitter: float) -> Floats:
    """Return crossings (P, 3) of a walk on a grid that prefers streets that it knows, and seldom turns back."""
    size, reuse = rng.integers(3, 6, 2), rng.uniform(0, 2)
    crossing = np.stack(np.meshgrid(*(np.arange(n) for n in size), [0.0], indexing="ij"), axis=-1)[:, :, 0] * block
    crossing[..., :2] += jitter * rng.normal(size=(*size, 2))
    at, before, visits = (0, 0), (-1, -1), dict[tuple[int, ...], float]()
    walk = [at]
    while len(walk) < 3 + length / block:
        ahead = [(at[0] + dx, at[1] + dy) for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1))]
        ahead = [to for to in ahead if 0 <= to[0] < size[0] and 0 <= to[1] < size[1]]
        weight = np.array([0.02 if to == before else 1 + reuse * visits.get((*at, *to), 0) for to in ahead])
        to = ahead[rng.choice(len(ahead), p=weight / weight.sum())]
        visits[*at, *to] = visits.get((*at, *to), 0) + 1
        before, at = at, to
        walk.append(at)
    return np.array([crossing[node] for node in walk])


def _laps(rng: np.random.Generator, kind: str, laps: float, length: float) -> Floats:
    angle = np.linspace(0, 2 * np.pi * laps, int(200 * laps))
    radius = 1 + sum(rng.uniform(0, 0.25 / n) * np.cos(n * angle + rng.uniform(0, 6)) for n in (2, 3, 5))
    curve = np.array([radius * np.cos(angle), radius * np.sin(angle), 0 * angle]).T
    if kind == "figure eight":
        curve[:, :2] = np.array([np.sin(angle), rng.uniform(0.5, 1) * np.sin(2 * angle)]).T
    curve *= length / np.linalg.norm(np.diff(curve, axis=0), axis=1).sum()
    if kind == "drone orbit":
        curve[:, 2] = rng.uniform(0.5, 2.5) * angle / (2 * np.pi)
    return curve


def _storeys(rng: np.random.Generator, length: float, height: float) -> Floats:
    """Return corners (P, 3) of rounds on each storey of a house, up by the stairs and down again."""
    wide, deep, top = rng.uniform(12, 30), rng.uniform(8, 15), int(rng.integers(2, 6))
    floor, up, corners = 0, 1, [[0.0, 0.0, 0.0]]
    while len(corners) * (wide + deep) / 5 < length:
        z = floor * height
        corners += [[wide, 0, z], [wide, deep, z], [0, deep, z], [0, 0, z]] * int(rng.integers(1, 3))
        up = 1 if floor == 0 else -1 if floor == top - 1 else up
        floor += up
        corners += [[-2, 0, z + up * height / 4], [-2, -2, z + up * height / 2], [0, -2, z + up * height * 0.75]]
        corners.append([0, 0, z + up * height])
    return np.array(corners)


def _rows(rng: np.random.Generator, length: float, pitch: float, long: float, rows: int, shuffled: bool) -> Floats:
    """Return ends (P, 3) of rows driven to and fro: one after the other and again, or as orders in a store demand."""
    corners, row = list[list[float]](), 0
    while len(corners) * long < 2 * length + 4 * long:
        ends = [-1.0, long + 1] if row % 2 == 0 else [long + 1, -1.0]
        corners += [[x, row * pitch, 0] for x in ends]
        row = 2 * int(rng.integers(rows // 2)) + 1 - row % 2 if shuffled else row + 1
        if row >= rows and not shuffled:
            corners += [[-4, rows * pitch, 0], [-4, 0, 0]]
            row = 0
    return np.array(corners)


# --- Measurements ---------------------------------------------------------------------------------------------------


def _odometry(rng: np.random.Generator, truth: Floats, sigma: Floats, spacing: float) -> Floats:
    """Return steps (N-1, 4, 4) with noise and, in many drives, wrong scale, yaw drift and failures."""
    steps = se3.between(truth[:-1], truth[1:])
    noise = sigma * rng.normal(size=(len(steps), 6))
    if rng.random() < 0.5:
        steps[:, :3, 3] *= 1 + 0.02 * rng.normal()
    if rng.random() < 0.5:
        noise[:, 2] += sigma[2] * 0.15 * (rng.normal() + _wave(rng, len(steps), 50))
    for event in rng.choice(EVENTS, rng.choice([0, 0, 0, 1, 1, 2, 3])):
        begin = int(rng.integers(10, len(steps) - 70))
        run, short = slice(begin, begin + int(rng.integers(20, 60))), slice(begin, begin + int(rng.integers(2, 9)))
        if event == "slip":
            steps[short, :3, 3] *= rng.uniform(1.2, 2.5)
        elif event == "short":
            steps[run, :3, 3] *= rng.uniform(0.4, 0.9)
        elif event == "frozen":
            steps[short], noise[short] = np.eye(4), 0
        elif event == "swerve":
            noise[begin, 2] += rng.choice([-1, 1]) * rng.uniform(5, 45) * DEGREE
        elif event == "stall":  # the wheels spin on the spot
            steps[begin, 0, 3] += rng.uniform(2, 6) * spacing
        else:
            noise[run] *= 4
    return steps @ se3.exp(noise)


def _true_closures(rng: np.random.Generator, truth: Floats, radius: float, gap: int) -> tuple[Ints, Ints, Floats]:
    """Return ends (L,), the earlier first, and relative poses of revisits in the same direction that are recognised."""
    distance = np.linalg.norm(truth[:, None, :3, 3] - truth[:, :3, 3], axis=2)
    a, b = np.nonzero(np.triu(distance < radius, gap))
    similar = se3.angle(se3.between(truth[a], truth[b])) < 35 * DEGREE
    looks = _wave(rng, len(truth), 4)[b] > rng.uniform(-1, 1)  # whether a stretch is recognised at all
    a, b = a[similar & looks], b[similar & looks]
    order = rng.permutation(len(a))
    _, first = np.unique(b[order], return_index=True)  # a match per keyframe
    chosen = rng.permutation(order[first])[: int(_log_uniform(rng, 6, len(truth) / 2))]
    return a[chosen], b[chosen], se3.between(truth[a[chosen]], truth[b[chosen]])


def _false_closures(
    rng: np.random.Generator, truth: Floats, radius: float, shift: Floats | None, active: Bools, wanted: int
) -> tuple[Ints, Ints, Floats]:
    """Return ends (L,) and relative poses of wrong matches: single ones, and groups that may agree with each other.

    A group takes the places around one keyframe for places elsewhere: of similar facades ("facade"), further along
    the same street ("repeat"), or on another floor or aisle ("shift"). "scattered" groups do not agree on a pose.
    """
    chosen = list[tuple[int, int, Floats]]()
    kinds = rng.choice(FALSE_KINDS[: 4 if shift is None else 5], int(rng.integers(1, 4)), replace=False)
    spread = active * np.repeat([8 * DEGREE, radius / 3], 3) * [1, 1, 1, 1, 1, 0.3]
    for attempt in range(200 * wanted):  # the path may have no places of the kinds drawn
        kind = str(rng.choice(kinds)) if attempt < 100 * wanted else "mistake"
        q, p = (int(row) for row in rng.integers(0, len(truth), 2))
        run = np.arange(q, min(q + int(rng.integers(3, 16)), len(truth)))
        moved = np.eye(4)
        if kind == "shift" and shift is not None:
            moved[:3, 3] = shift * rng.choice([-1, 1])
        elif kind == "repeat":
            moved[:3, 3] = truth[q, :3, 0] * rng.choice([-1, 1]) * rng.uniform(2, 6) * radius
        elif kind == "facade":
            moved = truth[p] @ se3.exp(spread * rng.normal(size=6)) @ se3.inverse(truth[q])
        for b in run[:1] if kind == "mistake" else run[rng.random(len(run)) < 0.8]:
            placed = moved @ truth[b]
            a = int(np.argmin(np.linalg.norm(truth[:, :3, 3] - placed[:3, 3], axis=1)))
            measured = se3.between(truth[a], placed)
            if kind in ("mistake", "scattered"):
                a = int(np.clip(p + b - q, 0, len(truth) - 1))
                measured = se3.exp(spread * rng.normal(size=6))
            elif np.linalg.norm(measured[:3, 3]) > radius or se3.angle(measured) > 35 * DEGREE:
                continue
            error = se3.between(measured, se3.between(truth[a], truth[b]))
            if abs(a - b) >= MIN_GAP_KEYFRAMES and np.linalg.norm(error[:3, 3]) > 2 * radius:
                chosen.append((min(a, b), max(a, b), measured if a < b else se3.inverse(measured)))
        if len(chosen) >= wanted:
            break
    chosen = chosen[:wanted]
    a, b = (np.array([row[end] for row in chosen], np.int64) for end in (0, 1))
    return a, b, np.array([row[2] for row in chosen]).reshape(-1, 4, 4)


# --- Back ends ------------------------------------------------------------------------------------------------------


def solve(drive: Drive, method: str) -> tuple[Floats, Bools]:
    """Return poses (N, 4, 4) and which closures are kept (L,).

    A closure is kept by a soft kernel if its chi-square is below the bound of GNC. Least squares keeps all.
    """
    graph, loops, knows = drive.graph, np.flatnonzero(~drive.graph.odometry), method == "true closures"
    if method == "odometry":
        return graph.world_from_body, np.zeros(len(loops), bool)
    if method == "vplog":
        solution = GncSettings().decided(graph).solution
        return solution.world_from_body, np.asarray(solution.weight[loops] > 0.5, bool)
    planar, axes = graph.dimension == 2, [3, 4, 2] if graph.dimension == 2 else [*range(6)]
    prior: Any = gtsam.PriorFactorPose2 if planar else gtsam.PriorFactorPose3
    between: Any = gtsam.BetweenFactorPose2 if planar else gtsam.BetweenFactorPose3
    bound, kernels = chi2_quantile(PROBABILITY, len(axes)), gtsam.noiseModel.mEstimator
    kernel = {"Cauchy (gtsam)": kernels.Cauchy.Create(bound**0.5), "DCS (gtsam)": kernels.DCS.Create(1.0)}.get(method)
    start, plain, factors = gtsam.Values(), gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    for row, pose in enumerate(drive.truth if knows else graph.world_from_body):
        start.insert(row, _gtsam_pose(pose, planar))
    tight = gtsam.noiseModel.Isotropic.Sigma(len(axes), 1e-6)
    factors.add(prior(0, start.atPose2(0) if planar else start.atPose3(0), tight))
    kept = drive.is_true if knows else np.ones(len(loops), bool)
    for edge in np.setdiff1d(np.arange(len(graph.a)), loops[~kept]).tolist():
        noise: Any = gtsam.noiseModel.Gaussian.Information(graph.information[edge][np.ix_(axes, axes)])
        ends = int(graph.a[edge]), int(graph.b[edge]), _gtsam_pose(graph.a_from_b[edge], planar)
        plain.add(between(*ends, noise))
        if kernel is not None and not graph.odometry[edge]:
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        factors.add(between(*ends, noise))
    if method == "GNC (gtsam)":
        settings = gtsam.GncLMParams()
        settings.setKnownInliers([0, *(1 + np.flatnonzero(graph.odometry)).tolist()])
        optimiser = gtsam.GncLMOptimizer(factors, start, settings)
        optimiser.setInlierCostThresholdsAtProbability(PROBABILITY)
        solved = optimiser.optimize()
        kept = np.asarray(np.asarray(optimiser.getWeights())[1 + loops] > 0.5, bool)
    else:
        settings = gtsam.LevenbergMarquardtParams()
        settings.setMaxIterations(100)
        settings.setRelativeErrorTol(1e-6)
        solved = gtsam.LevenbergMarquardtOptimizer(factors, start, settings).optimize()
        if kernel is not None:
            kept = np.array([2 * plain.at(edge).error(solved) < bound for edge in loops.tolist()], bool)
    if not planar:
        return np.array([solved.atPose3(row).matrix() for row in range(len(drive.truth))]), kept
    found = [solved.atPose2(row) for row in range(len(drive.truth))]
    values, zero = np.array([[pose.x(), pose.y(), 0, pose.theta()] for pose in found]), np.zeros(len(found))
    return _poses(values[:, :3], values[:, 3], zero, zero), kept


def _gtsam_pose(pose: Floats, planar: bool) -> Any:
    if planar:
        return gtsam.Pose2(pose[0, 3], pose[1, 3], float(np.arctan2(pose[1, 0], pose[0, 0])))
    return gtsam.Pose3(pose)


def main(arguments: Sequence[str]) -> int:
    """Solve drives by every method. Print a line per drive for vplog, then a table of the methods."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks second", description=__doc__)
    parser.add_argument("--drives", type=int, default=40, help="number of drives")
    parser.add_argument("--seed", type=int, default=1, help="seed of all random numbers")
    options = parser.parse_args(arguments)
    error, seconds, lost, kept_false = np.zeros((4, len(METHODS), options.drives))
    true, false, row = 0, 0, METHODS.index("vplog")
    for at in range(options.drives):
        drive = draw_drive(at, options.seed)
        for method, name in enumerate(METHODS):
            began = time.process_time()
            poses, kept = solve(drive, name)
            seconds[method, at] = time.process_time() - began
            error[method, at] = position_error(poses[:, :3, 3], drive.truth[:, :3, 3], align=True)
            lost[method, at], kept_false[method, at] = (drive.is_true & ~kept).sum(), (~drive.is_true & kept).sum()
        trues, falses = int(drive.is_true.sum()), int((~drive.is_true).sum())
        true, false = true + trues, false + falses
        print(
            f"{at:3} {drive.kind:<14} {len(drive.truth)} keyframes  lost {lost[row, at]:3.0f}/{trues:<3} "
            f"false kept {kept_false[row, at]:3.0f}/{falses:<3} "
            f"error over odometry {error[row, at] / error[0, at]:6.3f} "
            f"(true closures {error[-1, at] / error[0, at]:6.3f}, odometry {error[0, at]:.2f} m)",
            flush=True,
        )
    over = error / np.maximum(error[-1], 0.02 * error[0])
    print(f"{true} true and {false} false closures. Error: over that of least squares on the true closures alone.")
    print(f"{'':<15} worse than odometry  true lost  false kept  median error  95 % error  CPU s")
    for method, name in enumerate(METHODS):
        worse = (error[method] > 1.05 * error[0]).mean()
        shares = worse, lost[method].sum() / max(true, 1), kept_false[method].sum() / max(false, 1)
        print(
            f"{name:<15} {100 * shares[0]:17.1f} % {100 * shares[1]:8.1f} % {100 * shares[2]:9.1f} % "
            f"{np.median(over[method]):13.3f} {np.quantile(over[method], 0.95):11.3f} {np.median(seconds[method]):6.2f}"
        )
    return 0
