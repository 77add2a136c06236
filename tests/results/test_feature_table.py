"""Features that a map keeps come back as they were, the strongest of them, and only for what they were made from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from vplog.data import Features
from vplog.errors import ResultError
from vplog.results.feature_table import FeatureTable, write_features

if TYPE_CHECKING:
    from pathlib import Path


def image(count: int, seed: int) -> Features:
    random = np.random.default_rng(seed)
    return Features(
        points=random.uniform(0, 600, (count, 2)).astype(np.float32),
        sizes=random.uniform(1, 9, count).astype(np.float32),
        descriptors=random.integers(0, 256, (count, 128), dtype=np.uint8),
        depth_m=np.where(random.random(count) < 0.5, np.nan, 3.0).astype(np.float32),
        width=640,
        height=480,
    )


def test_the_strongest_come_back(tmp_path: Path) -> None:
    images = [image(count, seed) for seed, count in enumerate((30, 0, 12, 50))]
    path = tmp_path / "features.parquet"
    write_features(path, len(images), images.__getitem__, 20, "a" * 64)
    kept = FeatureTable(path, "a" * 64, 20)
    assert len(kept) == len(images)
    for row in (3, 0, 2, 1, 3):
        found, true = kept[row], images[row]
        assert (found.width, found.height) == (640, 480)
        for name in ("points", "sizes", "descriptors", "depth_m"):
            np.testing.assert_array_equal(getattr(found, name), getattr(true, name)[:20])
    kept.close()


@pytest.mark.parametrize(("made_from", "most"), [("b" * 64, 20), ("a" * 64, 21)])
def test_what_is_not_the_drive_s_is_refused(tmp_path: Path, made_from: str, most: int) -> None:
    path = tmp_path / "features.parquet"
    write_features(path, 1, lambda _: image(5, 0), 20, "a" * 64)
    with pytest.raises(ResultError, match="another state"):
        FeatureTable(path, made_from, most)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(ResultError, match="cannot be read"):
        FeatureTable(path, "a" * 64, 20)
