"""Self-calibration of a run's camera where nothing calibrates it, by excerpts of the drive, or an assumed lens."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import cv2
import numpy as np

from vplog.data import Camera, Frame
from vplog.errors import LogError
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import warn
from vplog.geometry.masking import masked
from vplog.odometry.self_calibration import EXCERPT, Lens, lens_of
from vplog.run.cache.codecs import json_codec
from vplog.run.cache.stage_cache import Inputs
from vplog.run.cache.steps import step
from vplog.stages import EncodedFrame, Log

_FOCAL_LENGTH = 1.2
"""Focal length of a camera that is not calibrated as a share of the longer side of its images, where they do not tell
it: COLMAP's, a field of view of 45 degrees; phones have some 0.7 to 1.2."""
_RATE_HZ = 15.0
"""Frames a second of an excerpt, at most: 5 s, in which a car passes a bend."""
_MOST_APART = 8
"""One of so many frames at least, as at 120 Hz: stamps may run faster than the camera did."""
_EXCERPTS = 6
"""Excerpts that are tried until two agree, and as many more where a longer drive turns most: a straight one tells
nothing, and a car turns for some % of its time."""
_PLACES = 120
"""Places of a drive at which it is looked how far the images turn."""
_SMALL = (64, 36)
"""px of the images that are compared there."""
_GOLDEN = 0.618034
"""Multiples of it, without their integers, spread evenly however many there are."""


def assumed(camera: Camera) -> Lens:
    """The lens of a camera whose images do not tell it."""
    return Lens(_FOCAL_LENGTH * max(camera.width, camera.height), 0.0)


def about_uncalibrated(camera: Camera) -> str:
    """Remark on an uncalibrated camera before a run: self-calibration, else assumptions."""
    return (
        f"Camera {camera.name} is not calibrated: where the motion of its images does not tell its focal length, "
        f"{_about_assumed(camera)}"
    )


def _about_assumed(camera: Camera) -> str:
    return (
        f"{assumed(camera).focal_px:.0f} px ({_FOCAL_LENGTH} times the longer side of its images) and no distortion "
        "are assumed, its centre in their middle. --calibration takes all from a file."
    )


@step("self_calibration", lambda *_: json_codec(lambda found: Lens(*found), list), without=("log",))
def self_calibrated(log: Log, inputs: Inputs, images: dict[str, Any], *, execution: Execution) -> Lens:
    """The lens of an uncalibrated camera by its images, else the assumed one; noted."""
    camera = log.camera()
    lens = lens_of(_excerpts(log, execution), camera)
    if lens is None:
        warn(
            f"Camera {camera.name} is not calibrated, and the motion of its images does not tell its focal length: "
            f"{_about_assumed(camera)}"
        )
        return assumed(camera)
    focal_px, distortion = lens
    warn(
        f"Camera {camera.name} is not calibrated: by the motion of its images a focal length of {focal_px:.0f} px and "
        f"a radial distortion of {distortion:.3f} are used, its centre in their middle. --calibration takes all from a "
        "file."
    )
    return lens


def _excerpts(log: Log, execution: Execution) -> Iterator[Callable[[], Iterator[Frame]]]:
    """Readers of excerpts that are spread over the drive, in a long one also of those where it turns; of one shorter
    than an excerpt the whole, twice."""
    stamp_ns = log.stamps()
    if len(stamp_ns) < 2:
        return
    every = min(max(round(1e9 / _RATE_HZ / float(np.median(np.diff(stamp_ns)))), 1), _MOST_APART)
    last = max(len(stamp_ns) - EXCERPT * every, 0)
    spread = [round(last * ((number + 1) * _GOLDEN % 1.0)) for number in range(_EXCERPTS if last else 2)]
    turning = _turning(log, stamp_ns, every, execution) if len(stamp_ns) > _EXCERPTS * EXCERPT * every else iter(())
    left = iter(spread)
    for kind in (left, turning, turning, left) * (_EXCERPTS // 2):  # both kinds with both lenses that they begin with
        if (first := next(kind, None)) is not None:
            excerpt = stamp_ns[first : first + EXCERPT * every : every]
            yield partial(decoded, log, excerpt, execution, "self_calibration")


def _turning(log: Log, stamp_ns: np.ndarray, every: int, execution: Execution) -> Iterator[int]:
    """First rows of excerpts about the places where the images move sideways most, none in another."""
    long, last = EXCERPT * every, len(stamp_ns) - EXCERPT * every
    rows = np.unique(np.round((len(stamp_ns) - 1 - every) * (np.arange(1, _PLACES + 1) * _GOLDEN % 1.0)).astype(int))
    pairs = stamp_ns[np.unique([rows, rows + every])]
    small = {
        frame.stamp_ns: np.asarray(cv2.resize(frame.image, _SMALL, interpolation=cv2.INTER_AREA), np.float32)
        for frame in decoded(log, pairs, execution, "self_calibration")
    }
    window, moved = cv2.createHanningWindow(_SMALL, cv2.CV_32F), dict[int, float]()
    for row in rows.tolist():
        one, other = (small.get(int(stamp_ns[at])) for at in (row, row + every))
        if one is not None and other is not None:
            (x, _), response = cv2.phaseCorrelate(one, other, window)
            moved[row] = abs(x) * response
    chosen = list[int]()
    for row in sorted(moved, key=lambda row: -moved[row]):
        if len(chosen) < _EXCERPTS and all(abs(row - other) >= long for other in chosen):
            chosen.append(row)
            yield min(max(row - long // 2, 0), last)


def decoded(log: Log, stamp_ns: np.ndarray, execution: Execution, stage: str) -> Iterator[Frame]:
    """All frames of these stamps (F,) that decode, in order."""

    def work(encoded: EncodedFrame) -> Frame | None:
        try:
            return masked(encoded.decode())
        except LogError:
            return None  # counted by the log

    frames = execution.map(work, log.frames(stamp_ns))
    return (frame for frame in execution.counted(stage, frames, len(stamp_ns)) if frame is not None)
