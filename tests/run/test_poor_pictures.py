"""Drives whose pictures are poor: what is recognised all the same, and what is said of them."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from vplog.data import Features, Keyframes, Odometry
from vplog.execution.execution import Execution
from vplog.features.sift import SiftSettings
from vplog.geometry import se3
from vplog.pipeline import load_pipeline, run
from vplog.run.cache.feature_shards import Extracted, packed
from vplog.run.cache.stage_cache import sealed
from vplog.run.feature_extraction import decoded
from vplog.verbs.demo import SMALL, make_drive
from vplog.verbs.evaluate_run import evaluate

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

QUICK = (
    "features.max_features=600", "places.neighbours=8", "propose.per_query=2", "verify.calibration.pairs=0",
    "pictures.closures=0", "pictures.megapixels=0",
)  # fmt: skip


def test_a_small_camera_recognises_its_revisits(tmp_path: Path) -> None:
    drive = make_drive(tmp_path / "drive", SMALL.model_copy(update={"width": 160, "height": 120}))
    found = {}
    for least in (0, 300):
        settings = load_pipeline("default", (*QUICK, f"features.min_features={least}"))
        done = run(drive.log, tmp_path / "run", settings, execution=Execution(2))
        closures = evaluate(tmp_path / "run", str(drive.truth))["closures"]
        assert closures["accepted_false"] == 0
        poor = [line for line in done.record["warnings"] if line.startswith("Pictures are")]
        found[least] = closures["recall"], poor
    assert found[300][0] > found[0][0] + 0.3
    assert not found[0][1]
    assert "small (160 x 120 px)" in found[300][1][0]


def test_good_pictures_are_called_nothing(finished: Path) -> None:
    from vplog.results.run_record import read_run_json
    from vplog.run.feature_extraction import stored_features

    features = stored_features(finished / ".cache")
    assert features is not None
    assert min(features.counts) > 300
    assert [len(features[row]) for row in range(3)] == features.counts[:3]
    assert np.all(["Pictures are" not in line for line in read_run_json(finished / "run.json")["warnings"]])


@pytest.mark.parametrize(
    ("frozen", "left_out"), [((), []), ((4, 5), [4, 5]), ((9,), [9]), (range(1, 12), range(1, 12))]
)
@pytest.mark.parametrize("turn", [False, True])
def test_pictures_of_a_camera_that_froze_are_matched_with_nothing(
    turn: bool, frozen: Sequence[int], left_out: Sequence[int], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Each keyframe is 1 m or 10 degrees from the one before, but for 7 and 8, where the body stands; the depth of a
    picture that repeats may be new. As many features prove nothing."""
    rng, count = np.random.default_rng(5), 12
    step = np.array([0, 0, np.radians(10), 0, 0, 0] if turn else [0, 0, 0, 1.0, 0, 0])
    moved = np.arange(count) - np.clip(np.arange(count) - 6.0, 0, 2)
    poses = se3.exp(moved[:, None] * step)
    found = list[tuple[int, Features, bytes]]()
    for row in range(count):
        points, descriptors = rng.random((9, 2), np.float32), rng.integers(0, 255, (9, 128)).astype(np.uint8)
        new = Features(points, np.ones(9, np.float32), descriptors, np.ones(9, np.float32), 64, 48)
        depth_m = rng.random(9, np.float32)
        repeats = row in frozen or row in (7, 8)
        found.append((10**9 * row, replace(found[-1][1], depth_m=depth_m) if repeats else new, b""))
    (tmp_path / "part").write_bytes(sealed("0" * 64, packed(found, [], [])))
    features = Extracted()
    features.add(tmp_path / "part")
    keyframes = Keyframes("drive", np.arange(count) * 10**9, poses)
    odometry = Odometry(keyframes.stamp_ns, poses, None)
    rest, new_features = decoded(keyframes, features, SiftSettings(min_features=0), odometry, "/cam")
    assert rest.stamp_ns.tolist() == new_features.stamp_ns == keyframes.stamp_ns.tolist()
    assert new_features.counts == [0 if row in left_out else 9 for row in range(count)]
    for row, (_, one, _) in enumerate(found):
        assert new_features[row].points.tolist() == ([] if row in left_out else one.points.tolist())
    unit = replace(odometry, metric=False)
    assert decoded(keyframes, features, SiftSettings(min_features=0), unit, "/cam")[1].counts == [9] * count
    assert (new_features.token == features.token) == (not left_out) == (not caplog.messages)
