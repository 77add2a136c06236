"""Ground truth of a drive: a file of poses, or its GPS fixes, which are positions only."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from vplog.data import Floats, Gps, Ints, Trajectory
from vplog.errors import TruthError, nearest
from vplog.evaluate.trajectory import Ate, Matched, ate_together
from vplog.geometry import geodesy, se3
from vplog.geometry.pose_conventions import AS_GIVEN
from vplog.geometry.tum import read_tum
from vplog.storage.remote_path import located
from vplog.storage.urls import shown

_NOT_COVERED = 0.05
"""Keyframes outside the truth as a share of those within that are spoken of: more than a truth's late start."""


def read_truth(place: str | Path, kinds: Iterable[str] = ("gps", "auto")) -> Trajectory:
    """A TUM file, here or by URL: world_from_body, s and m, in any order. `kinds` are what may be meant by a name that
    is no file.

    Raises TruthError with the first line that does not fit, SettingsError for a URL of no known kind.
    """
    path = located(place)
    if not path.exists() and (near := nearest(str(place), kinds)):
        raise TruthError(f"--truth {shown(str(place))}: there is no such file.{near}")
    return Trajectory(*read_tum(path, TruthError, "--truth"))


def local_enu(gps: Gps) -> tuple[Ints, Floats]:
    """Stamps and positions (T, 3) in m east, north and up of the first fix, without fixes that hold no position.

    Raises TruthError where no fix holds a position.
    """
    local = _usable(gps)
    return local.stamp_ns, local.enu_m


def _usable(gps: Gps) -> geodesy.LocalFixes:
    local = geodesy.local_enu(gps)
    if not len(local):
        raise TruthError(f"None of the {len(gps.stamp_ns)} GPS fixes holds a position. Give a TUM file with --truth.")
    return local


def ate_to_gps(estimate: Trajectory, gps: Gps, alignment: str = "se3") -> Ate:
    """Return the ATE of `matched_fixes` after an alignment of ALIGNMENTS. Raises TruthError as `matched_fixes`."""
    return ate_together([matched_fixes(estimate, gps)], alignment)[0]


def matched_fixes(estimate: Trajectory, gps: Gps) -> Matched:
    """Return the estimate at the stamps of the fixes, and the fixes as poses without rotation in m from the centre of
    the earth.

    The estimate is interpolated, and moved to the antenna if its place on the body is known, in the estimate's unit of
    length. Raises TruthError if fewer than three fixes lie within the estimate.
    """
    fixes = _usable(gps)
    stamp_ns, positions = fixes.stamp_ns, geodesy.earth_centred(fixes.enu_m, fixes.origin)
    if len(estimate.stamp_ns) < 2:
        raise TruthError("The trajectory has fewer than 2 poses: too few to compare with GPS. Run on more of the log.")
    if not np.isfinite(estimate.world_from_body).all():
        raise TruthError("The estimated trajectory holds a pose that is not finite. Run `vplog run` again.")
    inside = (stamp_ns >= estimate.stamp_ns[0]) & (stamp_ns <= estimate.stamp_ns[-1])
    if inside.sum() < 3:
        raise TruthError(
            f"Only {inside.sum()} of {len(inside)} GPS fixes lie within the drive; 3 are needed. Give a TUM file with "
            "--truth."
        )
    poses = se3.interpolate_at(estimate.stamp_ns, estimate.world_from_body, stamp_ns[inside])
    antenna_m = np.zeros(3) if gps.antenna_m is None else gps.antenna_m
    return poses @ se3.pose(np.eye(3), antenna_m), se3.pose(np.eye(3), positions[inside])


def truth_warnings(found: dict[str, Any]) -> list[str]:
    """Warnings that bear on the figures of one drive, by the record of `evaluate`."""
    truth, warnings = found["truth_is"], []
    if found["scale"] is not None:
        warnings.append(
            "The run has no metres of its own: Sim(3) alignment finds them, and all lengths and figures are multiplied "
            f"by {found['scale']:.4g}."
        )
    if truth["two_trajectories"]:
        return [
            *warnings,
            "The poses of the truth alternate between two places, so the file holds two trajectories and no figure "
            "means anything. Give a file with one trajectory.",
        ]
    if truth["convention"] != AS_GIVEN:
        warnings.append(
            f"The poses of the truth are {truth['convention']}. They were converted to world_from_body with "
            "quaternions x y z w, because only then do they move as the odometry does. Convert the file to "
            "silence this warning."
        )
    if truth["unit"] != "m":
        warnings.append(
            f"The truth is in {truth['unit']}, because its path is that much longer than the odometry's. It was "
            "converted to m. Convert the file to silence this warning."
        )
    if truth["length_scale"] is not None:
        warnings.append(
            f"The path of the truth is {truth['length_scale']:.3g} times as long as the odometry's, so closures with "
            "correct lengths are judged false. Check the scale of the truth, and the wheel radius or baseline."
        )
    if truth["frame"] != "body":
        what = (
            "the camera"
            if truth["frame"] == "camera"
            else "another point or other axes of the body, found by the odometry"
        )
        warnings.append(f"The truth is that of {what}: closures and drift are the body's, ATE and RPE are not.")
    if truth["offset_s"] is not None:
        warnings.append(
            "The truth is of another clock: it moves as the odometry does with "
            f"--truth-offset-s {truth['offset_s']:g}. Without that, figures and closures are judged at wrong times."
        )
    elif truth["other_motion"]:
        warnings.append(
            f"The truth does not move as the odometry does (median difference {truth['disagreement']:.0%} of the "
            "motion). Is it of another drive, is its clock more than 5 s off, are its poses world_from_body and its "
            "quaternions x y z w?"
        )
    if truth["odometry"]:
        warnings.append("The odometry of this run is the truth itself: only the scores of its closures mean something.")
    if not truth["oriented"]:
        warnings.append(
            "The truth has no orientations, so closures are judged by place, without heading, and there is no RPE and "
            "no drift. For these, give a truth with orientations."
        )
    if found["interpolated"]:
        warnings.append("Few poses have a stamp within 0.01 s of the truth's: poses are interpolated at its stamps.")
    keyframes, outside = found["closures"]["keyframes"], found["closures"]["outside"]
    if outside > keyframes * _NOT_COVERED:
        warnings.append(f"The truth covers {keyframes} of {keyframes + outside} keyframes: all figures are of these.")
    return warnings
