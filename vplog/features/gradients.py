"""What SIFT's features look like: the directions of edges around a point, relative to its own (Lowe 2004, 5 and 6).

A feature's surroundings are looked at on a grid that grows with its scale, so that each costs the same; the level of
the scale space is blurred by as much as the grid is coarse.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    from vplog.data import Bytes, Float32s, Ints

_REACH = 4.5
"""Scales around a point that its direction is taken from: three times 1.5 (Lowe 2004, section 5)."""
_STEPS = 8
"""Samples along that radius."""
_TURNS = 36
"""Bins of directions."""
_PEAK = 0.8
"""Share of the strongest direction from which on another one makes a feature of its own."""
_CELL = 3.0
"""Scales along a cell of the descriptor."""
_CELLS = 4
"""Cells along a side, of 8 directions each."""
_DENSE = 4
"""Samples along a cell."""
_MOST = 0.2
"""Values of unit length are cut here, so that no single strong edge rules (Lowe 2004, section 6.1)."""


def _direction_samples() -> tuple[Float32s, Float32s]:
    """(K, 2) places within the unit circle, and (K,) their weight, a Gaussian of a third of its radius."""
    along = np.arange(-_STEPS, _STEPS + 1) / _STEPS
    x, y = (grid.ravel() for grid in np.meshgrid(along, along))
    inside = x**2 + y**2 <= 1.0
    at = np.column_stack([x, y])[inside]
    return at.astype(np.float32), np.exp(-(at**2).sum(axis=1) * 4.5).astype(np.float32)


def _descriptor_samples() -> tuple[Float32s, Float32s, Ints]:
    """(G,) places along a side, in cells, (G,) their part in the later of two cells, (G,) the earlier."""
    reach = (_CELLS + 1) / 2.0
    at = (np.arange(int(2 * reach * _DENSE)) + 0.5) / _DENSE - reach
    cell = at + _CELLS / 2.0 - 0.5
    first = np.floor(cell)
    return at.astype(np.float32), (cell - first).astype(np.float32), first.astype(np.int64)


_TURN_AT, _TURN_WEIGHT = _direction_samples()
_AT, _LATER, _FIRST = _descriptor_samples()
_AROUND = np.exp(-(_AT[:, None] ** 2 + _AT**2) / (2.0 * (_CELLS / 2.0) ** 2)).astype(np.float32).ravel()
"""(G x G,) weight of a sample: a Gaussian of half the descriptor's width (Lowe 2004, section 6.1)."""


def directions(levels: Float32s, points: Float32s, sigma: Float32s) -> tuple[Ints, Float32s]:
    """Rows (M,) of `points` (K, 4), some twice, and (M,) their directions in rad, from +x towards +y.

    `levels` are those of their octave, and `sigma` (K,) the scales in its px.
    """
    return _directions(levels, points, sigma * np.float32(_REACH), _TURN_AT, _TURN_WEIGHT, _TURNS, _PEAK)


def describe(levels: Float32s, points: Float32s, sigma: Float32s, angle: Float32s) -> Bytes:
    """(M, 128) uint8 descriptors of points (M, 4) of one octave with scales and directions (M,)."""
    side = sigma * np.float32(_CELL)
    return _describe(levels, points, side, angle, _AT, _LATER, _FIRST, _AROUND, _CELLS, np.float32(_MOST))


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _turn(y, x):
    """Angle of (x, y) in turns, 0..1, to 1e-5: Abramowitz & Stegun 4.4.49; library functions differ by machine."""
    ax, ay = abs(x), abs(y)
    low, high = min(ax, ay), max(ax, ay)
    a = low / (high + np.float32(1e-20))
    q = a * a
    r = a * (
        np.float32(0.15915494)
        * (
            np.float32(0.9998660)
            + q
            * (
                np.float32(-0.3302995)
                + q * (np.float32(0.1801410) + q * (np.float32(-0.0851330) + q * np.float32(0.0208351)))
            )
        )
    )
    if ay > ax:
        r = np.float32(0.25) - r
    if x < 0:
        r = np.float32(0.5) - r
    if y < 0:
        r = np.float32(1.0) - r
    return r


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _directions(levels, points, reach, at, weight, turns, peak):
    S, H, W = levels.shape
    K = points.shape[0]
    rows, angles = np.empty(4 * K, np.int64), np.empty(4 * K, np.float32)
    count = 0
    raw, bins = np.empty(turns, np.float32), np.empty(turns, np.float32)
    for k in range(K):
        level = levels[min(max(int(np.rint(points[k, 2])), 0), S - 1)]
        raw[:] = 0
        cx, cy, r = points[k, 0] + np.float32(0.5), points[k, 1] + np.float32(0.5), reach[k]
        for n in range(at.shape[0]):
            x, y = int(cx + r * at[n, 0]), int(cy + r * at[n, 1])
            if x < 1 or y < 1 or x >= W - 1 or y >= H - 1:
                continue
            gx, gy = level[y, x + 1] - level[y, x - 1], level[y + 1, x] - level[y - 1, x]
            turn = int(_turn(gy, gx) * turns + np.float32(0.5))
            if turn >= turns:
                turn -= turns
            raw[turn] += weight[n] * np.sqrt(gx * gx + gy * gy)
        most = np.float32(0)
        for b in range(turns):  # binomial, as OpenCV's and VLFeat's
            bins[b] = (
                np.float32(0.375) * raw[b]
                + np.float32(0.25) * (raw[b - 1] + raw[(b + 1) % turns])
                + np.float32(0.0625) * (raw[b - 2] + raw[(b + 2) % turns])
            )
            most = max(most, bins[b])
        own = 0
        for b in range(turns):
            left, here, right = bins[b - 1], bins[b], bins[(b + 1) % turns]
            if here > left and here > right and here >= np.float32(peak) * most and own < 4:
                turn = (b + np.float32(0.5) * (left - right) / (left - here - here + right)) / turns
                rows[count], angles[count] = k, turn * np.float32(2.0 * np.pi)
                count += 1
                own += 1
    return rows[:count].copy(), angles[:count].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _describe(levels, points, side, angle, at, later, first, around, cells, most):
    M, G, C = points.shape[0], at.shape[0], cells + 2
    result = np.empty((M, cells * cells * 8), np.uint8)
    bins, values = np.empty(C * C * 9, np.float32), np.empty(cells * cells * 8, np.float32)
    gx, gy = np.empty(G * G, np.float32), np.empty(G * G, np.float32)
    strength, turn = np.empty(G * G, np.float32), np.empty(G * G, np.float32)
    one, eight = np.float32(1.0), np.float32(8.0)
    for m in range(M):
        level = levels[min(max(int(np.rint(points[m, 2])), 0), levels.shape[0] - 1)]
        _gather(level, points[m, 0], points[m, 1], side[m], angle[m], at, gx, gy)
        own = angle[m] * np.float32(1.0 / (2.0 * np.pi))
        for n in range(G * G):
            strength[n] = around[n] * np.sqrt(gx[n] * gx[n] + gy[n] * gy[n])
            relative = own - _turn(gy[n], gx[n])  # against the pixels' y, as OpenCV
            turn[n] = eight * (relative + one if relative < 0 else relative)
        bins[:] = 0
        _vote(strength, turn, later, first, C, bins)
        _normalise(bins, cells, most, values)
        for v in range(values.shape[0]):
            result[m, v] = np.uint8(min(values[v] + np.float32(0.5), np.float32(255.0)))
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _gather(level, x0, y0, side, angle, at, gx, gy):
    """Write the gradients (G x G,) of the pixels nearest to the grid's points; 0 outside the image."""
    H, W = level.shape
    G, half = at.shape[0], np.float32(0.5)
    c, s = side * np.float32(np.cos(angle)), side * np.float32(np.sin(angle))
    for i in range(G):
        cx, cy = x0 + half - s * at[i], y0 + half + c * at[i]
        for j in range(G):
            x, y = np.int64(cx + c * at[j]), np.int64(cy + s * at[j])
            if 1 <= x < W - 1 and 1 <= y < H - 1:
                gx[i * G + j] = level[y, x + 1] - level[y, x - 1]
                gy[i * G + j] = level[y + 1, x] - level[y - 1, x]
            else:
                gx[i * G + j], gy[i * G + j] = np.float32(0), np.float32(0)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _vote(strength, turn, later, first, C, bins):
    """Share each sample out among two rows, columns and directions; `bins` (C x C x 9,), the ninth being the first."""
    G = later.shape[0]
    for i in range(G):
        for j in range(G):
            n = i * G + j
            o = min(np.uint64(turn[n]), np.uint64(7))
            part, upper = turn[n] - np.float32(o), strength[n] * later[i]
            b = np.uint64((first[i] + 1) * C + first[j] + 1) * np.uint64(9) + o
            for value in (strength[n] - upper, upper):
                right = value * later[j]
                left = value - right
                more = left * part
                bins[b] += left - more
                bins[b + np.uint64(1)] += more
                more = right * part
                bins[b + np.uint64(9)] += right - more
                bins[b + np.uint64(10)] += more
                b += np.uint64(9 * C)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _normalise(bins, cells, most, values):
    """Write the descriptor: of unit length, cut at `most`, and of length 512 again, as OpenCV's bytes."""
    length, v = np.float32(0), 0
    for row in range(1, cells + 1):
        for column in range(1, cells + 1):
            b = (row * (cells + 2) + column) * 9
            bins[b] += bins[b + 8]
            for o in range(8):
                values[v] = bins[b + o]
                length += values[v] * values[v]
                v += 1
    cut = most * np.sqrt(length)
    length = np.float32(0)
    for v in range(values.shape[0]):
        values[v] = min(values[v], cut)
        length += values[v] * values[v]
    scale = np.float32(512.0) / max(np.sqrt(length), np.float32(1e-12))
    for v in range(values.shape[0]):
        values[v] *= scale
