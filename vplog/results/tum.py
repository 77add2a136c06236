"""trajectory.tum: one pose per line, as the TUM RGB-D benchmark and evo have it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog import geometry
from vplog.results.atomic import replacing

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Trajectory


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """`stamp tx ty tz qx qy qz qw` in s, m and 1; 9 decimals, the stamp's exact to the ns."""
    poses = trajectory.world_from_body
    values = np.concatenate([poses[:, :3, 3], geometry.quaternion(poses[:, :3, :3])], axis=1)
    with replacing(path) as stream:
        stream.write(b"# timestamp tx ty tz qx qy qz qw (world_from_body)\n")
        for stamp_ns, row in zip(trajectory.stamp_ns.tolist(), values.tolist(), strict=True):
            stream.write(f"{seconds(stamp_ns)} {' '.join(f'{value:.9f}' for value in row)}\n".encode())


def seconds(stamp_ns: int) -> str:
    """A stamp in s with all its digits; a float has too few for the clock of today."""
    whole, rest = divmod(abs(stamp_ns), 1_000_000_000)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{rest:09d}"
