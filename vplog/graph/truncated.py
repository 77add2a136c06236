"""The truncated least squares loss, reached by degrees: Yang et al., Graduated Non-Convexity, RA-L 2020."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from vplog.data import Floats


def truncated_weights(chi2: Floats, bound: float, mu: float) -> Floats:
    """Eq. (14): 1 for small residuals, 0 for large ones, between them falling."""
    with np.errstate(divide="ignore"):
        between = np.sqrt(bound * mu * (mu + 1.0) / chi2) - mu
    return np.where(chi2 <= bound * mu / (mu + 1.0), 1.0, np.where(chi2 >= bound * (mu + 1.0) / mu, 0.0, between))
