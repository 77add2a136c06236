"""The preflight: what is in a log, what a run would use of it and why, what is wrong, and the command to run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vplog import logs
from vplog.data import Bytes, Camera, Frame, Gps, Ints, LogInfo, Odometry, OdometrySource, Topic
from vplog.errors import LogError
from vplog.geometry.masking import masked
from vplog.logs import TopicChoice
from vplog.logs.odometry_sources import PROPERTIES, evidence_text
from vplog.logs.stamps import gap_ns, rate_hz
from vplog.odometry.visual import visual_odometry
from vplog.results.html import render
from vplog.results.previews import jpeg
from vplog.results.run_record import command_of
from vplog.run.keyframes import KeyframeSettings, select_keyframes, ways_without_images
from vplog.run.lidar_odometry import new_registration
from vplog.run.odometry import UNIT, gives_visual, is_metric, source_of
from vplog.run.provenance import arguments
from vplog.run.self_calibration import about_uncalibrated
from vplog.stages import Log
from vplog.storage.json_records import plain
from vplog.storage.scratch import replacing

_SAMPLES = 8
"""Frames that are decoded: enough to see what the drive looks like and whether its images decode throughout."""
PICTURE_PX = 480
"""px across a stored picture: a phone's width, and half of a column on a screen."""
_QUALITY = 75
"""JPEG quality: pictures to recognise a place by, of some 20 kB each."""
_MOST_TRIED = 4
"""Other topics that are tried where those chosen do not work: each reads the log again."""
_MOST_GAPS = 20
"""Gaps that are listed, the longest."""
_CAMERA = ("name", "width", "height", "matrix", "distortion_model", "distortion", "body_from_camera", "baseline_m")
_PART_WORDS = {
    "image": "camera",
    "right": "right image of the pair",
    "depth": "depth",
    "camera_info": "calibration",
    "right_info": "calibration of the right camera",
    "depth_info": "calibration of the depth",
    "odometry": "odometry",
    "gps": "satellite fixes",
    "imu": "IMU of the odometry",
    "mask": "masks of the camera's images",
    "lidar": "the lidar whose scans give the odometry",
    "tf_static": "static transforms",
    "tf": "transforms",
}


@dataclass(frozen=True, eq=False)
class Preflight:
    """Findings of `vplog info`."""

    record: dict[str, Any]
    """Plain values, as `vplog info --json` prints them."""
    pictures: list[tuple[int, Bytes]] = field(default_factory=list)
    """Stamp in ns and grey image of frames evenly spread over the drive, not wider than PICTURE_PX."""


def preflight(path: Path, topics: TopicChoice | None = None) -> Preflight:
    """Read the chosen topics once and decode a few frames. Raises LogError where the log cannot be opened.

    Where a run cannot work, other topics are tried in the same way, and the record's `command` is one that works.
    """
    found = _inspect(path, topics or logs.TopicChoice())
    if found.record["problems"]:
        found.record["command"] = _working_command(path, topics or logs.TopicChoice(), found)
    return found


def _working_command(path: Path, topics: TopicChoice, found: Preflight) -> str | None:
    """A run with another camera or odometry topic; with images alone a library, and of pictures in a folder a map; None
    where nothing works."""
    unused = [topic for topic in found.record["topics"] if topic["count"] and not topic["used"]]
    for topic in [topic for topic in unused if topic["role"] in ("image", "odometry")][:_MOST_TRIED]:
        file = {"odometry_file": None} if topic["role"] == "odometry" else {}
        choice = topics.model_copy(update={topic["role"]: topic["name"], **file})
        with suppress(LogError):
            if _inspect(path, choice).record["ready"]:
                return command(path, choice)
    images = topics.model_copy(update={"odometry": None, "odometry_file": None})
    verb = "library" if logs.open(path, images).file_names() is None else "batch"
    return command(path, images).replace("vplog run", f"vplog {verb}", 1) if found.pictures else None


def _inspect(path: Path, topics: TopicChoice) -> Preflight:
    """Findings with these topics; `command` runs on the log where there is no problem."""
    log = logs.open(path, topics)
    found = log.info()
    problems: list[str] = []
    camera = None
    with _noted(problems):
        camera = log.camera()
    odometry, gps = log.odometry(), log.gps()
    stamp_ns = log.stamps() if camera is not None else np.zeros(0, np.int64)
    sampled, decoded = _sampled(log, stamp_ns, problems)
    computed = _computed(log, topics) if camera is not None and odometry is None else ""
    keyframes, missing = None, []
    metric = camera is not None and is_metric(log)
    if computed == "visual" and camera is not None:
        if metric:
            _check_moves(log.name, sampled, camera, problems)
        elif camera.matrix is None:
            missing = [about_uncalibrated(camera)]
    elif computed == "lidar":
        with _noted(problems):
            new_registration(1.0)
    else:
        keyframes, missing = _keyframes(log, topics, stamp_ns, odometry, problems)
    warnings = [line for line in dict.fromkeys(found.warnings + log.warnings + missing) if line not in problems]
    named = {**asdict(found), "warnings": warnings}
    timing = _timing(stamp_ns)
    if assumed := getattr(log, "assumed_times", False):
        timing["rate_hz"] = None
    for topic, entry in zip(found.topics, named["topics"], strict=True):
        if topic.part == "lidar" and computed != "lidar":
            topic = replace(topic, used=False, part="")  # noqa: PLW2901
            entry.update(used=False, part="")
        entry["why"] = _why(topic, found, topics)
        entry["rate_hz"] = None if assumed else entry["rate_hz"]
    record = {
        **named,
        "camera": None if camera is None else {name: plain(getattr(camera, name)) for name in _CAMERA},
        "frames": {
            "count": len(stamp_ns), **timing, "sampled": decoded, "decoded": len(sampled), "keyframes": keyframes,
        },
        "odometry": _about_odometry(odometry, found, topics),
        "visual_odometry": _use(computed == "visual", camera is not None and gives_visual(log)),
        "lidar_odometry": _use(computed == "lidar", any(one.role == "lidar" and one.count for one in found.topics)),
        "gps": _about_gps(gps, found),
        "scale": _scale(camera, found, computed, gps, topics),
        "visual_scale": "metric" if metric else "unknown",
        "gaps": _gaps(found, stamp_ns, odometry, gps),
        "losses": [asdict(loss) for loss in getattr(log, "losses", [])],
        "problems": problems,
        "ready": not problems,
        "command": command(path, topics),
    }  # fmt: skip
    return Preflight(record, [(frame.stamp_ns, _small(frame.image)) for frame in sampled])


def _computed(log: Log, topics: TopicChoice) -> str:
    """Source of a run's odometry, as `source_of`; empty without one."""
    with suppress(LogError):
        return source_of(log, topics)
    return ""


def _use(used: bool, possible: bool) -> str:
    return "used" if used else "possible" if possible else ""


def command(path: Path, topics: TopicChoice) -> str:
    """The command that runs on this log with these topics."""
    return command_of({"arguments": arguments([path], topics)}, "OUT")


@contextmanager
def _noted(problems: list[str]) -> Iterator[None]:
    """Put a LogError of the block among the problems."""
    try:
        yield
    except LogError as error:
        problems.append(str(error))


def _sampled(log: Log, stamp_ns: Ints, problems: list[str]) -> tuple[list[Frame], int]:
    """Frames evenly spread over the drive that decode, and how many were tried."""
    rows = np.unique(np.linspace(0, len(stamp_ns) - 1, min(_SAMPLES, len(stamp_ns))).astype(np.int64))
    frames: list[Frame] = []
    reason = ""
    for encoded in log.frames(stamp_ns[rows]) if len(rows) else ():
        try:
            frames.append(encoded.decode())
        except LogError as error:
            reason = reason or str(error)
    if len(rows) and not frames:
        problems.append(f"None of {len(rows)} frames tried can be decoded. The first: {reason}")
    return frames, len(rows)


def _small(image: Bytes) -> Bytes:
    """The picture, not wider than PICTURE_PX."""
    height, width = image.shape
    if width <= PICTURE_PX:
        return image
    size = PICTURE_PX, max(round(height * PICTURE_PX / width), 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _keyframes(
    log: Log, topics: TopicChoice, stamp_ns: Ints, odometry: Odometry | None, problems: list[str]
) -> tuple[int | None, list[str]]:
    """Number of keyframes of a run with the default settings, and warnings of the frames that it would leave out."""
    if not len(stamp_ns):
        return None, []
    if odometry is None or len(odometry.stamp_ns) < 2:
        problems.append(f"There is no odometry, and a trajectory is built on it. {log.without_odometry()}")
        return None, []
    with _noted(problems):
        keyframes, missing = select_keyframes(log.name, stamp_ns, odometry, KeyframeSettings())
        if len(keyframes.stamp_ns) < 2:
            problems.append(
                "By the odometry nothing moves far enough for a second keyframe, and a graph needs two. Choose another "
                "odometry with --odometry-topic or --odometry-file."
            )
        return len(keyframes.stamp_ns), missing + ways_without_images(log, topics, keyframes, odometry)
    return None, []


def _check_moves(drive: str, frames: list[Frame], camera: Camera, problems: list[str]) -> None:
    """Note a camera that stands: one that is tracked through most of these frames and gives no second keyframe. Where
    they are too far apart to be tracked it moves, or only the whole drive tells."""
    odometry = visual_odometry(map(masked, frames), camera)
    if odometry is None or len(odometry.stamp_ns) <= len(frames) / 2 or len(odometry.breaks):
        return
    keyframes, _ = select_keyframes(drive, odometry.stamp_ns, odometry, KeyframeSettings())
    if len(keyframes.stamp_ns) < 2:
        position = odometry.odom_from_body[:, :3, 3]
        most_m = float(np.linalg.norm(position - position[0], axis=1).max())
        problems.append(
            f"The camera stands: by visual odometry it moves {most_m:.1g} m between {len(frames)} frames spread over "
            "the drive, and a graph needs two keyframes. Give a longer part of it, or poses with --odometry-file."
        )


def _why(topic: Topic, found: LogInfo, topics: TopicChoice) -> str:
    """Why a topic is used or not, in a sentence."""
    if topic.used:
        chosen = {str(value) for name, value in topics if value and not name.endswith("_file")}
        return f"used as {_PART_WORDS[topic.part]}" + (", as requested" if topic.name in chosen else "")
    if not topic.count:
        return "no messages"
    if not topic.role:
        return f"no use for {topic.type or 'its type'} in {topic.encoding or 'its encoding'}"
    part = "depth" if topic.role == "depth" else topic.role
    taken = next((other.name for other in found.topics if other.part == part), None)
    if topic.role == "odometry" and topics.odometry_file is not None:
        return f"{topics.odometry_file} is used instead"
    if topic.role == "camera_info":
        if topics.calibration_file is not None:
            return f"{topics.calibration_file} is used instead"
        return "its matrix is not set" if topic.calibrated is False else "of another camera"
    best, others = _odometry_sources(found)
    source = next((other for other in others if other.topic == topic.name), None)
    if best is not None and source is not None:
        return (
            f"{best.topic} is taken, score {best.score:.2g}; this has {evidence_text(source)}; "
            f"--odometry-topic {topic.name} takes it"
        )
    if topic.role == "imu":
        return "the odometry is neither velocities nor that of the images, which would take it"
    if topic.role == "lidar":
        return f"its scans are not the odometry; --odometry {topic.name} takes it from them"
    if topic.role in ("tf", "tf_static"):
        return "it adds no transform to those of other topics"
    if topic.role == "depth" and any(other.part == "right" for other in found.topics):
        return "depth comes from the pair"
    option = f"--{topic.role}-topic {topic.name}"
    return f"{taken} is taken; {option} takes this" if taken else f"left out; {option} takes it"


def _timing(stamp_ns: Ints) -> dict[str, Any]:
    """First and last stamp, and the rate between them."""
    if not len(stamp_ns):
        return {"start_ns": None, "end_ns": None, "rate_hz": None}
    return {"start_ns": int(stamp_ns[0]), "end_ns": int(stamp_ns[-1]), "rate_hz": rate_hz(stamp_ns)}


def _about_odometry(odometry: Odometry | None, found: LogInfo, topics: TopicChoice) -> dict[str, Any] | None:
    if odometry is None:
        return None
    taken, _ = _odometry_sources(found)
    position = odometry.odom_from_body[:, :3, 3]
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    known = odometry.covariance is not None
    return {
        "source": taken.topic if taken else str(topics.odometry_file),
        "type": taken.type if taken else "TUM file",
        "kind": taken.kind if taken else "poses",
        "properties": PROPERTIES[taken.kind if taken else "poses"],
        "frames": found.odometry_frames,
        "count": len(odometry.stamp_ns),
        **_timing(odometry.stamp_ns),
        "path_m": round(float(steps.sum()), 3),
        "choice": _choice(found, topics),
        "covariance": "logged" if known else "unknown",
    }


def _odometry_sources(found: LogInfo) -> tuple[OdometrySource | None, list[OdometrySource]]:
    """The source in use, None of a file, and the others."""
    best = next((source for source in found.odometry_sources if source.used), None)
    return best, [source for source in found.odometry_sources if source is not best]


def _choice(found: LogInfo, topics: TopicChoice) -> str:
    """Why this source is the odometry, and what comes next; empty of a file."""
    best, others = _odometry_sources(found)
    if best is None:
        return ""
    why = "as requested" if topics.odometry else "the only source" if not others else "the best source"
    text = f"{best.topic} is {why}: {evidence_text(best)}"
    return text + (f"; next is {others[0].topic}: {evidence_text(others[0])}" if others else "")


def _about_gps(gps: Gps | None, found: LogInfo) -> dict[str, Any] | None:
    if gps is None:
        return None
    return {
        "source": next((topic.name for topic in found.topics if topic.part == "gps"), ""),
        "count": len(gps.stamp_ns),
        **_timing(gps.stamp_ns),
        "with_covariance": int(np.isfinite(gps.covariance).all(axis=(1, 2)).sum()),
        "latitude_deg": [float(gps.latitude_deg.min()), float(gps.latitude_deg.max())],
        "longitude_deg": [float(gps.longitude_deg.min()), float(gps.longitude_deg.max())],
        "antenna_m": None if gps.antenna_m is None else gps.antenna_m.tolist(),
    }


def _scale(
    camera: Camera | None, found: LogInfo, computed: str, gps: Gps | None, topics: TopicChoice
) -> dict[str, str]:
    """Source of the metres of a closure."""
    if camera is None:
        return {"source": "none", "why": "The log has no camera images."}
    if camera.matrix is None and computed != "visual":
        return {
            "source": "none",
            "why": "No calibration, so no closure gets a metric pose; give one with --calibration.",
        }
    if camera.baseline_m is not None:
        return {"source": "stereo", "why": f"The pair has a baseline of {camera.baseline_m:.3f} m."}
    unused = any(line.startswith("Depth is not used") for line in found.warnings)
    if not unused and any(topic.part == "depth" for topic in found.topics):
        return {"source": "depth", "why": "Depth images come with the camera's."}
    if computed == "visual":
        imu = next((topic.name for topic in found.topics if topic.part == "imu"), None)
        if topics.camera_height_m is not None:
            why = f"Metres come from the camera's height of {topics.camera_height_m:g} m, where it sees flat ground."
            return {"source": "camera_height", "why": why}
        given = [] if imu is None else [f"{imu} gives them where the drive accelerates enough"]
        given += [] if gps is None else ["--gps takes them"]
        given += ["--camera-height-m gives them where flat ground is seen"]
        return {"source": "unknown", "why": f"{UNIT} {'; '.join(given)}."}
    return {"source": "odometry", "why": "A single camera has no scale: its metres are the odometry's."}


def _gaps(found: LogInfo, stamp_ns: Ints, odometry: Odometry | None, gps: Gps | None) -> list[dict[str, Any]]:
    """The longest stretches without a message, in order of time."""
    by_part = [("images", stamp_ns)]
    by_part += [("odometry", odometry.stamp_ns)] if odometry is not None else []
    by_part += [("gps", gps.stamp_ns)] if gps is not None else []
    gaps = []
    for part, stamps in by_part:
        steps = np.diff(stamps)
        gaps += [(int(steps[row]), int(stamps[row]), part) for row in np.flatnonzero(steps > gap_ns(stamps))]
    longest = sorted(gaps, reverse=True)[:_MOST_GAPS]
    return [
        {"what": part, "after_s": round((at - found.start_ns) / 1e9, 3), "seconds": round(step / 1e9, 3)}
        for step, at, part in sorted(longest, key=lambda gap: gap[1])
    ]


def preflight_lines(found: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Name and text of each line: the parts of the log that a run would use."""
    camera, frames, odometry, gps = (found[name] for name in ("camera", "frames", "odometry", "gps"))
    visual = "visual" if found["visual_scale"] == "metric" else "monocular"
    if camera is not None:
        matrix = camera["matrix"]
        model = "no distortion" if camera["distortion_model"] == "none" else camera["distortion_model"]
        lens = "uncalibrated" if matrix is None else f"fx {matrix[0][0]:.1f} px, {model}"
        pair = "" if camera["baseline_m"] is None else f", pair with a baseline of {camera['baseline_m']:.3f} m"
        yield "camera", f"{camera['name']}: {camera['width']} x {camera['height']}, {lens}{pair}"
        assumed = found["kind"] == "images" and frames["count"] > 1
        unknown = ", assumed to be 0.1 s apart as their names are no times" if assumed else ""
        rate = unknown if frames["rate_hz"] is None else f" at {frames['rate_hz']:.1f} Hz"
        keyframes = "" if frames["keyframes"] is None else f", about {frames['keyframes']} keyframes"
        yield "frames", f"{frames['count']}{rate}{keyframes}; {frames['decoded']} of {frames['sampled']} sampled decode"
    if odometry is not None:
        chain = " -> ".join(odometry["frames"]) or "no frames named"
        rate = "" if odometry["rate_hz"] is None else f" at {odometry['rate_hz']:.1f} Hz"
        text = f"{odometry['source']}: {chain}, {odometry['count']} poses{rate} over {odometry['path_m']:.1f} m"
        yield "odometry", f"{text}, covariance {odometry['covariance']}"
        if odometry["choice"]:
            yield "chosen", odometry["choice"]
        yield "drift", odometry["properties"]
    if found["visual_odometry"] == "used":
        yield "odometry", "visual: the run computes it from the images"
        yield "drift", PROPERTIES[visual]
    elif found["visual_odometry"]:
        yield "", f"--odometry visual: {PROPERTIES[visual]}"
    if found["lidar_odometry"] == "used":
        yield "odometry", "lidar: the run computes it from the scans"
        yield "drift", PROPERTIES["lidar"]
    elif found["lidar_odometry"]:
        yield "", f"--odometry lidar: {PROPERTIES['lidar']}"
    for source in found["odometry_sources"]:
        if not source["used"]:
            name = source["kind"] if source["kind"] in ("gps", "truth") else source["topic"]
            yield "", f"--odometry {name}: {PROPERTIES[source['kind']]}"
    if gps is not None:
        known = f"{gps['with_covariance']} with a covariance"
        yield "gps", f"{gps['source']}: {gps['count']} fixes, {known}; --gps uses them"
    if found["truth"]:
        yield "truth", f"{found['truth']}; vplog evaluate OUT --truth auto compares with it"
    yield "scale", f"{found['scale']['source']}: {found['scale']['why']}"
    if any(found["clock_offset_ms"].values()):  # none of data sets, which nothing recorded
        offsets = ", ".join(f"{topic} {offset:.1f}" for topic, offset in found["clock_offset_ms"].items())
        yield "offset", f"log time less header stamp, ms: {offsets}"


def write_page(path: Path, found: Preflight) -> None:
    """Raises ResultError where the file cannot be written."""
    with replacing(path) as stream:
        stream.write(page(found).encode())


def page(found: Preflight) -> str:
    """One file, no network, readable on a phone; whatever comes from the log is escaped."""
    record, start_ns = found.record, found.record["start_ns"]
    pictures = [(f"{(stamp_ns - start_ns) / 1e9:.1f} s", jpeg(image, _QUALITY)) for stamp_ns, image in found.pictures]
    name, seconds = record["path"].rstrip("/").rsplit("/", 1)[-1], max(record["end_ns"] - start_ns, 0) / 1e9
    return render(
        "info.html", record=record, name=name, seconds=seconds, facts=preflight_lines(record), pictures=pictures
    )
