"""How many wrong models would be found by chance with as many agreeing matches: the a-contrario test."""

from __future__ import annotations

from math import lgamma, log, log10


def log10_false_alarms(matches: int, inliers: int, sample: int, models: int, share: float) -> float:
    """log10 of the number of false alarms of a model that `inliers` of `matches` agree with.

    Moisan & Stival 2004, proposition 2; Moulon, Monasse & Marlet 2012, eq. 1. `sample` matches fix a model, in up to
    `models` ways; a wrong match agrees with a given model with probability `share` (0..1), the share of the image that
    lies within the tolerance.
    """
    if inliers <= sample:
        return log10(max(models, 1)) + log10(max(matches, 1))  # the sample alone proves nothing
    return (
        log10(models)
        + log10(max(matches - sample, 1))
        + _log10_binomial(matches, inliers)
        + _log10_binomial(inliers, sample)
        + (inliers - sample) * log10(min(max(share, 1e-300), 1.0))
    )


def _log10_binomial(n: int, k: int) -> float:
    return (lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)) / log(10)
