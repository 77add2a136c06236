"""Solve a g2o file with GTSAM alone: `python gtsam_solve.py lm|gnc FILE`. Imports nothing else, for `speed`."""

import sys
from pathlib import Path

import gtsam


def main(method: str, file: str) -> None:
    """Solve from the poses of the file; GNC knows that the odometry and the first pose are true."""
    with Path(file).open(encoding="utf-8") as lines:
        spatial = any(line.startswith("EDGE_SE3") for line in lines)
    factors, values = gtsam.readG2o(file, is3D=spatial)
    keys = [[gtsam.symbolIndex(key) for key in factors.at(row).keys()] for row in range(factors.size())]  # noqa: SIM118 (a method of GTSAM)
    true = [row for row, ends in enumerate(keys) if max(ends) - min(ends) == 1]
    first, noise = min(values.keys()), gtsam.noiseModel.Isotropic.Sigma(6 if spatial else 3, 1e-6)
    if spatial:
        factors.add(gtsam.PriorFactorPose3(first, gtsam.Pose3(), noise))
    else:
        factors.add(gtsam.PriorFactorPose2(first, gtsam.Pose2(), noise))
    if method == "lm":
        gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    else:
        settings = gtsam.GncLMParams()
        settings.setKnownInliers([*true, factors.size() - 1])
        gtsam.GncLMOptimizer(factors, values, settings).optimize()


if __name__ == "__main__":
    main(*sys.argv[1:])
