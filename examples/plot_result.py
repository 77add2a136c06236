"""Draw a finished run from above: odometry, optimised trajectory and loop closures, from its Parquet tables alone.

python examples/plot_result.py RUN result.png
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
import pyarrow.parquet as pq

mpl.use("Agg")  # no display needed
import matplotlib.pyplot as plt

if TYPE_CHECKING:
    from numpy.typing import NDArray


def columns(table: Path, *names: str, **options: Any) -> NDArray[Any]:
    """Read columns of a Parquet file as an array (rows, columns)."""
    return np.stack(pq.read_table(table, columns=[*names], **options).columns, axis=1)


def main(run: Path, picture: Path) -> None:
    """Trajectories in the horizontal plane, the first odometry pose laid on the first optimised one by position."""
    path = columns(run / "trajectory.parquet", "tx", "ty")
    odometry = columns(run / "trajectory.parquet", "odom_tx", "odom_ty")
    keyframes = columns(run / "keyframes.parquet", "world_tx", "world_ty")
    accepted = columns(run / "closures.parquet", "query", "match", filters=[("verdict", "=", "accepted")])
    figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
    axes.plot(*(odometry - odometry[0] + path[0]).T, color="0.65", linewidth=1.2, label="odometry")
    axes.plot(*path.T, color="tab:blue", linewidth=1.6, label="optimised")
    for closure in accepted:
        axes.plot(*keyframes[closure].T, color="tab:orange", linewidth=1, zorder=3)
    axes.scatter(
        *keyframes[accepted[:, 0]].T, s=9, color="tab:orange", zorder=4, label=f"{len(accepted)} loop closures"
    )
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(frameon=False)
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
