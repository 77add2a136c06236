"""landmarks.parquet gives back what was written, to the steps that it says."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.loops.scene import camera, empty, pose, scene, view
from vplog.errors import ResultError
from vplog.results.landmark_table import LandmarkTable, quantised, restored, write_landmarks

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Features, Floats

LENS = camera("plumb_bob", (-0.1, 0.01, 0.0, 0.0, 0.0))


def keyframes(count: int) -> list[tuple[Features, Floats]]:
    rng = np.random.default_rng(0)
    world = scene(rng)
    found = [view(world, pose(row * 0.5), LENS, rng, depth=True, clutter=0) for row in range(count - 1)]
    return [(own, np.full(len(own), 0.01)) for own in [*found, empty(LENS)]]


def test_values_come_back(tmp_path: Path) -> None:
    written = keyframes(20)  # more than a row group
    write_landmarks(tmp_path / "landmarks.parquet", written, LENS, "depth", "key")
    table = LandmarkTable(tmp_path / "landmarks.parquet", "key")
    assert (len(table), table.scale) == (20, "depth")
    assert np.array_equal(table.camera.body_from_camera, LENS.body_from_camera)
    assert np.array_equal(table.camera.distortion, LENS.distortion)
    for row, (own, sigma) in enumerate(written):
        found, found_sigma = table[row]
        assert np.allclose(found.points, own.points, atol=0.01)
        assert np.allclose(1.0 / found.depth_m, 1.0 / own.depth_m, rtol=1e-3)
        assert np.allclose(found_sigma, sigma, rtol=1e-3)
        assert np.abs(found.descriptors.astype(int) - own.descriptors).max(initial=0) < 16
    with pytest.raises(ResultError, match="keyframe 32"):
        table[32]


def test_a_table_of_another_state_is_refused(tmp_path: Path) -> None:
    write_landmarks(tmp_path / "landmarks.parquet", keyframes(2), LENS, "depth", "key")
    with pytest.raises(ResultError, match="another state"):
        LandmarkTable(tmp_path / "landmarks.parquet", "other key")
    data = (tmp_path / "landmarks.parquet").read_bytes()
    (tmp_path / "landmarks.parquet").write_bytes(data[: len(data) // 2])
    with pytest.raises(ResultError, match="cannot be read"):
        LandmarkTable(tmp_path / "landmarks.parquet", "key")


@pytest.mark.parametrize("name", ["y", "inverse_depth", "sigma", "descriptors"])
def test_columns_of_different_length_are_one_line(tmp_path: Path, name: str) -> None:
    path = tmp_path / "landmarks.parquet"
    write_landmarks(path, keyframes(3), LENS, "depth", "key")
    table = pq.read_table(path)
    at, values = table.schema.get_field_index(name), table[name].to_pylist()
    values[1] = values[1][:-1]
    changed = table.set_column(at, table.schema.field(at), pa.array(values, table.schema.field(at).type))
    pq.write_table(changed, path)
    with pytest.raises(ResultError, match="keyframe 1 cannot be read: columns of different length"):
        LandmarkTable(path, "key")[1]


def test_four_bits_stand_for_the_middle_of_their_values() -> None:
    values = np.arange(256, dtype=np.uint8)[None].repeat(2, 0)
    found = restored(quantised(values))
    assert quantised(values).shape == (2, 128)
    assert np.array_equal(found >> 4, values >> 4)
    assert (found[values < 16] == 0).all()
