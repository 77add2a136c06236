"""Data of the page's charts, which uPlot draws in the browser, and the view of its map."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vplog.data import Floats, Ints

Line = tuple[str, str, list[float | None]]

_BINS, _QUANTILE = 40, 0.995
"""Bins of a distribution; values above that quantile stand in the last one."""
_SECONDS = "seconds"
MOST_POINTS = 2000
"""Points of a path: more than a screen has pixels across adds nothing but bytes."""

_MOST_DOTS = 20_000
"""Single values of a chart, some 10 bytes each."""


@dataclass(frozen=True)
class Chart:
    """Lines, dots or columns over one axis."""

    label: str
    x_label: str
    x: list[float]
    """Ascending."""
    lines: list[Line]
    """Class of the stylesheet, name and value at each x; `dot` in the class for single values."""
    kind: str = "line"
    """`line` with gaps where a value is unknown, `curve` without, `bar`, `mirrored` for bars of two scales, the second
    downwards, or `time`: lines that are linked with map and ledger."""
    thresholds: list[tuple[str, float]] = field(default_factory=list)
    """Name and place on the axis."""


def subsampled(rows: NDArray[Any], most: int) -> NDArray[Any]:
    """At most so many rows (N, ...), evenly spaced, the first and the last among them."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(np.int64)]


def map_view(points: Floats) -> Floats:
    """(3, 3) from the world to the right, up and out of the map.

    From above where the ground is flat, else along the shortest axis; the longer of both others goes to the right,
    which turns the map by 90 degrees and never mirrors it.
    """
    size = np.ptp(points, axis=0)
    gone = 2 if size[2] <= 1.2 * size.min() else int(np.argmin(size))
    # against the axis left out: (x, y) from above, (y, z) from the front, (z, x) from the side
    right, up, out = np.eye(3)[[(gone + 1) % 3, (gone + 2) % 3, gone]]
    return np.stack([right, up, out] if size @ right >= size @ up else [up, -right, out])


def histogram(above: Floats, below: Floats, label: str, thresholds: Sequence[tuple[str, float]] = ()) -> Chart | None:
    """Counts by value of accepted candidates upwards and of rejected ones downwards, each to a scale of its own, since
    the rejected are often a hundred times as many; None without a value."""
    groups = [values[np.isfinite(values)] for values in (above, below)]
    if not any(map(len, groups)):
        return None
    low = min([*(float(group.min()) for group in groups if len(group)), *(at for _, at in thresholds)])
    ends = [float(np.quantile(group, _QUANTILE)) for group in groups if len(group)]
    high = max([*ends, *(at * 1.1 for _, at in thresholds)])
    edges = np.linspace(low, high if high > low else low + 1.0, _BINS + 1)
    counts = [np.histogram(np.clip(group, low, edges[-1]), edges)[0] for group in groups]
    lines = [("yes", "accepted", counts[0]), ("no", "rejected", -counts[1])]
    return _chart(label, "value", edges, lines, "mirrored", list(thresholds))


def curves(named: Mapping[str, Floats]) -> Chart:
    """Precision (P, second column) over recall (first) of two curves, by their names."""
    recall = np.concatenate([[0.0, 1.0], *(curve[:, 0] for curve in named.values())])
    order, lines, start = np.argsort(recall, kind="stable"), [], 2
    for kind, (name, curve) in zip(("after", "other"), named.items(), strict=False):
        values = np.full(len(recall), np.nan)
        values[start : (start := start + len(curve))] = curve[:, 1]
        lines.append((kind, name, values[order]))
    return _chart("precision over recall", "recall", recall[order], lines, "curve")


def over_time(lines: Sequence[tuple[str, str, Floats]], times: Floats, label: str, end_s: float) -> Chart | None:
    """Lines by class and name, of values (P,) at `times` (P,) s, with gaps at NaN; None without a value."""
    if not any(np.isfinite(values).any() for _, _, values in lines):
        return None
    most = _MOST_DOTS if lines[0][0].startswith("dot") else MOST_POINTS
    rows = subsampled(np.argsort(times, kind="stable"), most)
    ends = [(kind, name, np.r_[np.nan, values[rows], np.nan]) for kind, name, values in lines]
    return _chart(label, _SECONDS, np.r_[0.0, times[rows], end_s], ends, "time")  # all charts from start to end


def coverage(references: Ints, times: Floats, label: str, end_s: float) -> Chart | None:
    """The references that explain each keyframe, numbered by their first use.

    `references` (N, K) are their numbers, negative for none, at `times` (N,) s.
    """
    flat = references[references >= 0]
    used, first = np.unique(flat, return_index=True)
    number = np.full(int(flat.max(initial=0)) + 2, np.nan)  # the last one is that of no reference, -1
    number[used[np.argsort(first)]] = np.arange(1.0, len(used) + 1.0)
    shown = number[references].ravel()
    return over_time([("dot after", "reference", shown)], np.repeat(times, references.shape[1]), label, end_s)


def columns(values: Sequence[float], label: str, unit: str) -> Chart:
    """One column for each value, in order."""
    counts = np.array(values, np.float64)
    return _chart(label, label, np.arange(len(counts) + 1.0), [("after", unit, counts)], "bar")


def _chart(
    label: str, x_label: str, x: Floats, lines: Iterable[tuple[str, str, Floats | Ints]], kind: str,
    thresholds: list[tuple[str, float]] | None = None,
) -> Chart:  # fmt: skip
    """With values for JSON: seven digits, None where one is unknown, and for columns at the right end of the last."""
    known = [
        (paint, name, [float(f"{value:.7g}") if np.isfinite(value) else None for value in values.tolist()])
        for paint, name, values in lines
    ]
    padded = [(paint, name, values + [None] * (len(x) - len(values))) for paint, name, values in known]
    return Chart(label, x_label, [float(f"{at:.9g}") for at in x.tolist()], padded, kind, thresholds or [])
