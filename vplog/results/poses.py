"""The trajectory as other benchmarks have it: KITTI's matrices, EuRoC's table."""

from __future__ import annotations

from pathlib import Path

from vplog.data import Trajectory
from vplog.geometry import se3
from vplog.geometry.tum import seconds
from vplog.storage.scratch import replacing


def write_kitti(path: Path, trajectory: Trajectory) -> Path:
    """The upper three rows of world_from_body, row by row, one pose a line (KITTI odometry, readme of its devkit).

    KITTI has no stamps in this file: they go beside it as NAME.times.txt, in s, which is what is given back. The
    poses are the body's, where KITTI's own are those of its left camera.
    """
    times = path.with_name(f"{path.stem}.times.txt")
    with replacing(path) as stream:
        for row in trajectory.world_from_body[:, :3].reshape(-1, 12).tolist():
            stream.write(f"{' '.join(f'{value:.12g}' for value in row)}\n".encode())
    with replacing(times) as stream:
        for stamp_ns in trajectory.stamp_ns.tolist():
            stream.write(f"{seconds(stamp_ns)}\n".encode())
    return times


def write_euroc(path: Path, trajectory: Trajectory) -> None:
    """`timestamp [ns], position, quaternion w x y z` with commas, the first eight columns of EuRoC's ground truth."""
    values = se3.vectors(trajectory.world_from_body)[:, [0, 1, 2, 6, 3, 4, 5]]
    names = "p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    with replacing(path) as stream:
        stream.write(f"#timestamp [ns],{names}\n".encode())
        for stamp_ns, row in zip(trajectory.stamp_ns.tolist(), values.tolist(), strict=True):
            stream.write(f"{stamp_ns},{','.join(f'{value:.9f}' for value in row)}\n".encode())
