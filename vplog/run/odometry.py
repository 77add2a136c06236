"""The odometry of a run: the log's, or where it has none, or it is requested, that of its images or of its lidar."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from vplog.cache.codecs import json_codec
from vplog.cache.steps import Steps, step
from vplog.data import Camera, Frame, Keyframes, Odometry
from vplog.errors import LogError
from vplog.geometry.masking import masked
from vplog.run.feature_extraction import image_topics
from vplog.run.keyframes import KeyframeSettings, select_keyframes
from vplog.run.lidar_odometry import lidar_odometry, range_of
from vplog.run.visual_odometry.visual import visual_odometry

if TYPE_CHECKING:
    from vplog.cache.stage_cache import Inputs
    from vplog.execution.execution import Execution
    from vplog.logs import TopicChoice
    from vplog.stages import EncodedFrame, Log

_log = logging.getLogger(__name__)
_UNCALIBRATED = (
    "Camera %s is not calibrated, so no closure gets a metric pose: the trajectory is the odometry's. "
    "Record its camera_info, or name it with --camera-info-topic."
)
_SAMPLES = 8
"""Scans over the drive by which the range of the lidar is chosen."""
_NAMED = 4
"""Breaks that are named."""


@step("read")
def read(
    log: Log, topics: TopicChoice, settings: KeyframeSettings, *, steps: Steps
) -> tuple[Odometry, Camera, Keyframes]:
    """Odometry, camera and selected keyframes of a drive. Raises LogError where there is no odometry."""
    odometry = odometry_of(log, topics, steps)
    selected, warnings = select_keyframes(log.name, log.stamps(), odometry, settings)
    for warning in warnings:
        _log.warning(warning)
    if (camera := log.camera()).matrix is None:
        _log.warning(_UNCALIBRATED, camera.name)
    return odometry, camera, selected


def gives_visual(log: Log) -> bool:
    """Whether there is a calibrated camera with depth or a stereo pair."""
    with suppress(LogError):  # no images
        return log.camera().matrix is not None and log.has_depth()
    return False


def source_of(log: Log, topics: TopicChoice) -> Literal["log", "visual", "lidar"]:
    """The source of the odometry. Raises LogError where there is none at all.

    Unasked, images come before a lidar: they need no transforms to a second sensor and no extra to be installed, so
    that a log gives one result everywhere; and a cloud may be a depth camera's, which registers worse.
    """
    odometry = log.odometry()
    if odometry is not None and len(odometry.stamp_ns) > 1:
        return "log"
    if topics.odometry in (None, "visual") and gives_visual(log):
        return "visual"
    if topics.odometry != "visual" and log.lidar() is not None:
        return "lidar"
    what = "has no odometry, and a trajectory is built on it"
    if topics.odometry == "visual":
        what = "gives no visual odometry, which needs a calibrated camera with depth images or a stereo pair"
    raise LogError(f"{log.name} {what}. {log.without_odometry()}")


def odometry_of(log: Log, topics: TopicChoice, steps: Steps) -> Odometry:
    """The odometry of a drive. Raises LogError where there is none."""
    odometry, source = log.odometry(), source_of(log, topics)
    if source == "log" and odometry is not None:
        return odometry
    compute = by_lidar if source == "lidar" else by_images
    return steps(compute, log, topics.odometry is None, steps.cache.inputs, image_topics(topics))


@step("odometry", lambda *_: json_codec(_from_plain, _plain), lambda log, *_: len(log.stamps()), ("log",))
def by_images(log: Log, unasked: bool, inputs: Inputs, images: dict[str, Any], *, execution: Execution) -> Odometry:
    """Visual odometry, its breaks noted. Raises LogError where tracking fails from the first frame to the last."""
    if unasked:
        _log.warning("The log has no odometry, so visual odometry of its images is used (--odometry visual).")
    stamp_ns = log.stamps()
    odometry = visual_odometry(_decoded(log, stamp_ns, execution), log.camera())
    if odometry is None:
        raise LogError(
            f"{log.name}: no two of {len(stamp_ns)} frames could be tracked: too few corners with depth, or too little "
            "in common from one frame to the next. --odometry-file takes poses from a file."
        )
    _log_breaks("Visual odometry", odometry, stamp_ns, "frames")
    return odometry


@step("odometry", lambda *_: json_codec(_from_plain, _plain), lambda log, *_: len(log.lidar().stamp_ns), ("log",))
def by_lidar(log: Log, unasked: bool, inputs: Inputs, images: dict[str, Any], *, execution: Execution) -> Odometry:
    """The odometry of the lidar, its breaks noted. Raises LogError where no two scans match."""
    lidar = log.lidar()
    if lidar is None:
        raise LogError(f"{log.name} has no lidar. {log.without_odometry()}")
    if unasked:
        _log.warning("The log has no odometry, so that of its lidar %s is used (--odometry lidar).", lidar.name)
    stamp_ns = lidar.stamp_ns
    range_m = range_of(log.scans(stamp_ns[:: max(len(stamp_ns) // _SAMPLES, 1)]))
    scans = execution.counted("odometry", log.scans(stamp_ns), len(stamp_ns))
    odometry = lidar_odometry(scans, range_m, lidar)
    if odometry is None:
        raise LogError(
            f"{log.name}: no two of {len(stamp_ns)} scans of {lidar.name} match: too few points, or too little in "
            "common from one scan to the next. --odometry-file takes poses from a file."
        )
    _log_breaks(f"Odometry of {lidar.name}", odometry, stamp_ns, "scans")
    return odometry


def _decoded(log: Log, stamp_ns: np.ndarray, execution: Execution) -> Iterator[Frame]:
    """All frames that decode, in order."""

    def work(encoded: EncodedFrame) -> Frame | None:
        try:
            return masked(encoded.decode())
        except LogError:
            return None  # counted by the log

    frames = execution.map(work, log.frames(stamp_ns))
    return (frame for frame in execution.counted("odometry", frames, len(stamp_ns)) if frame is not None)


def _log_breaks(what: str, odometry: Odometry, stamp_ns: np.ndarray, of: str) -> None:
    """Warn of lost frames or scans, whose stamps are given, and of breaks."""
    if lost := len(stamp_ns) - len(odometry.stamp_ns):
        _log.warning("%s lost its track in %d of %d %s.", what, lost, len(stamp_ns), of)
    breaks = odometry.breaks
    if breaks is None or not len(breaks):
        return
    seconds = (odometry.stamp_ns[breaks] - stamp_ns[0]) / 1e9
    named = ", ".join(f"{second:.1f} s" for second in seconds[:_NAMED].tolist())
    more = f" and {len(breaks) - _NAMED} more" if len(breaks) > _NAMED else ""
    _log.warning(
        "%s starts again at %s%s after the first of the %s: the drive has %d pieces, which only closures relate to "
        "each other.",
        what, named, more, of, len(breaks) + 1,
    )  # fmt: skip


_ARRAYS = {"stamp_ns": np.int64, "odom_from_body": np.float64, "covariance": np.float64, "breaks": np.int64}
"""Fields of computed odometry, and their types."""


def _plain(odometry: Odometry) -> dict[str, Any]:
    return {name: getattr(odometry, name).tolist() for name in _ARRAYS}


def _from_plain(tree: dict[str, Any]) -> Odometry:
    arrays: dict[str, Any] = {name: np.array(tree[name], kind) for name, kind in _ARRAYS.items()}
    count = len(arrays["stamp_ns"])
    if arrays["odom_from_body"].shape != (count, 4, 4) or arrays["covariance"].shape != (count, 6, 6):
        raise ValueError("poses and covariances do not fit the stamps")
    return Odometry(**arrays)
