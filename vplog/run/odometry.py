"""The odometry of a run: the log's, or where it has none, or it is requested, that of its images or of its lidar."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from vplog.data import Camera, Imu, Keyframes, Odometry
from vplog.errors import LogError, plural
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import warn
from vplog.logs import TopicChoice
from vplog.logs.cameras import AHEAD
from vplog.odometry.inertial import SURE, with_imu
from vplog.odometry.metric_scale import in_metres
from vplog.odometry.visual import PERIOD_NS, visual_odometry
from vplog.refinement.gps_factors import NO_FIXES
from vplog.run.cache.codecs import json_codec
from vplog.run.cache.stage_cache import Inputs
from vplog.run.cache.steps import Steps, step
from vplog.run.feature_extraction import image_topics
from vplog.run.keyframes import KeyframeSettings, has_odometry, select_keyframes, ways_without_images
from vplog.run.lidar_odometry import lidar_odometry, range_of
from vplog.run.self_calibration import decoded, self_calibrated
from vplog.stages import Log

UNIT = (
    "A single camera has no metres: lengths are in a unit of its own, about a tenth of the distance of what is seen, "
    "and its scale wanders."
)
"""Warning where the scale is unknown."""
_SPEED = 0.05
"""Units a second of a motion that is not known: a keyframe a second, the least spacing."""
_SHORTEST = 1.0
"""Units of its way, at least: 20 keyframes of a short drive."""
_SAMPLES = 8
"""Scans over the drive by which the range of the lidar is chosen."""
_NAMED = 4
"""Breaks that are named."""


@step("read")
def read(
    log: Log, topics: TopicChoice, settings: KeyframeSettings, use_gps: bool = False, *, steps: Steps
) -> tuple[Odometry, Camera, Keyframes]:
    """Odometry, camera and selected keyframes of a drive; fixes give metres where `use_gps`, and nothing else does.
    Raises LogError where there is no odometry, or, with `use_gps`, no fix."""
    if use_gps and log.gps() is None:
        raise LogError(NO_FIXES)
    source = source_of(log, topics)
    camera = camera_of(log, topics, steps)
    odometry = odometry_of(log, topics, camera, steps)
    if source == "visual" and (imu := log.imu()) is not None and not _is_unknown(odometry):
        odometry = _with_imu(odometry, imu, camera)
    if topics.camera_height_m is not None and (is_metric(log) or source != "visual"):
        warn("--camera-height-m has no effect: the odometry is no single camera's.")
    if not odometry.metric:
        odometry = _with_scale(odometry, log, camera, use_gps)
    stamp_ns = odometry.stamp_ns if odometry.of_images else log.stamps()  # frames that were followed
    selected, warnings = select_keyframes(log.name, stamp_ns, odometry, settings)
    for warning in warnings + ways_without_images(log, topics, selected, odometry):
        warn(warning)
    if _is_unknown(odometry):
        camera = replace(camera, matrix=None, distortion_model="none", distortion=np.zeros(0))
    elif camera.matrix is None:
        warn(
            f"Camera {camera.name} is not calibrated, so no closure gets a metric pose: the trajectory is the "
            "odometry's. Record its camera_info, or name it with --camera-info-topic."
        )
    return odometry, camera, selected


def _with_imu(odometry: Odometry, imu: Imu, camera: Camera) -> Odometry:
    """Odometry with what the IMU says, noted."""
    found = with_imu(odometry, imu, camera)
    if isinstance(found, str):
        warn(f"Visual odometry does without the IMU {imu.name}: {found}.")
        return odometry
    what = "gravity"
    if not odometry.metric and found.odometry.metric:
        what += f" and metres, its unit {found.scale:.3g} m with a sigma of {found.sigma:.1%}"
    if found.bridged:
        what += f", and goes on across {plural(found.bridged, 'break')}"
    warn(f"Visual odometry takes {what} from the IMU {imu.name}.")
    if not found.odometry.metric:
        sigma = f"{found.sigma:.0%}" if found.sigma < 1 else "more than its size"
        warn(
            f"The drive accelerates too little for metres by the IMU: they would have a sigma of {sigma}, at most "
            f"{100 * SURE:.0f} % is taken."
        )
    return found.odometry


def _with_scale(odometry: Odometry, log: Log, camera: Camera, use_gps: bool) -> Odometry:
    """Odometry in units of its own, in metres by fixes where that can be."""
    gps = log.gps()
    if _is_unknown(odometry):
        return odometry
    if gps is None:
        warn(f"{UNIT} `vplog evaluate` aligns with a scale; --camera-height-m gives metres over flat ground.")
    elif not use_gps:
        warn(f"{UNIT} --gps takes metres from the fixes.")
    elif (found := in_metres(odometry, gps, camera)) is not None:
        return found
    else:
        warn(f"{UNIT} The fixes do not go far enough for metres.")
    return odometry


def camera_of(log: Log, topics: TopicChoice, steps: Steps) -> Camera:
    """The camera of a run: that of the log, or where its motion is to be computed from images that nothing calibrates,
    with the lens that they tell, or else an assumed one."""
    camera = log.camera()
    if camera.matrix is not None or source_of(log, topics) != "visual":
        return camera
    placed = camera.body_from_camera  # pictures have none: their truth may be poses of the camera
    lens = steps(self_calibrated, log, steps.cache.inputs, image_topics(topics, camera.name))
    return replace(lens.of(camera), body_from_camera=AHEAD if np.array_equal(placed, np.eye(4)) else placed)


def is_metric(log: Log) -> bool:
    """Whether there is a calibrated camera with depth or a stereo pair."""
    with suppress(LogError):  # no images
        return log.camera().matrix is not None and log.has_depth()
    return False


def gives_visual(log: Log) -> bool:
    """Whether there are images by which a run computes its odometry unasked: of any camera, but no pictures
    whose names hold no times, which need not follow each other."""
    with suppress(LogError):  # no images
        return is_metric(log) or (len(log.stamps()) > 1 and not getattr(log, "assumed_times", False))
    return False


def check_metric(log: Log, topics: TopicChoice, odometry: Odometry | None = None) -> None:
    """Raise LogError where a drive has no metres by its odometry, or before that is computed, nothing that may give
    them, or no odometry at all, so that no other drive is joined with it."""
    if odometry is None:
        given = source_of(log, topics) != "visual" or topics.camera_height_m is not None
        metric = given or is_metric(log) or log.imu() is not None
    else:
        metric = odometry.metric
    if not metric:
        raise LogError(
            f"{log.name}: the visual odometry of a single camera has no metres, so no other drive is joined with it. "
            "Run it by itself, or give --camera-height-m, or its poses by --odometry-file."
        )


def source_of(log: Log, topics: TopicChoice) -> Literal["log", "visual", "lidar"]:
    """The source of the odometry. Raises LogError where there is none at all.

    Unasked, images with depth come before a lidar: they need no transforms to a second sensor and no extra to be
    installed, so that a log gives one result everywhere; and a cloud may be a depth camera's, which registers worse.
    A single camera comes last, as it has no metres.
    """
    odometry = log.odometry()
    if odometry is not None and len(odometry.stamp_ns) > 1:
        return "log"
    if topics.odometry == "visual":
        log.camera()  # raises where there are no images
        return "visual"
    if topics.odometry is None and is_metric(log):
        return "visual"
    if log.lidar() is not None:
        return "lidar"
    if topics.odometry is None and gives_visual(log):
        return "visual"
    requested = f" by --odometry {topics.odometry}" if topics.odometry else ""
    raise LogError(f"{log.name} has no odometry{requested}, and a trajectory is built on it. {log.without_odometry()}")


def odometry_of(log: Log, topics: TopicChoice, camera: Camera, steps: Steps) -> Odometry:
    """The odometry of a drive whose camera is given. Raises LogError where there is none."""
    odometry, source = log.odometry(), source_of(log, topics)
    if source == "log" and odometry is not None:
        return odometry
    given = log, topics.odometry is None, steps.cache.inputs, image_topics(topics, log.camera().name)
    if source == "lidar":
        return steps(by_lidar, *given)
    return steps(by_images, *given, camera, topics.camera_height_m)


@step("odometry", lambda *_: json_codec(_from_plain, _plain), lambda log, *_: len(log.stamps()), ("log",))
def by_images(
    log: Log, unasked: bool, inputs: Inputs, images: dict[str, Any], camera: Camera, height_m: float | None,
    *, execution: Execution,
) -> Odometry:  # fmt: skip
    """Visual odometry, its breaks noted, in metres where the height of a single camera gives them. Where tracking fails
    from the first frame to the last: without depth a motion of which nothing is known, else raises LogError."""
    if unasked:
        warn("The log has no odometry, so visual odometry of its images is used (--odometry visual).")
    stamp_ns, metric = log.stamps(), is_metric(log)
    odometry = visual_odometry(decoded(log, stamp_ns, execution, "odometry"), camera, metric, height_m)
    if odometry is None and metric:
        raise LogError(
            f"{log.name}: no two of {len(stamp_ns)} frames could be tracked: too few corners with depth, or too little "
            "in common from one frame to the next. --odometry-file takes poses from a file."
        )
    if odometry is None:
        warn(
            f"No two of {len(stamp_ns)} frames could be tracked: too few corners, too little in common from one frame "
            "to the next, or a camera that only turns. Nothing is known of the motion: only the places recognised mean "
            "something, and the trajectory does not. --odometry-file takes poses from a file."
        )
        return _unknown(stamp_ns)
    if height_m is not None and not metric:
        warn(
            f"The camera's height of {height_m:.2f} m over the ground gives visual odometry its metres."
            if odometry.metric
            else "The images show no flat ground ahead of the camera often enough, so that its height of "
            f"{height_m:.2f} m gives no metres."
        )
    _warn_of_breaks("Visual odometry", odometry, stamp_ns, "frames")
    return odometry


@step("odometry", lambda *_: json_codec(_from_plain, _plain), lambda log, *_: len(log.lidar().stamp_ns), ("log",))
def by_lidar(log: Log, unasked: bool, inputs: Inputs, images: dict[str, Any], *, execution: Execution) -> Odometry:
    """The odometry of the lidar, its breaks noted. Raises LogError where no two scans match."""
    lidar = log.lidar()
    if lidar is None:
        raise LogError(f"{log.name} has no lidar. {log.without_odometry()}")
    if unasked:
        warn(f"The log has no odometry, so that of its lidar {lidar.name} is used (--odometry lidar).")
    stamp_ns = lidar.stamp_ns
    range_m = range_of(log.scans(stamp_ns[:: max(len(stamp_ns) // _SAMPLES, 1)]))
    scans = execution.counted("odometry", log.scans(stamp_ns), len(stamp_ns))
    odometry = lidar_odometry(scans, range_m, lidar)
    if odometry is None:
        raise LogError(
            f"{log.name}: no two of {len(stamp_ns)} scans of {lidar.name} match: too few points, or too little in "
            "common from one scan to the next. --odometry-file takes poses from a file."
        )
    _warn_of_breaks(f"Odometry of {lidar.name}", odometry, stamp_ns, "scans")
    return odometry


def _unknown(stamp_ns: np.ndarray) -> Odometry:
    """A motion of which nothing is known, with a break at every frame, by which keyframes are evenly spread in time."""
    poses = np.tile(np.eye(4), (len(stamp_ns), 1, 1))
    seconds = (stamp_ns - stamp_ns[0]) / 1e9
    poses[:, 0, 3] = seconds * max(_SPEED, _SHORTEST / max(float(seconds[-1]), 1e-9))
    covariance = np.tile(np.eye(6), (len(stamp_ns), 1, 1))
    return Odometry(stamp_ns, poses, covariance, breaks=np.arange(1, len(stamp_ns)), metric=False)


def _is_unknown(odometry: Odometry) -> bool:
    """Whether it is `_unknown`."""
    return not odometry.metric and len(odometry.breaks) == len(odometry.stamp_ns) - 1


def _warn_of_breaks(what: str, odometry: Odometry, stamp_ns: np.ndarray, of: str) -> None:
    """Warn of lost frames or scans, whose stamps are given, and of breaks."""
    if lost := int((~has_odometry(stamp_ns, odometry.stamp_ns, PERIOD_NS)).sum()):
        warn(f"{what} lost its track in {lost} of {len(stamp_ns)} {of}.")
    breaks = odometry.breaks
    if not len(breaks):
        return
    seconds = (odometry.stamp_ns[breaks] - stamp_ns[0]) / 1e9
    named = ", ".join(f"{second:.1f} s" for second in seconds[:_NAMED].tolist())
    more = f" and {len(breaks) - _NAMED} more" if len(breaks) > _NAMED else ""
    warn(
        f"{what} starts again at {named}{more} after the first of the {of}: the drive has {len(breaks) + 1} pieces, "
        "which only closures relate to each other."
    )


_ARRAYS = {"stamp_ns": np.int64, "odom_from_body": np.float64, "covariance": np.float64, "breaks": np.int64}
"""Fields of computed odometry, and their types."""
_FLAGS = ("metric", "of_images", "increments")


def _plain(odometry: Odometry) -> dict[str, Any]:
    return {name: getattr(odometry, name).tolist() for name in _ARRAYS} | {
        name: getattr(odometry, name) for name in _FLAGS
    }


def _from_plain(tree: dict[str, Any]) -> Odometry:
    arrays: dict[str, Any] = {name: np.array(tree[name], kind) for name, kind in _ARRAYS.items()}
    count = len(arrays["stamp_ns"])
    if arrays["odom_from_body"].shape != (count, 4, 4) or arrays["covariance"].shape != (count, 6, 6):
        raise ValueError("poses and covariances do not fit the stamps")
    metric, of_images, increments = (bool(tree[name]) for name in _FLAGS)
    return Odometry(**arrays, metric=metric, of_images=of_images, increments=increments)
