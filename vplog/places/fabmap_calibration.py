"""Calibration of FAB-MAP's posterior on the references alone: without it the posterior is far too certain."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog.places.fabmap_model import Evidence, average_place, log_mean

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vplog.data import Bools, Floats, Reference
    from vplog.places.fabmap_model import Model

    Words = NDArray[np.uint16]

_LEAST_IMAGES = 10
"""Least images of a drive to calibrate on."""
_MOST_QUERIES = 200
"""Most references used as queries, spread evenly; more do not change the second digit of the weight."""
_NEAR_SHARE = 10
"""An image's place may be seen from a tenth of the drive's images before and after it; the others are far."""
_WEIGHTS = np.geomspace(0.01, 1.0, 201)
"""Weights tried, in steps of 2.3 %: below 0.01 the posterior is the prior, above 1 a word would count twice."""


def calibrate(
    references: Sequence[Reference], images: Sequence[Words], model: Model, drawn: NDArray[np.int64] | None
) -> tuple[float, float]:
    """The weight of the evidence, and nats to add to that of a new place, from the references alone.

    References are queries in turn, and the others of the same drive are the places: neighbours in time show the query's
    place, those far in time do not. The weight is the exponent of the likelihood that makes the neighbours most likely
    (a temperature: Guo et al., On calibration of modern neural networks, ICML 2017, section 4.2; Ribatet, Cooley &
    Davison, Statistica Sinica 22, 2012). With the nats a new place is as probable as it is frequent when each query is
    posed twice, with all other places and with the far ones only. The papers' (1, 0) without enough neighbours.
    """
    queries, others, neighbour, far = _by_time(references)
    if len(queries) < _LEAST_IMAGES:
        return 1.0, 0.0
    evidence = Evidence(images, model)
    log_ratio = np.empty((len(queries), len(images)))
    for k, row in enumerate(queries):
        log_ratio[k] = evidence(images[row], len(images))[0]
        new_place = average_place(images[row], model) if drawn is None else log_mean(log_ratio[k, drawn[drawn != row]])
        log_ratio[k] -= new_place
    surprise = [
        (_log_sum(weight * log_ratio, others) - _log_sum(weight * log_ratio, neighbour)).mean() for weight in _WEIGHTS
    ]
    weight = float(_WEIGHTS[np.argmin(surprise)])
    # both questions together have a new place half of the time: even odds against the mean of the places
    known = [_log_sum(weight * log_ratio, places) - np.log(places.sum(axis=1)) for places in (others, far)]
    return weight, _even_odds(np.concatenate(known), len(queries)) / weight


def _by_time(references: Sequence[Reference]) -> tuple[NDArray[np.int64], Bools, Bools, Bools]:
    """(A,) rows of queries, and (A, L) which are the other places of the drive, which its neighbours, which are far."""
    names = {name: number for number, name in enumerate(sorted({reference.drive for reference in references}))}
    drive = np.array([names[reference.drive] for reference in references])
    order = np.lexsort((np.arange(len(drive)), np.array([reference.stamp_ns for reference in references]), drive))
    size = np.bincount(drive)
    position = np.empty(len(drive), np.int64)
    position[order] = np.arange(len(drive)) - (np.cumsum(size) - size)[drive[order]]
    queries = np.flatnonzero(size[drive] >= _LEAST_IMAGES)
    queries = queries[:: -(-len(queries) // _MOST_QUERIES) or 1]
    same = drive[queries, None] == drive
    gap = np.abs(position[queries, None] - position)
    return queries, same & (gap > 0), same & (gap == 1), same & (gap > size[drive] / _NEAR_SHARE) & (gap > 1)


def _log_sum(logs: Floats, chosen: Bools) -> Floats:
    """(A,) ln of the sum of exp over the chosen of (A, L)."""
    return np.logaddexp.reduce(logs, axis=1, where=chosen, initial=-np.inf)


def _even_odds(known: Floats, new_places: int) -> float:
    """The log likelihood of a new place at which its probabilities against `known` sum to `new_places`."""
    low, high = known.min() - 50.0, known.max() + 50.0  # e^-50 is nothing beside 1
    for _ in range(60):  # halvings: to the last bit of a sum that grows with the answer
        middle = (low + high) / 2
        if np.exp(-np.logaddexp(0, known - middle)).sum() < new_places:
            low = middle
        else:
            high = middle
    return float((low + high) / 2)
