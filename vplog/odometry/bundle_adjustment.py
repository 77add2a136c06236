"""Bundle adjustment of a window of views with landmarks: Levenberg-Marquardt with the landmarks eliminated (Triggs et
al. 2000, section 6.1), in compiled loops.

Eight views with 300 landmarks take 5 ms, where GTSAM with a factor for each observation took 40.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
import scipy

from vplog.data import Floats, Ints
from vplog.geometry import se3
from vplog.geometry.small_matrices import add_inner, add_moved, invert, product, subtract_moved, subtract_outer

_HUBER = 1.5
"""Sigmas beyond which an error counts linearly, as in the refinement of a single pose."""
_KNOWN = 6, 1e-3
"""Levenberg-Marquardt steps, and the relative decrease of the error that ends them, far below a sigma of the newest
pose: a window starts from the last one's result, and two or three converge."""
_UNKNOWN = 60, 1e-5
"""Steps and decrease with an unknown lens: along the valley of focal lengths and depths many steps gain little each."""
_FIXED = 1e-4
"""Sigma of the distance of the two oldest views without depths, as a share of it: nothing else tells it, so it stays as
it is; a stiffer one has steps rejected that turn the views."""
_BEHIND = 2.0
"""Error of a landmark behind a view in normalised coordinates, as GTSAM's."""
_WEAK = 1e-9
"""1/m^2, of a prior that keeps the block of a landmark invertible that lies behind all its views."""
_DAMPING, _FACTOR, _LARGEST = 1e-5, 10.0, 1e5
"""First damping of Levenberg-Marquardt, its factor where a step fails or succeeds, and the one that ends it, as
GTSAM's."""


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
    lens: Floats
    """(2,) s and k, see `adjust`."""
    lens_covariance: Floats
    """(2, 2), (0, 0) where the lens is known."""


def adjust(
    world_from_camera: Floats, points: Floats, observed: Observations, metric: bool, lens: Floats | None = None
) -> Bundle | None:
    """The views (W, 4, 4), the oldest fixed, and points (P, 3) that explain the observations best; None where these do
    not determine them. Without depths (not `metric`) the distance of the two oldest views, too, stays as it is. With a
    lens (2,) to be adjusted, from s and k, a ray (x, y) is observed at s (1 + k r^2) (x, y), r^2 = x^2 + y^2: s is the
    focal length by the one that the observations are normalised with, k the first radial distortion."""
    apart = 0.0 if metric else float(np.linalg.norm(world_from_camera[1][:3, 3] - world_from_camera[0][:3, 3]))
    window = _Window.of(observed, len(points), apart, 0 if lens is None else 2)
    start = np.array([1.0, 0.0]) if lens is None else lens
    state = _State(np.asarray(world_from_camera, np.float64), np.asarray(points, np.float64), start)
    cost, damping, (steps, converged) = math.inf, _DAMPING, _KNOWN if lens is None else _UNKNOWN
    try:
        for _ in range(steps):
            equations = window.equations(state, damping)
            before = equations.cost
            while damping <= _LARGEST:
                moved = equations.stepped(state)
                cost = window.cost(moved)
                if cost <= before:
                    state, damping = moved, max(damping / _FACTOR, _DAMPING)
                    break
                damping *= _FACTOR
                equations = window.equations(state, damping)
            if not before - cost > converged * before:
                break
        covariance = np.asarray(np.linalg.inv(window.equations(state, 0.0).hessian), np.float64)
    except np.linalg.LinAlgError:  # an indeterminate system
        return None
    poses = state.poses
    if not (np.isfinite(poses).all() and np.isfinite(covariance).all()):
        return None
    joint = np.zeros((12, 12))  # of the last two views; the oldest has none
    end = 6 * len(poses) - 6
    known = covariance[max(end - 12, 0) : end, max(end - 12, 0) : end]
    joint[12 - len(known) :, 12 - len(known) :] = known
    both = np.hstack([-se3.adjoint(se3.between(poses[-1], poses[-2])), np.eye(6)])
    return Bundle(poses, state.points, both @ joint @ both.T, state.lens, covariance[end:, end:])


class _State(NamedTuple):
    """Variables of the adjustment."""

    poses: Floats
    """(W, 4, 4) world_from_camera."""
    points: Floats
    """(P, 3)."""
    lens: Floats
    """(2,) s and k."""


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations of a window at some poses and points, the oldest view left out."""

    hessian: Floats
    """(6 W - 6, 6 W - 6) of the views, the landmarks eliminated."""
    gradient: Floats
    cost: float
    view: Ints
    first: Ints
    gains: Floats
    """(O, 6, 3) by which the step of the view of an observation moves its landmark."""
    own: Floats
    """(P, 3) steps of the landmarks where the views stay."""
    by_lens: Floats
    """(P, 2, 3) by which the step of the lens moves each landmark."""

    def stepped(self, state: _State) -> _State:
        """Raises LinAlgError where the equations are indeterminate."""
        count = 6 * len(state.poses)
        step = np.zeros(count + 2)
        factor = scipy.linalg.cho_factor(self.hessian, check_finite=False)
        step[6 : 6 + len(self.gradient)] = -np.asarray(
            scipy.linalg.cho_solve(factor, self.gradient, check_finite=False)
        )
        views, lens = step[:count].reshape(-1, 6), step[count:]
        by_views = np.add.reduceat((views[self.view, None] @ self.gains)[:, 0], self.first)
        points = state.points + self.own - by_views - lens @ self.by_lens
        return _State(state.poses @ se3.exp(views), points, state.lens + lens)


@dataclass(frozen=True, eq=False)
class _Window:
    """Observations by landmark."""

    view: Ints
    xyrho: Floats
    information: Floats
    """(O, 3, 3), 0 for rho where it was not measured."""
    first: Ints
    """(P + 1,) first observation of each landmark."""
    apart: float
    """Distance of the two oldest views where it is to stay, else 0."""
    free: int
    """Values of the lens that are adjusted, 0 or 2."""

    @classmethod
    def of(cls, observed: Observations, count: int, apart: float, free: int) -> _Window:
        order = np.lexsort([observed.view, observed.landmark])
        first = np.searchsorted(observed.landmark[order], np.arange(count + 1))
        xyrho, variance = observed.xyrho[order], observed.variance[order]
        measured = np.isfinite(variance) & np.isfinite(xyrho[:, 2])
        information = np.zeros((len(order), 3, 3))
        information[:, :2, :2] = np.linalg.inv(observed.rays[order])
        information[measured, 2, 2] = 1.0 / variance[measured]
        xyrho = np.where(np.isfinite(xyrho), xyrho, 0.0)
        return cls(observed.view[order].astype(np.int64), xyrho, information, first, apart, free)

    def equations(self, state: _State, damping: float) -> _Equations:
        """Raises LinAlgError where a landmark is indeterminate."""
        hessian, gradient, cost, gains, own, by_lens = _normal_equations(
            *state, self.free, self.view, self.xyrho, self.information, self.first, damping
        )
        if self.apart:
            error, along = self._stretched(state.poses)
            hessian[6:12, 6:12] += np.outer(along, along)
            gradient[6:12] += along * error
            cost += error**2 / 2.0
        return _Equations(hessian[6:, 6:], gradient[6:], cost, self.view, self.first[:-1], gains, own, by_lens)

    def cost(self, state: _State) -> float:
        """Half the sum of the robust squared errors."""
        stretched = self._stretched(state.poses)[0] ** 2 / 2.0 if self.apart else 0.0
        return _cost(*state, self.view, self.xyrho, self.information, self.first) + stretched

    def _stretched(self, poses: Floats) -> tuple[float, Floats]:
        """Error of the distance of the two oldest views in sigmas, and its derivative (6,) by the second."""
        moved = poses[1][:3, 3] - poses[0][:3, 3]
        length, sigma = float(np.linalg.norm(moved)), _FIXED * self.apart
        return (length - self.apart) / sigma, np.concatenate([np.zeros(3), moved @ poses[1][:3, :3]]) / length / sigma


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _normal_equations(poses, points, lens, free, view, xyrho, information, first, damping):
    """Hessian (6 W + F, 6 W + F) and gradient of the views and F `free` values of the lens without the landmarks (the
    Schur complement), the robust cost, what a step of an observation's view moves its landmark by (O, 6, 3), the
    landmarks' own steps (P, 3), and by a step of the lens (P, 2, 3)."""
    W, P = len(poses), len(points)
    end = 6 * W
    hessian, gradient, cost = np.zeros((end + free, end + free)), np.zeros(end + free), 0.0
    gains, cross, own = np.zeros((len(view), 6, 3)), np.zeros((len(view), 6, 3)), np.zeros((P, 3))
    by_lens, lens_gains, lens_cross = np.empty((3, 2)), np.zeros((P, 2, 3)), np.empty((2, 3))
    error, by_pose, by_point = np.empty(3), np.empty((3, 6)), np.empty((3, 3))
    weighed, weighed_point, weighed_lens = np.empty((3, 6)), np.empty((3, 3)), np.empty((3, 2))
    total, inverse, ahead = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for p in range(P):
        total[:], ahead[:], lens_cross[:] = np.eye(3) * (damping + _WEAK), 0.0, 0.0
        observations = range(first[p], first[p + 1])
        for o in observations:
            at = 6 * view[o]
            squared = _predict(
                poses[view[o]], points[p], lens, xyrho[o], information[o], error, by_pose, by_point, by_lens
            )
            cost += _huber(squared)
            weight = 1.0 if squared <= _HUBER**2 else _HUBER / math.sqrt(squared)
            product(information[o], by_pose, weight, weighed)
            product(information[o], by_point, weight, weighed_point)
            add_inner(hessian, at, at, by_pose, weighed)
            add_moved(gradient, at, weighed, error)
            add_inner(cross[o], 0, 0, by_pose, weighed_point)
            add_inner(total, 0, 0, by_point, weighed_point)
            add_moved(ahead, 0, weighed_point, error)
            if free:
                add_inner(hessian, at, end, weighed, by_lens)
                add_inner(lens_cross, 0, 0, by_lens, weighed_point)
                product(information[o], by_lens, weight, weighed_lens)
                add_inner(hessian, end, end, by_lens, weighed_lens)
                add_moved(gradient, end, weighed_lens, error)
        invert(total, 3, inverse)
        subtract_moved(own[p], 0, inverse, ahead)
        if free:
            product(lens_cross, inverse, 1.0, lens_gains[p])
            subtract_moved(gradient, end, lens_gains[p], ahead)
            subtract_outer(hessian, end, end, lens_gains[p], lens_cross)
        for o in observations:
            product(cross[o], inverse, 1.0, gains[o])
            subtract_moved(gradient, 6 * view[o], gains[o], ahead)
            for other in range(o, first[p + 1]):
                subtract_outer(hessian, 6 * view[o], 6 * view[other], gains[o], cross[other])
            if free:
                subtract_outer(hessian, 6 * view[o], end, gains[o], lens_cross)
    for i in range(end + free):
        hessian[i, i] += damping
        hessian[i, :i] = hessian[:i, i]
    return hessian, gradient, cost, gains, own, lens_gains


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _cost(poses, points, lens, view, xyrho, information, first):
    cost, error, by_pose, by_point, by_lens = 0.0, np.empty(3), np.empty((3, 6)), np.empty((3, 3)), np.empty((3, 2))
    for p in range(len(points)):
        for o in range(first[p], first[p + 1]):
            squared = _predict(
                poses[view[o]], points[p], lens, xyrho[o], information[o], error, by_pose, by_point, by_lens
            )
            cost += _huber(squared)
    return cost


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _huber(squared):
    """Half the robust square of an error."""
    return squared / 2.0 if squared <= _HUBER**2 else _HUBER * (math.sqrt(squared) - _HUBER / 2.0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _predict(pose, point, lens, xyrho, information, error, by_pose, by_point, by_lens):
    """Write the error (3,) of a landmark in a view, and its derivatives by the view's pose (3, 6), which moves as pose
    exp(d), by the landmark (3, 3) and by the lens (3, 2), 0 behind the view; the squared Mahalanobis distance."""
    dx, dy, dz = point[0] - pose[0, 3], point[1] - pose[1, 3], point[2] - pose[2, 3]
    x = pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz
    y = pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz
    z = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
    by_pose[:], by_point[:], by_lens[:], error[:] = 0.0, 0.0, 0.0, 0.0
    rho = u = v = bent = more = 0.0
    if z > 0.0:
        rho = 1.0 / z
        u, v = x * rho, y * rho
        square = u * u + v * v
        bent, more = lens[0] * (1.0 + lens[1] * square), 2.0 * lens[0] * lens[1]
        error[0], error[1], error[2] = bent * u - xyrho[0], bent * v - xyrho[1], rho - xyrho[2]
        by_lens[0, 0], by_lens[1, 0] = bent * u / lens[0], bent * v / lens[0]
        by_lens[0, 1], by_lens[1, 1] = lens[0] * square * u, lens[0] * square * v
    else:
        error[0] = error[1] = _BEHIND
    for k in range(3):
        # of the observed (x, y) by the ray (u, v), then by the point in the view
        by_u = bent + more * u * u if k == 0 else more * u * v if k == 1 else 0.0
        by_v = more * u * v if k == 0 else bent + more * v * v if k == 1 else 0.0
        a, b = rho * by_u, rho * by_v
        c = -rho * (by_u * u + by_v * v if k < 2 else rho)
        for i in range(3):
            by_point[k, i] = a * pose[i, 0] + b * pose[i, 1] + c * pose[i, 2]
        # the point in the view moves by skew(point) d_rotation - d_translation
        by_pose[k, 0], by_pose[k, 1], by_pose[k, 2] = b * z - c * y, c * x - a * z, a * y - b * x
        by_pose[k, 3], by_pose[k, 4], by_pose[k, 5] = -a, -b, -c
    squared = 0.0
    for i in range(3):
        for j in range(3):
            squared += error[i] * information[i, j] * error[j]
    return squared
