"""Frames in, features out: decoding and extraction on all cores, in the order of the log, few frames at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Features, Frame
from vplog.errors import LogError
from vplog.features.stereo_depth import StereoSettings, stereo_depth
from vplog.geometry.masking import masked
from vplog.stages import EncodedFrame, Extractor

if TYPE_CHECKING:
    from vplog.execution.execution import Execution


def extract_frames(
    frames: Iterable[EncodedFrame], extractor: Extractor, execution: Execution, stereo: StereoSettings | None = None
) -> Iterator[tuple[int, Frame | None, Features | None, str]]:
    """(stamp_ns, frame, features, why not) of every frame in order; frame and features are None where undecodable.

    With `stereo`, features of a frame with a right image and no depth image get their depth from the pair.
    """

    def work(encoded: EncodedFrame) -> tuple[int, Frame | None, Features | None, str]:
        try:
            frame = encoded.decode()
        except LogError as error:
            return encoded.stamp_ns, None, None, str(error)
        features = describe(extractor, frame)
        if stereo is not None and frame.depth is None:
            features = with_stereo_depth(features, frame, extractor, stereo)
        return encoded.stamp_ns, frame, features, ""

    return execution.map(work, frames, ahead=2)


def describe(extractor: Extractor, frame: Frame) -> Features:
    """The features of a frame, none of them with a masked centre."""
    features = extractor(masked(frame).image, frame.depth)
    if frame.mask is None:
        return features
    column, row = np.rint(features.points).astype(np.int64).T
    height, width = frame.mask.shape
    return features.rows(np.flatnonzero(frame.mask[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]))


def with_stereo_depth(features: Features, frame: Frame, extractor: Extractor, settings: StereoSettings) -> Features:
    """The features of a frame with depths by its right image; unchanged without one."""
    camera = frame.camera
    if frame.right is None or camera.baseline_m is None or camera.matrix is None:
        return features
    focal_px = float(camera.matrix[0, 0])
    right = extractor(frame.right, None)
    depth_m = stereo_depth(features, right, focal_px, camera.baseline_m, settings, camera.disparity_zero_px)
    return replace(features, depth_m=depth_m)
