"""Parameters of random worlds for back ends. Each parameter is drawn from a generator of its own, by seed and name."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any
from zlib import crc32

import numpy as np

STRATA = ("plain", "spaced", "late", "sessions", "isolated", "stalled", "frozen")
"""How a world differs from runs of neighbouring closures in one drive with working odometry (`plain`).

- `spaced`: the front end looks for closures only at every k-th keyframe, k from 1 to 30.
- `late`: the robot drives one lap, and at the end the first part of the lap again. All true closures join the end to
  the beginning, so they share one displacement: the drift of the lap.
- `sessions`: two to four sessions, which only closures join.
- `isolated`: a closure at most every 31 to 80 keyframes.
- `stalled`: the robot stands still for a while, but its odometry reports the commanded motion.
- `frozen`: the robot moves for a while, but its odometry reports none.
"""
PLAIN_SHARE = 0.5
"""Share of the worlds that are plain. The other strata are equally frequent."""
SPACINGS = {"spaced": (1, 30), "late": (1, 10), "sessions": (1, 10), "isolated": (31, 80)}
"""Smallest and largest number of keyframes between two that the front end looks for closures at. Elsewhere it is 1."""
QUERIES = 12
"""Keyframes that the front end looks for closures at, at least, unless a drive of 600 keyframes has fewer."""
KINDS = ("road", "aisles", "room", "drone")
CLAIMS = ("right", "wrong", "constant", "missing")
FALSE = ("random", "grouped", "aliased", "family")
GPS = ("white", "correlated", "jumping")
SIGMA_M = {"road": (0.03, 0.5), "aisles": (0.02, 0.2), "room": (0.005, 0.05), "drone": (0.05, 0.5)}
"""Noise of a closure's translation: what feature matching gets at the distances seen there."""
SCALES = {
    "road": (("stereo",), ("odometry",), ("stereo", "odometry")),
    "aisles": (("stereo",), ("odometry",), ("depth", "odometry")),
    "room": (("depth",), ("odometry",), ("depth", "odometry")),
    "drone": (("stereo",), ("odometry",), ("stereo", "odometry")),
}
"""Where the metres of closures come from."""


@dataclass(frozen=True)
class Parameters:
    """What a world is made of."""

    seed: int
    kind: str
    layout: str
    stratum: str
    """One of STRATA."""
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
    spacing: int
    """The query of each closure is a multiple of this number of keyframes."""
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


def draw(seed: int, stratum: str | None = None) -> Parameters:
    """Draw the parameters of a world, of the given stratum if there is one."""

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
    others = (1.0 - PLAIN_SHARE) / (len(STRATA) - 1)
    stratum = stratum or choice("stratum", STRATA, [PLAIN_SHARE, *[others] * (len(STRATA) - 1)])
    no_true = happens("no_true", 0.06) and stratum != "sessions"  # nothing would join them
    false_kind = choice("false_kind", FALSE)
    most_false = 0.6
    if false_kind in ("aliased", "family") and stratum not in ("plain", "spaced"):
        # true closures share displacements, too, or are few: if false ones were the majority, nobody could tell
        false_kind, most_false = "aliased", 0.4
    false_share = 1.0 if no_true else uniform("false_share", 0.05, most_false)
    if false_kind == "family" and not no_true:
        false_share = uniform("family_share", 0.5, 0.6)
    if happens("all_true", 0.25) and not no_true:
        false_kind, false_share = "none", 0.0
    if no_true and false_kind == "family":
        false_kind = "aliased"  # one family is all there is
    outside = kind in ("road", "drone")
    layouts = {"road": ("loop", "blocks"), "drone": ("circuit", "sweep")}.get(kind, (kind,))
    closest, furthest = SPACINGS.get(stratum, (1, 1))
    spacing = int(log_uniform("spacing", closest, furthest + 1)) if furthest > 1 else 1
    least = min(QUERIES * spacing, 600) if stratum != "sessions" else 200  # each session is a drive
    return Parameters(
        seed=seed,
        kind=kind,
        layout=layouts[0] if stratum == "late" else choice("layout", layouts),
        stratum=stratum,
        spatial=kind in ("room", "drone") or (kind == "road" and happens("spatial", 0.5)),
        keyframes=max(int(of("keyframes").integers(100, 601)), least),
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
        spacing=spacing,
        run=int(of("run").integers(2, 16)),
        sigma=log_uniform("sigma", *SIGMA_M[kind]),
        sigma_turn=float(np.radians(log_uniform("sigma_turn", 0.1, 2.0))),
        common_share=uniform("common_share", 0.0, 0.8),
        closure_factor=log_uniform("closure_factor", 0.2, 5.0) if happens("closure_mistold", 0.5) else 1.0,
        # wrong odometry gives no metres
        scales=SCALES[kind][0] if stratum in ("stalled", "frozen") else choice("scales", SCALES[kind]),
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
