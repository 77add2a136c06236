"""Charts as inline SVG: numbers in, text out. Colours are classes of the page's style, so that light and dark differ
there alone; whatever is told by colour is told by dashes or words too."""

from __future__ import annotations

import html
import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vplog.data import Floats

_WIDE, _HIGH = 640.0, 240.0
"""Units of a chart; it scales to the width of its box."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 12.0, 28.0, 38.0
_BINS, _MOST_SHOWN = 40, 0.995
"""Of a distribution: what lies above that share of the values stands in the last bin."""
_MAP_WIDE, _MAP_HIGH = 720.0, 520.0
_MOST_POINTS = 2000
"""Of a path: more than a screen has pixels across adds nothing but bytes."""
_MOST_SEGMENTS = 3000
"""Closures drawn on the map, evenly chosen."""


def trajectory_map(
    paths: Sequence[tuple[str, Floats]], dots: Sequence[tuple[str, Floats]], segments: Sequence[tuple[str, Floats]]
) -> str:
    """Paths (T, 3), dots (T, 3) and segments (S, 2, 3) in m, each with its class, seen along the shortest axis.

    Equal scale in both directions, with a bar of a round length.
    """
    everything = [points for _, points in (*paths, *dots) if len(points)]
    whole = np.concatenate(everything) if everything else np.zeros((1, 3))
    view, named = _view(whole)
    seen = whole @ view.T
    low, high = seen.min(0), seen.max(0)
    extent = np.maximum(high - low, 1e-6)
    scale = float(min((_MAP_WIDE - 40.0) / extent[0], _MAP_HIGH / extent[1]))
    height = max(100.0, float(extent[1]) * scale) + 70.0
    margin = (_MAP_WIDE - float(extent[0]) * scale) / 2.0

    def place(points: Floats) -> Floats:
        flat = (points @ view.T - low) * scale
        return np.stack([margin + flat[..., 0], height - 50.0 - flat[..., 1]], axis=-1)

    drawn = [f'<svg viewBox="0 0 {_MAP_WIDE:.0f} {height:.0f}" role="img" aria-label="map of the trajectory">']
    for kind, points in dots:
        marks = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in place(_thinned(points, _MOST_POINTS)).tolist())
        drawn.append(f'<path class="dot {kind}" d="{marks}"/>')
    for kind, ends in segments:
        rows = place(_thinned(ends, _MOST_SEGMENTS)).reshape(-1, 4).tolist()
        drawn.append(
            f'<path class="edge {kind}" d="'
            + "".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for a, b, c, d in rows)
            + '"/>'
        )
    for kind, points in paths:
        drawn += [f'<path class="track {kind}" d="{_path(place(_thinned(points, _MOST_POINTS)))}"/>']
    bar_m = _round_length(float(extent.max()) / 4.0)
    drawn.append(
        f'<path class="axis" d="M20 {height - 22:.1f}h{bar_m * scale:.1f}m0 -4v8M20 {height - 26:.1f}v8"/>'
        f'<text x="{28 + bar_m * scale:.1f}" y="{height - 18:.1f}">{bar_m:g} m ({named})</text></svg>'
    )
    return "".join(drawn)


def _view(points: Floats) -> tuple[Floats, str]:
    """(2, 3) from the world to the right and up of the map, and what that is in words.

    From above where the ground is flat, else without the shortest axis; the longer of both goes to the right, which
    turns the map by 90 degrees and never mirrors it.
    """
    size = np.ptp(points, axis=0)
    gone = 2 if size[2] <= 1.2 * size.min() else int(np.argmin(size))
    # seen against the axis left out: (x, y) from above, (y, z) from the front, (z, x) from the side
    right, up = (gone + 1) % 3, (gone + 2) % 3
    axes, names = np.eye(3), "xyz"
    if size[right] >= size[up]:
        return axes[[right, up]], f"{names[right]} to the right, {names[up]} up"
    return np.stack([axes[up], -axes[right]]), f"{names[up]} to the right, {names[right]} down"


def histogram(above: Floats, below: Floats, label: str, bars: Sequence[tuple[str, float]] = ()) -> str:
    """Counts by value of accepted candidates upwards and of rejected ones downwards, each to a scale of its own, since
    the rejected are often a hundred times as many; `bars` are named thresholds."""
    groups = [values[np.isfinite(values)] for values in (above, below)]
    values = np.concatenate(groups)
    if not len(values):
        return f'<p class="quiet">No candidate has a value of {html.escape(label)}.</p>'
    low = float(min([values.min(), *(at for _, at in bars)]))
    ends = [float(np.quantile(group, _MOST_SHOWN)) for group in groups if len(group)]
    high = max([*ends, *(at * 1.1 for _, at in bars)])
    high = high if high > low else low + 1.0
    edges = np.linspace(low, high, _BINS + 1)
    width = (_WIDE - _LEFT - _RIGHT) / _BINS
    middle, half = (_TOP + _HIGH - _BOTTOM) / 2.0, (_HIGH - _TOP - _BOTTOM) / 2.0
    drawn = [_open(f"distribution of {label}, accepted upwards, rejected downwards")]
    for kind, group, sign in (("yes", groups[0], -1.0), ("no", groups[1], 1.0)):
        counts = np.histogram(np.clip(group, low, high), edges)[0]
        most = max(int(counts.max()), 1)
        tall = (sign * half * counts / most).tolist()
        cells = "".join(
            f"M{_LEFT + number * width:.1f} {middle:.1f}h{width - 1:.1f}v{high_px:.1f}h{1 - width:.1f}z"
            for number, high_px in enumerate(tall)
            if high_px
        )
        top = middle + sign * half + (4.0 if sign < 0 else 0.0)
        drawn.append(f'<path class="fill {kind}" d="{cells}"/>')
        drawn.append(f'<text x="{_LEFT - 5:.0f}" y="{top + 4:.1f}" text-anchor="end">{int(counts.max())}</text>')
    for name, at in bars:
        x = _LEFT + (at - low) / (high - low) * (_WIDE - _LEFT - _RIGHT)
        drawn.append(f'<path class="bound" d="M{x:.1f} {_TOP - 4:.0f}V{_HIGH - _BOTTOM:.0f}"/>')
        anchor = "end" if x > _WIDE / 2 else "start"
        drawn.append(f'<text x="{x:.1f}" y="{_TOP - 8:.0f}" text-anchor="{anchor}">{html.escape(name)}</text>')
    drawn.append(f'<path class="axis" d="M{_LEFT} {middle:.1f}H{_WIDE - _RIGHT}"/>')
    drawn.append(_axes((low, high), None, label, ""))
    return "".join([*drawn, "</svg>"])


def curves(named: Sequence[tuple[str, Floats]]) -> str:
    """Precision (P, second column) over recall (first), each named curve with its class."""
    drawn = [_open("precision over recall")]
    for kind, points in named:
        x, y = _LEFT + points[:, 0] * (_WIDE - _LEFT - _RIGHT), _TOP + (1.0 - points[:, 1]) * (_HIGH - _TOP - _BOTTOM)
        drawn.append(f'<path class="track {kind}" d="{_path(_thinned(np.stack([x, y], 1), _MOST_POINTS))}"/>')
    drawn.append(_axes((0.0, 1.0), (0.0, 1.0), "recall", "precision"))
    return "".join([*drawn, "</svg>"])


def columns(values: Sequence[float], label: str, unit: str) -> str:
    """One column for each value, in order."""
    most, width = max([*values, 1e-9]), (_WIDE - _LEFT - _RIGHT) / max(len(values), 1)
    cells = "".join(
        f"M{_LEFT + number * width:.1f} {_y(value / most):.1f}h{max(width - 1, 0.5):.1f}V{_HIGH - _BOTTOM:.1f}"
        f"h{-max(width - 1, 0.5):.1f}z"
        for number, value in enumerate(values)
    )
    axes = _axes((0.0, float(len(values))), (0.0, float(most)), label, unit)
    return f'{_open(label)}<path class="fill after" d="{cells}"/>{axes}</svg>'


def _open(label: str) -> str:
    return f'<svg viewBox="0 0 {_WIDE:.0f} {_HIGH:.0f}" role="img" aria-label="{html.escape(label, quote=True)}">'


def _y(share: float) -> float:
    return _HIGH - _BOTTOM - share * (_HIGH - _TOP - _BOTTOM)


def _axes(x: tuple[float, float], y: tuple[float, float] | None, x_label: str, y_label: str) -> str:
    drawn = [f'<path class="axis" d="M{_LEFT} {_TOP}V{_HIGH - _BOTTOM}H{_WIDE - _RIGHT}"/>']
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        at = _LEFT + share * (_WIDE - _LEFT - _RIGHT)
        anchor = "middle" if share < 1.0 else "end"
        drawn.append(
            f'<text x="{at:.1f}" y="{_HIGH - _BOTTOM + 14:.0f}" text-anchor="{anchor}">{_short(x, share)}</text>'
        )
    if y is not None:
        for share in (0.0, 0.5, 1.0):
            drawn += [f'<text x="{_LEFT - 5:.0f}" y="{_y(share) + 4:.1f}" text-anchor="end">{_short(y, share)}</text>']
    middle = (_LEFT + _WIDE - _RIGHT) / 2
    drawn.append(
        f'<text x="{middle:.0f}" y="{_HIGH - 6:.0f}" text-anchor="middle">{html.escape(x_label)}</text>'
        f'<text x="4" y="11">{html.escape(y_label)}</text>'
    )
    return "".join(drawn)


def _short(ends: tuple[float, float], share: float) -> str:
    return f"{ends[0] + share * (ends[1] - ends[0]):.3g}"


def _path(points: Floats) -> str:
    """An SVG path through places (T, 2)."""
    if not len(points):
        return ""
    if len(points) == 1:
        return f"M{points[0, 0]:.1f} {points[0, 1]:.1f}h0"
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points.tolist())


def _thinned(points: Floats, most: int) -> Floats:
    """At most so many, evenly, the first and the last among them."""
    return points if len(points) <= most else points[np.linspace(0, len(points) - 1, most).astype(np.int64)]


def _round_length(most: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not longer."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= most * (1.0 + 1e-9))
