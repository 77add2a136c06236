"""Where SIFT's features are: extrema of differences of Gaussians over position and scale (Lowe 2004, sections 3 and 4).

Compiled, in plain float32 without contraction to fused operations: every machine finds the same features, bit by bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vplog.data import Float32s

LAYERS = 3
"""Scales to an octave (Lowe 2004, section 3.2)."""
SIGMA = 1.6
"""px of an octave: blur of its first level (Lowe 2004, section 3.3)."""
_LEAST_SIDE = 16
"""px of the smallest octave's shorter side: below it a feature's surroundings are larger than the image."""
_BORDER = 5
"""px along the sides where no extremum is looked for."""
_EDGE = 10.0
"""Largest ratio of the principal curvatures: what is stretched further is an edge (Lowe 2004, section 4.1)."""
_MOVES = 5
"""Samples that an extremum may move by while its place is refined."""
_EARLY = 0.5
"""Share of the contrast threshold that a sample must reach before its peak is looked for between samples."""


def octaves(image: Float32s, blur: float) -> Iterator[tuple[Float32s, Float32s]]:
    """(LAYERS + 3, h, w) Gaussian levels and (LAYERS + 2, h, w) their differences of every octave, the finest first.

    `image` (H, W) float32 has the blur `blur` in px already.
    """
    level = image
    if blur < SIGMA:
        level = np.empty_like(image)
        blur_into(image, level, np.empty_like(image), _kernel(np.sqrt(SIGMA**2 - blur**2)))
    while True:
        levels = np.empty((LAYERS + 3, *level.shape), np.float32)
        differences = np.empty((LAYERS + 2, *level.shape), np.float32)
        levels[0] = level
        for at in range(1, LAYERS + 3):
            before, after = (SIGMA * 2.0 ** (step / LAYERS) for step in (at - 1, at))
            blur_into(levels[at - 1], levels[at], differences[at - 1], _kernel(np.sqrt(after**2 - before**2)))
        yield levels, differences
        if min(level.shape) < 2 * _LEAST_SIDE:
            return
        level = np.ascontiguousarray(levels[LAYERS, ::2, ::2])


def _kernel(sigma: float) -> Float32s:
    """(R + 1,) float32: the middle of a Gaussian and its right half, cut beyond three sigmas; R is even."""
    x = np.arange(2 * int(np.ceil(1.5 * sigma)) + 1)
    half = np.exp(-(x**2) / (2.0 * sigma**2))
    return (half / (half[0] + 2.0 * half[1:].sum())).astype(np.float32)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def blur_into(image, result, difference, kernel):
    """Convolve (H, W) with a symmetric kernel along both sides, and subtract the image from that.

    Beyond the border the image is mirrored, without repeating its last pixel.
    """
    H, W = image.shape
    R = kernel.shape[0] - 1
    row = np.empty(W + 2 * R, np.float32)
    for y in range(H):
        middle, out = row[R : R + W], result[y]
        _scale(image[y], kernel[0], middle)
        for r in range(1, R, 2):  # two taps at once: half the sums to store
            a, b = image[max(min(abs(y - r), H - 1), 0)], image[max(H - 1 - abs(H - 1 - y - r), 0)]
            c, d = image[max(min(abs(y - r - 1), H - 1), 0)], image[max(H - 1 - abs(H - 2 - y - r), 0)]
            _add(a, b, kernel[r], c, d, kernel[r + 1], middle)
        for r in range(1, R + 1):
            row[R - r] = row[R + min(r, W - 1)]
            row[R + W - 1 + r] = row[R + max(W - 1 - r, 0)]
        _scale(middle, kernel[0], out)
        for r in range(1, R, 2):
            a, b, c, d = row[R - r :], row[R + r :], row[R - r - 1 :], row[R + r + 1 :]
            _add(a, b, kernel[r], c, d, kernel[r + 1], out)
        _subtract(out, image[y], difference[y])


# Loops over a row are functions of their own: only so the compiler sees that rows do not overlap, ten times as fast.


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _scale(a, weight, result):
    for x in range(result.shape[0]):
        result[x] = weight * a[x]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add(a, b, near, c, d, far, result):
    for x in range(result.shape[0]):
        result[x] += near * (a[x] + b[x]) + far * (c[x] + d[x])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _subtract(a, b, result):
    for x in range(result.shape[0]):
        result[x] = a[x] - b[x]


def extrema(differences: Float32s, contrast: float) -> Float32s:
    """(K, 4) float32 of an octave: x, y in its px, level (1..LAYERS) and contrast in grey levels."""
    beyond = np.zeros(differences.shape, np.bool_)
    _mark(differences, np.float32(_EARLY * contrast), _BORDER, beyond)
    return _refine_all(differences, np.flatnonzero(beyond), np.float32(contrast), _BORDER, _EDGE, _MOVES)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mark(D, early, border, beyond):
    """Write which samples are loud and none of their four neighbours beyond them."""
    S, H, W = D.shape
    for s in range(1, S - 1):
        for y in range(border, H - border):
            _mark_row(D[s, y - 1], D[s, y], D[s, y + 1], early, beyond[s, y])
            beyond[s, y, :border] = False
            beyond[s, y, W - border :] = False


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mark_row(above, row, below, early, beyond):
    """Without a branch: most are none, and which could not be foreseen."""
    for x in range(1, row.shape[0] - 1):
        v, left, right, up, down = row[x], row[x - 1], row[x + 1], above[x], below[x]
        high = (v > early) & (v >= left) & (v >= right) & (v >= up) & (v >= down)
        low = (v < -early) & (v <= left) & (v <= right) & (v <= up) & (v <= down)
        beyond[x] = high | low


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _refine_all(D, samples, contrast, border, edge, moves):
    _, H, W = D.shape
    result = np.empty((samples.shape[0], 4), np.float32)
    count = 0
    for n in range(samples.shape[0]):
        s, y, x = samples[n] // (H * W), samples[n] // W % H, samples[n] % W
        if _is_extremum(D, s, y, x, D[s, y, x]) and _refine(D, s, y, x, border, moves, contrast, edge, result[count]):
            count += 1
    return result[:count].copy()


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _is_extremum(D, s, y, x, v):
    """Whether no neighbour in place and scale is beyond v: ties count, as of a checkerboard's equal corners."""
    sign = np.float32(1.0) if v > 0 else np.float32(-1.0)
    for layer in (s, s - 1, s + 1):  # its own first, where most end
        for row in range(y - 1, y + 2):
            for column in range(x - 1, x + 2):
                if sign * D[layer, row, column] > sign * v:
                    return False
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _refine(D, s, y, x, border, moves, contrast, edge, result):
    """Whether the peak of the parabola around a sample is sharp and strong; write its x, y, level and contrast.

    Lowe 2004, section 4, eq. 2 and 3; in double precision, as the determinant of a flat one is tiny.
    """
    S, H, W = D.shape
    for _ in range(moves):
        v = np.float64(D[s, y, x])
        gx = 0.5 * (np.float64(D[s, y, x + 1]) - D[s, y, x - 1])
        gy = 0.5 * (np.float64(D[s, y + 1, x]) - D[s, y - 1, x])
        gs = 0.5 * (np.float64(D[s + 1, y, x]) - D[s - 1, y, x])
        xx = np.float64(D[s, y, x + 1]) + D[s, y, x - 1] - 2.0 * v
        yy = np.float64(D[s, y + 1, x]) + D[s, y - 1, x] - 2.0 * v
        ss = np.float64(D[s + 1, y, x]) + D[s - 1, y, x] - 2.0 * v
        xy = 0.25 * (np.float64(D[s, y + 1, x + 1]) - D[s, y + 1, x - 1] - D[s, y - 1, x + 1] + D[s, y - 1, x - 1])
        xs = 0.25 * (np.float64(D[s + 1, y, x + 1]) - D[s + 1, y, x - 1] - D[s - 1, y, x + 1] + D[s - 1, y, x - 1])
        ys = 0.25 * (np.float64(D[s + 1, y + 1, x]) - D[s + 1, y - 1, x] - D[s - 1, y + 1, x] + D[s - 1, y - 1, x])
        # the cofactors of the Hessian
        a, b, c = yy * ss - ys * ys, xs * ys - xy * ss, xy * ys - xs * yy
        determinant = xx * a + xy * b + xs * c
        if determinant == 0.0:
            return False
        d, e, f = xx * ss - xs * xs, xy * xs - xx * ys, xx * yy - xy * xy
        dx = -(a * gx + b * gy + c * gs) / determinant
        dy = -(b * gx + d * gy + e * gs) / determinant
        ds = -(c * gx + e * gy + f * gs) / determinant
        if abs(dx) < 0.5 and abs(dy) < 0.5 and abs(ds) < 0.5:
            peak = abs(v + 0.5 * (gx * dx + gy * dy + gs * ds))
            trace, sharp = xx + yy, f
            if peak < contrast or sharp <= 0.0 or trace * trace * edge >= (edge + 1.0) ** 2 * sharp:
                return False
            result[0], result[1], result[2], result[3] = x + dx, y + dy, s + ds, peak
            return True
        if not (abs(dx) < W and abs(dy) < H and abs(ds) < S):
            return False
        x, y, s = x + int(np.rint(dx)), y + int(np.rint(dy)), s + int(np.rint(ds))
        if not (1 <= s < S - 1 and border <= x < W - border and border <= y < H - border):
            return False
    return False
