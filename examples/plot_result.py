"""Draw a finished run from above: odometry, optimised trajectory and loop closures, from its Parquet tables alone.

python examples/plot_result.py RUN result.png
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import pyarrow.parquet as pq

mpl.use("Agg")  # no display needed
import matplotlib.pyplot as plt


def main(run: Path, picture: Path) -> None:
    """Trajectories in the horizontal plane, the first odometry pose laid on the first optimised one by position."""
    trajectory = pq.read_table(run / "trajectory.parquet").to_pandas()
    keyframes = pq.read_table(run / "keyframes.parquet", columns=["world_tx", "world_ty"]).to_pandas().to_numpy()
    closures = pq.read_table(run / "closures.parquet", columns=["query", "match", "verdict"]).to_pandas()
    accepted = closures[closures["verdict"] == "accepted"]
    first = trajectory.iloc[0]
    figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
    axes.plot(
        trajectory["odom_tx"] + first["tx"] - first["odom_tx"], trajectory["odom_ty"] + first["ty"] - first["odom_ty"],
        color="0.65", linewidth=1.2, label="odometry",
    )  # fmt: skip
    axes.plot(trajectory["tx"], trajectory["ty"], color="tab:blue", linewidth=1.6, label="optimised")
    for query, match in accepted[["query", "match"]].to_numpy():
        axes.plot(*keyframes[[query, match]].T, color="tab:orange", linewidth=1, zorder=3)
    axes.scatter(
        *keyframes[accepted["query"]].T, s=9, color="tab:orange", zorder=4, label=f"{len(accepted)} loop closures"
    )
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.legend(frameon=False)
    figure.savefig(picture, dpi=110)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
