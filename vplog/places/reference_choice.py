"""Choice of the reference images of a library."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from vplog.data import Ints
from vplog.settings import Settings

PAPER_SIZE = 100
"""L of the paper's experiments (section IV)."""
LEAST_SIZE = 8
"""References of even the shortest drive: twice the paper's J, so that there is a choice."""
FRAMES_A_REFERENCE = 8
"""Keyframes per reference, twice the paper's J: four references then reach beyond a frame's neighbours in time."""


class LibrarySettings(Settings):
    """Reference library that is made where none is given."""

    choose: Literal["random", "spread", "coverage"] = "random"
    """How: `random` frames, as the paper (section IV); `spread`, evenly along the drive; `coverage`, those that
    explain the other frames best (see vplog/places/coverage.py), which looks at the drive first."""
    size: int | None = Field(default=None, ge=1, le=1_000_000)
    """L: how many. None takes the paper's 100, and more, to 1600, of drives of which too few are recognised by their
    neighbours (see vplog/places/self_recognition.py), as in storeys that look alike; of a drive by itself every eighth
    keyframe at most: were every other frame a reference, the four that explain a frame would be its neighbours in time,
    which a later visit shares with nobody. With `coverage` None takes as many as explain the drive, 8 to 100, see
    `least_gain`."""
    least_gain: float = Field(default=0.005, gt=0, lt=1)
    """`coverage` without a size stops where one more reference adds less than this share of what is explained."""
    seed: int = Field(default=0, ge=0)
    """Seed of a random choice."""


def choose(stamp_ns: Ints, settings: LibrarySettings) -> Ints:
    """Rows of the frames that become references, increasing: at random, or evenly by number.

    Raises ValueError for a choice by coverage, which needs features: that is `places.coverage.choose_by_coverage`.
    """
    count = len(stamp_ns)
    every = min(max(count // FRAMES_A_REFERENCE, LEAST_SIZE), PAPER_SIZE)
    size = min(count, every if settings.size is None else settings.size)
    if settings.choose == "random":
        return np.sort(np.random.default_rng(settings.seed).choice(count, size, replace=False))
    if settings.choose == "spread":
        return evenly(count, size)
    raise ValueError("a choice by coverage needs features")


def evenly(count: int, size: int) -> Ints:
    """The middles of `size` equal parts of `count` rows, increasing; all rows where `size` is as many or more."""
    size = min(count, size)
    return (2 * np.arange(size, dtype=np.int64) + 1) * count // max(2 * size, 1)
