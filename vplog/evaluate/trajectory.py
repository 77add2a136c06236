"""Errors of an estimated trajectory against the truth: ATE and RPE, defined as evo computes them, and KITTI's drift.

Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012, sections IV.A and IV.B; Geiger et al.,
"Are we ready for autonomous driving?", CVPR 2012, and the odometry development kit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from vplog.data import Floats, Ints, Trajectory
from vplog.errors import TruthError, plural
from vplog.evaluate.pairs import MAX_GAP_S, bracketing
from vplog.geometry import se3

MAX_DIFFERENCE_S = 0.01
"""s; how far the stamps of two poses that are compared may be apart, evo's default."""
ALIGNMENTS = {"se3": "SE(3)", "sim3": "Sim(3)", "origin": "origin"}
"""By the name of the option: Umeyama without scale (evo's -a), with scale (-as), or the first poses made equal
(--align_origin)."""

_LEAST_PATH_M = 1e-3
"""m; a drive that stood still has no drift."""


@dataclass(frozen=True)
class Ate:
    """Absolute trajectory error: distances in m after an alignment."""

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    count: int
    """Poses compared."""
    alignment: str = "SE(3)"
    """`SE(3)` (Umeyama, rigid), `Sim(3)` (with scale) or `origin` (first poses made equal)."""
    scale: float = 1.0
    """Scale of the alignment, which multiplies the estimate; 1 but for Sim(3)."""


@dataclass(frozen=True)
class Drift:
    """Relative pose error per 100 m as KITTI has it; None where nothing fits."""

    translation_m: float | None
    """m per 100 m, which is %: mean over all segments."""
    rotation_deg: float | None
    """Degrees per 100 m."""
    lengths_m: list[float]
    """The lengths of path compared."""
    segments: int
    """Segments of all lengths."""


@dataclass(frozen=True)
class Rpe:
    """Relative pose error over steps of one kind; None where the drive has no step."""

    delta: str
    """The step: `1 frame`."""
    translation_rmse_m: float | None
    translation_mean_m: float | None
    translation_max_m: float | None
    rotation_rmse_deg: float | None
    rotation_mean_deg: float | None
    rotation_max_deg: float | None
    count: int
    """Steps compared."""


def associate(estimate: Trajectory, truth: Trajectory) -> tuple[Ints, Ints]:
    """Rows of the estimate and of the truth that show the same moment.

    Each pose of the trajectory with fewer poses (the estimate, of two equal ones) takes the nearest in time of the
    other, the earlier of two equally near, when it is within MAX_DIFFERENCE_S. In float seconds, as evo.
    Raises TruthError where there is no such pair or a pose is not finite.
    """
    for name, trajectory in (("estimated trajectory", estimate), ("truth", truth)):
        if not len(trajectory.stamp_ns):
            raise TruthError(f"The {name} holds no pose. Give a trajectory of this drive.")
        if not np.isfinite(trajectory.world_from_body).all():
            raise TruthError(f"The {name} holds a pose that is not finite. Leave that pose out.")
    estimate_is_longer = len(estimate.stamp_ns) > len(truth.stamp_ns)
    short, long = (truth, estimate) if estimate_is_longer else (estimate, truth)
    here, there = _nearest(_seconds(short.stamp_ns), _seconds(long.stamp_ns))
    if not len(here):
        spans = [
            f"{_seconds(t.stamp_ns[[0, -1]])[0]:.3f}..{_seconds(t.stamp_ns[[0, -1]])[1]:.3f} s"
            for t in (estimate, truth)
        ]
        raise TruthError(
            f"No stamps of the estimate ({spans[0]}) and the truth ({spans[1]}) are within {MAX_DIFFERENCE_S} s. "
            "Give the truth of this drive, in the log's clock."
        )
    return (there, here) if estimate_is_longer else (here, there)


def at_truth(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, bool]:
    """The estimate as it is compared with the truth, and whether it was interpolated at the truth's stamps.

    It is where in most of its steps that the truth meets no pose of that is near one of its stamps: a truth of 1 Hz in
    a clock of its own, or of 20 Hz beside odometry of 10 Hz.
    Those in a gap of it, as between the drives of a map, are left out: thrice its usual step, and 2 s at least.
    """
    step_s = 1e-9 * float(np.median(np.diff(estimate.stamp_ns))) if len(estimate.stamp_ns) > 1 else 0.0
    at_ns = truth.stamp_ns[bracketing(estimate.stamp_ns, truth.stamp_ns, max(MAX_GAP_S, 3.0 * step_s))[2]]
    near, _ = _nearest(_seconds(at_ns), _seconds(estimate.stamp_ns))
    if 2 * len(near) >= len(np.unique(np.searchsorted(estimate.stamp_ns, at_ns))):
        return estimate, False
    poses = se3.interpolate_at(estimate.stamp_ns, estimate.world_from_body, at_ns)
    return Trajectory(at_ns, poses), True


def _nearest(short: Floats, long: Floats) -> tuple[Ints, Ints]:
    """Rows of both; the comparisons are those of evo.core.sync.matching_time_indices, ties included."""
    after = np.minimum(np.searchsorted(long, short, side="right"), len(long) - 1)
    until = long[after] - short
    since = np.where(after > 0, short - long[np.maximum(after - 1, 0)], np.inf)
    inside = (short >= long[0] - MAX_DIFFERENCE_S) & (short <= long[-1] + MAX_DIFFERENCE_S)
    take_after = inside & (until <= MAX_DIFFERENCE_S) & (until < since)
    take_before = inside & ~take_after & (since <= MAX_DIFFERENCE_S) & (since <= until)
    here = np.flatnonzero(take_after | take_before)
    return here, (after - take_before)[here]


def _seconds(stamp_ns: Ints) -> Floats:
    """Stamps as the float that reading them from text gives: int / int in Python rounds once, correctly."""
    return np.array([stamp / 1_000_000_000 for stamp in stamp_ns.tolist()])


Matched: TypeAlias = tuple[Floats, Floats]
"""Estimated and true poses (K, 4, 4) of one trajectory at the same times."""


def matched_poses(estimate: Trajectory, truth: Trajectory) -> Matched:
    """Return the poses of `associate`. Raises TruthError as `associate`."""
    here, there = associate(estimate, truth)
    return estimate.world_from_body[here], truth.world_from_body[there]


def ate(estimate: Trajectory, truth: Trajectory, alignment: str = "se3") -> Ate:
    """ATE after an alignment of ALIGNMENTS, by default as `evo_ape tum TRUTH ESTIMATE -a` (Umeyama 1991).

    Raises TruthError where fewer than three poses can be compared.
    """
    return ate_together([matched_poses(estimate, truth)], alignment)[0]


def ate_together(trajectories: Sequence[Matched], alignment: str = "se3") -> list[Ate]:
    """Align trajectories that share one frame with one transform. Return the ATE of all poses, then of each trajectory.

    Raises TruthError if an alignment of three poses is not possible.
    """
    estimated, true = (np.concatenate(poses) for poses in zip(*trajectories, strict=True))
    positions, scale = true[:, :3, 3], 1.0
    if alignment == "origin":
        truth_from_estimate = true[0] @ se3.inverse(estimated[0])
    elif len(true) < 3:
        raise TruthError(
            f"Only {plural(len(true), 'pose')} with a truth; an alignment needs 3. Give one that covers the drive."
        )
    else:
        truth_from_estimate, scale = se3.umeyama(estimated[:, :3, 3], positions, alignment == "sim3")
    difference = se3.transform(truth_from_estimate, scale * estimated[:, :3, 3]) - positions
    ends = np.cumsum([len(poses) for _, poses in trajectories])
    return [_ate(one, alignment, scale) for one in (difference, *np.split(difference, ends[:-1]))]


def _ate(difference: Floats, alignment: str, scale: float = 1.0) -> Ate:
    error = np.linalg.norm(difference, axis=1)
    figures = _rms(error), float(error.mean()), float(np.median(error)), float(error.max())
    return Ate(*figures, len(error), ALIGNMENTS[alignment], scale)


def drift(estimate: Trajectory, truth: Trajectory) -> Drift:
    """Mean relative pose error over segments of the truth's path, per 100 m of it.

    As KITTI's kit: segments of 100, 200, .. 800 m, all that fit, from every tenth pose, each weighs the same. A drive
    shorter than 100 m has segments of 1 to 8 times the largest power of ten that fits.
    """
    here, there = associate(estimate, truth)
    estimated, true = estimate.world_from_body[here], truth.world_from_body[there]
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1))])
    if not path_m[-1] > _LEAST_PATH_M:
        return Drift(None, None, [], 0)
    unit_m = min(100.0, 10.0 ** np.floor(np.log10(path_m[-1])))
    starts = np.arange(0, len(path_m), 10)
    errors, lengths = [], []
    for length_m in unit_m * np.arange(1, 9):
        last = np.searchsorted(path_m, path_m[starts] + length_m, side="right")
        first, last = starts[last < len(path_m)], last[last < len(path_m)]
        if len(first):
            errors.append(_relative_errors(estimated, true, first, last) * (100.0 / length_m))
            lengths.append(float(length_m))
    if not errors:
        return Drift(None, None, [], 0)
    every = np.concatenate(errors)
    return Drift(float(every[:, 0].mean()), float(every[:, 1].mean()), lengths, len(every))


def rpe(estimate: Trajectory, truth: Trajectory) -> Rpe:
    """RPE over steps of one pose, as evo_rpe's defaults."""
    here, there = associate(estimate, truth)
    rows = np.arange(len(here))
    errors = _relative_errors(estimate.world_from_body[here], truth.world_from_body[there], rows[:-1], rows[1:])
    if not len(errors):
        return Rpe("1 frame", None, None, None, None, None, None, 0)
    metres, degrees = ((_rms(error), float(error.mean()), float(error.max())) for error in errors.T)
    return Rpe("1 frame", *metres, *degrees, len(errors))


def _relative_errors(estimated: Floats, true: Floats, first: Ints, last: Ints) -> Floats:
    """(S, 2) m and degrees by which the steps from rows `first` to rows `last` (S,) differ."""
    steps = (se3.between(poses[first], poses[last]) for poses in (true, estimated))
    wrong = se3.between(*steps)
    return np.stack([np.linalg.norm(wrong[:, :3, 3], axis=1), np.degrees(se3.angle(wrong))], axis=1)


def _rms(error: Floats) -> float:
    return float(np.sqrt(np.mean(error**2)))


def motion_figures(motions: Floats) -> dict[str, Any]:
    """Samples, and RMSE and maximum of distances (m) and angles (deg), of motions (K, 4, 4); None where K is 0."""
    found: dict[str, Any] = {"samples": len(motions)}
    for unit, values in (("m", np.linalg.norm(motions[:, :3, 3], axis=1)), ("deg", np.degrees(se3.angle(motions)))):
        found[f"rmse_{unit}"] = float(np.sqrt((values**2).mean())) if len(values) else None
        found[f"max_{unit}"] = float(values.max()) if len(values) else None
    return found
