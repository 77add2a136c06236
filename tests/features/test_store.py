"""What goes into the scratch file comes out again, from any thread, and nothing is left behind."""

from __future__ import annotations

import resource
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
import pytest

from vplog.data import THUMBNAIL_SIDE, Features
from vplog.errors import ResultError
from vplog.features.store import FeatureStore

if TYPE_CHECKING:
    from pathlib import Path


def _features(seed: int, count: int | None = None) -> Features:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 300)) if count is None else count
    depth = rng.uniform(0, 9, count).astype(np.float32)
    depth[::3] = np.nan
    return Features(
        points=rng.uniform(-0.5, 999, (count, 2)).astype(np.float32),
        sizes=rng.uniform(1, 60, count).astype(np.float32),
        descriptors=rng.integers(0, 256, (count, 128), dtype=np.uint8),
        depth_m=depth,
        width=640 + seed,
        height=480 - seed,
        thumbnail=rng.integers(0, 256, (THUMBNAIL_SIDE, THUMBNAIL_SIDE), dtype=np.uint8) if seed % 3 else None,
    )


def _equal(a: Features, b: Features) -> bool:
    same = all(
        getattr(a, name).dtype == getattr(b, name).dtype
        and getattr(a, name).shape == getattr(b, name).shape
        and getattr(a, name).tobytes() == getattr(b, name).tobytes()
        for name in ("points", "sizes", "descriptors", "depth_m")
    )
    assert (a.thumbnail is None) == (b.thumbnail is None)
    if a.thumbnail is not None and b.thumbnail is not None:
        same = same and np.array_equal(a.thumbnail, b.thumbnail)
    return same and (a.width, a.height) == (b.width, b.height)


def test_features_come_back_bit_by_bit(tmp_path: Path) -> None:
    images = [_features(seed) for seed in range(10)] + [_features(99, 0), _features(98, 1)]
    with FeatureStore(tmp_path / "scratch") as store:
        for row, features in enumerate(images):
            store.append(features)
            assert len(store) == row + 1
            assert _equal(store[row // 2], images[row // 2])  # reading between writing harms neither
        assert all(_equal(store[row], images[row]) for row in reversed(range(len(images))))


def test_threads_read_at_once(tmp_path: Path) -> None:
    images = [_features(seed) for seed in range(40)]
    with FeatureStore(tmp_path / "scratch") as store:
        for features in images:
            store.append(features)
        rows = np.random.default_rng(0).integers(0, 40, 1000).tolist()
        with ThreadPoolExecutor(8) as pool:
            found = list(pool.map(store.__getitem__, rows))
    assert all(_equal(features, images[row]) for features, row in zip(found, rows, strict=True))


def test_the_file_goes_when_done_and_when_it_fails(tmp_path: Path) -> None:
    path = tmp_path / "scratch"
    with FeatureStore(path) as store:
        store.append(_features(1))
        assert path.exists()
    assert not path.exists()
    with pytest.raises(KeyError), FeatureStore(path):
        raise KeyError
    assert not path.exists()


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="Cannot write"):
        FeatureStore(tmp_path / "no" / "scratch")


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "scratch"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        with pytest.raises(ResultError, match="Cannot store features"), FeatureStore(path) as store:
            resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))  # files stop growing as on a full disk
            for seed in range(20):
                store.append(_features(seed, 60))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not path.exists()
