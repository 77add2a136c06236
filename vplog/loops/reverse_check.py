"""Poses from query to match and from match to query: their consistency and their fusion."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog.geometry import se3

if TYPE_CHECKING:
    from vplog.data import Floats

_CHI2_6 = 22.458
"""Mahalanobis^2 of a 6D error that 0.1 % of right pairs exceed: chi-square, 6 degrees of freedom, 99.9 %."""
_HALVINGS = 20
"""Bisections of the weight 0..1, to one in a million."""


def reversed_pose(b_from_a: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """a_from_b (4, 4) of b_from_a, and its covariance (6, 6) moved from the frame of a to that of b.

    (T exp(d))^-1 = T^-1 exp(-Ad_T d).
    """
    Ad = se3.adjoint(b_from_a)
    return se3.inverse(b_from_a), Ad @ covariance @ Ad.T


def agree(pose: Floats, covariance: Floats, other: Floats, other_covariance: Floats) -> bool:
    """Whether two estimates a_from_b (4, 4), with covariances (6, 6) in b, are one pose within their joint noise.

    They share pixels, whose errors partly cancel in the difference: the sum of the covariances is generous, and what
    fails it is no noise.
    """
    apart = se3.log(se3.between(pose, other))
    return bool(apart @ np.linalg.solve(covariance + other_covariance, apart) < _CHI2_6)


def together(pose: Floats, covariance: Floats, other: Floats, other_covariance: Floats) -> tuple[Floats, Floats]:
    """One estimate of two of a_from_b that may share any part of their errors: pose (4, 4), covariance (6, 6).

    Covariance intersection (Julier & Uhlmann 1997): information w A + (1 - w) B is never too sure, however the errors
    are correlated; w is that of the smallest determinant of the covariance. Where one estimate is better in every
    direction it is taken alone.
    """
    a, b = (np.asarray(np.linalg.inv(c), np.float64) for c in (covariance, other_covariance))
    # det(w A + (1 - w) B) = det(B) prod(1 + w (r - 1)) over the eigenvalues r of B^-1 A; its log is concave in w
    gain = np.linalg.eigvals(other_covariance @ a).real - 1.0
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        w = (low + high) / 2.0
        low, high = (w, high) if (gain / (1.0 + w * gain)).sum() > 0 else (low, w)
    w = (low + high) / 2.0
    information = w * a + (1.0 - w) * b
    joint = np.asarray(np.linalg.inv(information), np.float64)
    step = joint @ ((1.0 - w) * b @ se3.log(se3.between(pose, other)))
    return pose @ se3.exp(step), joint
