"""Bundle adjustment of a window of views with landmarks, by GTSAM."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from vplog.data import Floats, Ints
from vplog.geometry import se3

_HUBER = 1.5
"""Sigmas beyond which an error counts linearly, as in the refinement of a single pose."""
_STEPS = 6
"""Levenberg-Marquardt steps; a window starts from the last one's result, and two or three converge."""
_CONVERGED = 1e-3
"""Relative decrease of the error that ends it: far below a sigma of the newest pose."""
_FIXED = 1e-6
"""Sigma of the oldest view's pose, rad and m: it stays where it is."""


@dataclass(frozen=True, eq=False)
class Observations:
    """O observations of landmarks in views. A landmark that is observed with (x, y, rho) has normalised image
    coordinates and an inverse depth in 1/m; rho is NaN where it was not measured."""

    view: Ints
    """(O,) row of the view."""
    landmark: Ints
    """(O,) row of the landmark."""
    xyrho: Floats
    """(O, 3)."""
    rays: Floats
    """(O, 2, 2) covariance of x and y."""
    variance: Floats
    """(O,) of rho."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """An adjusted window."""

    world_from_camera: Floats
    """(W, 4, 4)."""
    points: Floats
    """(P, 3) m."""
    last_motion: Floats
    """(6, 6) covariance of the last view's pose in the one before it, in the frame of the last."""


def adjust(world_from_camera: Floats, points: Floats, observed: Observations, metric: bool) -> Bundle | None:
    """The views (W, 4, 4), the oldest fixed, and points (P, 3) that explain the observations best; None where these do
    not determine them. Without depths (not `metric`) the distance of the two oldest views, too, stays as it is."""
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for row, pose in enumerate(world_from_camera):
        start.insert(X(row), gtsam.Pose3(pose))
    for row, point in enumerate(points):
        start.insert(L(row), point)
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED)
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(world_from_camera[0]), fixed))
    if not metric:
        apart = float(np.linalg.norm(world_from_camera[1][:3, 3] - world_from_camera[0][:3, 3]))
        held = gtsam.noiseModel.Isotropic.Sigma(1, _FIXED * apart)
        graph.add(gtsam.RangeFactorPose3(X(0), X(1), apart, held))
    _add_observations(graph, observed)
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(_STEPS)
    settings.setRelativeErrorTol(_CONVERGED)
    try:
        found = gtsam.LevenbergMarquardtOptimizer(graph, start, settings).optimize()
        last = len(world_from_camera) - 1
        joint = gtsam.Marginals(graph, found).jointMarginalCovariance(gtsam.KeyVector([X(last - 1), X(last)]))
        covariance = joint.fullMatrix()
    except RuntimeError:  # an indeterminate system
        return None
    poses = np.stack([found.atPose3(X(row)).matrix() for row in range(len(world_from_camera))])
    moved = np.stack([found.atPoint3(L(row)) for row in range(len(points))])
    if not (np.isfinite(poses).all() and np.isfinite(covariance).all()):
        return None
    both = np.hstack([-se3.adjoint(se3.between(poses[-1], poses[-2])), np.eye(6)])
    return Bundle(poses, moved, both @ covariance @ both.T)


def _add_observations(graph: gtsam.NonlinearFactorGraph, observed: Observations) -> None:
    """Factors of a stereo camera of 1 m baseline and focal length: rho is its disparity."""
    stereo, mono = gtsam.Cal3_S2Stereo(1.0, 1.0, 0.0, 0.0, 0.0, 1.0), gtsam.Cal3_S2(1.0, 1.0, 0.0, 0.0, 0.0)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER)
    measured = np.isfinite(observed.variance) & np.isfinite(observed.xyrho[:, 2])
    full = np.zeros((len(measured), 3, 3))
    full[:, :2, :2] = observed.rays
    full[:, 2, 2] = np.where(measured, observed.variance, 1.0)
    # left x, right x, y of (x, y, rho)
    turned = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    full = turned @ full @ turned.T
    columns = (observed.view.tolist(), observed.landmark.tolist(), observed.xyrho.tolist(), measured.tolist())
    for row, (view, landmark, (x, y, rho), known) in enumerate(zip(*columns, strict=True)):
        covariance = full[row] if known else observed.rays[row]
        noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(covariance))
        if known:
            at = gtsam.StereoPoint2(x, x - rho, y)
            graph.add(gtsam.GenericStereoFactor3D(at, noise, X(view), L(landmark), stereo))
        else:
            graph.add(gtsam.GenericProjectionFactorCal3_S2(np.array([x, y]), noise, X(view), L(landmark), mono))
