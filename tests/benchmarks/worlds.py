"""Random drives for back ends, by seed: odometry, closures and fixes with errors that are known, claimed as logs do.

Every parameter is drawn from its own generator, seeded by the world's seed and the parameter's name, so that none
depends on another and a new one changes no old one. Lengths are in m, angles in rad; (6,) and (6, 6) are rotation
first. `world(seed)` makes a world, `world.graph()` its pose graph with the noise that the log claims.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any
from zlib import crc32

import numpy as np

from vplog.data import Closures, EdgeKind, Gps, Keyframes, Odometry, PoseGraph, Verdict
from vplog.geometry import se3
from vplog.geometry.geodesy import geodetic, local_enu
from vplog.graph.noise import NoiseSettings, edge_covariance

if TYPE_CHECKING:
    from vplog.data import Bools, Floats, Ints

KINDS = ("road", "aisles", "room", "drone")
CLAIMS = ("right", "wrong", "constant", "missing")
FALSE = ("random", "grouped", "aliased", "family")
GPS = ("white", "correlated", "jumping")
RADIUS_M = {"road": 4.0, "aisles": 1.2, "room": 0.6, "drone": 6.0}
"""How far apart two views of one place may be."""
SIGMA_M = {"road": (0.03, 0.5), "aisles": (0.02, 0.2), "room": (0.005, 0.05), "drone": (0.05, 0.5)}
"""Noise of a closure's translation: what feature matching gets at the distances seen there."""
SPEED = {"road": 8.0, "aisles": 1.0, "room": 0.4, "drone": 4.0}
"""m/s, for the stamps."""
SCALES = {
    "road": (("stereo",), ("odometry",), ("stereo", "odometry")),
    "aisles": (("stereo",), ("odometry",), ("depth", "odometry")),
    "room": (("depth",), ("odometry",), ("depth", "odometry")),
    "drone": (("stereo",), ("odometry",), ("stereo", "odometry")),
}
"""Where the metres of closures come from."""
REACH_M = 100.0
"""Drift is stated over this length, or over the way where that is shorter (the KITTI benchmark's shortest)."""
FALSE_BEYOND = 5.0
"""Sigmas of a closure's translation by which a false one is off at least; and half of the radius."""
PLACES = 20
"""Pairs of places tried, of which the one that most of a drive agrees with is the one that looks alike."""
ELSEWHERE = 6.0
"""Tolerances between two places that look alike, where no next aisle says: three radii. The shift that most of a drive
agrees with would be the least one allowed otherwise."""
LEAST_SHARE = 0.02
"""Least error of an oracle as a share of the odometry's."""
FEWEST = 20
"""Keyframes that come back to a place; a drive with fewer is drawn again, some times."""
MOST_FALSE = 400
"""Closures, so that worlds stay fast."""
ORIGIN = (48.1, 11.5, 500.0)
"""Latitude and longitude in degrees and altitude in m of the world's frame, which is east-north-up there."""


@dataclass(frozen=True)
class Parameters:
    """What a world is made of."""

    seed: int
    kind: str
    layout: str
    spatial: bool
    """False: a plane but for small heights, rolls and pitches, all of them free in the graph."""
    keyframes: int
    drift: float
    """m per m over REACH_M; rotation and slowly wandering biases have their parts of it."""
    white_share: float
    """Of the drift's variance; the rest is a bias that wanders."""
    bias_length: float
    """Metres over which the bias keeps its sign."""
    turn: float
    """Rotation drift over REACH_M, as a multiple of `drift` in rad."""
    levelled: bool
    """Roll and pitch drift a tenth as much, as with an inertial unit."""
    scale_error: float
    """The odometry's metres are too long by this share."""
    claim: str
    claim_factor: float
    """Sigma claimed for the odometry to the true one; 1 unless the claim is `wrong`."""
    claim_turn_factor: float
    accumulated: bool
    """The covariance logged is that of the pose since the start; otherwise of each increment."""
    closures: int
    """Wanted; a drive that comes back less has fewer."""
    run: int
    """Most closures of neighbouring keyframes in a run."""
    sigma: float
    """m, of a closure's translation."""
    sigma_turn: float
    """rad, of its rotation."""
    common_share: float
    """Share of a closure's variance that is common to its run."""
    closure_factor: float
    """Sigma claimed for closures to the true one."""
    scales: tuple[str, ...]
    """Where their metres come from."""
    depth_error: float
    """Share by which closures of the first of `scales` are too long."""
    false_share: float
    """Share of all closures, as wanted."""
    false_kind: str
    """One of FALSE, or `none`."""
    no_true: bool
    """No closure is true."""
    gps: str
    """One of GPS, or `none`."""
    gps_every: float
    """m between fixes."""
    gps_sigma: float
    gps_length: float
    """Metres over which the error of correlated fixes is alike."""
    gps_factor: float
    """Sigma claimed to the true one."""

    @property
    def mistold(self) -> list[str]:
        """What the log claims wrongly or leaves out, or is systematic."""
        return [name for name, wrong in self._wrong().items() if wrong] or ["nothing"]

    def _wrong(self) -> dict[str, bool]:
        return {
            "odometry sigma too small": self.claim == "wrong" and min(self.claim_factor, self.claim_turn_factor) < 0.5,
            "odometry sigma too large": self.claim == "wrong" and max(self.claim_factor, self.claim_turn_factor) > 2.0,
            "odometry sigma constant": self.claim == "constant",
            "odometry sigma missing": self.claim == "missing",
            "odometry scale": self.scale_error != 0.0,
            "closure sigma too small": self.closure_factor < 0.7,
            "closure sigma too large": self.closure_factor > 1.4,
            "closure depth": self.depth_error != 0.0,
            "gps sigma too small": self.gps != "none" and self.gps_factor < 0.7,
            "gps sigma too large": self.gps != "none" and self.gps_factor > 1.4,
        }

    @property
    def falseness(self) -> str:
        """What kind of false closures there are."""
        return f"{self.false_kind}, none true" if self.no_true else self.false_kind

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


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
    odometry_covariance: Floats
    """(N-1, 6, 6) of each edge, true: white noise of the same growth as its wandering bias and its scale error."""
    odometry_claimed: Floats | None
    """(N-1, 6, 6) as the log has it, None where it has none."""
    closure_covariance: Floats
    """(L, 6, 6) true: of a run of n together as much as what they share and an n-th of what they do not."""
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

    def true_graph(self) -> PoseGraph:
        """The odometry and the true closures alone, with the true noise."""
        information = _inverse(self.closure_covariance)
        return self._graph(self.odometry_covariance, information, np.flatnonzero(self.is_true))

    def _graph(self, odometry: Floats, closures: Floats, rows: Ints) -> PoseGraph:
        poses, n = self.keyframes.odom_from_body, len(self.truth)
        return PoseGraph(
            poses,
            np.concatenate([np.arange(n - 1), self.closures.match[rows]]).astype(np.int32),
            np.concatenate([np.arange(1, n), self.closures.query[rows]]).astype(np.int32),
            np.concatenate([se3.between(poses[:-1], poses[1:]), self.closures.match_from_query[rows]]),
            np.concatenate([_inverse(odometry), closures[rows]]),
            [EdgeKind.ODOMETRY] * (n - 1) + [EdgeKind.LOOP] * len(rows),
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


# --- parameters -----------------------------------------------------------------------------------------------------


def draw(seed: int) -> Parameters:
    """The parameters of a world, each from a generator of its own."""

    def of(name: str) -> np.random.Generator:
        return np.random.default_rng([seed, crc32(name.encode())])

    def choice(name: str, values: Any, weights: Any = None) -> Any:
        return values[int(of(name).choice(len(values), p=weights))]

    def uniform(name: str, low: float, high: float) -> float:
        return float(of(name).uniform(low, high))

    def log_uniform(name: str, low: float, high: float) -> float:
        return float(np.exp(of(name).uniform(np.log(low), np.log(high))))

    def happens(name: str, probability: float) -> bool:
        return bool(of(name).random() < probability)

    kind = choice("kind", KINDS)
    claim = choice("claim", CLAIMS)
    no_true = happens("no_true", 0.06)
    false_kind = choice("false_kind", FALSE)
    false_share = 1.0 if no_true else uniform("false_share", 0.05, 0.6)
    if false_kind == "family" and not no_true:
        false_share = uniform("family_share", 0.5, 0.6)
    if happens("all_true", 0.25) and not no_true:
        false_kind, false_share = "none", 0.0
    if no_true and false_kind == "family":
        false_kind = "aliased"  # one family is all there is
    outside = kind in ("road", "drone")
    return Parameters(
        seed=seed,
        kind=kind,
        layout=choice("layout", {"road": ("loop", "blocks"), "drone": ("circuit", "sweep")}.get(kind, (kind,))),
        spatial=kind in ("room", "drone") or (kind == "road" and happens("spatial", 0.5)),
        keyframes=int(of("keyframes").integers(100, 601)),
        drift=log_uniform("drift", 0.002, 0.06),
        white_share=uniform("white_share", 0.0, 1.0),
        bias_length=log_uniform("bias_length", 0.05, 0.5),
        turn=log_uniform("turn", 0.2, 2.0),
        levelled=happens("levelled", 0.5),
        scale_error=uniform("scale_error", -0.05, 0.05) if happens("scaled", 0.3) else 0.0,
        claim=claim,
        claim_factor=log_uniform("claim_factor", 0.1, 10.0) if claim == "wrong" else 1.0,
        claim_turn_factor=log_uniform("claim_turn_factor", 0.1, 10.0) if claim == "wrong" else 1.0,
        accumulated=claim in ("right", "wrong") and happens("accumulated", 0.25),
        closures=int(log_uniform("closures", 30, 300)),
        run=int(of("run").integers(2, 16)),
        sigma=log_uniform("sigma", *SIGMA_M[kind]),
        sigma_turn=float(np.radians(log_uniform("sigma_turn", 0.1, 2.0))),
        common_share=uniform("common_share", 0.0, 0.8),
        closure_factor=log_uniform("closure_factor", 0.2, 5.0) if happens("closure_mistold", 0.5) else 1.0,
        scales=choice("scales", SCALES[kind]),
        depth_error=choice("depth_sign", (-1, 1)) * uniform("depth_error", 0.03, 0.15)
        if happens("depth", 0.3)
        else 0.0,
        false_share=false_share,
        false_kind=false_kind,
        no_true=no_true,
        gps=choice("gps_kind", GPS) if outside and happens("gps", 0.65) else "none",
        gps_every=log_uniform("gps_every", 2.0, 30.0),
        gps_sigma=log_uniform("gps_sigma", 0.1, 5.0),
        gps_length=uniform("gps_length", 10.0, 60.0),
        gps_factor=log_uniform("gps_factor", 0.2, 5.0) if happens("gps_mistold", 0.5) else 1.0,
    )


# --- the world ------------------------------------------------------------------------------------------------------


def world(seed: int) -> World:
    """The world of a seed, always the same."""
    return make(draw(seed))


def make(parameters: Parameters) -> World:
    """The world of some parameters; the seed among them decides all errors."""

    def random(what: str) -> np.random.Generator:
        return np.random.default_rng([parameters.seed, crc32(what.encode()), 1])

    truth, next_aisle = _drive(parameters, random("drive"))
    odom, covariance = _odometry(parameters, truth, random("odometry"))
    metres = _way(truth)
    stamps = 1_700_000_000_000_000_000 + (metres / SPEED[parameters.kind] * 1e9).astype(np.int64)
    stamps = stamps + 1_000_000 * np.arange(len(stamps))  # no two alike, whatever stands still
    pairs = _pairs(parameters, truth, next_aisle, random("pairs"))
    measured, marginal, closure_covariance, scale = _measured(parameters, truth, pairs, random("closures"))
    information = _inverse(marginal * parameters.closure_factor**2)
    claimed = _claimed(parameters, covariance, random("claim"))
    return World(
        parameters,
        truth,
        Odometry(stamps, odom, _logged(parameters, odom, claimed)),
        Keyframes(f"world {parameters.seed}", stamps, odom),
        _ledger(pairs, measured, information, scale),
        pairs.is_true,
        covariance + _scale_covariance(parameters, truth),
        claimed,
        closure_covariance,
        *_fixes(parameters, truth, stamps, random("gps")),
    )


def _way(truth: Floats) -> Floats:
    """(N,) metres travelled at each pose."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])


def _smooth(random: np.random.Generator, t: Floats, harmonics: int, first: float = 1.0) -> Floats:
    """A random smooth function of t (K,) of root mean square 1 or so: harmonics of frequency `first` on."""
    phase, size = random.uniform(0, 2 * np.pi, harmonics), random.uniform(0.3, 1.0, harmonics)
    frequency = first * (np.arange(harmonics) + 1.0) * random.uniform(0.8, 1.2, harmonics)
    waves = np.sin(2 * np.pi * frequency * t[:, None] + phase) * size
    return waves.sum(1) / np.sqrt((size**2).sum() / 2.0)


# --- where it goes --------------------------------------------------------------------------------------------------


def _drive(parameters: Parameters, random: np.random.Generator) -> tuple[Floats, Floats | None]:
    """True poses (N, 4, 4) that come back somewhere, and the shift (3,) that takes an aisle to the next one."""
    tries = [_tried(parameters, random)]
    while len(tries) < 10 and len(_revisits(parameters, tries[-1][0], np.eye(4))) < FEWEST:
        tries.append(_tried(parameters, random))
    return tries[-1]


def _tried(parameters: Parameters, random: np.random.Generator) -> tuple[Floats, Floats | None]:
    if parameters.kind == "room":
        return _hand_held(parameters, random), None
    shift = None
    if parameters.kind == "aisles":
        line, shift = _aisles(random)
    elif parameters.kind == "drone":
        line = _circuit(random) if parameters.layout == "circuit" else _sweep(random)
    else:
        line = _loop(random) if parameters.layout == "loop" else _blocks(random)
    points = _resampled(line, parameters, random)
    if parameters.kind != "drone":
        points[:, 2] = _ground(points, parameters.spatial, random)
    return _headed(points, parameters, random), shift


def _loop(random: np.random.Generator) -> Floats:
    """(K, 3) laps of a closed road of 200-1500 m, each a little beside the other."""
    laps, length = random.uniform(1.15, 3.0), random.uniform(200.0, 1500.0)
    t = np.linspace(0.0, laps, 4000)
    angle, radius = 2 * np.pi * t, np.ones(len(t))
    for k in range(2, 5):
        radius += random.uniform(0.0, 0.5 / k) * np.cos(k * angle + random.uniform(0, 2 * np.pi))
    circle = np.stack([radius * np.cos(angle), radius * np.sin(angle) * random.uniform(0.4, 1.0)], axis=1)
    lap = np.linalg.norm(np.diff(circle[t <= 1.0], axis=0), axis=1).sum()
    beside = 0.5 * _smooth(random, t, 6)
    circle = circle * length / lap * (1.0 + beside / length)[:, None]
    return np.concatenate([circle, np.zeros((len(t), 1))], axis=1)


def _blocks(random: np.random.Generator) -> Floats:
    """(K, 3) a drive of 600-3000 m over the crossings of a town, corners rounded."""
    side, across, length = random.uniform(40.0, 150.0), int(random.integers(3, 6)), random.uniform(600.0, 3000.0)
    steps, at, heading = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]]), np.array([0, 0]), 0
    corners = [at]
    while len(corners) * side < length:
        # straight on twice as often as either turn; never back
        turns = [turn for turn in (0, 0, 1, -1) if _within(at + steps[(heading + turn) % 4], across)]
        heading = (heading + turns[int(random.integers(len(turns)))]) % 4
        at = at + steps[heading]
        corners.append(at)
    line = _dense(np.array(corners, float) * side, 1.0)
    return np.concatenate([_rounded(line, 8), np.zeros((len(line), 1))], axis=1)


def _within(at: Any, across: int) -> bool:
    return bool((at >= 0).all() and (at < across).all())


def _aisles(random: np.random.Generator) -> tuple[Floats, Floats]:
    """(K, 3) up and down parallel aisles 3-8 m apart, first all of them, then some again; and the shift to the next."""
    count, apart, length = int(random.integers(4, 11)), random.uniform(3.0, 8.0), random.uniform(15.0, 50.0)
    again = random.integers(0, count, int(random.uniform(0.5, 2.0) * count))
    order, corners, end = [*range(count), *again.tolist()], [], 0.0
    for aisle in order:
        corners += [[end, aisle * apart], [length - end, aisle * apart]]
        end = length - end
    line = _rounded(_dense(np.array(corners), 0.1), 6)
    return np.concatenate([line, np.zeros((len(line), 1))], axis=1), np.array([0.0, apart, 0.0])


def _circuit(random: np.random.Generator) -> Floats:
    """(K, 3) rounds of a closed curve in the air, each 1-2 m beside the other."""
    laps = random.uniform(1.2, 3.0)
    t = np.linspace(0.0, laps, 4000)
    size = np.array([random.uniform(20.0, 150.0), random.uniform(20.0, 150.0), random.uniform(3.0, 20.0)])
    line = np.stack([np.cos(2 * np.pi * t), np.sin(2 * np.pi * t), np.zeros(len(t))], axis=1)
    for k in range(2, 4):
        line += random.uniform(-0.4, 0.4, 3) * np.cos(2 * np.pi * k * t[:, None] + random.uniform(0, 2 * np.pi, 3))
    beside = np.stack([_smooth(random, t, 5) for _ in range(3)], axis=1)
    return line * size + beside + [0.0, 0.0, 30.0]


def _sweep(random: np.random.Generator) -> Floats:
    """(K, 3) strips of a field flown one way, then across."""
    width, apart, climb = random.uniform(50.0, 200.0), random.uniform(10.0, 30.0), random.uniform(0.0, 5.0)
    across, corners, end = np.arange(0.0, width, apart), [], 0.0
    for at in across.tolist():
        corners += [[end, at, 30.0], [width - end, at, 30.0]]
        end = width - end
    for at in across[::-1].tolist():
        corners += [[at, end, 30.0 + climb], [at, width - end, 30.0 + climb]]
        end = width - end
    return _rounded(_dense(np.array(corners), 1.0), 6)


def _hand_held(parameters: Parameters, random: np.random.Generator) -> Floats:
    """(N, 4, 4) wandering about a room, looking around."""
    n = parameters.keyframes
    t = np.linspace(0.0, n / 80.0, n) + random.uniform(-0.2, 0.2, n) / 80.0
    size = np.array([random.uniform(0.8, 2.5), random.uniform(0.8, 2.5), random.uniform(0.1, 0.3)])
    points = np.stack([_smooth(random, t, 3, 0.4) for _ in range(3)], axis=1) * size
    yaw, pitch, roll = (_smooth(random, t, 3, 0.3) * spread for spread in (1.2, 0.25, 0.15))
    return se3.pose(_turned(yaw, pitch, roll), points)


def _dense(corners: Floats, step: float) -> Floats:
    """(K, d) a broken line at even steps."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    along = np.arange(0.0, at[-1], step)
    return np.stack([np.interp(along, at, axis) for axis in corners.T], axis=1)


def _rounded(line: Floats, half: int) -> Floats:
    """A running mean over as many points either side."""
    padded = np.pad(line, ((half, half), (0, 0)), mode="edge")
    total = np.cumsum(np.concatenate([np.zeros((1, line.shape[1])), padded]), axis=0)
    width = 2 * half + 1
    return (total[width:] - total[:-width]) / width


def _resampled(line: Floats, parameters: Parameters, random: np.random.Generator) -> Floats:
    """(N, 3) points along a line at uneven steps, no further apart than two views of one place may be, twice."""
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    n = int(np.clip(at[-1] / (2.0 * RADIUS_M[parameters.kind]), parameters.keyframes, 600))
    step = at[-1] / (n - 1)
    along = np.linspace(0.0, at[-1], n) + random.uniform(-0.2, 0.2, n) * step
    return np.stack([np.interp(along, at, axis) for axis in line.T], axis=1)


def _ground(points: Floats, spatial: bool, random: np.random.Generator) -> Floats:
    """(N,) heights of the ground: hills of some metres, or of some centimetres in a plane."""
    height, wave = (random.uniform(2.0, 15.0), 300.0) if spatial else (random.uniform(0.01, 0.1), 60.0)
    turn = random.uniform(0, 2 * np.pi, 4)
    x, y = points[:, 0] / wave, points[:, 1] / wave
    return height * (np.sin(2 * np.pi * x + turn[0]) * np.cos(2 * np.pi * y + turn[1]) + 0.3 * np.sin(4 * x + turn[2]))


def _headed(points: Floats, parameters: Parameters, random: np.random.Generator) -> Floats:
    """(N, 4, 4) looking along the way, give or take."""
    ahead = np.gradient(points, axis=0)
    yaw = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])) + random.normal(0.0, np.radians(1.0), len(points))
    if parameters.layout == "sweep":
        yaw = np.full(len(points), random.uniform(-np.pi, np.pi)) + random.normal(0.0, 0.05, len(points))
    pitch = -np.arctan2(ahead[:, 2], np.linalg.norm(ahead[:, :2], axis=1))
    t = np.linspace(0.0, 10.0, len(points))
    shake = np.radians(5.0 if parameters.kind == "drone" else 0.5)
    return se3.pose(_turned(yaw, pitch + shake * _smooth(random, t, 5), shake * _smooth(random, t, 5)), points)


def _turned(yaw: Floats, pitch: Floats, roll: Floats) -> Floats:
    """(N, 3, 3)."""
    x, y, z = np.eye(3)
    R = se3.so3_exp(yaw[:, None] * z) @ se3.so3_exp(pitch[:, None] * y) @ se3.so3_exp(roll[:, None] * x)
    return np.asarray(R, np.float64)


# --- odometry -------------------------------------------------------------------------------------------------------


def _odometry(parameters: Parameters, truth: Floats, random: np.random.Generator) -> tuple[Floats, Floats]:
    """Odometry (N, 4, 4) from the identity on, and the true covariance (N-1, 6, 6) of its edges without the scale."""
    step, metres = se3.between(truth[:-1], truth[1:]), np.diff(_way(truth))
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
    poses = np.tile(np.eye(4), (len(truth), 1, 1))
    for k in range(len(step)):
        poses[k + 1] = poses[k] @ measured[k]
    # what wanders over `half` metres grows as white noise does that is 2 half times its square, once it had the way
    variance = white**2 + bias**2 * min(2.0 * half, length)
    return poses, np.einsum("k,ij->kij", np.maximum(metres, 1e-6), np.diag(variance))


def _wandering(random: np.random.Generator, metres: Floats, length: float, size: int) -> Floats:
    """(K, size) a stationary process of variance 1 that keeps its value over `length` metres (Ornstein-Uhlenbeck)."""
    values = np.empty((len(metres), size))
    value = random.normal(size=size)
    for k, keeps in enumerate(np.exp(-metres / length).tolist()):
        value = keeps * value + np.sqrt(1.0 - keeps**2) * random.normal(size=size)
        values[k] = value
    return values


def _scale_covariance(parameters: Parameters, truth: Floats) -> Floats:
    """(N-1, 6, 6) white noise along the way that grows to as much as the scale error makes of the whole way."""
    step = se3.between(truth[:-1], truth[1:])[:, :3, 3]
    metres = np.linalg.norm(step, axis=1)
    result = np.zeros((len(step), 6, 6))
    along = step[:, :, None] * step[:, None, :] / np.maximum(metres, 1e-6)[:, None, None]
    result[:, 3:, 3:] = parameters.scale_error**2 * metres.sum() * along
    return result


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


# --- closures -------------------------------------------------------------------------------------------------------


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


def _pairs(parameters: Parameters, truth: Floats, shift: Floats | None, random: np.random.Generator) -> Pairs:
    """The closures in order of query, then match."""
    share, runs = parameters.false_share, _runs(_revisits(parameters, truth, np.eye(4)), parameters.run, random)
    true = _some(runs, round(parameters.closures * (1.0 - share)))
    # as many as their share of all is, where the drive comes back less often than was wanted, too
    count = parameters.closures if parameters.no_true else round(_count(true) * share / (1.0 - share))
    false = _false_runs(parameters, truth, shift, min(count, MOST_FALSE), random)
    if parameters.false_kind == "family" and not parameters.no_true:
        true = _some(true, max(int(_count([run for run, _ in false]) / random.uniform(1.05, 1.5)), 3))
    claims: dict[tuple[int, int], tuple[int, Floats, bool]] = {}
    runs = [*((run, np.eye(4), True) for run in true), *((run, D, False) for run, D in false)]
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


def _revisits(parameters: Parameters, truth: Floats, D: Floats, wider: float = 1.0) -> Ints:
    """(K, 2) of each query its nearest earlier keyframe that sees the same place, or would were the world displaced."""
    moved, metres = D @ truth, _way(truth)
    radius, rows = _radius(parameters, truth) * wider, np.arange(len(truth))
    here, there = truth[:, :3, 3] - truth[0, :3, 3], moved[:, :3, 3] - truth[0, :3, 3]
    gap = (here**2).sum(1)[:, None] + (there**2).sum(1) - 2.0 * here @ there.T
    # of the angle between two rotations, by the trace of one's transpose times the other
    cosine = (truth[:, :3, :3].reshape(-1, 9) @ moved[:, :3, :3].reshape(-1, 9).T - 1.0) / 2.0
    apart = (metres - metres[:, None] > 8.0 * radius) & (rows - rows[:, None] > 10)
    gap[~apart | (cosine < np.cos(np.radians(40.0)))] = np.inf
    best = gap.argmin(0)
    query = np.flatnonzero(gap[best, rows] < radius**2)
    return np.stack([best[query], query], axis=1)


def _radius(parameters: Parameters, truth: Floats) -> float:
    """m; at least so much that a drive along the same line sees its keyframes again."""
    return max(RADIUS_M[parameters.kind], 0.75 * _way(truth)[-1] / len(truth))


def _runs(pairs: Ints, most: int, random: np.random.Generator) -> list[Ints]:
    """The pairs in runs of neighbouring keyframes at both ends, cut to at most so many, in random order."""
    if not len(pairs):
        return []
    jumps = (np.diff(pairs[:, 1]) > 2) | (np.abs(np.diff(pairs[:, 0])) > 4)
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
    parameters: Parameters, truth: Floats, shift: Floats | None, count: int, random: np.random.Generator
) -> list[tuple[Ints, Floats]]:
    """Runs of pairs (K, 2), each with the displacement D (4, 4) that it claims, `count` pairs in all or fewer."""
    if parameters.false_kind == "none" or count <= 0:
        return []
    if parameters.false_kind in ("aliased", "family"):
        return _displaced(parameters, truth, shift, count, random)
    found: list[tuple[Ints, Floats]] = []
    left = count
    for _ in range(50 * count):
        if left <= 0:
            break
        a, b = np.sort(random.integers(0, len(truth), 2)).tolist()
        most = int(random.integers(4, 21)) if parameters.false_kind == "grouped" else 1
        size = min(most, left, b - a - 10, len(truth) - b)
        if size < 1:
            continue
        D = _claimed_displacement(parameters, truth, a, b, random)
        run = np.stack([a + np.arange(size), b + np.arange(size)], axis=1)
        run = run[_is_false(parameters, truth, run, D) & _looks_near(parameters, truth, run, D)]
        if len(run):
            found.append((run, D))
            left -= len(run)
    return found


def _claimed_displacement(parameters: Parameters, truth: Floats, a: int, b: int, random: np.random.Generator) -> Floats:
    """D (4, 4) by which keyframe b looks as if it were at a, give or take what two views of one place may differ."""
    near = random.normal(size=6) * ([0.02, 0.02, 0.2, *[_radius(parameters, truth) / 3.0] * 3])
    if not parameters.spatial:
        near[5] *= 0.05
    return truth[a] @ se3.exp(near) @ se3.inverse(truth[b])


def _displaced(
    parameters: Parameters, truth: Floats, shift: Floats | None, count: int, random: np.random.Generator
) -> list[tuple[Ints, Floats]]:
    """Pairs that one D explains, the same for all: the next aisle, or the place of two that are most alike."""
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
        pairs = _revisits(parameters, truth, D, 2.0)
        pairs = pairs[_is_false(parameters, truth, pairs, D, 1.0 if shift is not None else ELSEWHERE)]
        if len(pairs) > len(best):
            best, chosen = pairs, D
    return [(run, chosen) for run in _some(_runs(best, parameters.run, random), count)]


def _is_false(parameters: Parameters, truth: Floats, pairs: Ints, D: Floats, times: float = 1.0) -> Bools:
    """(K,) whether a claim is further from the truth than its tolerance, or some times that."""
    claimed = se3.between(truth[pairs[:, 0]], D @ truth[pairs[:, 1]])
    error = claimed[:, :3, 3] - se3.between(truth[pairs[:, 0]], truth[pairs[:, 1]])[:, :3, 3]
    return np.asarray(np.linalg.norm(error, axis=1) > times * tolerance_m(parameters, truth))


def tolerance_m(parameters: Parameters, truth: Floats) -> float:
    """How far a closure may be off and still be true: 5 sigma, the largest that is drawn, and half a place's radius."""
    return max(FALSE_BEYOND * 2.0 * parameters.sigma, 0.5 * _radius(parameters, truth))


def _looks_near(parameters: Parameters, truth: Floats, pairs: Ints, D: Floats) -> Bools:
    """(K,) whether the claim is one of two views of one place."""
    claimed = se3.between(truth[pairs[:, 0]], D @ truth[pairs[:, 1]])
    return np.asarray(np.linalg.norm(claimed[:, :3, 3], axis=1) < 3.0 * _radius(parameters, truth))


def _marginal(parameters: Parameters, count: int, random: np.random.Generator) -> Floats:
    """(L, 6, 6) true covariance of each closure by itself: of half to twice the drawn sigma."""
    size = np.exp(random.uniform(np.log(0.5), np.log(2.0), count))
    sigma = size[:, None] * np.array([*[parameters.sigma_turn] * 3, *[parameters.sigma] * 3])
    return np.asarray(sigma[:, :, None] ** 2 * np.eye(6), np.float64)


def _measured(
    parameters: Parameters, truth: Floats, pairs: Pairs, random: np.random.Generator
) -> tuple[Floats, Floats, Floats, list[str]]:
    """match_from_query (L, 4, 4), its covariance (L, 6, 6) by itself and as in World, and where its metres are from."""
    count, run = len(pairs.run), pairs.run
    marginal = _marginal(parameters, count, random)
    measured = se3.between(truth[pairs.match], pairs.displaced @ truth[pairs.query])
    share, runs = parameters.common_share, int(run.max(initial=-1)) + 1
    common, own = random.normal(size=(runs, 6))[run], random.normal(size=(count, 6))
    source = random.integers(0, len(parameters.scales), runs)[run]
    scale = [parameters.scales[one] for one in source.tolist()]
    stretch = np.where(source == 0, 1.0 + parameters.depth_error, 1.0)
    stretch[[one == "odometry" for one in scale]] *= 1.0 + parameters.scale_error
    off = (stretch - 1.0)[:, None] * measured[:, :3, 3]
    measured[:, :3, 3] *= stretch[:, None]
    sigma = np.sqrt(np.diagonal(marginal, axis1=1, axis2=2))
    measured = measured @ se3.exp(sigma * (np.sqrt(share) * common + np.sqrt(1.0 - share) * own))
    size = np.bincount(run, minlength=runs)[run].astype(float)
    covariance = marginal * (size * share + 1.0 - share)[:, None, None]
    covariance[:, 3:, 3:] += (size * (off**2).sum(1))[:, None, None] * np.eye(3) / 3.0
    return measured, marginal, covariance, scale


def _ledger(pairs: Pairs, measured: Floats, information: Floats, scale: list[str]) -> Closures:
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
        residual_before=unknown,
        residual_after=unknown,
        weight=unknown,
    )


# --- fixes ----------------------------------------------------------------------------------------------------------


def _fixes(
    parameters: Parameters, truth: Floats, stamps: Ints, random: np.random.Generator
) -> tuple[Gps | None, Ints, Floats, Floats, Floats, Bools]:
    """The log's GPS, and rows, positions, true and claimed covariance, and whether sound, of its fixes."""
    metres = _way(truth)
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
