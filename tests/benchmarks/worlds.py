"""Random drives for back ends, by seed: odometry, closures and fixes with errors that are known, claimed as logs do.

Every parameter is drawn from its own generator, seeded by the world's seed and the parameter's name, so that none
depends on another and a new one changes no old one. Lengths are in m, angles in rad; (6,) and (6, 6) are rotation
first. `world(seed)` makes a world, `world.graph()` its pose graph with the noise that the log claims.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from tests.benchmarks.world_closures import draw_pairs, ledger, measure
from tests.benchmarks.world_drives import Drive, drive, way
from tests.benchmarks.world_parameters import Parameters, draw
from vplog.data import EdgeKind, Gps, Keyframes, Odometry, PoseGraph
from vplog.geometry import se3
from vplog.geometry.geodesy import geodetic, local_enu
from vplog.graph.noise import NoiseSettings, edge_covariance

if TYPE_CHECKING:
    from vplog.data import Bools, Closures, Floats, Ints

__all__ = ["Parameters", "Score", "World", "draw", "make", "over_oracle", "position_error", "score", "world"]

SPEED = {"road": 8.0, "aisles": 1.0, "room": 0.4, "drone": 4.0}
"""m/s, for the stamps."""
REACH_M = 100.0
"""Drift is stated over this length, or over the way where that is shorter (the KITTI benchmark's shortest)."""
LEAST_SHARE = 0.02
"""Least error of an oracle as a share of the odometry's."""
PAUSE_NS = 60_000_000_000
"""Between two sessions."""
ORIGIN = (48.1, 11.5, 500.0)
"""Latitude and longitude in degrees and altitude in m of the world's frame, which is east-north-up there."""


@dataclass(frozen=True, eq=False)
class World:
    """A drive and what is true of it. L closures, F fixes."""

    parameters: Parameters
    truth: Floats
    """(N, 4, 4) in the world's frame, east-north-up."""
    odometry: Odometry
    keyframes: Keyframes
    closures: Closures
    is_true: Bools
    """(L,)."""
    breaks: Ints
    """Rows of `odometry_covariance` that join two sessions. The odometry does not measure these."""
    is_wrong: Bools
    """(N-1,) True for the odometry edges in which the robot is stalled or the odometry is frozen."""
    odometry_covariance: Floats
    """(N-1, 6, 6) of each edge, true: white noise of the same growth as its wandering bias, and as the errors of a
    stretch of wrong edges. The scale is beside."""
    odometry_claimed: Floats | None
    """(N-1, 6, 6) as the log has it, None where it has none."""
    closure_covariance: Floats
    """(L, 6, 6) true: of a run of n together as much as what they share and an n-th of what they do not."""
    by_depth: Bools
    """(L,) those whose metres are too long by `depth_error`."""
    gps: Gps | None
    fix_row: Ints
    """(F,) keyframe of each fix; empty without GPS."""
    fix_enu: Floats
    """(F, 3) in the world's frame, as measured."""
    fix_covariance: Floats
    """(F, 3, 3) true: white noise of the same power where errors are correlated."""
    fix_claimed: Floats
    """(F, 3, 3) as the log has it."""
    fix_sound: Bools
    """(F,) False for those of a jump."""

    def graph(self) -> PoseGraph:
        """The odometry and all closures with the noise that the log claims, or vplog's drift model without a claim."""
        claimed = self.odometry_claimed
        if claimed is None:
            claimed, _, _ = edge_covariance(self.odometry, self.keyframes.stamp_ns, NoiseSettings())
        return self._graph(claimed, self.closures.information, np.arange(len(self.closures)))

    @property
    def session(self) -> Ints:
        """(N,) number of the session that each keyframe belongs to."""
        return np.searchsorted(self.breaks, np.arange(len(self.truth)))

    def true_graph(self, odometry_long: float = 0.0, depth_long: float = 0.0) -> PoseGraph:
        """The odometry and the true closures alone, with the true noise, and metres that are too long by these shares
        made right, noise and all."""
        graph = self._graph(self.odometry_covariance, _inverse(self.closure_covariance), np.flatnonzero(self.is_true))
        by_odometry = np.array([scale == "odometry" for scale in self.closures.scale], bool)[self.is_true]
        length = np.full(len(graph.a), 1.0 + odometry_long)
        length[~graph.odometry] = np.where(by_odometry, 1.0 + odometry_long, 1.0)
        length[~graph.odometry] *= np.where(self.by_depth[self.is_true], 1.0 + depth_long, 1.0)
        graph.a_from_b[:, :3, 3] /= length[:, None]
        graph.information[:, 3:] *= length[:, None, None]
        graph.information[:, :, 3:] *= length[:, None, None]
        return graph

    def _graph(self, odometry: Floats, closures: Floats, rows: Ints) -> PoseGraph:
        poses, edges = self.keyframes.odom_from_body, np.delete(np.arange(len(self.truth) - 1), self.breaks)
        return PoseGraph(
            poses,
            np.concatenate([edges, self.closures.match[rows]]).astype(np.int32),
            np.concatenate([edges + 1, self.closures.query[rows]]).astype(np.int32),
            np.concatenate([se3.between(poses[edges], poses[edges + 1]), self.closures.match_from_query[rows]]),
            np.concatenate([_inverse(odometry[edges]), closures[rows]]),
            [EdgeKind.ODOMETRY] * len(edges) + [EdgeKind.LOOP] * len(rows),
        )

    def world_from_enu(self) -> Floats:
        """(4, 4) from the plane of the log's first fix, which is vplog's frame, to the world's."""
        assert self.gps is not None
        there = local_enu(self.gps)
        axes = np.concatenate([np.zeros((1, 3)), 100.0 * np.eye(3)])
        latitude, longitude, altitude = np.concatenate([[ORIGIN], geodetic(axes, there.origin)]).T
        unknown = np.full((len(latitude), 3, 3), np.nan)
        here = local_enu(Gps(np.arange(len(latitude)), latitude, longitude, altitude, unknown)).enu_m[1:]
        return se3.umeyama(axes, here)[0]


def _inverse(matrices: Floats) -> Floats:
    return np.asarray(np.linalg.inv(matrices), np.float64)


@dataclass(frozen=True)
class Score:
    """What a method made of a world."""

    error_m: float
    """Root mean square distance of positions; after rigid alignment, or as they are where there is GPS."""
    true_lost: int
    false_kept: int


def score(world: World, poses: Floats, kept: Bools) -> Score:
    """Score of poses (N, 4, 4), in the world's frame where it has GPS, and of the closures (L,) kept."""
    lost, wrong = int((world.is_true & ~kept).sum()), int((~world.is_true & kept).sum())
    return Score(position_error(poses[:, :3, 3], world.truth[:, :3, 3], world.gps is None), lost, wrong)


def position_error(points: Floats, truth: Floats, align: bool) -> float:
    """Root mean square distance of points (N, 3) in m, after the best rigid motion (evo's `ape -a`) where `align`."""
    if align:
        points = se3.transform(se3.umeyama(points, truth)[0], points)
    return float(np.sqrt(((points - truth) ** 2).sum(1).mean()))


def over_oracle(error_m: float, oracle_m: float, odometry_m: float) -> float:
    """An error as a multiple of the oracle's, which is taken to be 2 % of the odometry's at least: below that it is
    luck, and nobody's loss."""
    return error_m / max(oracle_m, LEAST_SHARE * odometry_m, 1e-9)


def world(seed: int, stratum: str | None = None) -> World:
    """The world of a seed (of the given stratum if there is one), always the same."""
    return make(draw(seed, stratum))


def make(parameters: Parameters) -> World:
    """The world of some parameters; the seed among them decides all errors."""

    def random(what: str) -> np.random.Generator:
        return np.random.default_rng([parameters.seed, crc32(what.encode()), 1])

    made = drive(parameters, random("drive"))
    truth = made.truth
    odom, expected, covariance = _odometry(parameters, made, random("odometry"))
    stamps = 1_700_000_000_000_000_000 + (made.metres / SPEED[parameters.kind] * 1e9).astype(np.int64)
    stamps = (
        stamps + 1_000_000 * np.arange(len(stamps)) + PAUSE_NS * made.session
    )  # no two alike, whatever stands still
    pairs = draw_pairs(parameters, made, random("pairs"))
    measured, marginal, closure_covariance, scale, by_depth = measure(parameters, truth, pairs, random("closures"))
    information = _inverse(marginal * parameters.closure_factor**2)
    claimed = _claimed(parameters, expected, random("claim"))
    return World(
        parameters,
        truth,
        Odometry(stamps, odom, _logged(parameters, odom, claimed), breaks=made.breaks + 1),
        Keyframes(f"world {parameters.seed}", stamps, odom),
        ledger(pairs, measured, information, scale),
        pairs.is_true,
        made.breaks,
        made.is_wrong,
        covariance,
        claimed,
        closure_covariance,
        by_depth,
        *_fixes(parameters, truth, stamps, random("gps")),
    )


# --- odometry ------------------------------------------------------------------------------------------------------


def _odometry(parameters: Parameters, made: Drive, random: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Odometry (N, 4, 4) from the identity on, and two covariances (N-1, 6, 6) of its edges without the scale: what it
    would be if no edge was wrong, and the true one."""
    step, metres = made.step, np.diff(made.metres)
    length = float(metres.sum())
    reach, half = min(REACH_M, length), parameters.bias_length * min(5.0 * REACH_M, length)
    # sigma per axis over the reach, in rad and m; a third of the variance is each axis's
    over = parameters.drift / np.sqrt(3.0) * np.array([*[parameters.turn] * 3, *[reach] * 3])
    if not parameters.spatial:
        over = over * [0.1, 0.1, 1.0, 1.0, 1.0, 0.1]
    elif parameters.levelled:
        over = over * [0.1, 0.1, 1.0, 1.0, 1.0, 1.0]
    white = over * np.sqrt(parameters.white_share / reach)  # per root of a metre
    bias = over * np.sqrt(1.0 - parameters.white_share) / reach  # per metre
    error = random.normal(size=(len(step), 6)) * white * np.sqrt(metres)[:, None]
    error += _wandering(random, metres, half, 6) * bias * metres[:, None]
    measured = np.array(step)
    measured[:, :3, 3] *= 1.0 + parameters.scale_error
    measured = measured @ se3.exp(error)
    measured[(step == np.eye(4)).all((1, 2))] = np.eye(4)  # frozen, or the pose is held until the next session
    poses = np.tile(np.eye(4), (len(made.truth), 1, 1))
    for k in range(len(step)):
        poses[k + 1] = poses[k] @ measured[k]
    # what wanders over `half` metres grows as white noise does that is 2 half times its square, once it had the way
    variance = white**2 + bias**2 * min(2.0 * half, length)
    covariance = np.einsum("k,ij->kij", np.maximum(metres, 1e-6), np.diag(variance))
    return poses, covariance, covariance + _of_wrong_edges(made)


def _of_wrong_edges(made: Drive) -> Floats:
    """(N-1, 6, 6) covariance of the errors of wrong edges. A stretch of n edges has the mean square of its errors on
    each axis, times n, because the errors add up."""
    error = se3.log(se3.between(se3.between(made.truth[:-1], made.truth[1:]), made.step))
    variance = np.zeros(error.shape)
    rows = np.flatnonzero(made.is_wrong)
    for stretch in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        variance[stretch] = (error[stretch] ** 2).sum(0)
    return np.einsum("ki,ij->kij", variance, np.eye(6))


def _wandering(random: np.random.Generator, metres: Floats, length: float, size: int) -> Floats:
    """(K, size) a stationary process of variance 1 that keeps its value over `length` metres (Ornstein-Uhlenbeck)."""
    values = np.empty((len(metres), size))
    value = random.normal(size=size)
    for k, keeps in enumerate(np.exp(-metres / length).tolist()):
        value = keeps * value + np.sqrt(1.0 - keeps**2) * random.normal(size=size)
        values[k] = value
    return values


def _claimed(parameters: Parameters, covariance: Floats, random: np.random.Generator) -> Floats | None:
    """(N-1, 6, 6) of each edge as the log has it, None where it has none."""
    if parameters.claim == "missing":
        return None
    if parameters.claim == "constant":
        turn, shift = np.exp(random.uniform(np.log([1e-4, 1e-3]), np.log([0.05, 0.5])))
        return np.tile(np.diag([turn**2] * 3 + [shift**2] * 3), (len(covariance), 1, 1))
    factor = np.array([parameters.claim_turn_factor] * 3 + [parameters.claim_factor] * 3)
    return np.asarray(covariance * np.outer(factor, factor), np.float64)


def _logged(parameters: Parameters, odom: Floats, claimed: Floats | None) -> Floats | None:
    """(N, 6, 6) of the samples, which are the keyframes: of each increment, or of the pose since the start."""
    if claimed is None or not parameters.accumulated:
        return None if claimed is None else np.concatenate([claimed[:1], claimed])
    total = [np.diag([1e-12] * 6)]
    for moved, added in zip(se3.adjoint(se3.between(odom[1:], odom[:-1])), claimed, strict=True):
        total.append(moved @ total[-1] @ moved.T + added)
    return np.array(total)


# --- fixes ---------------------------------------------------------------------------------------------------------


def _fixes(
    parameters: Parameters, truth: Floats, stamps: Ints, random: np.random.Generator
) -> tuple[Gps | None, Ints, Floats, Floats, Floats, Bools]:
    """The log's GPS, and rows, positions, true and claimed covariance, and whether sound, of its fixes."""
    metres = way(truth)
    row = np.unique(np.searchsorted(metres, np.arange(0.0, metres[-1], parameters.gps_every)))
    if parameters.gps == "none" or len(row) < 3:
        row = np.zeros(0, np.int64)
        return None, row, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros(0, bool)
    sigma = parameters.gps_sigma * np.array([1.0, 1.0, 2.0])
    gaps = np.diff(metres[row], prepend=0.0)
    error, power = random.normal(size=(len(row), 3)), 1.0
    if parameters.gps == "correlated":
        share = 0.9  # of the variance; the rest is white
        wandering = _wandering(random, gaps, parameters.gps_length, 3)
        error = np.sqrt(share) * wandering + np.sqrt(1.0 - share) * error
        power = 1.0 - share + share * max(2.0 * parameters.gps_length / float(gaps[1:].mean()), 1.0)
    enu, sound = truth[row, :3, 3] + error * sigma, np.ones(len(row), bool)
    if parameters.gps == "jumping":
        for _ in range(int(random.integers(1, 5))):
            start, size = int(random.integers(len(row))), int(random.integers(2, max(len(row) // 10, 2) + 1))
            jump = random.normal(size=3) * [1.0, 1.0, 0.5]
            enu[start : start + size] += jump / np.linalg.norm(jump) * random.uniform(10.0, 60.0)
            sound[start : start + size] = False
    true = np.tile(np.diag(sigma**2), (len(row), 1, 1))
    claimed = true * parameters.gps_factor**2
    latitude, longitude, altitude = geodetic(enu, ORIGIN).T
    gps = Gps(stamps[row], latitude, longitude, altitude, claimed, np.zeros(3))
    return gps, row, enu, true * power, claimed, sound
