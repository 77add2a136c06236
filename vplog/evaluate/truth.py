"""Ground truth of a drive: a file of poses, or its GPS fixes, which are positions only."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from vplog.data import Floats, Gps, Ints, Trajectory
from vplog.errors import TruthError, nearest
from vplog.evaluate.trajectory import Ate, aligned_error
from vplog.geometry import geodesy, se3
from vplog.geometry.tum import read_tum
from vplog.storage.remote_path import located
from vplog.storage.urls import shown


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
    local = geodesy.local_enu(gps)
    if not len(local):
        raise TruthError(f"None of the {len(gps.stamp_ns)} GPS fixes holds a position. Give a TUM file with --truth.")
    return local.stamp_ns, local.enu_m


def ate_to_gps(estimate: Trajectory, gps: Gps, alignment: str = "se3") -> Ate:
    """ATE of the estimate, interpolated at the fixes, after an alignment. It is that of the antenna where its place on
    the body is known, in the estimate's unit of length.

    Raises TruthError where fewer than three fixes lie within the estimate.
    """
    stamp_ns, positions = local_enu(gps)
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
    return aligned_error(se3.transform(poses, antenna_m[None])[:, 0], positions[inside], alignment)
