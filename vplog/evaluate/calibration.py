"""Reliability of probabilities: the share of right answers by their claimed probability."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.errors import TruthError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from vplog.data import Bools, Floats, Ints


@dataclass(frozen=True, eq=False)
class Reliability:
    """The reliability diagram: B bins of equal width of the probability, 0..1."""

    edges: Floats
    """(B + 1,); a bin has its lower edge, the last both."""
    count: Ints
    """(B,) answers in each."""
    confidence: Floats
    """(B,) their mean probability; NaN in an empty bin."""
    accuracy: Floats
    """(B,) the share of them that are right; NaN in an empty bin."""
    expected_calibration_error: float
    """Mean distance of accuracy and confidence over the answers: 0 where every bin's probability is its accuracy."""

    @property
    def overconfidence(self) -> float:
        """Mean probability less the share that is right, -1..1; positive where answers are more certain than right."""
        filled = self.count > 0
        gap = self.confidence[filled] - self.accuracy[filled]
        return float((self.count[filled] * gap).sum() / self.count.sum())

    def as_json(self) -> dict[str, Any]:
        """The diagram as plain values; None where a bin is empty."""
        filled = self.count > 0
        return {
            "expected_calibration_error": round(self.expected_calibration_error, 6),
            "overconfidence": round(self.overconfidence, 6),
            "count": self.count.tolist(),
            "confidence": [round(c, 6) if f else None for c, f in zip(self.confidence.tolist(), filled, strict=True)],
            "accuracy": [round(a, 6) if f else None for a, f in zip(self.accuracy.tolist(), filled, strict=True)],
        }


def reliability(probability: ArrayLike, right: Bools, bins: int) -> Reliability:
    """Compare the probabilities (Q,) of Q answers with which of them are right (Q,).

    Guo et al., On calibration of modern neural networks, ICML 2017, Eq. (3). Raises TruthError without answers, and
    ValueError where the shapes do not fit or a probability is not one.
    """
    probability = np.asarray(probability, np.float64)
    right = np.asarray(right, bool)
    if probability.ndim != 1 or probability.shape != right.shape or bins < 1:
        raise ValueError(f"{probability.shape} probabilities, {right.shape} outcomes, {bins} bins")
    if len(probability) == 0:
        raise TruthError("No query has an answer, so no probability can be judged. Are there candidates?")
    if not np.all((probability >= 0) & (probability <= 1)):
        raise ValueError("a probability is not between 0 and 1")
    edges = np.linspace(0.0, 1.0, bins + 1)
    row = np.clip(np.searchsorted(edges, probability, side="right") - 1, 0, bins - 1)
    count = np.bincount(row, minlength=bins)
    filled = np.where(count > 0, count, np.nan)
    confidence = np.bincount(row, probability, minlength=bins) / filled
    accuracy = np.bincount(row, right, minlength=bins) / filled
    error = float(np.nansum(count * np.abs(accuracy - confidence)) / len(probability))
    return Reliability(edges, count, confidence, accuracy, error)
