"""Which frames become the reference images of a library."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from vplog.settings import Settings

if TYPE_CHECKING:
    from vplog.data import Ints

PAPER_SIZE = 100
"""L of the paper's experiments (section IV)."""
_FRAMES_A_REFERENCE = 8
"""Keyframes per reference, twice the paper's J: four references then reach beyond a frame's neighbours in time."""
_LEAST_SIZE = 8
"""References of even the shortest drive: twice the paper's J, so that there is a choice."""


class LibrarySettings(Settings):
    """Which images become the reference library where none is given."""

    choose: Literal["random"] = "random"
    """How: a random collection of the drive's own keyframes, as the paper (section IV)."""
    size: int | None = Field(default=None, ge=1, le=1_000_000)
    """L: how many. None takes every eighth keyframe, at most the paper's 100: were every other frame a reference, the
    four that explain a frame would be its neighbours in time, which a later visit shares with nobody."""
    seed: int = Field(default=0, ge=0)
    """Of the choice."""


def choose(stamp_ns: Ints, settings: LibrarySettings) -> Ints:
    """Rows of the frames that become references, increasing."""
    count = len(stamp_ns)
    every = min(max(count // _FRAMES_A_REFERENCE, _LEAST_SIZE), PAPER_SIZE)
    size = min(count, every if settings.size is None else settings.size)
    return np.sort(np.random.default_rng(settings.seed).choice(count, size, replace=False))
