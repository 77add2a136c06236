"""Epipolar verification of a candidate without calibration, which estimates no pose."""

from __future__ import annotations

import cv2
import numpy as np
from pydantic import Field

from vplog.data import Bools, Float32s, Verdict
from vplog.loops.verify_metric import Pose, log10_false_alarms
from vplog.settings import Settings

_SAMPLE = 7
"""Matches that fix a fundamental matrix."""
_MODELS = 3
"""Fundamental matrices that seven matches allow: Hartley & Zisserman 2004, section 11.1.2."""


class EpipolarSettings(Settings):
    """Acceptance of two uncalibrated images as views of one place."""

    min_inliers: int = Field(default=20, ge=8)
    """Matches that must agree; a line is a weak test, so no fewer than for a pose."""
    log10_false_alarms: float = Field(default=-6.0, le=0)
    """Most wrong geometries expected by chance, as log10 (Moisan & Stival 2004)."""
    max_error_px: float = Field(default=2.0, gt=0)
    """Distance in px to the epipolar line that is an agreement: two sigmas of a SIFT point."""
    rounds: int = Field(default=2000, ge=1, le=1_000_000)
    """Most samples of RANSAC: a geometry is found with 99 % where 42 % of the matches are right."""
    min_spread: float = Field(default=0.1, ge=0, le=1)
    """Share of the image that the inliers' bounding box must cover; less is one object, not a place."""


def solve(query: Float32s, match: Float32s, width: int, height: int, settings: EpipolarSettings) -> Pose:
    """The verdict on matched pixels (K, 2) of two images of `width` x `height` px: at best `no_calibration`."""
    inlier, is_chance = epipolar_inliers(query, match, width, height, settings)
    count = int(inlier.sum())
    if is_chance or count < settings.min_inliers:
        return Pose(Verdict.TOO_FEW_INLIERS, count, 0.0)
    spread = float(np.prod(np.ptp(query[inlier] / [width, height], axis=0)))
    verdict = Verdict.NO_CALIBRATION if spread >= settings.min_spread else Verdict.POOR_SPREAD
    return Pose(verdict, count, spread)


def epipolar_inliers(
    query: Float32s, match: Float32s, width: int, height: int, settings: EpipolarSettings
) -> tuple[Bools, bool]:
    """(K,) which matches agree with the epipolar geometry of most, and whether so many may do so by chance."""
    mask = None
    if len(query) > _SAMPLE:
        bounds = settings.max_error_px, 0.99, settings.rounds
        try:
            _, mask = cv2.findFundamentalMat(match, query, cv2.USAC_MAGSAC, *bounds)
        except cv2.error:  # USAC's check for one plane (DEGENSAC) raises where it finds no model beside the plane's
            _, mask = cv2.findFundamentalMat(match, query, cv2.FM_RANSAC, *bounds)
    inlier = np.zeros(len(query), bool) if mask is None else np.asarray(mask).ravel().astype(bool)
    # a line crosses the image over its diagonal at most: Moisan & Stival 2004, eq. 9
    share = 2.0 * settings.max_error_px * np.hypot(width, height) / (width * height)
    alarms = log10_false_alarms(len(query), int(inlier.sum()), _SAMPLE, _MODELS, share)
    return inlier, alarms > settings.log10_false_alarms
