"""Choice of a drive's odometry among the sources of its log: evidence on each, and the score that ranks them.

A score is a product of factors, 1 where there is no evidence against a source. Type, frames and name
are guesses, so they mostly leave more than half; measured evidence (coverage, rate, jumps) may leave next to nothing.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from vplog.data import Floats, Gps, Ints, Odometry, OdometrySource, Trajectory
from vplog.errors import plural
from vplog.geometry.pose_conventions import AS_GIVEN, POSE_CONVENTIONS
from vplog.logs.continuity import find_jumps
from vplog.logs.dead_reckoning import dead_reckoned, gyro_agrees, odometry_of_fixes, turned_by_gyro
from vplog.logs.formats.container import Channel, Contents, Notes
from vplog.logs.gather import TopicCollector
from vplog.logs.messages.records import short_type
from vplog.logs.stamps import NONE, longest_gap_ns
from vplog.logs.tf_odometry import FrameTree, frame_name
from vplog.logs.topic_selection import COMMAND, SOURCES, Selection
from vplog.logs.tracks import PoseTrack

TRUTH = Channel("truth", "ground truth", "")
"""The ground truth of a data set as a source; it is no topic."""
_TYPES = {"nav_msgs/Odometry": 1.0, "foxglove.Odometry": 1.0, "geometry_msgs/PoseWithCovarianceStamped": 0.8}
_OTHER_TYPE = 0.7
"""Pose types that need not be the odometry of the body; transforms among them."""
_TRANSFORMS = 0.75
"""Transforms, a little before such types: they name both frames."""
_OF_KIND = {
    "twist": ("velocities added up", 0.5),
    "gps": ("positions, with headings from their motion", 0.2),
    "truth": ("is the ground truth of the data set", 0.01),
}
"""The evidence against other kinds of sources than poses."""
PROPERTIES = {
    "poses": "drifts as the estimator behind it does, wheels and cameras by about 0.5 to 2 % of the way",
    "tf": "drifts as the estimator behind it does, wheels and cameras by about 0.5 to 2 % of the way",
    "twist": "drifts by about 1 to 5 % of the way; knows neither slip nor, without a gyroscope, small turns",
    "gps": "does not drift, and is off by metres at any time; knows neither roll and pitch nor a heading at rest",
    "visual": "drifts by about 0.5 to 2 % of the way; breaks where images lack features, and goes on as another piece",
    "monocular": "has no metres, and its scale wanders; breaks where the camera only turns, and goes on as a new piece",
    "lidar": "drifts by about 0.5 to 2 % of the way; lost along a tunnel, and goes on as another piece after a gap",
    "truth": "does not drift; an evaluation with it tells nothing about real odometry",
}
"""The drift of each kind of source, and what it cannot know."""
_MAP = ("map", "world", "earth", "utm", "enu")
"""Frames whose poses jump when the place is known better (ROS REP 105)."""
_BODIES = ("base_link", "base_footprint", "base", "body", "robot", "chassis", "vehicle")
"""Frames that move: what is placed in them is a part of the robot."""
_TRUTH = re.compile(r"ground_?truth|(^|[/_])gt([/_]|$)|vicon|optitrack|mocap|qualisys", re.IGNORECASE)
"""Names of ground truth and of the systems that measure it."""
_COMMANDED, _MAYBE_COMMANDED = "is a command by its name", "may be a command by its name"
COVERED = 0.9
"""Share of the camera's time that odometry covers in a usual log: recorders start and stop within seconds."""
_LEAST_HZ = 5.0
"""Poses a second, or one per image, beyond which more of them add nothing: 2 m apart at 10 m/s."""
_HEADLESS = "moves every way without turning"
_LEAST_PATH_M, _BENT, _TURNED = 10.0, 0.02, 1e-6
"""m of a path from which that counts; the part of squared steps off their main direction, as of directions that spread
evenly over 30 degrees; and the change of a rotation's elements that is more than rounding."""
_ASKEW = 0.2
"""That part from which steps do not lie along one axis of the body."""
_SPARSE, _STILL, _PLACED = "poses a second that differ", "never moves", "is placed in"
_TURNS, _FORTH = "turns, but never moves", "goes back and forth"
_OTHER_CONVENTION = "points where it goes only if its poses are read as those"
_STEP_M, _TIMES, _EXCESS_M = 0.2, 3.0, 10.0
"""m of a step that is more than noise; and how many times, and m, the path of these is longer than that over poses a
second apart where two nodes publish what has drifted apart."""
_NEAR = 0.3
"""Share of such a step within which the poses two apart lie."""
_HANGS_M_S2 = -5.0
"""m/s^2 along the z of an IMU, below which gravity tells that it hangs upside down, or is forward-right-down."""
_FASTEST = 1e3, 100.0
"""m/s and rad/s; a velocity beyond either is damage: integrated, one alone turns or shifts all that follows."""
_LEAST_FACTOR = 0.01
"""Least factor: nothing measured makes a source impossible where it is the only one."""
_DOUBTS = {
    _STILL: "did its estimator run?", _TURNS: "did its estimator run?", _PLACED: "is it a part of the robot?",
    _OTHER_CONVENTION: "are they written so?", _FORTH: "do two nodes publish it?",
    _HEADLESS: "is it a receiver's, which does not know where the body heads?",
}  # fmt: skip
"""Question to the user where the evidence against the source that is taken begins so."""


def score_source(
    source: Channel, frames: list[str], odometry: Odometry, camera_ns: Ints, span_ns: Ints, source_kind: str = "poses"
) -> OdometrySource:
    """The evidence on one source. `camera_ns` (F,) are the stamps of the images; where there are none, `span_ns` (2,),
    the time that all sources cover together, counts instead."""
    stamp_ns, poses, topic, kind = odometry.stamp_ns, odometry.odom_from_body, source.topic, source.type
    moved = int(np.any(np.diff(poses, axis=0) != 0, axis=(1, 2)).sum())
    seconds = (int(stamp_ns[-1]) - int(stamp_ns[0])) / 1e9
    rate_hz = moved / seconds if seconds > 0 else None
    coverage, jumps = _coverage(stamp_ns, camera_ns, span_ns), len(find_jumps(stamp_ns, poses))
    step_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    path_m, camera_hz = float(step_m.sum()), _LEAST_HZ
    if len(camera_ns) > 1:
        camera_hz = (len(camera_ns) - 1) * 1e9 / int(camera_ns[-1] - camera_ns[0])
    evidence = _evidence_by_name(topic, kind, frames, source_kind)
    if coverage < COVERED:
        whose = "camera's" if len(camera_ns) else "sources'"
        evidence[f"covers {coverage:.0%} of the {whose} time"] = max(coverage * coverage / 2, _LEAST_FACTOR)
    if rate_hz is not None and (share := rate_hz / min(camera_hz, _LEAST_HZ)) < COVERED:
        what = f"{rate_hz:.2g} {_SPARSE}" if moved else _STILL
        evidence[what] = max(math.sqrt(share), _LEAST_FACTOR)  # the root: a robot that mostly stands has odometry too
    if rate_hz is None:
        evidence["a single pose"] = _LEAST_FACTOR
    if moved and path_m == 0:
        evidence[_TURNS] = _LEAST_FACTOR
    _, rows = np.unique((stamp_ns - stamp_ns[0]) // 10**9, return_index=True)
    apart_m = float(np.linalg.norm(np.diff(poses[rows, :3, 3], axis=0), axis=1).sum())
    long = np.flatnonzero(step_m > _STEP_M)
    if float(step_m[long].sum()) > max(_TIMES * apart_m, apart_m + _EXCESS_M) and _returns(poses[:, :3, 3], long):
        evidence[_FORTH] = _LEAST_FACTOR
    if source_kind in ("poses", "tf") and path_m > _LEAST_PATH_M and (convention := _convention(poses)) != AS_GIVEN:
        evidence[f"{_OTHER_CONVENTION} {convention}"] = 0.1
    if source_kind not in ("gps", "truth") and path_m > _LEAST_PATH_M and _is_headless(poses, source_kind == "twist"):
        evidence[_HEADLESS] = _LEAST_FACTOR
    if jumps:
        evidence[f"jumps {plural(jumps, 'time')}"] = 1.0 / (1.0 + jumps)
    score, rate_hz = round(math.prod(evidence.values()), 6), None if rate_hz is None else round(rate_hz, 3)
    numbers = len(stamp_ns), rate_hz, round(coverage, 4), round(path_m, 3), jumps
    return OdometrySource(topic, kind, frames, *numbers, evidence, score, source_kind)


def _is_headless(poses: Floats, integrated: bool) -> bool:
    """Whether a path bends and the body does not turn with it, as of positions alone; or, of velocities integrated in
    the body's axes, whether they were along the world's, as those of a satellite receiver: they turn as the body does,
    and turned back they all point ahead."""
    steps, back = np.diff(poses[:, :3, 3], axis=0), np.swapaxes(poses[:-1, :3, :3], 1, 2)
    if float(np.ptp(poses[:, :3, :3], axis=0).max()) <= _TURNED:
        return _bend(steps) > _BENT
    velocities = (back @ steps[:, :, None])[:, :, 0]
    ahead = (back @ velocities[:, :, None])[:, :, 0]
    return integrated and _bend(velocities) > max(_BENT, 2 * _bend(ahead))


def _returns(position: Floats, steps: Ints) -> bool:
    """Whether the pose before or behind a step is mostly near the one at its other end: noise and circles do not go
    back to where they were."""
    two = np.linalg.norm(position[2:] - position[:-2], axis=1)
    steps = steps[(steps > 0) & (steps < len(two))]
    back = np.minimum(two[steps], two[steps - 1])
    length = np.linalg.norm(position[steps + 1] - position[steps], axis=1)
    return bool(len(steps)) and bool(np.median(back / length) < _NEAR)


def _convention(poses: Floats) -> str:
    """Return the key of POSE_CONVENTIONS in which poses (T, 4, 4) move along one axis of the body on a path that bends.

    Only conventions of the quaternions are tried, because without another sensor one cannot tell which path is right.
    Return AS_GIVEN if they do so as given, if they do so in no convention, or if the path hardly bends.
    """
    steps = np.diff(poses[:, :3, 3], axis=0)
    reads = {name: convert(poses) for name, convert in POSE_CONVENTIONS.items()}
    bends = {
        name: _bend((steps[:, None] @ read[:-1, :3, :3])[:, 0])
        for name, read in reads.items()
        if np.array_equal(read[:, :3, 3], poses[:, :3, 3])
    }
    best = min(bends, key=lambda name: bends[name])
    differs = _bend(steps) > _BENT and bends[AS_GIVEN] > _ASKEW and bends[best] < _BENT
    return best if differs else AS_GIVEN


def _bend(steps: Floats) -> float:
    """Part of the squares of (K, 3) steps that is off their main direction, one way or back, at most 1."""
    _, off, along = np.linalg.eigvalsh(steps.T @ steps)
    return float(off / along) if along > 0 else 0.0


@dataclass(frozen=True, eq=False)
class SourceOdometry:
    """Odometry of one source."""

    odometry: Odometry | None
    frames: list[str]
    """Frames of the chain, from the fixed one to the body."""
    notes: Notes
    """On what was repaired or left out of it."""
    kind: str = "poses"
    """As `OdometrySource.kind`."""


def read_sources(read: TopicCollector, chosen: Selection) -> dict[Channel, SourceOdometry]:
    """The odometry that was gathered from each source."""
    tree, found = FrameTree([*read.dynamic.static(), *read.transforms]), {}
    for source in chosen.sources:
        notes, track = Notes(), read.poses.get(source)
        if track is None:
            found[source] = SourceOdometry(*read.dynamic.odometry(tree, source.topic, notes), notes, "tf")
        elif (chosen.kind == "twist" or not track.moves) and (twists := track.twists) is not None:
            odometry = _by_twists(read, track, twists, tree, notes)
            found[source] = SourceOdometry(odometry, [track.parent or "odom", track.child], notes, "twist")
        elif chosen.kind != "twist":
            found[source] = SourceOdometry(track.finish(notes), [track.parent, track.child], notes)
    return found


def _by_twists(
    read: TopicCollector, track: PoseTrack, twists: Floats, tree: FrameTree, notes: Notes
) -> Odometry | None:
    """Velocities (K, 12) added up, turned by the gyroscope where the log has one and says how it is mounted."""
    stamp_ns, rows = track.stamps.order(track.topic, notes)
    size = np.linalg.norm(twists[rows, :6].reshape(-1, 2, 3), axis=2)
    sound = np.isfinite(size).all(1) & (size <= _FASTEST).all(1)
    if dropped := int((~sound).sum()):
        notes.add(
            f"{track.topic}: {plural(dropped, 'message')} with a velocity that is not finite, or beyond "
            f"{_FASTEST[0]:.0f} m/s or {_FASTEST[1]:.0f} rad/s, dropped."
        )
    stamp_ns, rows = stamp_ns[sound], rows[sound]
    if len(rows) < 2:
        return None
    moving, variances = twists[rows, :6], twists[rows, 6:]
    text = f"{track.topic}: the odometry is its velocities, integrated"
    gyro_ns, measured = read.imu.finish(notes)
    mounts = (tree.between(body, read.imu.frame) for body in (track.child, "base_link") if body and len(gyro_ns))
    placed = next((mount for mount in mounts if mount is not None), None)
    inside = np.asarray((gyro_ns >= stamp_ns[0]) & (gyro_ns <= stamp_ns[-1]))
    if inside.sum() < len(rows):
        notes.add(f"{text}.")
        return _dead_reckoned(stamp_ns, moving, variances, longest_gap_ns(stamp_ns), track.topic, notes)
    turns = [measured[:, :3] @ (np.eye(4) if placed is None else placed)[:3, :3].T]
    if placed is None and np.median(measured[:, 5]) < _HANGS_M_S2:
        turns.insert(0, measured[:, :3] * [1.0, -1.0, -1.0])
    gyro = next((one for one in turns if gyro_agrees(stamp_ns, moving, gyro_ns, one)), None)
    hangs = gyro is not None and gyro is not turns[-1]
    if hangs or (placed is None and frame_name(read.imu.frame) not in ("", track.child, "base_link")):
        how = (
            "have z down, as its accelerometer tells (or is that of the other sign?)"
            if hangs
            else "be mounted as the body is"
        )
        notes.add(f"{read.imu.topic}: its frame has no static transform; it is taken to {how}.")
    if gyro is None:
        notes.add(
            f"{text}; the gyroscope of {read.imu.topic} is not used, as its turns are not those of the velocities: "
            "its mount (static transform), its unit or its clock is another's."
        )
        return _dead_reckoned(stamp_ns, moving, variances, longest_gap_ns(stamp_ns), track.topic, notes)
    longest_ns = longest_gap_ns(stamp_ns)
    stamp_ns, turned, off = turned_by_gyro(stamp_ns, moving, gyro_ns, gyro)
    bias = "its bias unknown, as the body does not stand still for a second, but for turns on the spot"
    bias = bias if off is None else f"less a bias of {np.degrees(off):.3f} deg/s at rest"
    notes.add(f"{text}; it turns by the gyroscope of {read.imu.topic}, {bias}.")
    return _dead_reckoned(stamp_ns, turned, np.full_like(turned, np.nan), longest_ns, track.topic, notes)


def _dead_reckoned(
    stamp_ns: Ints, twists: Floats, variances: Floats, longest_ns: int, topic: str, notes: Notes
) -> Odometry:
    odometry = dead_reckoned(stamp_ns, twists, variances, longest_ns)
    if len(odometry.breaks):
        longest_s = np.diff(odometry.stamp_ns)[odometry.breaks - 1].max() / 1e9
        notes.add(
            f"{topic}: {plural(len(odometry.breaks), 'gap')} between its velocities, of up to {longest_s:.1f} s, in "
            "which the motion is not known: only closures and fixes relate what is before to what is behind."
        )
    return odometry


def other_sources(gps: Gps | None, contents: Contents, chosen: Selection) -> dict[Channel, SourceOdometry]:
    """Fixes and the ground truth of a data set, as odometry."""
    found = {}
    if gps is not None and chosen.gps is not None and chosen.kind in ("", "gps"):
        odometry, notes = odometry_of_fixes(gps), Notes()
        if odometry is not None:
            notes.add(f"The odometry is the fixes of {chosen.gps.topic}, which are constraints of the graph, too.")
        elif chosen.kind:
            notes.add(f"The fixes of {chosen.gps.topic} do not go far enough for a heading: they are no odometry.")
        found[chosen.gps] = SourceOdometry(odometry, ["enu", ""], notes, "gps")
    if isinstance(truth := contents.truth, Trajectory) and chosen.kind in ("", "truth"):
        odometry = Odometry(truth.stamp_ns, truth.world_from_body, None)
        notes = Notes()
        notes.add(f"The odometry is the ground truth of the data set: {PROPERTIES['truth'].split('; ')[1]}.")
        found[TRUTH] = SourceOdometry(odometry, ["world", contents.body], notes, "truth")
    return found


def rank_sources(found: dict[Channel, SourceOdometry], camera_ns: Ints) -> list[tuple[OdometrySource, Channel]]:
    """Every source with a usable pose, the best first; of equal ones that with most poses, then by name."""
    usable = [(source, one, one.odometry) for source, one in found.items() if one.odometry is not None]
    ends = np.array([odometry.stamp_ns[[0, -1]] for _, _, odometry in usable], np.int64).reshape(-1, 2)
    span_ns = np.array([ends[:, 0].min(), ends[:, 1].max()]) if usable else NONE
    weighed = [
        (score_source(source, one.frames, odometry, camera_ns, span_ns, one.kind), source)
        for source, one, odometry in usable
    ]
    return sorted(weighed, key=lambda one: (-one[0].score, -one[0].count, one[1]))


def choose_odometry(sources: list[tuple[OdometrySource, Channel]], chosen: Selection, notes: Notes) -> Channel | None:
    """The source to use: the requested one, else the best. What is lost with it is noted."""
    requested = chosen.odometry or (sources[0][1] if chosen.kind in SOURCES and sources else None)
    commands = [one for one, _ in sources if not requested and _COMMANDED in one.evidence]
    withheld = [one for one, _ in sources if one.kind == "truth" and not requested]
    headless = [one for one, _ in sources if not requested and _HEADLESS in one.evidence]
    fit = [one for one in sources if one[0] not in commands + withheld + headless]
    if commands and (not fit or commands[0].score > fit[0][0].score):
        names = ", ".join(source.topic for source in commands)
        notes.add(
            f"{names}: a command by its name (where the robot should be), so not used as odometry; --odometry-topic "
            f"{commands[0].topic} takes it."
        )
    if headless and not fit:
        names = ", ".join(source.topic for source in headless)
        notes.add(
            f"{names} {_HEADLESS}, as positions or velocities of a satellite receiver do, which do not know where the "
            f"body heads, so not used as odometry; --odometry-topic {headless[0].topic} takes it."
        )
    if not fit:
        others = (source for source in chosen.sources if source not in chosen.tf)  # which have mounts and joints, too
        return None if sources or chosen.kind in SOURCES else requested or next(others, None)
    best, source = fit[0]
    _note_doubts(best, requested is not None, chosen.image is not None, notes)
    return source


def _note_doubts(source: OdometrySource, requested: bool, has_images: bool, notes: Notes) -> None:
    if source.coverage < COVERED and has_images:
        better = "" if requested else " No other source is better; --odometry-file takes one from a file."
        notes.add(
            f"{source.topic} covers {source.coverage:.0%} of the camera's time; the frames outside have no odometry "
            f"and are left out.{better}"
        )
    if has_images and any(_SPARSE in what for what in source.evidence) and (source.rate_hz or 1.0) < 1.0:
        notes.add(
            f"{source.topic} has {source.rate_hz:.2g} poses a second that differ; between them the motion is "
            "interpolated."
        )
    for what in source.evidence:
        for doubt in (doubt for start, doubt in _DOUBTS.items() if what.startswith(start)):
            notes.add(f"{source.topic} {what}; {doubt}{'' if requested else ' No other source is better.'}")
    if not requested and _MAYBE_COMMANDED in source.evidence:
        notes.add(
            f"{source.topic} is a command by its name (where the robot should be), but moves {source.frames[-1]}, "
            "and no other source is better; --odometry-file takes one from a file."
        )
    if is_truth(source.topic, *source.frames):
        notes.add(
            f"{source.topic} is ground truth by its name{'' if requested else ', and the best that the log has'}; "
            "an evaluation with it tells nothing about real odometry."
        )


def is_truth(*names: str) -> bool:
    """Whether a topic, or a frame of it, is ground truth by its name."""
    return any(map(_TRUTH.search, names))


def evidence_text(source: OdometrySource) -> str:
    """The score of a source and the evidence against it."""
    return f"score {source.score:.2g}" + "".join(f", {what}" for what in source.evidence)


def _evidence_by_name(topic: str, kind: str, frames: list[str], source_kind: str) -> dict[str, float]:
    """The evidence against a source by name, type and frames."""
    if source_kind in ("gps", "truth"):
        return dict([_OF_KIND[source_kind]])
    name = short_type(kind)
    likely = _TRANSFORMS if "TFMessage" in name or "FrameTransform" in name or name == "tf/tfMessage" else _OTHER_TYPE
    found = {f"a {name.replace('.', '/').split('/')[-1]}": _TYPES.get(name, likely)}
    found = dict([_OF_KIND["twist"]]) if source_kind == "twist" else found
    parent, child = (frame.split("/")[-1] for frame in (*frames[:1], *frames[-1:])) if frames else ("", "")
    if parent in _BODIES or (parent and parent == child):
        found[f"{_PLACED} {parent}, which moves"] = 0.05
    elif parent in _MAP:
        found[f"in {parent}, where poses jump"] = 0.9
    elif not parent:
        found["names no frame"] = 0.8
    if child and "odom" in child:
        found[f"moves {child}, not the body"] = 0.1
    elif child and child not in _BODIES:
        found[f"moves {child}, not base_link"] = 0.9
    if is_truth(topic, *frames):
        found["is ground truth by its name"] = _LEAST_FACTOR
    if COMMAND.search(topic):  # a goal names the frame that it lies in, none that moves
        found |= {_MAYBE_COMMANDED: 0.1} if child else {_COMMANDED: _LEAST_FACTOR}
    return {what: factor for what, factor in found.items() if factor < 1.0}


def _coverage(stamp_ns: Ints, camera_ns: Ints, span_ns: Ints) -> float:
    """Share of the images with odometry at their stamp: between two poses not further apart than a keyframe bears."""
    if not len(camera_ns):
        whole = int(span_ns[1] - span_ns[0])
        return int(stamp_ns[-1] - stamp_ns[0]) / whole if whole > 0 else 1.0
    if len(stamp_ns) < 2:
        return float(np.isin(camera_ns, stamp_ns).mean())
    gap_ns = longest_gap_ns(stamp_ns)  # as KeyframeSettings.max_odometry_gap_s
    right = np.searchsorted(stamp_ns, camera_ns).clip(1, len(stamp_ns) - 1)
    before, behind = stamp_ns[right - 1], stamp_ns[right]
    inside = (before <= camera_ns) & (camera_ns <= behind) & (behind - before <= gap_ns)
    return float((inside | np.isin(camera_ns, stamp_ns)).mean())
