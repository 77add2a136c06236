"""Views of a drive by day and at dusk: the same frames, and darker with other noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog import logs

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def day_and_dusk(log: Path, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The first images of a log, (H, W) uint8 twice."""
    found, rng = logs.open(log), np.random.default_rng(0)
    for frame in found.frames(found.stamps()[:count]):
        day = frame.decode().image
        yield day, np.clip(0.8 * day + rng.normal(0, 2, day.shape), 0, 255).astype(np.uint8)
