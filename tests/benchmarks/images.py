"""Images to measure on: real drives where there are some, else the demo's rendered street."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vplog import logs
from vplog.data import Reference
from vplog.verbs.demo import make_drive

if TYPE_CHECKING:
    from vplog.data import Bytes
    from vplog.features.extractors import FeatureSettings

REAL = ("gardens_day_left.mcap", "kitti00")
"""A walk of 960 x 540 px and a street of 1241 x 376 px, in the folder VPLOG_DATA / drives."""
LIBRARY = 100
"""L of the paper (section IV)."""


@dataclass(frozen=True, eq=False)
class Images:
    """Images of one drive, and others of it that are the library."""

    name: str
    images: list[Bytes]
    library: list[Bytes]

    def references(self, extractor: FeatureSettings) -> list[Reference]:
        return [Reference(image, extractor(image), self.name, row) for row, image in enumerate(self.library)]


def drives(count: int) -> list[Images]:
    """`count` images of each real drive, or of the demo's where there is none."""
    folder = Path(os.environ.get("VPLOG_DATA", Path(__file__).parents[3] / "shared" / "data")) / "drives"
    found = [_read(folder / name, name, count) for name in REAL if (folder / name).exists()]
    if found:
        return found
    with tempfile.TemporaryDirectory() as scratch:
        return [_read(make_drive(Path(scratch)).log, "demo drive (rendered)", count)]


def _read(path: Path, name: str, count: int) -> Images:
    """Library frames at random, images evenly among the others: as a run has them, but none explains itself."""
    log = logs.open(path)
    stamps = log.stamps()
    library = np.sort(np.random.default_rng(0).choice(len(stamps), min(LIBRARY, len(stamps) // 2), replace=False))
    others = np.setdiff1d(np.arange(len(stamps)), library)
    chosen = others[np.linspace(0, len(others) - 1, min(count, len(others))).astype(np.int64)]
    rows = np.union1d(library, chosen)
    image = {row: frame.decode().image for row, frame in zip(rows.tolist(), log.frames(stamps[rows]), strict=True)}
    return Images(name, [image[row] for row in chosen.tolist()], [image[row] for row in library.tolist()])
