"""Selection of keyframes: by motion, never two with the same stamp, none where odometry is missing."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from vplog.data import Bools, Floats, Ints, Keyframes, Odometry
from vplog.errors import LogError, plural
from vplog.geometry import se3
from vplog.logs.stamps import longest_gap_ns
from vplog.settings import Settings

if TYPE_CHECKING:
    from vplog.logs import TopicChoice
    from vplog.stages import Log

_PAPER_SPACING_M = 1.0
"""m; the paper takes views 1-5 m apart (section IV): the near end."""
_LEAST_SPACING_M = 0.05
"""m; closer views, even indoors, hardly differ (at 2 m distance 5 cm is 1.4 degrees of parallax)."""

_BLIND_S, _BLIND_SHARE, _BLIND_STEPS = 10.0, 0.05, 10
"""s, share of the odometry's time, and spacings of keyframes from which a way without images is warned of."""


class KeyframeSettings(Settings):
    """A frame becomes a keyframe when the odometry has moved or turned far enough since the last one."""

    distance_m: float | None = Field(default=None, ge=0)
    """Spacing in m; None takes 1 m, or a thousandth of the path where that is shorter (at least 5 cm)."""
    sparseness: float = Field(default=1.0, gt=0, le=1000)
    """Times the spacing that is taken where `distance_m` is None: 2 makes half as many keyframes."""
    rotation_deg: float = Field(default=10.0, ge=0)
    """Turning by this much makes a keyframe too: a tenth to a seventh of a usual field of view."""
    max_odometry_gap_s: float | None = Field(default=None, ge=0, le=1e9)
    """Frames in a longer gap of the odometry are left out: what happened there is not known. None takes 1 s, or three
    times the odometry's own period where that is longer: two samples lost in a row."""


def select_keyframes(
    drive: str, stamp_ns: Ints, odometry: Odometry, settings: KeyframeSettings
) -> tuple[Keyframes, list[str]]:
    """Keyframes among the frames with these (F,) increasing stamps, and what was left out, a sentence each.

    Raises LogError where no two frames have odometry.
    """
    if len(stamp_ns) < 2:
        raise LogError(
            f"{drive} has {plural(len(stamp_ns), 'frame')}, and a graph needs two. Give a longer part of it."
        )
    warnings = []
    covered = is_covered(stamp_ns, odometry, settings)
    if missing := int((~covered).sum()):
        warnings.append(f"{missing} of {plural(len(stamp_ns), 'frame')} without odometry at its stamp left out.")
    stamp_ns = np.unique(stamp_ns[covered])
    if len(stamp_ns) < 2:
        raise LogError(
            f"{drive}: no two frames have odometry at their stamps "
            f"(odometry covers {odometry.stamp_ns[0]} to {odometry.stamp_ns[-1]} ns). "
            "Compare the clocks with `vplog info`, or choose another topic with --odometry-topic."
        )
    poses = se3.interpolate_at(odometry.stamp_ns, odometry.odom_from_body, stamp_ns)
    # the first of each piece of two samples or more: else closures may not find a short one
    begin = odometry.breaks[np.diff(odometry.breaks, append=len(odometry.stamp_ns)) > 1]
    begins = np.searchsorted(stamp_ns, odometry.stamp_ns[begin])
    rows = _far_enough(poses, _spacing(poses, settings), np.deg2rad(settings.rotation_deg), begins)
    return Keyframes(drive, stamp_ns[rows], poses[rows]), warnings


def ways_without_images(log: Log, topics: TopicChoice, keyframes: Keyframes, odometry: Odometry) -> list[str]:
    """A warning where the odometry moves on and there are no images, as of a camera that stops or starts late; none
    where --start or --stop leave images out."""
    known, stamp_ns, position = odometry.stamp_ns, log.stamps(), keyframes.odom_from_body[:, :3, 3]
    if topics.start_s is not None or topics.stop_s is not None or len(position) < 2:
        return []
    edges = np.concatenate([known[:1], np.clip(stamp_ns, known[0], known[-1]), known[-1:]])
    longest_ns = max(_BLIND_S * 1e9, _BLIND_SHARE * (known[-1] - known[0]), longest_gap_ns(stamp_ns))
    step_m = max(float(np.median(np.linalg.norm(np.diff(position, axis=0), axis=1))), _LEAST_SPACING_M)
    found = []
    for at in np.flatnonzero(np.diff(edges) > longest_ns).tolist():
        begin, end = np.searchsorted(known, edges[at : at + 2])
        inside = odometry.odom_from_body[begin:end, :3, 3]
        far_m = float(np.linalg.norm(inside - inside[:1], axis=1).max(initial=0.0))
        if far_m >= _BLIND_STEPS * step_m:
            found.append((far_m, (edges[at + 1] - edges[at]) / 1e9, (edges[at] - known[0]) / 1e9))
    if not found:
        return []
    far_m, seconds, since_s = max(found)
    more = f", and {plural(len(found) - 1, 'time')} more" if len(found) > 1 else ""
    further = "Did the camera stop, or start late?"
    if log.further_cameras():
        further = "Further cameras count at its images alone: name one that has more of them first, with --image-topic."
    return [
        f"{log.camera().name} has no images for {seconds:.0f} s, from {since_s:.0f} s of the odometry on{more}, while "
        f"the body moves on by {far_m:.3g} m: no place is recognised there. {further}"
    ]


def row_of(keyframes: Keyframes, name: int | str) -> int | None:
    """The row of the keyframe that a row or a stamp in ns names, None where there is none."""
    if not re.fullmatch("[0-9]{1,19}", str(name)):
        return None
    number, count = int(name), len(keyframes.stamp_ns)
    row = number if number < count else int(np.searchsorted(keyframes.stamp_ns, number))
    return row if row == number or (row < count and keyframes.stamp_ns[row] == number) else None


def is_covered(stamp_ns: Ints, odometry: Odometry, settings: KeyframeSettings) -> Bools:
    """(F,) whether odometry is known at each stamp."""
    longest_s = settings.max_odometry_gap_s
    gap_ns = longest_gap_ns(odometry.stamp_ns) if longest_s is None else int(longest_s * 1e9)
    return has_odometry(stamp_ns, odometry.stamp_ns, gap_ns)


def has_odometry(stamp_ns: Ints, odometry_ns: Ints, gap_ns: int) -> Bools:
    """(F,) whether odometry has a sample at each stamp, or samples at most `gap_ns` apart about it."""
    right = np.searchsorted(odometry_ns, stamp_ns)
    inside = (right > 0) & (right < len(odometry_ns))
    right = np.minimum(right, len(odometry_ns) - 1)
    sampled = odometry_ns[right] == stamp_ns  # known whatever lies beside it
    return sampled | (inside & (odometry_ns[right] - odometry_ns[right - 1] <= gap_ns))


def _spacing(poses: Floats, settings: KeyframeSettings) -> float:
    if settings.distance_m is not None:
        return settings.distance_m
    apart = poses[_far_enough(poses, _LEAST_SPACING_M, np.pi)]  # noise of a robot that stands is no way
    path_m = float(np.linalg.norm(np.diff(apart[:, :3, 3], axis=0), axis=1).sum())
    return settings.sparseness * float(np.clip(path_m / 1000.0, _LEAST_SPACING_M, _PAPER_SPACING_M))


def _far_enough(poses: Floats, distance_m: float, rotation_rad: float, always: Ints | None = None) -> list[int]:
    """Rows of poses that have moved or turned so far since the one before; rows `always` are among them."""
    least_trace = 1.0 + 2.0 * np.cos(min(rotation_rad, np.pi)) + 1e-12
    rows, chosen = [0], set() if always is None else set(always.tolist())
    for row in range(1, len(poses)):
        last, this = poses[rows[-1]], poses[row]
        turned = (last[:3, :3] * this[:3, :3]).sum() <= least_trace  # the trace of the rotation between them
        if turned or row in chosen or np.linalg.norm(this[:3, 3] - last[:3, 3]) >= distance_m:
            rows.append(row)
    return rows
