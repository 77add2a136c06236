"""Covariance of the odometry edges between keyframes."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from vplog.data import UNKNOWN_VARIANCE, Bools, Floats, Ints, Odometry
from vplog.errors import GraphError, plural
from vplog.geometry import se3
from vplog.settings import Settings

_MOST_CONSTANTS = 4
"""Covariances that a driver chooses from: for motion and rest, or for straight ways and turns."""
_VAIN = 10.0
"""Sigmas of summed increments as a multiple of the drift model's, from which they are none: a fifth of the distance."""
_CHUNK = 1 << 15
"""Rows handled at once; bounds the memory of (rows, 6, 6) arrays to some 10 MB each."""
_AXES = ("roll", "pitch", "yaw", "x", "y", "z")


class NoiseSettings(Settings):
    """Noise of the odometry edges."""

    source: Literal["log", "model"] = "log"
    """`log` takes the covariance of the log where it is usable, `model` always takes the drift model below."""
    drift_per_metre: float = Field(default=0.02, gt=0, le=1)
    """Translation drift in m per m travelled: wheel and visual odometry lose 1-2 % (KITTI odometry benchmark)."""
    turn_per_metre: float = Field(default=0.0005, gt=0, le=1)
    """Rotation drift in rad per m travelled: 0.03 deg/m, between good (0.01) and plain (0.05) odometry."""
    turn_per_radian: float = Field(default=0.03, gt=0, le=1)
    """Rotation drift in rad per rad turned: the scale error of a gyroscope or a wheel base, 1-3 %."""
    memory_m: float = Field(default=100.0, gt=0)
    """Metres over which drift keeps its sign; the shortest length that the KITTI benchmark averages over."""
    memory_rad: float = Field(default=6.283185307179586, gt=0)
    """Radians of turning over which rotation drift keeps its sign: one full turn."""
    best_share: float = Field(default=0.2, gt=0, le=1)
    """Least sigma of an edge as a share of the model's: 0.4 % and 0.006 deg/m are better than odometry gets."""
    worst_share: float = Field(default=1.0, ge=1)
    """Largest sigma of an edge as a share of the model's where the log holds a constant covariance, or a few."""
    floor_m: float = Field(default=0.001, gt=0)
    """Least sigma of an edge's translation: 1 mm, below what any odometry resolves."""
    floor_rad: float = Field(default=0.0002, gt=0)
    """Least sigma of an edge's rotation: 0.01 deg, below what any odometry resolves."""


def edge_covariance(
    odometry: Odometry, keyframe_stamp_ns: Ints, settings: NoiseSettings
) -> tuple[Floats, list[str], str]:
    """`covariance_without_breaks`, but where the odometry breaks an edge may be any turn, and as long as the path."""
    edges = broken_edges(odometry, keyframe_stamp_ns)
    if 0 < len(edges) == len(keyframe_stamp_ns) - 1:  # nothing is known of any
        covariance, warnings, source = np.zeros((len(edges), 6, 6)), [], "unknown"
    else:
        covariance, warnings, source = covariance_without_breaks(odometry, keyframe_stamp_ns, settings)
    if len(edges):
        path_m = np.linalg.norm(np.diff(odometry.odom_from_body[:, :3, 3], axis=0), axis=1).sum()
        covariance[edges] = np.diag([*[np.pi**2 / 3] * 3, *[max(float(path_m), 1.0) ** 2] * 3])
    return covariance, warnings, source


def broken_edges(odometry: Odometry, keyframe_stamp_ns: Ints) -> Ints:
    """Edges, by the row of their earlier keyframe, within which the odometry breaks."""
    edges = np.searchsorted(keyframe_stamp_ns, odometry.stamp_ns[odometry.breaks], "left") - 1
    return np.unique(edges[(edges >= 0) & (edges < len(keyframe_stamp_ns) - 1)])


def covariance_without_breaks(
    odometry: Odometry, keyframe_stamp_ns: Ints, settings: NoiseSettings
) -> tuple[Floats, list[str], str]:
    """Covariance (N-1, 6, 6) of each edge between consecutive keyframes, in the later body's frame; warnings; source.

    Logs use the covariance of odometry in three ways:

    1. `model`: None, NaN, infinite, zero or negative says that it is unknown. The drift model stands in: an edge's
       variance is rate^2 * memory * travelled, a random walk that equals the linear rate once `memory` is travelled
       (or the whole drive, where that is shorter). Drift is systematic (scale, bias), so independent edges with
       the plain rate each would claim a drift that only grows with the root of the distance, far too small.
    2. `accumulated`: the trace of its rotations or translations grows over the drive: it is the covariance P of the
       pose since the start, right perturbation, so the edge's is P_b - Ad(b_from_a) P_a Ad(b_from_a)^T. Where a driver
       leaves out the lever arm of the heading that difference is not a covariance, and P_a is only rotated.
    3. `increments`: it is constant or fluctuates. That cannot belong to an accumulated pose, so it is the noise of
       one increment, as RTAB-Map takes it. Errors add per sample: the covariances between the keyframes, moved to
       the later body by the adjoint, are summed, a cut interval by its share.

    Fixes, as odometry that does not drift, are increments (`fixes`), whatever the drift model says.

    Single axes that are zero or beyond 1e3 (a planar robot), and edges with unusable samples, take the model. No edge
    has less noise than `best_share` of the model's: over-confident odometry would throw every closure out. A covariance
    that never changes, or only between a few values as from motion to rest, is a figure in a driver, not an estimate
    (it has a parked robot drift away), so its edges have no more than `worst_share` of the model's: odometry that may
    be anywhere cannot tell a false closure. Likewise increments that the odometry does not say to be such, where they
    sum up to far more than the model: a filter that fixes correct has such a covariance of its pose.

    Raises GraphError where the keyframes are not increasing or the odometry does not cover them.
    """
    stamps, keys = odometry.stamp_ns, keyframe_stamp_ns
    if len(keys) < 2:
        return np.zeros((0, 6, 6)), [], "model"
    if len(stamps) < 2 or (np.diff(keys) <= 0).any() or keys[0] < stamps[0] or keys[-1] > stamps[-1]:
        raise GraphError(
            f"Keyframes at {keys[0]}..{keys[-1]} ns must increase and lie within the odometry "
            f"({len(stamps)} samples, {stamps[0] if len(stamps) else 0}..{stamps[-1] if len(stamps) else 0} ns)."
        )
    if not odometry.drifts and odometry.covariance is not None:
        return _summed_increments(odometry, keys, odometry.covariance), [], "fixes"
    modelled = _drift_model(odometry, keys, settings)
    if settings.source == "model" or odometry.covariance is None:
        unknown = [_unknown("The odometry has no covariance", settings)]
        return modelled, [] if settings.source == "model" else unknown, "model"

    logged = np.asarray(odometry.covariance, np.float64)
    finite: Bools = np.asarray(np.isfinite(logged).all((1, 2)))
    variance = np.where(finite[:, None], np.diagonal(logged, axis1=1, axis2=2), 0.0)
    sound: Bools = np.asarray(finite & (variance >= 0).all(1) & (variance > 0).any(1))
    if sound.mean() < 0.5:  # more than half of the drive would come from the model anyway
        what = "all zero" if (finite & (logged == 0).all((1, 2))).mean() > 0.5 else "unusable"
        return modelled, [_unknown(f"The odometry's covariance is {what}", settings)], "model"
    variance = variance[sound]
    unknown = np.inf if odometry.of_images else UNKNOWN_VARIANCE  # visual odometry has no such marks
    known: Bools = np.asarray(((variance > 0) & (variance < unknown)).mean(0) > 0.5)
    if not known.any():
        return modelled, [_unknown("The odometry's covariance marks every axis as unknown", settings)], "model"

    warnings = []
    usable = sound.copy()
    usable[sound] = (variance[:, known] < unknown).all(1)
    # an unknown axis must not leak into known ones through the adjoint: the model fills it in at the end
    logged = np.where((known[:, None] & known) & usable[:, None, None], logged, 0.0)
    logged = (logged + np.swapaxes(logged, 1, 2)) / 2
    constants = _constants(variance[usable[sound]][:, known])
    accumulated = not (constants or odometry.increments) and _is_accumulated(variance, known)
    source = "accumulated" if accumulated else "increments"
    difference = _accumulated_growth if source == "accumulated" else _summed_increments
    covariance = difference(odometry, keys, logged)
    for axis in np.flatnonzero(~known):
        covariance[:, axis, :], covariance[:, :, axis] = 0.0, 0.0
        covariance[:, axis, axis] = modelled[:, axis, axis]
    if not known.all():
        names = ", ".join(_AXES[axis] for axis in np.flatnonzero(~known))
        warnings.append(f"The odometry's covariance leaves {names} unknown; the drift model is used there.")

    # an edge reads the samples from the one at or before its start to the one at or after its end
    before = np.concatenate([[0], np.cumsum(~usable)])
    first = np.searchsorted(stamps, keys[:-1], "right") - 1
    last = np.searchsorted(stamps, keys[1:], "left")
    broken: Bools = np.asarray(before[last + 1] > before[first])
    covariance[broken] = modelled[broken]
    if broken.any():
        warnings.append(
            f"The odometry's covariance is unusable at {int((~usable).sum())} of {len(usable)} samples, "
            f"so {int(broken.sum())} edges take the drift model."
        )
    of_pose = not (constants or accumulated or odometry.increments)
    within, implausible = _plausible(covariance, modelled, settings, constants, of_pose)
    return within, warnings + implausible, source


def _plausible(
    covariance: Floats, modelled: Floats, settings: NoiseSettings, constants: int, of_pose: bool
) -> tuple[Floats, list[str]]:
    """The covariances within what odometry can have, and warnings. `of_pose` says that they may be a pose's, summed."""
    most, warnings = settings.worst_share, []
    within, share = _bounded(covariance, modelled, settings.best_share, most if constants == 1 else np.inf)
    # judged by the surest and the least sure direction of an edge: a sound heading must not hide a vain position
    least, largest = np.median(share[:, 0]), np.median(share[:, -1])
    if least < settings.best_share / 2.0:  # what is raised by less than that was as good as believed
        warnings.append(
            f"The odometry's covariance is implausible: it claims {least:.1%} of the drift model's sigma "
            f"({settings.drift_per_metre:.1%} of the distance, {np.degrees(settings.turn_per_metre):.3f} deg/m), which "
            f"no odometry reaches, so it is raised to {settings.best_share:.0%} of it."
        )
    if (constants and largest > most) or (of_pose and largest > _VAIN * most):
        if constants > 1:  # which of them it is tells how sure the odometry is
            within = _bounded(covariance * (most / largest) ** 2, modelled, settings.best_share, np.inf)[0]
        elif of_pose:
            within = _bounded(covariance, modelled, settings.best_share, most)[0]
        what = "is " + plural(constants, "constant") + "," if constants else "does not grow, and sums up to"
        warnings.append(
            f"The odometry's covariance is implausible: it {what} {largest:.1f} times the drift model in sigma, so it "
            f"is lowered to {most:g} times."
        )
    return within, warnings


def _unknown(what: str, settings: NoiseSettings) -> str:
    return (
        f"{what}, so a drift of {settings.drift_per_metre:.1%} of the distance and "
        f"{np.degrees(settings.turn_per_metre):.3f} deg/m is assumed."
    )


def _drift_model(odometry: Odometry, keys: Ints, settings: NoiseSettings) -> Floats:
    """(N-1, 6, 6) diagonal: rule 1."""
    step = se3.between(odometry.odom_from_body[:-1], odometry.odom_from_body[1:])
    metres = _travelled(odometry.stamp_ns, np.linalg.norm(step[:, :3, 3], axis=1), keys)
    radians = _travelled(odometry.stamp_ns, se3.angle(step), keys)
    reach_m, reach_rad = min(settings.memory_m, metres.sum()), min(settings.memory_rad, radians.sum())
    t = settings.floor_m**2 + settings.drift_per_metre**2 * reach_m * metres
    r = settings.floor_rad**2 + settings.turn_per_metre**2 * reach_m * metres
    r = r + settings.turn_per_radian**2 * reach_rad * radians
    result = np.zeros((len(metres), 6, 6))
    result[:, range(3), range(3)] = r[:, None]
    result[:, range(3, 6), range(3, 6)] = t[:, None]
    return result


def _travelled(stamps: Ints, step: Floats, keys: Ints) -> Floats:
    """(N-1,) sums between the keyframes of the steps (T-1,) between the samples."""
    since_start = stamps - stamps[0]
    return np.diff(np.interp(keys - stamps[0], since_start, np.concatenate([[0.0], np.cumsum(step)])))


def _constants(variance: Floats) -> int:
    """The number of different rows of (S, A) where a driver chooses from a few; 0 where they are estimates."""
    count = len(np.unique(np.round(np.log(np.maximum(variance, 1e-300)), 8), axis=0))
    return count if count <= max(min(_MOST_CONSTANTS, len(variance) // 10), 1) else 0


def _is_accumulated(variance: Floats, known: Bools) -> bool:
    """Whether the trace of the rotations or that of the translations of (S, 6) variances grows over the drive, allowing
    a hiccup per hundred samples. With the lever arm of the heading the translations of a drive that comes back shrink.
    """
    rotation = np.arange(6) < 3
    for part in (known & rotation, known & ~rotation):
        trace: Floats = variance[:, part].sum(1)
        steady = (np.diff(trace) >= -1e-9 * trace[1:]).mean() > 0.99
        if steady and trace[-1] > 2.0 * trace[: len(trace) // 4 + 1].min():
            return True
    return False


def _summed_increments(odometry: Odometry, keys: Ints, logged: Floats) -> Floats:
    """Rule 3: noise of the increments summed, (N-1, 6, 6)."""
    stamps = odometry.stamp_ns
    inside = stamps[(stamps > keys[0]) & (stamps < keys[-1])]
    cuts = np.union1d(inside, keys)  # each piece between two cuts lies within one increment and one edge
    ends = cuts[1:]
    sample = np.searchsorted(stamps, ends, "left")  # the increment that ends at this sample
    share = np.diff(cuts) / (stamps[sample] - stamps[sample - 1])
    edge = np.searchsorted(keys, ends, "left") - 1
    key_pose = se3.interpolate_at(stamps, odometry.odom_from_body, keys[1:])
    result = np.zeros((len(keys) - 1, 6, 6))
    for start in range(0, len(ends), _CHUNK):
        part = slice(start, start + _CHUNK)
        pose = se3.interpolate_at(stamps, odometry.odom_from_body, ends[part])
        moved = se3.adjoint(se3.between(key_pose[edge[part]], pose))
        noise = moved @ (share[part, None, None] * logged[sample[part]]) @ np.swapaxes(moved, 1, 2)
        first = np.flatnonzero(np.diff(edge[part], prepend=-1))  # edges in order, so each one's pieces are a run
        result[edge[part][first]] += np.add.reduceat(noise, first, axis=0)
    return result


def _accumulated_growth(odometry: Odometry, keys: Ints, logged: Floats) -> Floats:
    """Rule 2: growth of the accumulated covariance, (N-1, 6, 6)."""
    stamps = odometry.stamp_ns
    right = np.clip(np.searchsorted(stamps, keys), 1, len(stamps) - 1)
    share = ((keys - stamps[right - 1]) / (stamps[right] - stamps[right - 1]))[:, None, None]
    at_key = (1 - share) * logged[right - 1] + share * logged[right]
    poses = se3.interpolate_at(stamps, odometry.odom_from_body, keys)
    b_from_a = se3.between(poses[1:], poses[:-1])
    moved = se3.adjoint(b_from_a)
    turned = se3.adjoint(se3.pose(b_from_a[:, :3, :3], np.zeros(3)))
    exact = at_key[1:] - moved @ at_key[:-1] @ np.swapaxes(moved, 1, 2)
    plain = at_key[1:] - turned @ at_key[:-1] @ np.swapaxes(turned, 1, 2)
    least, most = np.moveaxis(np.linalg.eigvalsh((exact + np.swapaxes(exact, 1, 2)) / 2)[:, [0, -1]], -1, 0)
    return np.where((least >= -1e-6 * most)[:, None, None], exact, plain)


def _bounded(covariance: Floats, modelled: Floats, least: float, most: float) -> tuple[Floats, Floats]:
    """Symmetric, with every direction between these shares of the diagonal `modelled`, in sigma; and the shares
    (N-1, 6) that were there, increasing."""
    sigma = np.sqrt(np.diagonal(modelled, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    values, vectors = np.linalg.eigh((covariance + np.swapaxes(covariance, 1, 2)) / 2 / scale)
    result = (vectors * np.clip(values, least**2, most**2)[:, None, :]) @ np.swapaxes(vectors, 1, 2) * scale
    return (result + np.swapaxes(result, 1, 2)) / 2, np.sqrt(np.maximum(values, 0.0))
