"""The ledger of a drive's candidates, checked in parts, so that a kill costs at most the last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from itertools import chain
from typing import Any

import numpy as np

from vplog.data import Camera, Closures, Ints, Keyframes, Trajectory, Verdict
from vplog.execution.execution import Execution
from vplog.loops.candidate import Drive
from vplog.loops.propose import Proposals
from vplog.loops.verify import VerifySettings, calibration_share, drive_of, no_closures, verify_between
from vplog.run.cache.codecs import closures_codec, json_codec
from vplog.run.cache.feature_shards import Extracted
from vplog.run.cache.steps import Steps, step

_PART_CANDIDATES = 1000
"""Candidates of a part: 5 to 10 s of one core, as a part of the keyframes."""


@dataclass(frozen=True, eq=False)
class DriveFeatures:
    """The keyframes of a drive with their features, and the settings by which closures between them are verified."""

    keyframes: Keyframes
    camera: Camera
    features: Extracted
    settings: VerifySettings
    odometry: Trajectory
    """odom_from_body, between the keyframes as well."""


def for_verification(drive: DriveFeatures) -> Drive:
    """Raises LogError for a calibrated camera with an unknown distortion model."""
    features, settings = drive.features, drive.settings
    matches = features.matches(settings.matching)
    return drive_of(drive.keyframes, drive.camera, features.__getitem__, settings, matches)


@step("verify", items=lambda proposals, *_: len(proposals.query))
def verify(proposals: Proposals, drive: DriveFeatures, *, steps: Steps) -> Closures:
    """The ledger of `loops.verify.verify_between`, whose row depends on its two frames and the calibration alone.

    The best candidates of every keyframe are verified, and the others where one of those, or of a neighbouring
    keyframe's, shows the same view; where none does, or `enough` of the best are accepted, they are left out. A part
    has all candidates of some map frames, whose landmarks are made once all the same.
    """
    if not len(proposals.query):
        return no_closures()
    share, best = calibrated(drive, steps), proposals.rank < drive.settings.always

    def verified(rows: Ints) -> Closures:
        parts = [rows[part] for part in _parts(proposals.match[rows])]
        return merged(steps.in_parts(verify_part, [(proposals.rows(part), share, drive) for part in parts]), parts)

    first = verified(np.flatnonzero(best))
    alike = first.query[~first.of(Verdict.TOO_FEW_MATCHES)]
    near = np.isin(proposals.query, np.concatenate([alike - 1, alike, alike + 1]))
    others = ~best & near
    if drive.settings.enough:
        accepted = np.bincount(first.query[first.accepted], minlength=len(drive.keyframes.stamp_ns))
        others &= accepted[proposals.query] < drive.settings.enough
    more = np.flatnonzero(others)
    return merged([first, verified(more)], [np.flatnonzero(best), more]) if len(more) else first


def calibrated(drive: DriveFeatures, steps: Steps) -> float:
    """Relative error of rotations by the calibration, 0 without one."""
    return 0.0 if drive.camera.matrix is None else steps.part(calibrate, drive)


@step("calibrate", lambda *_: json_codec(float, float))
def calibrate(drive: DriveFeatures, *, execution: Execution) -> float:
    """Relative error of rotations by the calibration, see `loops.verify.calibration_share`."""
    return calibration_share(for_verification(drive), execution, drive.odometry)


@step("verify", lambda *_: closures_codec(), items=lambda proposals, *_: len(proposals.query))
def verify_part(proposals: Proposals, share: float, drive: DriveFeatures, *, execution: Execution) -> Closures:
    """The ledger of some candidates."""
    views = for_verification(drive)
    return verify_between(proposals, views, views, execution, share)


def _parts(match: np.ndarray) -> list[Ints]:
    """Rows of the candidates of each part, by map frame."""
    order = np.argsort(match, kind="stable")
    begins = np.flatnonzero(np.diff(match[order], prepend=-1))
    # a map frame goes to the part in which its first candidate falls
    number = np.repeat(begins // _PART_CANDIDATES, np.diff(begins, append=len(order)))
    return [np.sort(order[number == part]) for part in np.unique(number)]


def merged(parts: Sequence[Closures], rows: Sequence[Ints]) -> Closures:
    """One ledger of several parts, by the numbers `rows` of their candidates."""
    place = np.argsort(np.concatenate(rows), kind="stable")
    columns: dict[str, Any] = {}
    for field in fields(Closures):
        values = [getattr(part, field.name) for part in parts]
        joined = np.concatenate(values) if isinstance(values[0], np.ndarray) else list(chain.from_iterable(values))
        columns[field.name] = joined[place] if isinstance(joined, np.ndarray) else [joined[at] for at in place.tolist()]
    return Closures(**columns)
