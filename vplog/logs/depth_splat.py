"""Measurements of a depth image written to the px of another camera that they cover."""

from __future__ import annotations

import math

import numba

_OVERLAP_PX = 0.25
"""px by which a measurement reaches over its own edge: on a slope neighbours drift apart by a part of a px and would
leave holes. At the edge of something near, it is as much too large."""
_MOST_PX = 16.0
"""Most px of the images to each side that one of the depth covers: four times what 160 of them have in 1280. What lies
in the camera itself, or a damaged calibration, would write the whole image for every px."""


@numba.njit(cache=True, nogil=True)
def splat(depth_m, rays, shift_m, pinhole, lens, scales, result):
    """Write the depth (H, W) along the other camera's z to `result`, NaN at first, as DepthRegistration has the other
    arguments; nearer ones hide those behind them."""
    height, width = result.shape
    for i in range(depth_m.shape[0]):
        for j in range(depth_m.shape[1]):
            depth = depth_m[i, j]
            z = depth * rays[i, j, 2] + shift_m[2]
            if not (depth > 0 and z > 0):
                continue
            x = pinhole[0] * (depth * rays[i, j, 0] + shift_m[0]) / z + pinhole[2]
            y = pinhole[1] * (depth * rays[i, j, 1] + shift_m[1]) / z + pinhole[3]
            if not (-0.5 < x < width - 0.5 and -0.5 < y < height - 0.5):
                continue
            column, row = round(x), round(y)
            u = lens[row, column, 0] + scales[0] * (x - column)
            v = lens[row, column, 1] + scales[1] * (y - row)
            half_u = min(0.5 * scales[2] * depth / z, _MOST_PX) + _OVERLAP_PX
            half_v = min(0.5 * scales[3] * depth / z, _MOST_PX) + _OVERLAP_PX
            for r in range(max(math.ceil(v - half_v), 0), min(math.floor(v + half_v), height - 1) + 1):
                for c in range(max(math.ceil(u - half_u), 0), min(math.floor(u + half_u), width - 1) + 1):
                    if not result[r, c] <= z:
                        result[r, c] = z
