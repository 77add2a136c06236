"""Which source of a log is the drive's odometry: the evidence on each, and the score by which the best is taken.

A score is a product of factors, 1 where nothing speaks against a source. What the type, the frames and the name say are
guesses, so they leave more than half; what was measured (coverage, rate, jumps) may leave next to nothing.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import OdometrySource
from vplog.logs.continuity import find_jumps
from vplog.logs.formats.container import Notes, plural
from vplog.logs.messages.records import short_type
from vplog.logs.stamps import NONE
from vplog.logs.tf_odometry import FrameTree

if TYPE_CHECKING:
    from vplog.data import Ints, Odometry
    from vplog.logs.formats.container import Channel
    from vplog.logs.gather import Gathered
    from vplog.logs.topic_selection import Selection

_TYPES = {"nav_msgs/Odometry": 1.0, "foxglove.Odometry": 1.0, "geometry_msgs/PoseWithCovarianceStamped": 0.8}
_OTHER_TYPE = 0.7
"""A type that says where something is, but not that it is the body by its odometry; transforms among them."""
_TRANSFORMS = 0.75
"""Transforms, a little before such types: they name both frames."""
_MAP = ("map", "world", "earth", "utm", "enu")
"""Frames whose poses jump when the place is known better (ROS REP 105)."""
_BODIES = ("base_link", "base_footprint", "base", "body", "robot", "chassis", "vehicle")
"""Frames that move: what is placed in them is a part of the robot."""
_TRUTH = re.compile(r"ground_?truth|(^|[/_])gt([/_]|$)|vicon|optitrack|mocap|qualisys", re.IGNORECASE)
"""Names of ground truth and of the systems that measure it."""
_COMMAND = re.compile(
    "(?<![a-z])(goal|set_?point|target|desired|reference|command|cmd|ref|plan|way_?point|initial_?pose|clicked)s?(?![a-z])",
    re.IGNORECASE,
)
"""Words for where a robot is to be, or is commanded to be."""
_COMMANDED, _MAYBE_COMMANDED = "is a command by its name", "may be a command by its name"
COVERED = 0.9
"""Share of the camera's time that odometry covers in a usual log: recorders start and stop within seconds."""
_LEAST_HZ = 5.0
"""Poses a second, or one per image, beyond which more of them add nothing: 2 m apart at 10 m/s."""
_SPARSE = "poses a second that differ"
_FAINT = 0.01
"""Least factor: nothing measured makes a source impossible where it is the only one."""


def weigh(source: Channel, frames: list[str], odometry: Odometry, camera_ns: Ints, span_ns: Ints) -> OdometrySource:
    """The evidence on one source. `camera_ns` (F,) are the stamps of the images; where there are none, `span_ns` (2,),
    the time that all sources cover together, counts instead."""
    stamp_ns, poses, topic, kind = odometry.stamp_ns, odometry.odom_from_body, source.topic, source.type
    moved = int(np.any(np.diff(poses, axis=0) != 0, axis=(1, 2)).sum())
    seconds = (int(stamp_ns[-1]) - int(stamp_ns[0])) / 1e9
    rate_hz = moved / seconds if seconds > 0 else None
    coverage, jumps = _coverage(stamp_ns, camera_ns, span_ns), len(find_jumps(stamp_ns, poses))
    path_m = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    camera_hz = _LEAST_HZ
    if len(camera_ns) > 1:
        camera_hz = (len(camera_ns) - 1) * 1e9 / int(camera_ns[-1] - camera_ns[0])
    evidence = _named(topic, kind, frames)
    if coverage < COVERED:
        whose = "camera's" if len(camera_ns) else "sources'"
        evidence[f"covers {coverage:.0%} of the {whose} time"] = max(coverage * coverage / 2, _FAINT)
    if rate_hz is not None and (share := rate_hz / min(camera_hz, _LEAST_HZ)) < COVERED:
        what = f"{rate_hz:.2g} {_SPARSE}" if moved else "its pose never changes"
        evidence[what] = max(math.sqrt(share), _FAINT)  # the root: a robot that mostly stands has odometry too
    if rate_hz is None:
        evidence["a single pose"] = _FAINT
    if jumps:
        evidence[f"jumps {plural(jumps, 'time')}"] = 1.0 / (1.0 + jumps)
    score, rate_hz = round(math.prod(evidence.values()), 6), None if rate_hz is None else round(rate_hz, 3)
    numbers = len(stamp_ns), rate_hz, round(coverage, 4), round(path_m, 3), jumps
    return OdometrySource(topic, kind, frames, *numbers, evidence, score)


@dataclass(frozen=True, eq=False)
class SourceOdometry:
    """What one source gives as odometry."""

    odometry: Odometry | None
    frames: list[str]
    """From the one that stands still to the body."""
    notes: Notes
    """On what was repaired or left out of it."""


def read_sources(read: Gathered, chosen: Selection) -> dict[Channel, SourceOdometry]:
    """The odometry that was gathered from each source."""
    tree, found = FrameTree([*read.moving.still(), *read.transforms]), {}
    for source in chosen.sources:
        notes, track = Notes(), read.poses.get(source)
        if track is not None:
            found[source] = SourceOdometry(track.finish(notes), [track.parent, track.child], notes)
        else:
            found[source] = SourceOdometry(*read.moving.odometry(tree, source.topic, notes), notes)
    return found


def weigh_sources(found: dict[Channel, SourceOdometry], camera_ns: Ints) -> list[tuple[OdometrySource, Channel]]:
    """Every source with a usable pose, the best first; of equal ones that with most poses, then by name."""
    ends = [one.odometry.stamp_ns[[0, -1]] for one in found.values() if one.odometry is not None]
    span_ns = np.array([min(end[0] for end in ends), max(end[1] for end in ends)]) if ends else NONE
    weighed = [
        (weigh(source, one.frames, one.odometry, camera_ns, span_ns), source)
        for source, one in found.items()
        if one.odometry is not None
    ]
    return sorted(weighed, key=lambda one: (-one[0].score, -one[0].count, one[1]))


def choose_odometry(sources: list[tuple[OdometrySource, Channel]], chosen: Selection, notes: Notes) -> Channel | None:
    """The source to use: the requested one, else the best. What is lost with it is noted."""
    requested = chosen.odometry
    commands = [one for one, _ in sources if not requested and _COMMANDED in one.evidence]
    fit = [one for one in sources if one[0] not in commands]
    if commands and (not fit or commands[0].score > fit[0][0].score):
        names = ", ".join(source.topic for source in commands)
        notes.add(
            f"{names}: a command by its name (where the robot should be), so not used as odometry; --odometry-topic "
            f"{commands[0].topic} takes it."
        )
    if not fit:
        return None if sources else requested or next(iter(chosen.sources), None)
    best, source = fit[0]
    _note_doubts(best, requested is not None, chosen.image is not None, notes)
    return source


def _note_doubts(source: OdometrySource, requested: bool, pictured: bool, notes: Notes) -> None:
    if source.coverage < COVERED and pictured:
        better = "" if requested else " No other source is better; --odometry-file takes one from a file."
        notes.add(
            f"{source.topic} covers {source.coverage:.0%} of the camera's time; the frames outside have no odometry "
            f"and are left out.{better}"
        )
    if pictured and any(_SPARSE in what for what in source.evidence) and (source.rate_hz or 1.0) < 1.0:
        notes.add(
            f"{source.topic} has {source.rate_hz:.2g} poses a second that differ; between them the motion is "
            "interpolated."
        )
    if not requested and _MAYBE_COMMANDED in source.evidence:
        notes.add(
            f"{source.topic} is a command by its name (where the robot should be), but moves {source.frames[-1]}, "
            "and no other source is better; --odometry-file takes one from a file."
        )
    if any(map(_TRUTH.search, (source.topic, *source.frames))):
        notes.add(
            f"{source.topic} is ground truth by its name{'' if requested else ', and the best that the log has'}; "
            "measured against it, the trajectory says nothing about real odometry."
        )


def in_words(source: OdometrySource) -> str:
    """The score and what speaks against the source."""
    return f"score {source.score:.2g}" + "".join(f", {what}" for what in source.evidence)


def _named(topic: str, kind: str, frames: list[str]) -> dict[str, float]:
    """What name, type and frames say against a source."""
    name = short_type(kind)
    likely = _TRANSFORMS if "TFMessage" in name or "FrameTransform" in name or name == "tf/tfMessage" else _OTHER_TYPE
    found = {f"a {name.replace('.', '/').split('/')[-1]}": _TYPES.get(name, likely)}
    parent, child = (frame.split("/")[-1] for frame in (*frames[:1], *frames[-1:])) if frames else ("", "")
    if parent in _BODIES or (parent and parent == child):
        found[f"is placed in {parent}, which moves"] = 0.05
    elif parent in _MAP:
        found[f"in {parent}, where poses jump"] = 0.9
    elif not parent:
        found["names no frame"] = 0.8
    if child and "odom" in child:
        found[f"moves {child}, not the body"] = 0.1
    elif child and child not in _BODIES:
        found[f"moves {child}, not base_link"] = 0.9
    if any(map(_TRUTH.search, (topic, *frames))):
        found["is ground truth by its name"] = _FAINT
    if _COMMAND.search(topic):  # a goal names the frame that it lies in, none that moves
        found |= {_MAYBE_COMMANDED: 0.1} if child else {_COMMANDED: _FAINT}
    return {what: factor for what, factor in found.items() if factor < 1.0}


def _coverage(stamp_ns: Ints, camera_ns: Ints, span_ns: Ints) -> float:
    """Share of the images with odometry at their stamp: between two poses not further apart than a keyframe bears."""
    if not len(camera_ns):
        whole = int(span_ns[1] - span_ns[0])
        return int(stamp_ns[-1] - stamp_ns[0]) / whole if whole > 0 else 1.0
    if len(stamp_ns) < 2:
        return float(np.isin(camera_ns, stamp_ns).mean())
    gap_ns = max(10**9, 3 * int(np.median(np.diff(stamp_ns))))  # as KeyframeSettings.max_odometry_gap_s
    right = np.searchsorted(stamp_ns, camera_ns).clip(1, len(stamp_ns) - 1)
    before, behind = stamp_ns[right - 1], stamp_ns[right]
    inside = (before <= camera_ns) & (camera_ns <= behind) & (behind - before <= gap_ns)
    return float((inside | np.isin(camera_ns, stamp_ns)).mean())
