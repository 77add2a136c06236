"""Cameras as plain values, in JSON."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from vplog.data import Camera
from vplog.errors import ResultError

_CAMERA: dict[str, Callable[[Any], Any]] = {
    "name": str, "distortion_model": str, "width": int, "height": int, "disparity_zero_px": float, "baseline_m": float,
    "matrix": lambda rows: np.array(rows, np.float64).reshape(3, 3),
    "distortion": lambda values: np.array(values, np.float64).reshape(-1),
    "body_from_camera": lambda rows: np.array(rows, np.float64).reshape(4, 4),
}  # fmt: skip
"""Fields of a camera, from plain values."""


def camera_from(values: dict[str, Any], again: str) -> Camera:
    """The camera of plain values. Raises ResultError, with the remedy `again`, where the values are not one."""
    try:
        known = {name: kind(values[name]) for name, kind in _CAMERA.items() if values[name] is not None}
        return Camera(**(dict[str, Any](matrix=None, baseline_m=None) | known))
    except (KeyError, TypeError, ValueError) as error:
        raise ResultError(f"The record of a camera is damaged: {error}. {again}") from None
