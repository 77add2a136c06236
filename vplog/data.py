"""Data that flows between the stages: frozen dataclasses of arrays, and nothing that computes.

Letters: N keyframes, M features, D descriptor length, C candidate closures, E edges, T samples in time.
Poses are (4, 4) float64 in metres; `a_from_b` maps points in b to a, so `a_from_b @ b_from_c` chains by eye.
6-vectors and (6, 6) matrices are rotation first (rad), then translation (m), in the frame of the body that
moves (b of a_from_b), as GTSAM has them. Stamps are int64 nanoseconds since the epoch of the log's clock.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Float32s = NDArray[np.float32]
Ints = NDArray[np.int64]
Int32s = NDArray[np.int32]
Bytes = NDArray[np.uint8]
Uint16s = NDArray[np.uint16]
Bools = NDArray[np.bool_]

THUMBNAIL_SIDE = 128
"""px; GIST is commonly computed on 128 x 128, and SeqSLAM's thumbnails are smaller."""


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera and where it sits on the body."""

    name: str
    matrix: Floats | None
    """(3, 3) pinhole matrix in px of the full image, None where the log holds no calibration."""
    distortion_model: str
    """`none`, `plumb_bob` (OpenCV's 4 or 5 coefficients), `rational_polynomial` (8+) or `equidistant` (fisheye, 4)."""
    distortion: Floats
    """(K,) coefficients of the model, empty for `none`."""
    width: int
    height: int
    body_from_camera: Floats
    """(4, 4); the camera looks along its z, x right, y down."""
    baseline_m: float | None = None
    """m from this camera, the left one of a rectified pair, to the right one along its x. None without a pair; with
    one `matrix` is of the rectified images, which have no distortion, and frames have a `right` image."""
    disparity_zero_px: float = 0.0
    """px that points at infinity lie further left in the right image: difference of the principal points."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One decoded image. Streamed, never stored."""

    stamp_ns: int
    camera: Camera
    image: Bytes
    """(H, W) uint8 grey."""
    depth: Float32s | None = None
    """(H, W) float32 m along the camera's z, NaN where unknown; registered to the image. None without a depth topic."""
    right: Bytes | None = None
    """(H, W) uint8 grey of the right camera of a stereo pair, both rectified: rows correspond. None without a pair,
    or where this frame's right image is missing or damaged."""
    colour: Bytes | None = None
    """(H, W, 3) uint8 red, green, blue of the image, where it was decoded in colour: three times the grey where it has
    none."""
    mask: Bools | None = None
    """(H, W) px of the image that count; None where all do. Of a right image the others are filled."""


@dataclass(frozen=True, eq=False)
class Odometry:
    """The drive's own estimate of its motion, one row per sample, increasing stamps."""

    stamp_ns: Ints
    odom_from_body: Floats
    """(T, 4, 4)."""
    covariance: Floats | None
    """(T, 6, 6) as logged, in the body frame; a row is NaN where that sample's is unusable, None where all are."""
    drifts: bool = True
    """Not where every pose is measured by itself, as satellite fixes are; `covariance` then is that of increments, and
    known."""
    breaks: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    """(B,) rows whose motion since the row before is not known, as where visual odometry lost its track: the pose is
    held."""
    metric: bool = True
    """Not where lengths are in a unit of its own, as those of one camera without depth."""
    of_images: bool = False
    """Where it is that of the images that closures are found in, so that they share its errors of calibration."""
    increments: bool = False
    """Where `covariance` is known to be that of the motion since the row before; in a log its values tell."""

    @property
    def trajectory(self) -> Trajectory:
        """Its poses alone."""
        return Trajectory(self.stamp_ns, self.odom_from_body)


UNKNOWN_VARIANCE = 1e3
"""m^2, rad^2 or those of velocities; drivers write 1e3, 99999, 1e6 or more on an axis that they do not measure."""
RECEIVER_SIGMA_M = 3.0
"""m; horizontal noise of a fix whose covariance is unknown: an open sky without corrections."""
SCALE_WANDER = 0.01
"""Standard deviation of the log of a single camera's scale after one unit, growing as the root of the way: 10 % in 100,
as it drifts in bends."""


@dataclass(frozen=True, eq=False)
class Gps:
    """Satellite fixes, WGS84."""

    stamp_ns: Ints
    latitude_deg: Floats
    longitude_deg: Floats
    altitude_m: Floats
    covariance: Floats
    """(T, 3, 3) m^2, east-north-up; NaN where unknown."""
    antenna_m: Floats | None = None
    """(3,) position of the antenna on the body, None where the log lacks it."""


@dataclass(frozen=True, eq=False)
class Imu:
    """Measurements of an inertial measurement unit."""

    name: str
    stamp_ns: Ints
    """(K,) increasing."""
    gyro: Floats
    """(K, 3) rad/s about its axes."""
    accel: Floats
    """(K, 3) m/s^2 along its axes, gravity's reaction included."""
    body_from_imu: Floats
    """(4, 4)."""


@dataclass(frozen=True, eq=False)
class Lidar:
    """A lidar whose scans the log holds."""

    name: str
    """Its topic."""
    stamp_ns: Ints
    """(L,) of its scans, increasing."""
    body_from_lidar: Floats
    """(4, 4)."""


@dataclass(frozen=True, eq=False)
class Scan:
    """One turn of a lidar."""

    stamp_ns: int
    """As its message has it: of the first point, the last or one between."""
    points: Floats
    """(K, 3) m in the lidar's frame, finite."""
    seconds: Floats | None
    """(K,) s after `stamp_ns` at which each was measured; None where that is unknown."""


@dataclass(frozen=True, eq=False)
class Keyframes:
    """The frames that become nodes."""

    drive: str
    stamp_ns: Ints
    """(N,) strictly increasing."""
    odom_from_body: Floats
    """(N, 4, 4) odometry interpolated to the frame's stamp."""


@dataclass(frozen=True, eq=False)
class Features:
    """Local features of one image, strongest first."""

    points: Float32s
    """(M, 2) px, (0, 0) the centre of the top-left pixel."""
    sizes: Float32s
    """(M,) px, diameter of the described neighbourhood."""
    descriptors: Bytes
    """(M, D) uint8."""
    depth_m: Float32s
    """(M,) depth along the camera's z, NaN unknown."""
    width: int
    """Width of the image in px, the frame of `points`."""
    height: int
    thumbnail: Bytes | None = None
    """(THUMBNAIL_SIDE, THUMBNAIL_SIDE) uint8: the whole image by area averages, None where it is not at hand."""

    def __len__(self) -> int:
        return len(self.points)

    def rows(self, rows: slice | Ints) -> Features:
        """Some of the features."""
        parts = {name: getattr(self, name)[rows] for name in ("points", "sizes", "descriptors", "depth_m")}
        return replace(self, **parts)


@dataclass(frozen=True, eq=False)
class Reference:
    """One image of a raw-image library, with where it came from."""

    image: Bytes
    """(H, W) uint8 grey; smaller than the frame of its features in a library that has thumbnails alone."""
    features: Features
    drive: str
    stamp_ns: int


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of an image's windows on the references that explain it."""

    references: Ints
    """(J,) best first; fewer where fewer references share anything."""
    corners: Floats
    """(J, I, 4) x0 y0 x1 y1 as shares of the reference's sides, NaN where nothing of a window is found."""


@dataclass(frozen=True, eq=False)
class SharedReferences:
    """The references that explain both images of C pairs."""

    references: list[Uint16s]
    """(C,) of (S,) reference numbers, by decreasing part in the score."""
    overlap: list[Float32s]
    """(C,) of (S,) common share of a box, mean over the boxes, 0..1."""


@dataclass(frozen=True, eq=False)
class Ranking:
    """The places of a map that are most like a query, best first."""

    rows: Int32s
    """(K,) rows of the map."""
    score: Float32s
    """(K,) decreasing; its scale is the recogniser's own."""


class Verdict(StrEnum):
    """Verdict on a candidate closure. A rejected loop is a value with a reason, never an exception."""

    ACCEPTED = "accepted"
    TOO_FEW_MATCHES = "too_few_matches"
    TOO_FEW_LANDMARKS = "too_few_landmarks"
    TOO_FEW_INLIERS = "too_few_inliers"
    POOR_SPREAD = "poor_spread"
    DEGENERATE_MOTION = "degenerate_motion"
    NO_CALIBRATION = "no_calibration"
    IMPLAUSIBLE_POSE = "implausible_pose"
    TOO_FAR = "too_far"
    INCONSISTENT = "inconsistent"
    DIRECTION_ONLY = "direction_only"
    REJECTED_BY_SOLVER = "rejected_by_solver"
    NOT_SIGNIFICANT = "not_significant"
    ACCEPTED_BY_DECISION = "accepted_by_decision"
    REJECTED_BY_DECISION = "rejected_by_decision"

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]


_SENTENCES = {
    Verdict.ACCEPTED: "Verified by geometry and kept by the robust solve.",
    Verdict.TOO_FEW_MATCHES: "The two images share too few feature matches to be checked.",
    Verdict.TOO_FEW_LANDMARKS: "Too few matches have a known 3D position in the map frame.",
    Verdict.TOO_FEW_INLIERS: "No single camera pose explains enough of the matches.",
    Verdict.POOR_SPREAD: "The matches that agree cover too small a part of the image to fix a pose.",
    Verdict.DEGENERATE_MOTION: "The map frames around the match moved too little or too straight for triangulation.",
    Verdict.NO_CALIBRATION: "The images agree by epipolar geometry, but without calibration there is no metric pose.",
    Verdict.IMPLAUSIBLE_POSE: "The pose found would put the camera further away than a shared view can be.",
    Verdict.TOO_FAR: "The views agree, but are further apart than one place is wide; nearer keyframes fit better.",
    Verdict.INCONSISTENT: "The pose from query to match and the one from match to query do not agree.",
    Verdict.DIRECTION_ONLY: "Kept by the robust solve with rotation and direction only, without metres.",
    Verdict.REJECTED_BY_SOLVER: "Verified by geometry, but at odds with the other constraints of the robust solve.",
    Verdict.NOT_SIGNIFICANT: "Verified by geometry, but more likely to be false than --false-rate allows.",
    Verdict.ACCEPTED_BY_DECISION: "A known inlier by decision: the robust solve kept it without a test.",
    Verdict.REJECTED_BY_DECISION: "Left out by decision, whatever geometry and the robust solve make of it.",
}


ACCEPTED = (Verdict.ACCEPTED, Verdict.ACCEPTED_BY_DECISION)
"""Verdicts of closures with metres in the solution."""
USED = (*ACCEPTED, Verdict.DIRECTION_ONLY)
"""Verdicts of closures in the solution, at least in part."""


@dataclass(frozen=True, eq=False)
class Closures:
    """The ledger: one row per candidate closure, the rejected ones too, ordered by query, then rank."""

    query: Int32s
    """(C,) keyframe row, the later one."""
    match: Int32s
    """(C,) keyframe row, the earlier one."""
    rank: Int32s
    """(C,) 0 is the query's best candidate."""
    score: Float32s
    """(C,) the recogniser's similarity."""
    support: Int32s
    """(C,) neighbours of the pair that agree by sequence; 0 where no sequence was used."""
    shared_references: list[Uint16s]
    """(C,) numbers of the library's references that explain both places, those that count most first; empty for a
    recogniser without boxes, whose places share no references."""
    shared_overlap: list[Float32s]
    """(C,) of each shared reference, the share of a box that the two places' boxes have in common, mean over the
    boxes, 0..1."""
    matches: Int32s
    """(C,) feature matches that passed the ratio and mutual tests."""
    landmarks: Int32s
    """(C,) matches with a known 3D position in the map frame."""
    inliers: Int32s
    """(C,) matches that agree with the pose, or with the epipolar geometry where there is no pose."""
    spread: Float32s
    """(C,) share of the query image that the inliers' bounding box covers, 0..1."""
    reverse_inliers: Int32s
    """(C,) inliers of the reverse check, from match to query; -1 where it was not done."""
    scale: list[str]
    """(C,) where the metres of match_from_query come from: `odometry`, `depth`, `stereo`, or `none` without metres."""
    match_from_query: Floats
    """(C, 4, 4) body frames, NaN where no pose was found."""
    information: Floats
    """(C, 6, 6) of match_from_query, NaN where no pose was found."""
    verdict: list[Verdict]
    p_false: Floats
    """(C,) 0..1: the least false rate that admits it, which is the share of false closures expected among it and all
    better ones; NaN where geometry found no closure, or nothing calibrates it."""
    residual_before: Floats
    """(C,) sigma: Mahalanobis distance of the closure to the odometry, NaN where not in the graph."""
    residual_after: Floats
    """(C,) sigma: the same after the solve."""
    weight: Floats
    """(C,) 0..1 of the robust solve, NaN where not in the graph."""
    query_camera: Int32s
    """(C,) the camera of the query's picture, by its number among those of the drive; 0 is the first."""
    match_camera: Int32s
    """(C,) that of the match's picture."""

    def __len__(self) -> int:
        return len(self.query)

    def of(self, *verdicts: Verdict) -> Bools:
        """(C,) whether each candidate has one of these verdicts."""
        return np.array([verdict in verdicts for verdict in self.verdict], bool)

    def rows(self, rows: Ints) -> Closures:
        """Some of the candidates."""
        columns: dict[str, Any] = {name: getattr(self, name) for name in self.__dataclass_fields__}
        for name, column in columns.items():
            columns[name] = [column[row] for row in rows.tolist()] if isinstance(column, list) else column[rows]
        return Closures(**columns)

    @property
    def of_first_camera(self) -> Bools:
        """(C,) whether both pictures of each candidate are of the first camera."""
        return (self.query_camera == 0) & (self.match_camera == 0)

    @property
    def accepted(self) -> Bools:
        """(C,) whether each candidate is a closure with metres, by the robust solve or by decision."""
        return self.of(*ACCEPTED)

    def lines(self, positions: Floats, rows: Bools) -> Floats:
        """(S, 2, 3) from the match to the query of some candidates (C,), by positions of the keyframes (N, 3)."""
        return np.stack([positions[self.match[rows]], positions[self.query[rows]]], axis=1)


class EdgeKind(StrEnum):
    ODOMETRY = "odometry"
    LOOP = "loop"
    """A closure, which may be false."""
    KNOWN_LOOP = "known_loop"
    """A closure that is a known inlier."""


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Nodes and what was measured between them."""

    world_from_body: Floats
    """(N, 4, 4) initial."""
    a: Int32s
    b: Int32s
    a_from_b: Floats
    """(E, 4, 4)."""
    information: Floats
    """(E, 6, 6), in the frame of b."""
    kind: list[EdgeKind]
    dimension: int = 3
    """3, or 2 for a planar graph: all poses and edges then are turns about z and shifts along x and y, and only rows
    and columns 2, 3, 4 of `information` (yaw, x, y) are used, the others being zero."""

    @cached_property
    def odometry(self) -> Bools:
        """(E,) whether each edge is odometry, not a closure."""
        which = np.array([kind == EdgeKind.ODOMETRY for kind in self.kind], bool)
        which.flags.writeable = False  # it serves all who ask
        return which


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of optimising a pose graph."""

    world_from_body: Floats
    """(N, 4, 4)."""
    weight: Floats
    """(E,) 0..1; 1 for every edge that is not robust."""
    error_before: float
    """Half the chi-square of the graph at its initial poses, over the inlier edges."""
    error_after: float
    iterations: int
    converged: bool
    reason: str
    """One sentence: why it stopped, or why the result is the odometry."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Every odometry sample, corrected."""

    stamp_ns: Ints
    world_from_body: Floats
    """(T, 4, 4)."""


@dataclass(frozen=True)
class Topic:
    """One topic of a log, as found."""

    name: str
    type: str
    encoding: str
    count: int
    role: str
    """`image`, `depth`, `camera_info`, `odometry`, `gps`, `imu`, `lidar`, `tf_static`, `tf`, or `` where vplog has no
    use for it."""
    used: bool
    part: str = ""
    """Its use: `image`, `right`, `depth`, `camera_info`, `right_info`, `depth_info`, `odometry`, `gps`, `lidar`,
    `tf_static`, `tf`; empty where it is not used."""
    pixels: str = ""
    """Pixel layout or format of images, by the first message."""
    width: int = 0
    """px of the first image; 0 where only decoding gives it, as for video."""
    height: int = 0
    frame: str = ""
    """frame_id of images and calibrations."""
    calibrated: bool | None = None
    """Whether the matrix of a calibration is set."""
    rate_hz: float | None = None
    """Messages a second of the time between its first and last; None where it was not read, or they span no time."""


@dataclass(frozen=True)
class OdometrySource:
    """One source of odometry in a log, and the evidence by which one of several is chosen."""

    topic: str
    type: str
    frames: list[str]
    """Frames of the chain, from the fixed one to the body; empty names where it names none."""
    count: int
    rate_hz: float | None
    """Poses a second that differ from the one before; None of a single pose."""
    coverage: float
    """Share of the camera's images with odometry at their stamp; without images, of the time of all sources."""
    path_m: float
    jumps: int
    """Steps that no motion of this drive explains."""
    evidence: dict[str, float]
    """Evidence against it, in words, and the factor of the score for each."""
    score: float
    """Product of the factors."""
    kind: str = "poses"
    """`poses`, `tf`, `twist`, `gps` or `truth`."""
    used: bool = False


@dataclass(frozen=True)
class LogInfo:
    """Topics of a log and their use: the answer of `vplog info`."""

    path: str
    kind: str
    """`mcap`, `ros1`, `ros2-mcap`, `ros2-db3`, `images`, or a data set's: `kitti`, `euroc`, `tum-rgbd`, `vslam-lab`,
    `colmap`, `utm-images`, `stereo-images`, `video`."""
    start_ns: int
    end_ns: int
    messages: int
    topics: list[Topic]
    warnings: list[str] = field(default_factory=list)
    odometry_frames: list[str] = field(default_factory=list)
    """Names of the frames from the one that stands still to the body; empty where the odometry names none."""
    clock_offset_ms: dict[str, float] = field(default_factory=dict)
    """Median of log time less header stamp, by topic in use."""
    odometry_sources: list[OdometrySource] = field(default_factory=list)
    """Candidates for the odometry, the best first."""
    truth: str = ""
    """The ground truth that comes with the log, which `evaluate --truth auto` takes: `poses`, `positions`, a topic, or
    empty."""


@dataclass(frozen=True, eq=False)
class Structure:
    """3D points of a drive, and their observations in its images."""

    world: Floats
    """(P, 3) m."""
    error_px: Floats
    """(P,) mean reprojection error."""
    point: Ints
    """(O,) the point of each observation."""
    image: Ints
    """(O,) its image, increasing."""
    px: Float32s
    """(O, 2) where, as `Features.points`."""
