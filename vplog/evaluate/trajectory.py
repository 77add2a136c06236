"""How far an estimated trajectory is from the truth: ATE and RPE, defined as evo computes them.

Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012, sections IV.A and IV.B.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog import geometry
from vplog.errors import TruthError

if TYPE_CHECKING:
    from vplog.data import Floats, Ints, Trajectory

MAX_DIFFERENCE_S = 0.01
"""s; how far the stamps of two poses that are compared may be apart, evo's default."""


@dataclass(frozen=True)
class Ate:
    """Absolute trajectory error: distances in m after a rigid alignment."""

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    count: int
    """Poses compared."""


@dataclass(frozen=True)
class Rpe:
    """Relative pose error over steps of one kind; None where the drive has no such step."""

    delta: str
    """The step: `1 frame`, or a length of path such as `100 m`."""
    translation_rmse_m: float | None
    translation_mean_m: float | None
    translation_max_m: float | None
    rotation_rmse_deg: float | None
    rotation_mean_deg: float | None
    rotation_max_deg: float | None
    count: int
    """Steps compared."""


def associate(estimate: Trajectory, truth: Trajectory, max_difference_s: float = MAX_DIFFERENCE_S) -> tuple[Ints, Ints]:
    """Rows of the estimate and of the truth that show the same moment.

    Each pose of the trajectory with fewer poses (the estimate, of two equal ones) takes the nearest in time of the
    other, the earlier of two equally near, when it is no further than `max_difference_s`. In float seconds, as evo.
    Raises TruthError where there is no such pair or a pose is not finite.
    """
    for name, trajectory in (("estimated trajectory", estimate), ("truth", truth)):
        if not len(trajectory.stamp_ns):
            raise TruthError(f"The {name} holds no pose.")
        if not np.isfinite(trajectory.world_from_body).all():
            raise TruthError(f"The {name} holds a pose that is not finite.")
    estimate_is_longer = len(estimate.stamp_ns) > len(truth.stamp_ns)
    short, long = (truth, estimate) if estimate_is_longer else (estimate, truth)
    here, there = _nearest(_seconds(short.stamp_ns), _seconds(long.stamp_ns), max_difference_s)
    if not len(here):
        spans = [
            f"{_seconds(t.stamp_ns[[0, -1]])[0]:.3f}..{_seconds(t.stamp_ns[[0, -1]])[1]:.3f} s"
            for t in (estimate, truth)
        ]
        raise TruthError(
            f"No stamps of the estimate ({spans[0]}) and the truth ({spans[1]}) are within {max_difference_s} s. "
            "Give the truth of this drive, in the log's clock."
        )
    return (there, here) if estimate_is_longer else (here, there)


def _nearest(short: Floats, long: Floats, max_difference_s: float) -> tuple[Ints, Ints]:
    """Rows of both; the comparisons are those of evo.core.sync.matching_time_indices, ties included."""
    after = np.minimum(np.searchsorted(long, short, side="right"), len(long) - 1)
    until = long[after] - short
    since = np.where(after > 0, short - long[np.maximum(after - 1, 0)], np.inf)
    inside = (short >= long[0] - max_difference_s) & (short <= long[-1] + max_difference_s)
    take_after = inside & (until <= max_difference_s) & (until < since)
    take_before = inside & ~take_after & (since <= max_difference_s) & (since <= until)
    here = np.flatnonzero(take_after | take_before)
    return here, (after - take_before)[here]


def _seconds(stamp_ns: Ints) -> Floats:
    """Stamps as the float that reading them from text gives: int / int in Python rounds once, correctly."""
    return np.array([stamp / 1_000_000_000 for stamp in stamp_ns.tolist()])


def ate(estimate: Trajectory, truth: Trajectory, max_difference_s: float = MAX_DIFFERENCE_S) -> Ate:
    """ATE after the best rigid alignment without scale (Umeyama 1991), as `evo_ape tum TRUTH ESTIMATE -a`.

    Raises TruthError where fewer than three poses can be compared.
    """
    here, there = associate(estimate, truth, max_difference_s)
    return aligned_error(estimate.world_from_body[here, :3, 3], truth.world_from_body[there, :3, 3])


def aligned_error(estimate: Floats, truth: Floats) -> Ate:
    """ATE of positions (T, 3) that belong together. Raises TruthError where T is less than three."""
    if len(estimate) < 3:
        raise TruthError(f"Only {len(estimate)} poses have a truth; an alignment needs 3 at least.")
    truth_from_estimate, _ = geometry.umeyama(estimate, truth)
    error = np.linalg.norm(geometry.transform(truth_from_estimate, estimate) - truth, axis=1)
    return Ate(_rms(error), float(error.mean()), float(np.median(error)), float(error.max()), len(error))


def rpe(
    estimate: Trajectory,
    truth: Trajectory,
    delta_m: float | None = None,
    max_difference_s: float = MAX_DIFFERENCE_S,
) -> Rpe:
    """RPE over consecutive steps of one pose, or of `delta_m` of the estimate's path, as evo_rpe's defaults."""
    here, there = associate(estimate, truth, max_difference_s)
    estimated, true = estimate.world_from_body[here], truth.world_from_body[there]
    ends = np.arange(len(here)) if delta_m is None else _path_steps(estimated[:, :3, 3], delta_m)
    start, stop = ends[:-1], ends[1:]
    name = "1 frame" if delta_m is None else f"{delta_m:g} m"
    if not len(start):
        return Rpe(name, None, None, None, None, None, None, 0)
    error = geometry.between(
        geometry.between(true[start], true[stop]), geometry.between(estimated[start], estimated[stop])
    )
    metres, degrees = np.linalg.norm(error[:, :3, 3], axis=1), np.degrees(geometry.angle(error))
    return Rpe(
        name,
        *(_rms(metres), float(metres.mean()), float(metres.max())),
        *(_rms(degrees), float(degrees.mean()), float(degrees.max())),
        len(metres),
    )


def _path_steps(positions: Floats, delta_m: float) -> Ints:
    """Rows where `delta_m` of path are complete, counted anew from each such row; row 0 is the first."""
    rows, travelled = [0], 0.0
    for row, step in enumerate(np.linalg.norm(np.diff(positions, axis=0), axis=1).tolist(), start=1):
        travelled += step
        if travelled >= delta_m:
            rows.append(row)
            travelled = 0.0
    return np.array(rows)


def _rms(error: Floats) -> float:
    return float(np.sqrt(np.mean(error**2)))
