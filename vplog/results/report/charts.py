"""Charts as paths and labels of an SVG. Colours are classes of the stylesheet, so that light and dark differ there
alone; what colour distinguishes, dashes or words distinguish too."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from vplog.data import Floats, Ints

    Label = tuple[str, str, str, str]

_WIDTH, _HEIGHT = 640.0, 240.0
"""Units of a chart; it scales to the width of its box."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 52.0, 12.0, 28.0, 44.0
_ACROSS, _DOWN = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
_BINS, _QUANTILE = 40, 0.995
"""Bins of a distribution; values above that quantile stand in the last one."""
PLOT = (_LEFT, _ACROSS, _TOP, _TOP + _DOWN)
"""Left end, width, top and foot of the plot in a chart."""
_SECONDS = "seconds into the drive"
MOST_POINTS = 2000
"""Points of a path: more than a screen has pixels across adds nothing but bytes."""


@dataclass(frozen=True)
class Chart:
    """An SVG picture."""

    label: str
    """Text alternative, for screen readers."""
    paths: list[tuple[str, str]]
    """Classes and data of each path, in the order they are painted."""
    texts: list[Label]
    """x, y, text-anchor and words of each label."""
    size: tuple[str, str] = (f"{_WIDTH:.0f}", f"{_HEIGHT:.0f}")


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
    high = high if high > low else low + 1.0
    edges, width = np.linspace(low, high, _BINS + 1), _ACROSS / _BINS
    middle, height = _TOP + _DOWN / 2.0, _DOWN / 2.0
    paths, texts = [], []
    for kind, group, sign in (("yes", groups[0], -1.0), ("no", groups[1], 1.0)):
        counts = np.histogram(np.clip(group, low, high), edges)[0]
        most = int(counts.max())
        tall = (sign * height * counts / max(most, 1)).tolist()
        bars = "".join(_bar(_LEFT + bin * width, middle, width, rise) for bin, rise in enumerate(tall) if rise)
        paths.append((f"fill {kind}", bars))
        texts.append(_label(_LEFT - 5, middle + sign * height + (8.0 if sign < 0 else -1.0), "end", str(most)))
    for name, at in thresholds:
        x = _LEFT + (at - low) / (high - low) * _ACROSS
        paths.append(("bound", f"M{x:.1f} {_TOP - 4:.0f}V{_HEIGHT - _BOTTOM:.0f}"))
        texts.append(_label(x, _TOP - 8, "end" if x > _WIDTH / 2 else "start", name))
    paths.append(("axis", f"M{_LEFT} {middle:.1f}H{_WIDTH - _RIGHT}"))
    return _with_axes(
        f"distribution of {label}, accepted upwards, rejected downwards", paths, texts, (low, high), label
    )


def curves(named: Mapping[str, Floats]) -> Chart:
    """Precision (P, second column) over recall (first) of two curves, by their names."""
    return _lines(
        list(zip(("after", "other"), named.values(), strict=False)),
        "precision over recall",
        (0.0, 1.0),
        "recall",
        (0.0, 1.0),
        "precision",
    )


def over_time(lines: Sequence[tuple[str, Floats, Floats]], label: str, end_s: float) -> Chart | None:
    """Lines by class (`dot` for single values), times in s and values (P,), with gaps at NaN; None without a value."""
    values = np.concatenate([values for _, _, values in lines])
    if not np.isfinite(values).any():
        return None
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    named = [(kind, np.column_stack([times, values])) for kind, times, values in lines]
    return _lines(named, label, (0.0, end_s), _SECONDS, (low, high if high > low else low + 1.0), "")


def coverage(references: Ints, times: Floats, label: str, end_s: float) -> Chart:
    """Stretches of the drive that each reference explains, those used first at the bottom.

    `references` (N, K) are their numbers, negative for none, at `times` (N,) s.
    """
    rows = subsampled(np.arange(len(times)), MOST_POINTS)
    used, first = np.unique(references[rows], return_index=True)
    used = used[np.argsort(first, kind="stable")]
    used, ends = used[used >= 0], np.append(times[rows[1:]], end_s)
    lines = []
    for at, one in enumerate(used.tolist()):
        has = np.concatenate([[False], (references[rows] == one).any(1), [False]])
        starts, stops = np.flatnonzero(has[1:] & ~has[:-1]), np.flatnonzero(has[:-1] & ~has[1:]) - 1
        y = _TOP + _DOWN * (1.0 - (at + 0.5) / len(used))
        for x, to in (np.column_stack([times[rows[starts]], ends[stops]]) / end_s * _ACROSS + _LEFT).tolist():
            lines.append(f"M{x:.1f} {y:.1f}H{to:.1f}")
    return _with_axes(label, [("after", "".join(lines))], [], (0.0, end_s), _SECONDS, (0.0, float(len(used))))


def _lines(
    named: Sequence[tuple[str, Floats]], label: str, x: tuple[float, float], x_label: str, y: tuple[float, float],
    y_label: str,
) -> Chart:  # fmt: skip
    low, size = np.array([x[0], y[0]]), np.array([x[1] - x[0], y[1] - y[0]])
    paths = []
    for kind, points in named:
        across = (subsampled(points[:, :2], MOST_POINTS) - low) / size * [_ACROSS, -_DOWN] + [_LEFT, _TOP + _DOWN]
        gaps = np.flatnonzero(~np.isfinite(across).all(1))
        pieces = [piece[np.isfinite(piece).all(1)] for piece in np.split(across, gaps)]
        draw = _dots if kind.startswith("dot") else _line
        paths.append((f"track {kind}", "".join(draw(piece) for piece in pieces if len(piece))))
    return _with_axes(label, paths, [], x, x_label, y, y_label)


def columns(values: Sequence[float], label: str, unit: str) -> Chart:
    """One column for each value, in order."""
    most, width = max([*values, 1e-9]), _ACROSS / max(len(values), 1)
    foot = _HEIGHT - _BOTTOM
    bars = [_bar(_LEFT + at * width, foot, width, -value / most * _DOWN) for at, value in enumerate(values)]
    ends = (0.0, float(len(values))), (0.0, float(most))
    return _with_axes(label, [("fill after", "".join(bars))], [], ends[0], label, ends[1], unit)


def _bar(x: float, foot: float, width: float, rise: float) -> str:
    """A column of a chart, one unit narrower than its share where that is wide enough."""
    width = max(width - 1.0, width / 2.0)
    return f"M{x:.1f} {foot:.1f}h{width:.1f}v{rise:.1f}h{-width:.1f}z"


def _with_axes(
    label: str,
    paths: list[tuple[str, str]],
    texts: list[Label],
    x: tuple[float, float],
    x_label: str,
    y: tuple[float, float] | None = None,
    y_label: str = "",
) -> Chart:
    """A chart with its axes: ranges and labels, no numbers on the upright axis without a range."""
    foot = _HEIGHT - _BOTTOM
    frame = f"M{_LEFT} {_TOP}V{foot}H{_WIDTH - _RIGHT}"
    marks = [
        _label(_LEFT + share * _ACROSS, foot + 16, "middle" if share < 0.95 else "end", text)
        for share, text in round_ticks(x, 6)
    ]
    if y is not None:
        marks += [_label(_LEFT - 5, foot - share * _DOWN + 2, "end", text) for share, text in round_ticks(y, 4)]
    marks.append(_label(_LEFT + _ACROSS / 2, _HEIGHT - 8, "middle", x_label))
    marks.append(_label(4, 14, "start", y_label))
    return Chart(label, [*paths, ("axis", frame)], [*texts, *marks])


def _label(x: float, y: float, anchor: str, words: str) -> Label:
    return f"{x:.1f}", f"{y:.1f}", anchor, words


def round_ticks(ends: tuple[float, float], most: int) -> list[tuple[float, str]]:
    """Place (0 to 1) and text of the multiples of 1, 2 or 5 times a power of ten in a range, at most so many."""
    low, high = ends
    power = 10.0 ** np.floor(np.log10((high - low) / most))
    step = next(times * power for times in (1, 2, 5, 10) if (high - low) / (times * power) < most)
    values = step * np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) + 0.0
    return [((value - low) / (high - low), f"{value:.6g}") for value in values.tolist()]


def _dots(points: Floats) -> str:
    return "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points.tolist())


def _line(points: Floats) -> str:
    """A path through points (T, 2); one point alone is a dot."""
    return _dots(points) if len(points) < 2 else "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points.tolist())
